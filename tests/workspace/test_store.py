"""The store of items: exact round trips, nothing lost by a kill, and every changed byte noticed."""

import contextlib
import multiprocessing
import os
import re
import signal
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest

from corrsfm.errors import DamageError, WorkspaceError
from corrsfm.types import Features, Matches, PruneResult, TwoViewModel
from corrsfm.workspace import mending
from corrsfm.workspace import store as store_module
from corrsfm.workspace.items import FEATURES, MATCHES, PRUNED, PrunedMatches
from corrsfm.workspace.store import ItemStore


def make_features(num: int = 5, seed: int = 0) -> Features:
    rng = np.random.default_rng(seed)
    return Features(
        keypoints=rng.uniform(0, 640, (num, 2)).astype(np.float32),
        scales=rng.uniform(1, 9, num).astype(np.float32),
        orientations=rng.uniform(-3, 3, num).astype(np.float32),
        scores=rng.uniform(0, 1, num).astype(np.float32),
        descriptors=rng.integers(0, 256, (num, 128)).astype(np.uint8),
        image_size=(640, 480),
    )


def make_matches(largest: int = 7) -> Matches:
    return Matches(
        indices=np.array([[0, largest], [1, 3], [4, largest]], np.int32),
        ratios=np.array([0.25, 0.5, 1.0], np.float32),
        mutual=np.array([True, False, True]),
    )


def assert_same(left: object, right: object) -> None:
    for name, value in vars(left).items():
        np.testing.assert_array_equal(value, getattr(right, name), err_msg=name)


@pytest.fixture
def store(tmp_path: Path) -> ItemStore:
    return ItemStore(tmp_path / "features.db", FEATURES, remedy="corrsfm extract photos scene")


def fill(store: ItemStore, names: str = "abc", fingerprint: str = "1") -> ItemStore:
    for name in names:
        store.add(name, fingerprint, make_features(200, seed=ord(name)), 2.0)
    store.commit(dict.fromkeys(names, fingerprint), "sealed")
    return store


def test_features_come_back_exactly_as_they_went_in(store: ItemStore) -> None:
    features = make_features()
    store.add("a/b.jpg", "f", features)
    store.commit({"a/b.jpg": "f"})
    assert_same(store.read("a/b.jpg"), features)


def test_descriptors_of_networks_come_back_in_half_precision(store: ItemStore) -> None:
    floats = np.random.default_rng(0).normal(size=(5, 64)).astype(np.float32)
    features = make_features()
    learned = Features(
        keypoints=features.keypoints, scales=None, orientations=None, scores=features.scores,
        descriptors=floats, image_size=(640, 480),
    )  # fmt: skip
    store.add("a", "f", learned)
    back = store.read("a")
    assert back.scales is None and back.orientations is None
    np.testing.assert_array_equal(back.descriptors, floats.astype(np.float16).astype(np.float32))


@pytest.mark.parametrize("largest", [7, 65_535, 65_536])
def test_matches_come_back_exactly_as_they_went_in(tmp_path: Path, largest: int) -> None:
    store = ItemStore(tmp_path / "matches.db", MATCHES)
    store.add(("x/a.jpg", "b.jpg"), "f", make_matches(largest))
    assert_same(store.read(("x/a.jpg", "b.jpg")), make_matches(largest))


def test_no_features_and_no_matches_round_trip(store: ItemStore, tmp_path: Path) -> None:
    store.add("a.jpg", "f", make_features(0))
    assert len(store.read("a.jpg")) == 0
    matches = ItemStore(tmp_path / "matches.db", MATCHES)
    none = Matches(
        indices=np.zeros((0, 2), np.int32), ratios=np.zeros(0, np.float32), mutual=np.zeros(0, bool)
    )
    matches.add(("a", "b"), "f", none)
    assert len(matches.read(("a", "b"))) == 0


def test_pruned_matches_keep_order_model_and_counts(tmp_path: Path) -> None:
    matches = make_matches()
    model = TwoViewModel(kind="fundamental", matrix=np.arange(9.0).reshape(3, 3))
    result = PruneResult(
        scores=np.array([0.5, 0.1, 0.9], np.float32),
        inlier_mask=np.array([True, False, True]),
        model=model,
        decided_by="loransac",
    )
    store = ItemStore(tmp_path / "pruned.db", PRUNED)
    store.add(("a", "b"), "f", PrunedMatches.from_result(matches, result))
    back = store.read(("a", "b"))
    np.testing.assert_array_equal(back.indices, [[0, 7], [4, 7]])
    np.testing.assert_array_equal(back.scores, np.array([0.5, 0.9], np.float32))
    assert back.num_putative == 3 and back.decided_by == "loransac"
    assert back.model is not None and back.model.kind == "fundamental"
    np.testing.assert_array_equal(back.model.matrix, model.matrix)
    ((pair, counts),) = store.attributes([("a", "b")])
    assert pair == ("a", "b") and (counts["num_putative"], counts["num_kept"]) == (3, 2)


