"""Files written whole or not at all, their hashes, and lists that people write."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from corrsfm.errors import InputError, WorkspaceError

__all__ = [
    "FRAME_TIMES",
    "OWN_RECORD",
    "atomic_path",
    "atomic_write_json",
    "atomic_write_text",
    "read_lines",
    "sha256_of",
    "share_file",
]

OWN_RECORD = ".corrsfm.json"
"""In a folder of photos that corrsfm made: what they were made from. Without it the photos are the user's."""

FRAME_TIMES = "frames.json"
"""The file beside the frames of a video that lists them in the order of time."""


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a sibling path to write to; rename it to ``path`` on success, remove it on failure.

    Works for files and folders. A leftover of a killed process is removed first.
    """
    temporary = path.with_name(f".{path.name}.partial")
    _remove(temporary)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        if temporary.is_dir():
            _replace_folder(temporary, path)
        else:
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
            os.replace(temporary, path)
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _replace_folder(source: Path, target: Path) -> None:
    """Put a folder in another's place; a kill in between leaves neither, never a mixture."""
    old = target.with_name(f".{target.name}.old")
    _remove(old)
    if target.exists():
        os.replace(target, old)
    os.replace(source, target)
    _remove(old)


def atomic_write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises
    ------
    WorkspaceError
        If it cannot be written.
    """
    try:
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be written ({error.strerror})") from error


def atomic_write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    atomic_write_text(path, json.dumps(value, indent=2, ensure_ascii=False, default=str) + "\n")


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


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def read_lines(path: Path) -> list[str]:
    """Lines of a text file that a person wrote, such as a list of photos.

    Raises
    ------
    InputError
        If it cannot be read, or is not UTF-8 (with or without byte order mark).
    """
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text ({error}); save it as UTF-8") from error
