"""The HDF5 store: exact round trips, hloc's layout, and a journal that survives being killed."""

import errno
import fcntl
import multiprocessing
import os
import shutil
import signal
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from corrsfm.errors import InputError, WorkspaceError
from corrsfm.types import Features, Matches, PruneResult, TwoViewModel
from corrsfm.workspace.hloc import FEATURES, MATCHES, PRUNED, PrunedMatches, check_hloc_keys
from corrsfm.workspace.store import ItemStore


def make_features(num: int = 5, seed: int = 0) -> Features:
    rng = np.random.default_rng(seed)
    return Features(
        # Multiples of 1/64 px: adding and subtracting half a pixel is then exact in float32.
        keypoints=rng.integers(0, 640 * 64, (num, 2)).astype(np.float32) / 64,
        scales=rng.uniform(1, 9, num).astype(np.float32),
        orientations=rng.uniform(-3, 3, num).astype(np.float32),
        scores=rng.uniform(0, 1, num).astype(np.float32),
        descriptors=rng.integers(0, 256, (num, 128)).astype(np.uint8),
        image_size=(640, 480),
    )


def make_matches() -> Matches:
    return Matches(
        indices=np.array([[0, 7], [1, 3], [4, 7]], np.int32),
        ratios=np.array([0.25, 0.5, 1.0], np.float32),
        mutual=np.array([True, False, True]),
    )


def assert_same(left: object, right: object) -> None:
    for name, value in vars(left).items():
        np.testing.assert_array_equal(value, getattr(right, name), err_msg=name)


@pytest.fixture
def store(tmp_path: Path) -> ItemStore:
    return ItemStore(tmp_path / "features.h5", FEATURES)


def test_features_come_back_exactly_as_they_went_in(store: ItemStore) -> None:
    features = make_features()
    store.add("a/b.jpg", "f", features)
    store.commit({"a/b.jpg": "f"})
    assert_same(store.read("a/b.jpg"), features)


def test_no_features_and_no_matches_round_trip(store: ItemStore, tmp_path: Path) -> None:
    store.add("a.jpg", "f", make_features(0))
    store.commit({"a.jpg": "f"})
    assert len(store.read("a.jpg")) == 0
    matches = ItemStore(tmp_path / "matches.h5", MATCHES)
    none = Matches(
        indices=np.zeros((0, 2), np.int32), ratios=np.zeros(0, np.float32), mutual=np.zeros(0, bool)
    )
    matches.add(("a", "b"), "f", none)
    matches.commit({("a", "b"): "f"})
    assert len(matches.read(("a", "b"))) == 0


def test_features_file_has_hlocs_layout_with_its_pixel_convention(store: ItemStore) -> None:
    features = make_features()
    store.add("a/b.jpg", "f", features)
    store.commit({"a/b.jpg": "f"})
    with h5py.File(store.path) as file:
        group = file["a/b.jpg"]
        np.testing.assert_array_equal(group["keypoints"][()], features.keypoints - 0.5)
        assert group["keypoints"].dtype == np.float32
        assert group["descriptors"].shape == (128, 5)
        np.testing.assert_array_equal(
            group["descriptors"][()].astype(np.float64).T * 512, features.descriptors
        )


def test_matches_file_has_hlocs_layout(tmp_path: Path) -> None:
    store = ItemStore(tmp_path / "matches.h5", MATCHES)
    store.add(("x/a.jpg", "b.jpg"), "f", make_matches())
    store.commit({("x/a.jpg", "b.jpg"): "f"})
    with h5py.File(store.path) as file:
        group = file["x-a.jpg/b.jpg"]
        np.testing.assert_array_equal(group["matches0"][()], [7, 3, -1, -1, 7])
        np.testing.assert_allclose(group["matching_scores0"][()], [0.75, 0.5, 0, 0, 0])
    assert_same(store.read(("x/a.jpg", "b.jpg")), make_matches())


