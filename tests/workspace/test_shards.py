"""Shards: what workers leave is merged by this run or the next; what they did not finish is made again."""

import contextlib
import logging
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from corrsfm import config as cfg
from corrsfm.errors import ClusterError, ImageError
from corrsfm.types import Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.items import PRUNED, PrunedMatches
from corrsfm.workspace.resume import complete
from corrsfm.workspace.shards import Shard, blocks, fill_shard, make_items, merge_shards, shards_of
from corrsfm.workspace.store import ItemStore

PAIRS: list[Pair] = [(f"{a}.jpg", f"{b}.jpg") for a in range(5) for b in range(a + 1, 5)]
WANTED = {pair: f"fingerprint of {pair}" for pair in PAIRS}

logger = logging.getLogger("corrsfm")


def item(pair: Pair) -> PrunedMatches:
    number = PAIRS.index(pair)
    return PrunedMatches(
        indices=np.full((number, 2), number, np.int32), scores=np.ones(number, np.float32), num_putative=20
    )


def work(workspace: Workspace, pairs: Iterable[Pair], run: cfg.RunConfig) -> Iterator[tuple[Pair, Any]]:
    assert (run.threads, run.cluster, run.workers) == (3, None, 0)
    assert workspace.root.is_absolute()
    for pair in pairs:
        logger.warning("%s: looks odd", pair)
        yield pair, ImageError(f"{pair[0]}: is gone") if pair == PAIRS[7] else item(pair)


def broken(workspace: Workspace, pairs: Iterable[Pair], run: cfg.RunConfig) -> Iterator[tuple[Pair, Any]]:
    yield PAIRS[0], item(PAIRS[0])
    raise RuntimeError("no memory")