def test_a_pair_pruned_to_nothing_stays_recorded(tmp_path: Path) -> None:
    result = PruneResult(scores=np.zeros(3, np.float32), inlier_mask=np.zeros(3, bool))
    store = ItemStore(tmp_path / "pruned.db", PRUNED)
    store.add(("a", "b"), "f", PrunedMatches.from_result(make_matches(), result))
    assert store.read(("a", "b")).num_putative == 3
    assert len(store.read(("a", "b")).indices) == 0


def test_finished_items_are_those_with_the_wanted_fingerprint(store: ItemStore) -> None:
    fill(store)
    store.add("d", "1", make_features())
    assert store.finished({"a": "1", "b": "2", "d": "1", "e": "1"}) == {"a", "d"}
    store.close()
    assert store.finished({"a": "1", "b": "2", "d": "1", "e": "1"}) == {"a", "d"}


def test_commit_keeps_what_is_wanted_and_drops_the_rest(store: ItemStore) -> None:
    fill(store)
    store.add("b", "2", make_features(seed=9), 5.0)
    store.commit({"a": "1", "b": "2"})
    assert store.seconds() == 7.0
    assert_same(store.read("a"), make_features(200, seed=ord("a")))
    assert_same(store.read("b"), make_features(seed=9))
    with pytest.raises(WorkspaceError, match="holds nothing for c; run: corrsfm extract photos scene"):
        store.read("c")


@pytest.mark.parametrize("wanted", [{"a": "2"}, {"a": "1", "z": "1"}])
def test_a_stage_is_not_finished_without_every_item(store: ItemStore, wanted: dict[str, str]) -> None:
    fill(store)
    with pytest.raises(WorkspaceError, match="was never finished"):
        store.commit(wanted)
    store.close()
    assert store.finished(dict.fromkeys("abc", "1")) == set("abc")


def test_what_is_there_is_not_written_again(store: ItemStore) -> None:
    num = 400
    for number in range(num):
        store.add(f"{number}", "1", make_features(50, seed=number))
    wanted = {f"{number}": "1" for number in range(num)}
    store.commit(wanted)
    before = store.path.read_bytes()
    store.add("7", "2", make_features(50, seed=1000))
    store.commit(wanted | {"7": "2"})
    after = store.path.read_bytes()
    page = 4096
    changed = sum(
        before[start : start + page] != after[start : start + page] for start in range(0, len(after), page)
    )
    assert changed < 20 < len(after) / page / 10


def test_a_file_shrinks_when_most_of_it_is_gone(store: ItemStore) -> None:
    fill(store, "abcdefgh")
    size = store.path.stat().st_size
    store.commit({"a": "1"})
    assert store.path.stat().st_size < size / 3
    assert_same(store.read("a"), make_features(200, seed=ord("a")))


def _add_forever(path: Path) -> None:
    store = ItemStore(path, FEATURES)
    for number in range(10_000):
        store.add(f"{number:05d}", "f", make_features(200, seed=number))
        path.with_name("count").write_text(f"{number}", encoding="utf-8")


def test_a_killed_writer_loses_nothing_that_it_had_added(tmp_path: Path) -> None:
    path, count = tmp_path / "features.db", tmp_path / "count"
    process = multiprocessing.get_context("spawn").Process(target=_add_forever, args=(path,))
    process.start()
    while not (count.exists() and int(count.read_text(encoding="utf-8") or 0) > 20):
        assert process.is_alive()
        time.sleep(0.01)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    added = int(count.read_text(encoding="utf-8") or 0)
    store = ItemStore(path, FEATURES)
    done = sorted(store.finished({f"{number:05d}": "f" for number in range(10_000)}))
    assert len(done) > added
    assert done == [f"{number:05d}" for number in range(len(done))]
    store.commit({name: "f" for name in done})
    assert_same(store.read(done[-1]), make_features(200, seed=int(done[-1])))