def test_files_written_by_hloc_are_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "features.h5", "w") as file:
        group = file.create_group("a.jpg")
        group["keypoints"] = np.array([[10, 20]], np.float16)
        group["descriptors"] = np.full((128, 1), 0.125, np.float16)
        group["image_size"] = np.array([64, 48])
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        group = file.create_group("a.jpg/b.jpg")
        group["matches0"] = np.array([-1, 4], np.int16)
        group["matching_scores0"] = np.array([0, 0.5], np.float16)
    features = ItemStore(tmp_path / "features.h5", FEATURES).read("a.jpg")
    np.testing.assert_array_equal(features.keypoints, [[10.5, 20.5]])
    np.testing.assert_array_equal(features.descriptors, np.full((1, 128), 64))
    matches = ItemStore(tmp_path / "matches.h5", MATCHES).read(("a.jpg", "b.jpg"))
    np.testing.assert_array_equal(matches.indices, [[1, 4]])
    np.testing.assert_array_equal(matches.ratios, [0.5])


def test_pruned_matches_keep_order_model_and_counts(tmp_path: Path) -> None:
    matches = make_matches()
    model = TwoViewModel(kind="fundamental", matrix=np.arange(9.0).reshape(3, 3))
    result = PruneResult(
        scores=np.array([0.5, 0.1, 0.9], np.float32),
        inlier_mask=np.array([True, False, True]),
        model=model,
        decided_by="loransac",
    )
    pruned = PrunedMatches.from_result(matches, result)
    store = ItemStore(tmp_path / "pruned.h5", PRUNED)
    store.add(("a", "b"), "f", pruned)
    store.commit({("a", "b"): "f"})
    back = store.read(("a", "b"))
    np.testing.assert_array_equal(back.indices, [[0, 7], [4, 7]])
    np.testing.assert_array_equal(back.scores, np.array([0.5, 0.9], np.float32))
    assert back.num_putative == 3 and back.decided_by == "loransac"
    assert back.model is not None and back.model.kind == "fundamental"
    np.testing.assert_array_equal(back.model.matrix, model.matrix)


def test_a_pair_pruned_to_nothing_stays_recorded(tmp_path: Path) -> None:
    result = PruneResult(scores=np.zeros(3, np.float32), inlier_mask=np.zeros(3, bool))
    store = ItemStore(tmp_path / "pruned.h5", PRUNED)
    store.add(("a", "b"), "f", PrunedMatches.from_result(make_matches(), result))
    store.commit({("a", "b"): "f"})
    assert store.read(("a", "b")).num_putative == 3
    assert len(store.read(("a", "b")).indices) == 0


def test_finished_items_are_those_with_the_wanted_fingerprint(store: ItemStore) -> None:
    store.add("a", "1", make_features(seed=1))
    store.add("b", "1", make_features(seed=2))
    store.commit({"a": "1", "b": "1"})
    store.add("c", "1", make_features(seed=3))
    assert store.finished({"a": "1", "b": "2", "c": "1", "d": "1"}) == {"a", "c"}


def test_commit_keeps_unchanged_items_replaces_changed_and_drops_unwanted(store: ItemStore) -> None:
    for name in "abc":
        store.add(name, "1", make_features(seed=ord(name)))
    store.commit(dict.fromkeys("abc", "1"))
    store.add("b", "2", make_features(seed=9))
    store.commit({"a": "1", "b": "2"})
    assert_same(store.read("a"), make_features(seed=ord("a")))
    assert_same(store.read("b"), make_features(seed=9))
    with pytest.raises(WorkspaceError, match="holds nothing for c"):
        store.read("c")


def test_commit_of_an_unfinished_item_fails_and_leaves_the_old_file(store: ItemStore) -> None:
    store.add("a", "1", make_features())
    store.commit({"a": "1"})
    before = store.path.read_bytes()
    with pytest.raises(WorkspaceError, match="never finished"):
        store.commit({"a": "1", "b": "1"})
    assert store.path.read_bytes() == before


def test_a_stale_item_in_the_file_is_not_committed_for_a_new_fingerprint(store: ItemStore) -> None:
    store.add("a", "1", make_features())
    store.commit({"a": "1"})
    with pytest.raises(WorkspaceError, match="never finished"):
        store.commit({"a": "2"})


