"""Files written whole or not at all, their hashes, and lists that people write."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import shutil
import stat
import sys
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from corrsfm.disk import explain, is_of_the_disk, why_not
from corrsfm.errors import InputError, WorkspaceError

__all__ = [
    "FRAME_TIMES",
    "OWN_RECORD",
    "PAGE_BEGINNING",
    "RESULT_BEGINNING",
    "atomic_path",
    "atomic_write_json",
    "atomic_write_text",
    "make_folder",
    "open_file",
    "read_bytes",
    "read_json",
    "read_lines",
    "read_text",
    "remove",
    "replaced_name",
    "require_file",
    "require_replaceable",
    "share_file",
    "sync_folder",
    "unfinished_name",
    "why_unusable",
]

OWN_RECORD = ".corrsfm.json"
"""In a folder of photos that corrsfm made: what they were made from. Without it the photos are the user's."""

FRAME_TIMES = "frames.json"
"""The file beside the frames of a video that lists them in the order of time."""

PAGE_BEGINNING = (
    b'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
    b'<meta http-equiv="Content-Security-Policy"'
)
"""How every page that corrsfm writes begins."""

RESULT_BEGINNING = b'{\n "format_version"'
"""How every result file begins."""

LARGEST_TEXT_BYTES = 1 << 28
"""Of a list that is read at once: two million pairs of long names."""


@contextlib.contextmanager
def atomic_path(path: Path, *, before_replacing: Callable[[], None] = lambda: None) -> Iterator[Path]:
    """Yield a sibling path to write to; rename it to ``path`` on success, remove it on failure.

    Works for files and folders. A leftover of a killed process is removed first. When this returns, the file
    or everything in the folder is on the disk, and so is its name: a power cut leaves the old or the new.

    Parameters
    ----------
    path : Path
    before_replacing : callable, optional
        Called when all is on the disk, just before it gets its name; what it raises leaves the old in place.

    Raises
    ------
    WorkspaceError
        If nothing can be written there, or a folder is where a file should go.
    """
    temporary = _unfinished(path)
    try:
        yield temporary
        try:
            if temporary.is_dir():
                _replace_folder(temporary, path, before_replacing)
            else:
                _sync(temporary)
                before_replacing()
                os.replace(temporary, path)
                sync_folder(path.parent)
        except (IsADirectoryError, NotADirectoryError) as error:
            raise WorkspaceError(
                f"{path}: cannot be replaced ({error.strerror}); choose another name"
            ) from error
    finally:
        remove(temporary)


def _unfinished(path: Path) -> Path:
    """Where a file or folder is written before it gets its name; nothing is there."""
    if path.name in ("", ".."):
        raise WorkspaceError(f"{path}: is a folder; expected the name of what to write in it")
    temporary = unfinished_name(path)
    try:
        make_folder(path.parent)
        remove(temporary)
    except OSError as error:
        advice = "" if is_of_the_disk(error) else "; choose another place"
        raise WorkspaceError(why_not(error, path, "written") + advice) from error
    return temporary


def unfinished_name(path: Path) -> Path:
    """Where something is while it is written; `corrsfm.disk.explain` names what it will become."""
    return path.with_name(f".{path.name}.corrsfm.partial")


def make_folder(folder: Path) -> None:
    """Make a folder and those above it where they are missing, so that a power cut does not undo it."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


def _sync(path: Path) -> None:
    with open(path, "rb") as written:
        os.fsync(written.fileno())


def _sync_below(folder: Path) -> None:
    """Flush every file of a folder, and which files it holds, to the disk."""
    for root, _, names in os.walk(folder):
        for name in names:
            if not os.path.islink(path := os.path.join(root, name)):
                _sync(Path(path))
        sync_folder(Path(root))


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all in it, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def replaced_name(folder: Path) -> Path:
    """Where a folder is while another takes its place, and stays if a kill comes then."""
    return folder.with_name(f".{folder.name}.corrsfm.old")


def _replace_folder(source: Path, target: Path, before_replacing: Callable[[], None]) -> None:
    """Put a folder in another's place; a kill in between leaves neither, never a mixture."""
    old = replaced_name(target)
    remove(old)
    _sync_below(source)
    before_replacing()
    if target.exists():
        os.replace(target, old)
    os.replace(source, target)
    sync_folder(target.parent)
    remove(old)


