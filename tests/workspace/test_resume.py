"""What a stage took is counted over all runs that had a part in it."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from corrsfm import config as cfg
from corrsfm.types import Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.items import PrunedMatches
from corrsfm.workspace.resume import complete
from corrsfm.workspace.stores import pruned_of

A, B, C = ("a", "b"), ("a", "c"), ("b", "c")
SECONDS_EACH = 10.0
ONE, TWO = cfg.PruneMethod.RATIO, cfg.PruneMethod.LORANSAC


class Work:
    """Makes items that take ten seconds each by a clock of its own, and breaks off where told."""

    def __init__(self, workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
        self.workspace = workspace
        self.now = 0.0
        self.made: list[Pair] = []
        monkeypatch.setattr(time, "monotonic", lambda: self.now)

    def run(
        self, wanted: dict[Pair, str], *, name: cfg.PruneMethod = ONE, stop_at: Pair | None = None
    ) -> float:
        """The seconds on record afterwards."""

        def produce(missing: list[Pair]) -> Iterator[tuple[Pair, PrunedMatches]]:
            for key in missing:
                if key == stop_at:
                    raise KeyboardInterrupt
                self.now += SECONDS_EACH
                self.made.append(key)
                indices = np.zeros((1, 2), np.int32)
                yield key, PrunedMatches(indices=indices, scores=np.ones(1, np.float32), num_putative=1)

        complete(
            self.workspace,
            "pruned matches",
            pruned_of(self.workspace, name),
            wanted,
            produce,
            cfg.PruneConfig(method=name),
            inputs={"matches": name},
            overwrite=False,
            unit="pair",
        )
        record = self.workspace.record_of("pruned matches")
        assert record is not None
        return record.seconds


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Work:
    return Work(Workspace(tmp_path / "scene", create=True), monkeypatch)


def test_an_interrupted_run_and_the_one_that_went_on_count_together(work: Work) -> None:
    wanted = {A: "1", B: "1", C: "1"}
    with pytest.raises(KeyboardInterrupt):
        work.run(wanted, stop_at=C)
    assert work.run(wanted) == 30.0
    assert work.run(wanted) == 30.0
    assert work.made == [A, B, C]


def test_what_was_kept_counts_its_share_and_what_was_made_again_its_own_time(work: Work) -> None:
    assert work.run({A: "1", B: "1", C: "1"}) == 30.0
    assert work.run({A: "1", B: "1", C: "2"}) == 30.0
    assert work.run({A: "1", B: "1"}) == 20.0
    assert work.made == [A, B, C, C]


def test_another_file_in_between_costs_neither_its_items_nor_their_seconds(work: Work) -> None:
    wanted = {A: "1", B: "1"}
    assert work.run(wanted, name=ONE) == 20.0
    before = work.workspace.pruned.read_bytes()
    assert work.run({A: "2"}, name=TWO) == 10.0
    assert work.workspace.pruned.read_bytes() != before
    assert work.run(wanted, name=ONE) == 20.0
    assert work.workspace.pruned.read_bytes() == before
    assert work.made == [A, B, A]


def test_an_unfinished_file_waits_for_its_turn(work: Work) -> None:
    wanted = {A: "1", B: "1"}
    with pytest.raises(KeyboardInterrupt):
        work.run(wanted, name=ONE, stop_at=B)
    work.run(wanted, name=TWO)
    assert work.run(wanted, name=ONE) == 20.0
    assert work.made == [A, A, B, B]