def _add_forever(path: Path) -> None:
    store = ItemStore(path, FEATURES)
    for number in range(10_000):
        store.add(f"{number:05d}", "f", make_features(200, seed=number))


def test_killed_writer_loses_at_most_the_item_in_work(tmp_path: Path) -> None:
    path = tmp_path / "features.h5"
    process = multiprocessing.get_context("spawn").Process(target=_add_forever, args=(path,))
    process.start()
    store = ItemStore(path, FEATURES)
    wanted = {f"{number:05d}": "f" for number in range(10_000)}
    # Opened before the writer has set the file up, the journal would turn one of the two away.
    log = store.journal.path.with_name(store.journal.path.name + "-wal")
    while not (log.exists() and log.stat().st_size > 100_000):
        assert process.is_alive()
        time.sleep(0.01)
    while len(store.finished(wanted)) <= 20:
        assert process.is_alive()
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    store.close()
    done = sorted(store.finished(wanted))
    assert len(done) > 20
    assert done == [f"{number:05d}" for number in range(len(done))]
    store.commit({name: "f" for name in done})
    assert_same(store.read(done[-1]), make_features(200, seed=int(done[-1])))


def test_a_half_written_file_is_refused_with_what_to_do(store: ItemStore) -> None:
    store.path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(WorkspaceError, match="not a readable HDF5 file.*delete it"):
        store.read("a")


def test_a_truncated_file_is_refused_with_what_to_do(store: ItemStore) -> None:
    store.add("a", "1", make_features(1000))
    store.commit({"a": "1"})
    store.path.write_bytes(store.path.read_bytes()[:5000])
    with pytest.raises(WorkspaceError, match="truncated file.*delete it"):
        store.read("a")


