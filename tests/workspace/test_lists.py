"""The index of a workspace remembers photos as long as they are the same, and holds any name."""

import os
from pathlib import Path

import pytest

from corrsfm.errors import WorkspaceError
from corrsfm.files import sha256_of
from corrsfm.images.cache import PhotoCache
from corrsfm.types import PairList
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.lists import read_index, read_pairs, write_pairs


def test_swapped_photos_of_equal_size_and_time_get_each_their_hash(tmp_path: Path) -> None:
    paths = [tmp_path / "a.bmp", tmp_path / "b.bmp"]
    for path, content in zip(paths, (b"one", b"two"), strict=True):
        path.write_bytes(content)
        os.utime(path, ns=(10**18, 10**18))
    cache = PhotoCache(tmp_path / "cache.json")
    before = [cache.hash_of(path) for path in paths]
    cache.save()
    paths[0].rename(tmp_path / "c.bmp")
    paths[1].rename(paths[0])
    (tmp_path / "c.bmp").rename(paths[1])
    again = PhotoCache(tmp_path / "cache.json")
    assert [again.hash_of(path) for path in paths] == before[::-1] == [sha256_of(path) for path in paths]


def test_a_photo_that_is_replaced_meanwhile_is_read_again(tmp_path: Path) -> None:
    photo, cache = tmp_path / "a.bmp", PhotoCache(tmp_path / "cache.json")
    photo.write_bytes(b"one")
    before = cache.hash_of(photo)
    photo.write_bytes(b"three")
    assert before != cache.hash_of(photo) == sha256_of(photo)


def test_a_photo_is_remembered_wherever_the_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.bmp").write_bytes(b"one")
    cache = PhotoCache(tmp_path / "cache.json")
    known = cache.hash_of(tmp_path / "a.bmp")
    cache.save()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("corrsfm.images.cache.sha256_of", lambda path: pytest.fail("read again"))
    assert PhotoCache(tmp_path / "cache.json").hash_of(Path("a.bmp")) == known


@pytest.mark.parametrize("damage", ["digit", "shape", "cut"])
def test_a_damaged_cache_of_photos_counts_as_empty(tmp_path: Path, damage: str) -> None:
    (tmp_path / "a.bmp").write_bytes(b"one")
    path = tmp_path / "cache.json"
    cache = PhotoCache(path)
    known = cache.hash_of(tmp_path / "a.bmp")
    cache.save()
    text = path.read_text("utf-8")
    changed = {"digit": text.replace(known, "0" + known[1:]), "shape": '{"a": 3}', "cut": text[:-9]}
    path.write_text(changed[damage], "utf-8")
    assert PhotoCache(path).hash_of(tmp_path / "a.bmp") == known


def test_pairs_of_any_names_come_back(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    pairs = PairList(
        pairs=(("a b.jpg", "sub/\u2028.jpg"), ("a b.jpg", "x\x0by\x85.jpg")),
        origins=(("retrieval", "sequential"), ("file",)),
    )
    write_pairs(workspace, pairs)
    assert read_pairs(workspace) == pairs


def test_damaged_pairs_say_what_to_run(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    workspace.pair_origins.write_text("a.jpg\tb.jpg\n")
    workspace.finish("pairs", StageRecord(fingerprint="", config={"pairing": ["spatial"], "num_spatial": 7}))
    command = f"corrsfm pairs {workspace.root} --pairing spatial --num-spatial 7"
    with pytest.raises(WorkspaceError, match=f"damaged .*; run: {command} --overwrite$"):
        read_pairs(workspace)
    workspace.pair_origins.unlink()
    with pytest.raises(WorkspaceError, match=f"missing; run: {command}$"):
        read_pairs(workspace)


@pytest.mark.parametrize(("content", "problem"), [(None, "missing"), ("{}", "damaged")])
def test_a_lost_index_says_how_it_was_made(tmp_path: Path, content: str | None, problem: str) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    workspace.images_dir = tmp_path / "photos"
    workspace.finish("images", StageRecord(fingerprint="", config={"camera_mode": "single"}))
    if content is not None:
        workspace.images_json.write_text(content)
    command = f"corrsfm extract {tmp_path / 'photos'} {workspace.root} --camera-mode single"
    with pytest.raises(WorkspaceError, match=f"{problem}.*: {command}$"):
        read_index(workspace)
