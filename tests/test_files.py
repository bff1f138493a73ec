"""Files come into being whole, and are told apart by what they hold."""

import os
import sys
from pathlib import Path

import pytest

from corrsfm.errors import InputError, WorkspaceError
from corrsfm.files import (
    atomic_path,
    atomic_write_text,
    read_lines,
    require_replaceable,
    sha256_of,
    share_file,
)


def test_an_exception_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    atomic_write_text(path, "old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_leftover_of_a_killed_writer_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / ".models.corrsfm.partial").mkdir()
    (tmp_path / ".models.corrsfm.partial" / "junk").write_text("x")
    with atomic_path(tmp_path / "models") as temporary:
        temporary.mkdir()
        (temporary / "new").write_text("y")
    assert [path.name for path in (tmp_path / "models").iterdir()] == ["new"]


def test_folders_replace_folders_whole(tmp_path: Path) -> None:
    for content in ("one", "two"):
        with atomic_path(tmp_path / "models") as temporary:
            temporary.mkdir()
            (temporary / content).touch()
    assert [path.name for path in (tmp_path / "models").iterdir()] == ["two"]
    assert [path.name for path in tmp_path.iterdir()] == ["models"]


def test_hash_is_the_published_one_of_known_bytes(tmp_path: Path) -> None:
    (tmp_path / "abc").write_bytes(b"abc")
    assert sha256_of(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_file_without_a_hash_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent: no such file"):
        sha256_of(tmp_path / "absent")


def test_a_list_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.txt: no such file$"):
        read_lines(tmp_path / "none.txt")
    with pytest.raises(InputError, match=r"is a folder, expected a file\)$"):
        read_lines(tmp_path)
    (tmp_path / "latin.txt").write_bytes(b"caf\xe9.jpg")
    with pytest.raises(InputError, match=r"latin\.txt: is not UTF-8 text .*; save it as UTF-8"):
        read_lines(tmp_path / "latin.txt")


@pytest.mark.parametrize("has_links", [True, False])
def test_a_shared_file_takes_the_place_of_another_and_survives_its_replacement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_links: bool
) -> None:
    def no_links(*paths: object) -> None:
        raise OSError("no hard links here")

    if not has_links:
        monkeypatch.setattr(os, "link", no_links)
    first, name = tmp_path / "first", tmp_path / "name"
    first.write_text("1")
    name.write_text("old")
    share_file(first, name)
    share_file(first, name)
    atomic_write_text(first, "2")
    assert (name.read_text(), first.read_text()) == ("1", "2")
    assert sorted(tmp_path.iterdir()) == [first, name]


class Flushes:
    """Records what is flushed and renamed, in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: list[str] = []
        fsync, replace = os.fsync, os.replace

        def flush(handle: int) -> None:
            fsync(handle)
            self.seen.append(f"flush {Path(os.readlink(f'/proc/self/fd/{handle}')).name}")

        def rename(source: Path, target: Path) -> None:
            replace(source, target)
            self.seen.append(f"rename {Path(target).name}")

        monkeypatch.setattr(os, "fsync", flush)
        monkeypatch.setattr(os, "replace", rename)


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc what a handle leads to")
def test_a_file_is_on_the_disk_before_its_name_and_its_name_before_it_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushes = Flushes(monkeypatch)
    atomic_write_text(tmp_path / "new" / "a.txt", "x")
    assert flushes.seen == [
        f"flush {tmp_path.name}",
        "flush .a.txt.corrsfm.partial",
        "rename a.txt",
        "flush new",
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc what a handle leads to")
def test_everything_in_a_folder_is_on_the_disk_before_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushes = Flushes(monkeypatch)
    with atomic_path(tmp_path / "models") as temporary:
        (temporary / "0").mkdir(parents=True)
        (temporary / "0" / "cameras.bin").write_bytes(b"x")
    assert flushes.seen == [
        "flush .models.corrsfm.partial", "flush cameras.bin", "flush 0", "rename models",
        f"flush {tmp_path.name}",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_file_is_not_read(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "x"
    {"pipe": os.mkfifo, "folder": os.mkdir, "device": lambda p: os.symlink("/dev/zero", p)}[kind](path)
    for read in (read_lines, sha256_of):
        with pytest.raises(
            InputError, match=r"x: cannot be read \(is a (pipe or device|folder), expected a file"
        ):
            read(path)


def test_places_where_nothing_can_be_written_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "x", Path("."), tmp_path):
        with pytest.raises(WorkspaceError, match="cannot be|is a folder"):
            atomic_write_text(path, "x")


def test_a_file_is_replaced_by_one_of_its_kind_alone(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    require_replaceable(path, "a result file", b"{")
    for content in (b"", b'{"a": 1}'):
        path.write_bytes(content)
        require_replaceable(path, "a result file", b"{", b"[")
    path.write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match=r"results\.json: exists and is not a result file; choose another"):
        require_replaceable(path, "a result file", b"{", b"[")


def test_pipes_and_links_that_lead_nowhere_are_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "link.json").symlink_to(tmp_path / "nowhere")
    for name in ("pipe.json", "link.json"):
        with pytest.raises(InputError, match=f"{name}: is a pipe, a device or a link that leads nowhere"):
            require_replaceable(tmp_path / name, "a result file", b"{")