def test_a_file_that_another_program_holds_is_not_to_be_deleted(store: ItemStore) -> None:
    store.add("a", "1", make_features())
    store.commit({"a": "1"})
    with open(store.path, "r+b") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(WorkspaceError, match="in use by another program") as caught:
            store.read("a")
    assert "delete" not in str(caught.value) and "HDF5_USE_FILE_LOCKING=FALSE" in str(caught.value)
    assert store.read("a") is not None


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), "check the permissions"),
        (OSError(errno.ENOLCK, "unable to lock file"), "HDF5_USE_FILE_LOCKING=FALSE"),
        (OSError(errno.EIO, "Input/output error"), "check the disk"),
    ],
)
def test_a_file_that_cannot_be_opened_now_is_not_to_be_deleted(
    store: ItemStore, monkeypatch: pytest.MonkeyPatch, error: OSError, text: str
) -> None:
    def refuse(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(h5py, "File", refuse)
    with pytest.raises(WorkspaceError, match=text) as caught:
        store.read("a")
    assert "delete" not in str(caught.value)


@pytest.mark.parametrize(
    ("descriptors", "text"),
    [
        (np.full((256, 1), 0.1), r"a\.jpg: descriptors of shape \(256, 1\), expected SIFT's \(128, 1\)"),
        (np.full((128, 2), 0.1), r"shape \(128, 2\), expected SIFT's \(128, 1\)"),
        (np.full((128, 1), -0.1), "descriptors from -0.1 to -0.1, expected SIFT's"),
        (np.full((128, 1), 12.0), "descriptors from 12 to 12"),
        (np.full((128, 1), np.nan), "descriptors from nan to nan"),
    ],
)
def test_descriptors_of_another_kind_are_refused(
    store: ItemStore, descriptors: np.ndarray, text: str
) -> None:
    with h5py.File(store.path, "w") as file:
        group = file.create_group("a.jpg")
        group["keypoints"] = np.array([[10, 20]], np.float16)
        group["descriptors"] = descriptors
        group["image_size"] = np.array([64, 48])
    with pytest.raises(WorkspaceError, match=text):
        store.read("a.jpg")


def test_counts_of_a_pair_are_read_without_its_matches(tmp_path: Path) -> None:
    result = PruneResult(scores=np.zeros(3, np.float32), inlier_mask=np.array([True, False, True]))
    store = ItemStore(tmp_path / "pruned.h5", PRUNED)
    store.add(("a", "b"), "f", PrunedMatches.from_result(make_matches(), result))
    store.commit({("a", "b"): "f"})
    with h5py.File(store.path, "r+") as file:
        del file["a/b/matches0"], file["a/b/matching_scores0"]
    ((pair, counts),) = store.attributes([("a", "b")])
    assert pair == ("a", "b")
    assert (counts["num_putative"], counts["num_kept"]) == (3, 2)


def test_commit_tells_its_progress(store: ItemStore) -> None:
    seen: list[str] = []
    for name in "abc":
        store.add(name, "1", make_features())
    store.commit(dict.fromkeys("abc", "1"), lambda keys: (seen.append(key) or key for key in keys))
    assert seen == ["a", "b", "c"]


def test_a_damaged_journal_is_started_afresh(store: ItemStore) -> None:
    store.journal.path.write_bytes(b"not a database at all" * 100)
    store.add("a", "1", make_features())
    assert store.finished({"a": "1"}) == {"a"}


def test_a_file_of_another_version_is_refused(store: ItemStore) -> None:
    with h5py.File(store.path, "w") as file:
        file.attrs["version"] = 99
    with pytest.raises(WorkspaceError, match="format version 99"):
        store.read("a")


def test_a_full_disk_is_reported_and_keeps_the_old_file(
    store: ItemStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.add("a", "1", make_features())
    store.commit({"a": "1"})
    store.add("b", "1", make_features())

    def no_space(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(WorkspaceError, match="No space left.*free some disk space"):
        store.commit({"a": "1", "b": "1"})
    monkeypatch.undo()
    assert store.finished({"a": "1", "b": "1"}) == {"a", "b"}
    assert not list(store.path.parent.glob("*.partial"))


def test_a_disk_that_would_fill_up_is_not_written_to(
    store: ItemStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    # HDF5 may crash the process instead of raising an error.
    store.add("a", "1", make_features(1000))
    usage = shutil.disk_usage(store.path.parent)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=100_000))
        with pytest.raises(WorkspaceError, match=r"needs \d+ MB, 0 MB are free; free some disk space"):
            store.commit({"a": "1"})
    store.commit({"a": "1"})
    assert len(store.read("a")) == 1000


def test_names_that_hloc_cannot_tell_apart_are_refused() -> None:
    check_hloc_keys(["a/1.jpg", "b/1.jpg"])
    with pytest.raises(InputError, match=r"a/1\.jpg.*a-1\.jpg"):
        check_hloc_keys(["a/1.jpg", "a-1.jpg"])


@pytest.mark.parametrize("way", ["group", "dataset", "raw", "virtual"])
def test_values_are_never_read_from_another_file(store: ItemStore, tmp_path: Path, way: str) -> None:
    store.add("a.jpg", "f", make_features(4))
    store.commit({"a.jpg": "f"})
    other = tmp_path / "other.h5"
    shutil.copy(store.path, other)
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(16)))
    with h5py.File(store.path, "r+") as file:
        del file["a.jpg"]["scores"]
        if way == "group":
            del file["a.jpg"]
            file["a.jpg"] = h5py.ExternalLink("other.h5", "a.jpg")
        elif way == "dataset":
            file["a.jpg"]["scores"] = h5py.ExternalLink("other.h5", "a.jpg/scores")
        elif way == "raw":
            file["a.jpg"].create_dataset("scores", (4,), np.float32, external=[(str(secret), 0, 16)])
        else:
            layout = h5py.VirtualLayout((4,), np.float32)
            layout[:] = h5py.VirtualSource(other, "a.jpg/scores", (4,))
            file["a.jpg"].create_virtual_dataset("scores", layout)
    with pytest.raises(WorkspaceError, match="a.jpg: its values lie in another file; move the file away"):
        store.read("a.jpg")