class OneByOne:
    """A cluster that does its tasks at once, in this process."""

    address = "tcp://nowhere:1"

    def __init__(self, stop_after: int = 1000) -> None:
        self.num_left = stop_after

    def count_slots(self) -> int:
        return 1

    def outcomes(self, function: Any, tasks: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        for key, arguments in tasks:
            if not self.num_left:
                raise ClusterError("the scheduler is gone")
            self.num_left -= 1
            try:
                yield key, function(*arguments)
            except Exception as error:
                yield key, error


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    monkeypatch.chdir(tmp_path)
    return Workspace(Path("scene"), create=True)


@pytest.fixture
def store(workspace: Workspace) -> ItemStore[Pair, PrunedMatches]:
    return ItemStore(workspace.pruned_by("ratio"), PRUNED)


RUN = cfg.RunConfig(threads=3, cluster="tcp://nowhere:1")


def run_stage(workspace: Workspace, store: Any, cluster: Any, function: Any = work, **options: Any) -> Any:
    wanted = dict(WANTED)

    def produce(missing: list[Pair]) -> Iterator[tuple[Pair, Any]]:
        for key, made in make_items(
            cluster, workspace, store, function, missing, lambda pair: pair, wanted, RUN
        ):
            yield key, item(key) if isinstance(made, ImageError) else made

    return complete(
        workspace, "pruned matches", store, wanted, produce, cfg.PruneConfig(),
        inputs={}, overwrite=options.get("overwrite", False), unit="pair",
    )  # fmt: skip


def check(store: Any) -> None:
    assert store.finished(WANTED) == set(WANTED)
    for pair in PAIRS:
        assert np.array_equal(store.read(pair).indices, item(pair).indices)


def test_the_items_of_all_shards_are_in_the_store_and_no_shard_is_left(
    workspace: Workspace, store: Any, caplog: pytest.LogCaptureFixture
) -> None:
    outcome = run_stage(workspace, store, OneByOne())
    assert (outcome.num_items, outcome.num_reused) == (10, 0)
    check(store)
    assert not workspace.shards.exists()
    # In the log of this process both the worker and the one that sent the work speak.
    assert caplog.messages.count("('0.jpg', '1.jpg'): looks odd") == 2
    assert sum("looks odd" in message for message in caplog.messages) == len(PAIRS) + 1


def test_shards_that_a_killed_run_left_are_merged_by_the_next(workspace: Workspace, store: Any) -> None:
    with pytest.raises(ClusterError):
        run_stage(workspace, store, OneByOne(stop_after=2))
    assert len(store.finished(WANTED)) == 4
    folder = shards_of(workspace, store)
    folder.mkdir(parents=True, exist_ok=True)
    rest = {pair: WANTED[pair] for pair in PAIRS[8:]}
    run = cfg.RunConfig(threads=3)
    fill_shard(str(workspace.root.absolute()), str(folder), ".db", "pruned", work, list(rest), rest, run, 1)
    (folder / ".half.db").write_bytes(b"half")
    (folder / "damaged.db").write_bytes(b"rubbish")
    outcome = run_stage(workspace, store, OneByOne())
    assert outcome.num_reused == 6
    check(store)
    assert not workspace.shards.exists()


def test_shards_of_other_options_leave_a_finished_store_finished(workspace: Workspace, store: Any) -> None:
    run_stage(workspace, store, OneByOne())
    # Another method's store is the one that the record is about.
    workspace.forget("pruned matches")
    folder = shards_of(workspace, store)
    folder.mkdir(parents=True, exist_ok=True)
    other = dict.fromkeys(PAIRS[:2], "other options")
    run = cfg.RunConfig(threads=3)
    fill_shard(str(workspace.root.absolute()), str(folder), ".db", "pruned", work, list(other), other, run, 1)
    run_stage(workspace, store, OneByOne())
    check(store)
    assert store.seal() is not None


def test_when_all_is_made_again_no_shard_counts(workspace: Workspace, store: Any) -> None:
    run_stage(workspace, store, OneByOne())
    assert run_stage(workspace, store, OneByOne()).skipped
    outcome = run_stage(workspace, store, OneByOne(), overwrite=True)
    assert outcome.num_reused == 0


def test_a_block_that_fails_leaves_no_file_and_ends_the_stage(workspace: Workspace, store: Any) -> None:
    with pytest.raises(ClusterError, match=r"RuntimeError: no memory\); finished work is kept"):
        run_stage(workspace, store, OneByOne(), broken)
    assert list(shards_of(workspace, store).iterdir()) == []


def test_a_worker_stops_when_nobody_waits_for_its_block_and_leaves_nothing(
    workspace: Workspace, tmp_path: Path
) -> None:
    gone = tmp_path / "scene" / ".shards" / "ratio"
    with pytest.raises(ClusterError, match="nobody waits"):
        fill_shard(
            str(tmp_path / "scene"), str(gone), ".db", "pruned", work, PAIRS, WANTED,
            cfg.RunConfig(threads=3), 1,
        )  # fmt: skip
    assert not gone.exists()


def test_a_finished_stage_removes_what_a_late_worker_wrote(workspace: Workspace, store: Any) -> None:
    run_stage(workspace, store, OneByOne())
    shards_of(workspace, store).mkdir(parents=True)
    (shards_of(workspace, store) / "late.db").touch()
    assert run_stage(workspace, store, OneByOne()).skipped
    assert not workspace.shards.exists()


def test_a_shard_says_which_items_could_not_be_made(workspace: Workspace, tmp_path: Path) -> None:
    wanted = {pair: WANTED[pair] for pair in PAIRS[6:8]}
    shard = fill_shard(
        str(tmp_path / "scene"), str(tmp_path), ".db", "pruned", work, list(wanted), wanted,
        cfg.RunConfig(threads=3), 1,
    )  # fmt: skip
    assert isinstance(shard, Shard)
    assert {pair: str(error) for pair, error in shard.failures.items()} == {
        PAIRS[7]: f"{PAIRS[7][0]}: is gone"
    }
    assert ItemStore(tmp_path / shard.name, PRUNED).finished(WANTED) == {PAIRS[6]}
    assert shard.warnings == {"%s: looks odd": f"{PAIRS[6]}: looks odd"}


def test_merging_nothing_does_nothing(workspace: Workspace, store: Any) -> None:
    assert merge_shards(workspace, store) == 0
    assert not store.path.exists()


def test_blocks_hold_every_key_once_and_pairs_that_share_photos() -> None:
    names = [f"{number:03}.jpg" for number in range(200)]
    pairs = [(names[a], names[b]) for a in range(200) for b in range(a + 1, min(200, a + 11))]
    made = list(blocks(pairs, 4))
    assert sorted(pair for block in made for pair in block) == pairs
    assert max(map(len, made)) <= 128
    photos = [len({name for pair in block for name in pair}) for block in made]
    assert max(photos) <= 40
    assert [len(block) for block in blocks(names, 1)] == [16] * 12 + [8]
    assert [len(block) for block in blocks(names[:8], 16)] == [1] * 8
    assert list(blocks([], 3)) == []


def test_whole_items_of_a_damaged_shard_are_kept(workspace: Workspace, store: Any) -> None:
    folder = shards_of(workspace, store)
    folder.mkdir(parents=True)
    wanted = {pair: WANTED[pair] for pair in PAIRS[:4]}
    shard = fill_shard(
        str(workspace.root.absolute()), str(folder), ".db", "pruned", work, list(wanted), wanted,
        cfg.RunConfig(threads=3), 1,
    )  # fmt: skip
    with contextlib.closing(sqlite3.connect(folder / shard.name)) as connection, connection:
        connection.execute("UPDATE arrays SET data = x'00' WHERE number = 2")
    assert merge_shards(workspace, store) == 1
    kept = store.finished(WANTED)
    assert len(kept) == 3 and kept < wanted.keys()
    assert not workspace.shards.exists()