def atomic_write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises
    ------
    WorkspaceError
        If it cannot be written.
    """
    with _writing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def _writing(path: Path, before_replacing: Callable[[], None] = lambda: None) -> Iterator[Path]:
    try:
        with atomic_path(path, before_replacing=before_replacing) as temporary:
            yield temporary
    except OSError as error:
        raise WorkspaceError(why_not(error, path, "written")) from error


def atomic_write_json(path: Path, value: Any, *, before_replacing: Callable[[], None] = lambda: None) -> None:
    """Write JSON whole or not at all; see `atomic_path`.

    Raises
    ------
    WorkspaceError
        If it cannot be written.
    """
    with _writing(path, before_replacing) as temporary, open(temporary, "w", encoding="utf-8") as stream:
        # Piece by piece: the report of a large scene is larger than all it is made from.
        json.dump(value, stream, indent=2, ensure_ascii=False, default=str)
        stream.write("\n")


def share_file(source: Path, name: Path) -> None:
    """Give a file another name without copying it, in place of what has that name.

    Files are replaced, never changed, so neither name can harm the other.

    Parameters
    ----------
    source : Path
    name : Path
        On a file system without hard links it becomes a copy.
    """
    # Renaming one name of a file to another of its names does nothing.
    if name.exists() and os.path.samefile(source, name):
        return
    with atomic_path(name) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copy2(source, temporary)


def sync_folder(folder: Path) -> None:
    """Flush which files a folder holds to the disk, as far as its file system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _open_regular(path: Path) -> io.BufferedReader:
    """Open a file, but no pipe and no device: from these a program may read for ever; else `OSError`."""
    # A pipe that nobody writes to would hold the opening up.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(handle, "rb")
    os.close(handle)
    kind = "folder" if stat.S_ISDIR(mode) else "pipe or device"
    raise OSError(errno.EINVAL, f"is a {kind}, expected a file", str(path))


def open_file(path: Path) -> io.BufferedReader:
    """Open a file that the user named for reading, but no pipe and no device.

    Raises
    ------
    InputError
        If there is no such file, it cannot be read, or it is none.
    """
    try:
        return _open_regular(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except PermissionError as error:
        raise InputError(explain(error)) from error
    except OSError as error:
        # Not the fault of the file, whose removal would be advised.
        if is_of_the_disk(error):
            raise
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def require_file(path: Path) -> None:
    """Raise what `open_file` raises, for files that a library will open."""
    open_file(path).close()


def read_text(path: Path, *, largest_bytes: int = LARGEST_TEXT_BYTES) -> str:
    """Text of a file that a person or another program wrote.

    Raises
    ------
    InputError
        If it cannot be read, is larger than that, or is not UTF-8 (with or without byte order mark).
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest_bytes:
            raise InputError(
                f"{path}: has {size / 1e6:,.0f} MB, expected a text of at most {largest_bytes / 1e6:,.0f} MB"
            )
        try:
            return file.read().decode("utf-8-sig")
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: is not UTF-8 text ({error}); save it as UTF-8") from error


def read_bytes(path: Path) -> bytes:
    """What a file of our own holds; `OSError` if it cannot be read, or is a pipe or device."""
    with _open_regular(path) as file:
        return file.read()


def read_json(path: Path) -> Any:
    """What a JSON file of our own holds.

    Raises
    ------
    OSError
        If it cannot be read, or is a pipe or device.
    ValueError
        If it is not JSON.
    """
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except RecursionError as error:
        raise ValueError("nested too deep") from error


def require_replaceable(path: Path, what: str, *beginnings: bytes) -> None:
    """Refuse to replace a file of another kind, such as a photo that an option was meant to come before.

    Parameters
    ----------
    path : Path
        Where a file is to be written; need not exist.
    what : str
        The kind of file that is written, with its article.
    beginnings : bytes
        One of which files of that kind begin with.

    Raises
    ------
    InputError
        If another file is there, or it cannot be read.
    """
    if path.is_dir() or not os.path.lexists(path):
        return
    if not path.is_file():
        raise InputError(f"{path}: is a pipe, a device or a link that leads nowhere; choose another name")
    with open_file(path) as file:
        head = file.read(max(map(len, beginnings)))
    if head and not head.startswith(beginnings):
        raise InputError(f"{path}: exists and is not {what}; choose another name, or remove it")


def why_unusable(path: str) -> str:
    """What is wrong with a path whatever is there; empty if nothing."""
    if not path:
        return "expected a path, this one is empty"
    try:
        path.encode("utf-8")
    except UnicodeEncodeError:
        if sys.getfilesystemencoding() != "utf-8":
            return f"cannot be read in this locale ({sys.getfilesystemencoding()}); set LC_ALL=C.UTF-8"
        return "is not valid UTF-8; rename it"
    if any(unicodedata.category(character) == "Cc" for character in path):
        return "holds a line break or another control character; rename it"
    try:
        os.stat(path)
    except OSError as error:
        # A place that is not there yet, or a pattern.
        if error.errno not in (errno.ENOENT, errno.ENOTDIR):
            return f"cannot be used: {str(error.strerror).lower()}"
    return ""


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    with open_file(path) as stream:
        try:
            return hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def read_lines(path: Path) -> list[str]:
    """Lines of a text file that a person wrote, such as a list of photos.

    Raises
    ------
    InputError
        As `read_text`.
    """
    return read_text(path).splitlines()
