"""What a disk refuses is found out before it does harm, and said in one line."""

import errno
import os
import resource
import stat
from pathlib import Path

import pytest

from corrsfm.disk import explain, is_of_the_disk, opening, require_room, room_for


def test_a_full_disk_is_named_by_what_was_to_be_written(tmp_path: Path) -> None:
    error = OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "photo.jpg"))
    assert is_of_the_disk(error)
    assert explain(error, tmp_path / ".out.corrsfm.partial" / "images").startswith(
        f"{tmp_path / 'out'}: cannot be written, the disk is full"
    )


def test_what_vanished_is_not_taken_for_closed(tmp_path: Path) -> None:
    assert opening(tmp_path / "scene").startswith(f"{tmp_path / 'scene'}: is not there any more;")


def test_a_name_that_is_missing_is_no_matter_of_the_disk() -> None:
    assert not is_of_the_disk(FileNotFoundError(errno.ENOENT, "No such file or directory", "x"))


def test_the_advice_names_the_folder_on_the_way_and_opens_it(tmp_path: Path, monkeypatch) -> None:
    closed = tmp_path / "a b"
    (closed / "inner").mkdir(parents=True)
    really = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: Path(path) != closed and really(path, mode)
    )  # root may enter everything
    text = explain(PermissionError(errno.EACCES, "Permission denied", str(closed / "inner" / "file")))
    assert text == f"{closed}: may not be entered; change that with: chmod -R u+rwX '{closed}'"


def test_room_that_is_there_leaves_nothing(tmp_path: Path) -> None:
    with room_for(tmp_path, 1000, 0):
        (tmp_path / "file").write_bytes(b"x")
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="macOS cannot set space aside")
def test_the_limit_of_the_shell_counts_for_each_file(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    try:
        require_room(tmp_path, 1 << 15, 1 << 16)
        with pytest.raises(OSError, match="large") as refused:
            require_room(tmp_path, 1 << 17)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert refused.value.filename == str(tmp_path)
    assert "ulimit -f" in explain(refused.value)
    assert os.listdir(tmp_path) == []


def test_a_folder_that_is_open_stays_as_it_is(tmp_path: Path) -> None:
    before = stat.S_IMODE(tmp_path.stat().st_mode)
    require_room(tmp_path, 1)
    assert stat.S_IMODE(tmp_path.stat().st_mode) == before


def test_a_link_in_place_of_the_scratch_file_is_not_written_through(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("kept")
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / ".room.0.partial").symlink_to(mine)
    require_room(folder, 100)
    assert mine.read_text() == "kept" and os.listdir(folder) == []


def test_too_many_open_files_are_a_matter_of_the_shell() -> None:
    error = OSError(errno.EMFILE, "Too many open files", "scene/features.db")
    assert is_of_the_disk(error)
    assert explain(error) == ("scene/features.db: too many open files; raise the limit, with: ulimit -n 1024")