def test_a_power_cut_takes_the_last_two_seconds_at_most(
    store: ItemStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What SQLite has flushed lies in the file itself; the log beside it may be lost.
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    names = [f"{number:02d}" for number in range(30)]
    for number, name in enumerate(names):
        now = 0.5 * number
        store.add(name, "1", make_features(20, seed=number))
        on_disk = tmp_path / f"cut-{number}.db"
        on_disk.write_bytes(store.path.read_bytes())
        with contextlib.closing(sqlite3.connect(on_disk)) as left:
            num = left.execute("SELECT count(*) FROM items").fetchone()[0] if number > 4 else number
        assert num >= number + 1 - 4
    store.commit(dict.fromkeys(names, "1"))
    on_disk = ItemStore(tmp_path / "end.db", FEATURES)
    on_disk.path.write_bytes(store.path.read_bytes())
    assert on_disk.finished(dict.fromkeys(names, "1")) == set(names) and not on_disk.find_damage()


def test_what_is_finished_was_flushed(store: ItemStore, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed: list[str] = []
    monkeypatch.setattr(store_module, "sync_folder", lambda folder: flushed.append(folder.name))
    fill(store)
    assert flushed == [store.path.parent.name]
    with contextlib.closing(sqlite3.connect(store.path)) as plain:
        assert plain.execute("PRAGMA journal_mode").fetchone() == ("delete",)
    connection = store._writer()
    # Checkpoints of NORMAL and FULL flush the log before, and the file after they copy.
    assert connection.execute("PRAGMA synchronous").fetchone()[0] >= 1


def test_between_runs_there_is_one_file_that_a_read_only_disk_can_hold(store: ItemStore) -> None:
    fill(store)
    assert sorted(path.name for path in store.path.parent.iterdir()) == ["features.db"]
    store.path.chmod(0o444)
    store.path.parent.chmod(0o555)
    try:
        assert_same(store.read("a"), make_features(200, seed=ord("a")))
    finally:
        store.path.parent.chmod(0o755)


def test_another_file_in_its_place_is_refused(store: ItemStore, tmp_path: Path) -> None:
    fill(store)
    sealed = ItemStore(store.path, FEATURES, remedy="corrsfm extract photos scene", seal="sealed")
    assert len(sealed.read("a")) == 200
    other = ItemStore(store.path, FEATURES, remedy="corrsfm extract photos scene", seal="another")
    with pytest.raises(WorkspaceError, match="is not the file that its step wrote; run: .* --verify"):
        other.read("a")
    with pytest.raises(DamageError, match="holds features, expected matches"):
        ItemStore(store.path, MATCHES).read(("a", "b"))


@pytest.mark.parametrize("way", ["add", "absorb", "mend"])
def test_a_file_that_was_changed_is_not_taken_for_the_finished_one(
    store: ItemStore, tmp_path: Path, way: str
) -> None:
    shard = fill(ItemStore(tmp_path / "shard.db", FEATURES), "b", "2")
    fill(store)
    assert store.seal() == "sealed"
    if way == "add":
        store.add("a", "2", make_features())
    elif way == "absorb":
        store.absorb(shard.path)
    else:
        with contextlib.closing(sqlite3.connect(store.path)) as file, file:
            file.execute("UPDATE arrays SET checksum = 0 WHERE number = 1")
        assert store.mend()
    store.close()
    assert store.seal() is None


def test_who_shares_a_file_keeps_what_it_has(store: ItemStore, tmp_path: Path) -> None:
    fill(store)
    other = tmp_path / "other.db"
    os.link(store.path, other)
    store.add("a", "2", make_features(seed=9))
    store.commit({"a": "2"})
    assert ItemStore(other, FEATURES).held("abc") == dict.fromkeys("abc", "1")


def test_a_link_is_not_written_through(store: ItemStore, tmp_path: Path) -> None:
    target = tmp_path / "elsewhere"
    target.write_text("precious", encoding="utf-8")
    store.path.symlink_to(target)
    with pytest.raises(WorkspaceError, match="is a link"):
        store.add("a", "1", make_features())
    assert target.read_text(encoding="utf-8") == "precious"


def test_a_shard_is_absorbed(store: ItemStore, tmp_path: Path) -> None:
    fill(store, "ab")
    shard = fill(ItemStore(tmp_path / "shard.db", FEATURES), "bc", "2")
    assert store.absorb(shard.path) == 2
    store.commit({"a": "1", "b": "2", "c": "2"})
    assert_same(store.read("c"), make_features(200, seed=ord("c")))


def test_every_changed_byte_of_an_item_is_noticed_and_costs_that_item_only(store: ItemStore) -> None:
    fill(store)
    whole = store.path.read_bytes()
    rng = np.random.default_rng(0)
    silent = 0
    for _ in range(60):
        place = int(rng.integers(len(whole)))
        changed = bytearray(whole)
        changed[place] ^= 1 << int(rng.integers(8))
        store.path.write_bytes(changed)
        for name in "abc":
            try:
                features = store.read(name)
            except WorkspaceError:
                continue
            assert_same(features, make_features(200, seed=ord(name)))
        lost = store.mend()
        store.close()
        silent += not lost
        kept = store.finished(dict.fromkeys("abc", "1"))
        assert len(kept) >= 2 or lost
        for name in kept:
            assert_same(store.read(name), make_features(200, seed=ord(name)))
        for name in set("abc") - kept:
            store.add(name, "1", make_features(200, seed=ord(name)))
        store.commit(dict.fromkeys("abc", "1"))
        for beside in store.path.parent.glob("*.damaged*"):
            beside.unlink()
    # Bytes that mean nothing, such as those of free space, harm nothing.
    assert silent < 30


@pytest.mark.parametrize("look_up", [False, True])
def test_a_key_that_is_no_text_any_more_is_damage_and_is_mended(store: ItemStore, look_up: bool) -> None:
    store.add("first photo.jpg", "1", make_features(20, seed=0))
    store.add("second photo.jpg", "1", make_features(20, seed=1))
    store.commit({"first photo.jpg": "1", "second photo.jpg": "1"})
    content = bytearray(store.path.read_bytes())
    # The row holds the key, and so does the index that keys are looked up in.
    places = [found.start() for found in re.finditer(b"first photo", content)]
    assert len(places) == 2
    content[places[look_up] + 2] ^= 0x80
    store.path.write_bytes(content)
    assert store.mend()
    names = ("first photo.jpg", "second photo.jpg")
    for name in set(names) - store.finished(dict.fromkeys(names, "1")):
        store.add(name, "1", make_features(20, seed=0))
    store.commit(dict.fromkeys(names, "1"))
    assert store.find_damage() == []
    assert_same(store.read("second photo.jpg"), make_features(20, seed=1))


@pytest.mark.parametrize(
    "content", [b"", b"not a database at all" * 100, b"SQLite format 3\0" + bytes(4000), None]
)
def test_a_file_that_is_no_store_is_put_aside_and_begun_anew(store: ItemStore, content: bytes | None) -> None:
    if content is None:
        with sqlite3.connect(store.path) as other:
            other.execute("CREATE TABLE something (value)")
    else:
        store.path.write_bytes(content)
    with pytest.raises(DamageError, match="run: corrsfm extract photos scene --verify"):
        store.finished({"a": "1"})
    (lost,) = store.mend()
    assert "0 whole items are kept" in lost
    fill(store)
    assert_same(store.read("a"), make_features(200, seed=ord("a")))


def test_a_truncated_file_keeps_the_items_that_are_whole(store: ItemStore) -> None:
    names = "abcdefgh"
    fill(store, names)
    store.path.write_bytes(store.path.read_bytes()[: store.path.stat().st_size * 2 // 3])
    with pytest.raises(DamageError, match="damaged"):
        store.read("h")
    (lost,) = store.mend()
    store.close()
    kept = store.finished(dict.fromkeys(names, "1"))
    assert f"{len(kept)} whole items are kept" in lost
    assert 3 <= len(kept) < len(names)


def test_a_file_cut_at_any_page_is_mended_and_what_it_keeps_is_right(store: ItemStore) -> None:
    names = "abcdefgh"
    fill(store, names)
    whole = store.path.read_bytes()
    for length in range(0, len(whole), 4096):
        # Off the boundary as well: SQLite takes the two for different damages.
        for cut in (length, length + 1904):
            store.path.write_bytes(whole[:cut])
            store.mend()
            for name in store.finished(dict.fromkeys(names, "1")):
                assert_same(store.read(name), make_features(200, seed=ord(name)))
            store.close()


def test_an_interrupted_mending_costs_no_item(store: ItemStore, monkeypatch: pytest.MonkeyPatch) -> None:
    names = "abcdefgh"
    fill(store, names)
    store.path.write_bytes(store.path.read_bytes()[: store.path.stat().st_size * 2 // 3])

    def interrupt(connection: sqlite3.Connection, row: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(mending, "insert_row", interrupt)
        store.mend()
    assert [path.name for path in store.path.parent.iterdir()] == [store.path.name]
    (lost,) = store.mend()
    assert len(store.finished(dict.fromkeys(names, "1"))) >= 3
    assert "whole items are kept" in lost


def test_a_store_held_by_another_program_is_kept(store: ItemStore, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(store)
    other = sqlite3.connect(store.path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda path, **options: connect(path, timeout=0, **options))
    with pytest.raises(WorkspaceError, match="in use by another program.*close it there") as caught:
        store.add("d", "1", make_features())
    assert not isinstance(caught.value, DamageError)
    other.execute("ROLLBACK")
    store.add("d", "1", make_features())
    assert store.finished({"a": "1", "d": "1"}) == {"a", "d"}


def test_a_full_disk_is_reported_and_keeps_what_is_there(store: ItemStore) -> None:
    fill(store)
    connection = store._writer()
    (num_pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {num_pages}")
    with pytest.raises(WorkspaceError, match="the disk is full.*finished work is kept") as caught:
        store.add("d", "1", make_features(5000))
    assert not isinstance(caught.value, DamageError)
    store.close()
    assert store.finished(dict.fromkeys("abcd", "1")) == set("abc")


def test_a_file_of_another_version_is_put_aside(store: ItemStore) -> None:
    fill(store)
    with sqlite3.connect(store.path) as other:
        other.execute("PRAGMA user_version = 99")
    with pytest.raises(DamageError, match="format version 99"):
        store.read("a")
    (lost,) = store.mend()
    assert "format version 99" in lost and "kept" in lost
    assert set(store.held("abc")) == set("abc")
    store.close()


def test_numbers_up_to_the_last_are_looked_through_in_no_time(store: ItemStore) -> None:
    fill(store)
    with sqlite3.connect(store.path) as other:
        for table in ("items", "arrays"):
            other.execute(f"UPDATE {table} SET number = {2**63 - 1} WHERE number = 2")
        other.execute("PRAGMA user_version = 99")
    (lost,) = store.mend()
    assert f"{len('abc')} whole items are kept" in lost
    store.close()


def test_a_folder_in_its_place_is_put_aside(store: ItemStore) -> None:
    store.path.mkdir()
    (store.path / "notes.txt").write_text("not ours")
    with pytest.raises(DamageError, match="is no file"):
        store.finished({"a": "1"})
    (lost,) = store.mend()
    assert "0 whole items are kept" in lost
    store.close()
    assert store.path.is_file()
    assert (store.path.with_name(f"{store.path.name}.damaged") / "notes.txt").read_text() == "not ours"


def test_the_origin_can_be_asked_for_while_another_process_writes(store: ItemStore) -> None:
    store.clear("from elsewhere")
    store.add("a", "1", make_features())
    assert store.path.with_name("features.db-wal").exists()
    assert ItemStore(store.path, FEATURES).origin() == "from elsewhere"
    store.commit({"a": "1"}, "sealed")
    assert ItemStore(store.path, FEATURES).origin() == "from elsewhere"
    store.clear()
    assert store.origin() is None and not store.finished({"a": "1"})


ENDLESS = "CREATE VIEW {} AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n FROM c) SELECT * FROM c"


@pytest.mark.parametrize("table", ["about", "items", "arrays"])
def test_a_view_in_place_of_a_table_is_damage_that_mending_repairs(store: ItemStore, table: str) -> None:
    with contextlib.closing(sqlite3.connect(fill(store).path)) as connection:
        connection.execute(f"ALTER TABLE {table} RENAME TO old")
        connection.execute(ENDLESS.format(table.upper()))
        connection.commit()
    for look in (lambda: store.read("a"), store.find_damage, store.origin, store.seal, store.seconds):
        with pytest.raises(DamageError, match=f"{table.upper()} is a view.*run: corrsfm extract .* --verify"):
            look()
    (lost,) = store.mend()
    assert f"{3 if table == 'about' else 0} whole items are kept" in lost
    assert store.find_damage() == []


def test_a_trigger_is_damage_whose_items_are_kept(store: ItemStore) -> None:
    with contextlib.closing(sqlite3.connect(fill(store).path)) as connection:
        connection.execute("CREATE TRIGGER t AFTER INSERT ON items BEGIN DELETE FROM items; END")
        connection.commit()
    with pytest.raises(DamageError, match="items has a trigger"):
        store.add("d", "1", make_features())
    assert "3 whole items are kept" in store.mend()[0]
    store.add("d", "1", make_features())
    assert store.held("abcd").keys() == set("abcd")


@pytest.mark.parametrize(
    ("name", "value"),
    [("scales", np.nan), ("scales", -1), ("scales", 0), ("scales", np.inf), ("orientations", np.nan)],
)
def test_scales_and_orientations_that_are_none_are_damage(store: ItemStore, name: str, value: float) -> None:
    features = make_features()
    getattr(features, name)[2] = value
    store.add("a", "1", features)
    with pytest.raises(DamageError, match=f"a: {name} that are not finite"):
        store.read("a")
    assert store.find_damage() == ["a"]
