"""What a disk refuses, for want of space or permission: found out before it does harm, said in one line."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shlex
import stat
from collections.abc import Iterator
from pathlib import Path

__all__ = ["explain", "is_closed", "is_of_the_disk", "opening", "require_room", "room_for", "why_not"]

_FULL = (errno.ENOSPC, errno.EDQUOT)
_CLOSED = (errno.EACCES, errno.EPERM)
_TOO_MANY = (errno.EMFILE, errno.ENFILE)
_OF_THE_DISK = (*_FULL, *_TOO_MANY, errno.EFBIG, errno.EROFS, errno.EIO)
# Some file systems cannot set space aside.
_UNKNOWN = (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS)
_LAST_BYTES = 1 << 12
_UNFINISHED = re.compile(r"\.(.+)\.corrsfm\.partial")


def is_of_the_disk(error: OSError) -> bool:
    """Whether an error is about space, permission or a limit, and not about a name or a program."""
    return error.errno in _OF_THE_DISK or (error.errno in _CLOSED and error.filename is not None)


def explain(error: OSError, path: Path | str | None = None) -> str:
    """What an error of the operating system means, in one line: the path, the cause and what helps.

    Parameters
    ----------
    error : OSError
    path : path, optional
        What was to be read or written, if not what the error names; of a full disk any place on it.
    """
    named = error.filename if isinstance(error.filename, str | bytes) else None
    place = Path(path if path is not None else os.fsdecode(named or "."))
    shown = _finished_name(place)
    if error.errno in _FULL:
        return (
            f"{shown}: cannot be written, the disk is full ({str(error.strerror).lower()}); free some "
            "space there and run the same command again"
        )
    if error.errno == errno.EFBIG:
        return (
            f"{shown}: cannot be written, it is larger than files may be in this shell; raise the limit, "
            "with: ulimit -f unlimited"
        )
    if error.errno in _TOO_MANY:
        return f"{shown}: {str(error.strerror).lower()}; raise the limit, with: ulimit -n 1024"
    if error.errno == errno.EROFS:
        return _read_only(shown)
    if error.errno in _CLOSED:
        return opening(Path(os.fsdecode(named))) if named else f"{shown}: {error.strerror}"
    return f"{shown}: {error.strerror}"


def why_not(error: OSError, path: Path, what: str) -> str:
    """Why something cannot be written or made, whether the disk is the cause, see `explain`, or the name."""
    return explain(error, path) if is_of_the_disk(error) else f"{path}: cannot be {what} ({error.strerror})"


def _read_only(path: Path) -> str:
    return f"{path}: cannot be written, its disk is read-only; use another folder, or a copy of this one"


def is_closed(path: Path | str) -> bool:
    """Whether something is at a path, or may be, that this user may not read."""
    try:
        is_folder = stat.S_ISDIR(os.stat(path).st_mode)
    except PermissionError:
        return True
    except (OSError, ValueError):
        return False
    return not os.access(path, os.R_OK | (os.X_OK if is_folder else 0))


def opening(path: Path) -> str:
    """What keeps a path from being read and written, perhaps a folder on the way, and what opens it."""
    is_way_open = all(os.access(folder, os.X_OK) for folder in path.parents if folder.exists())
    if is_way_open and not os.path.lexists(path) and os.access(_nearest(path), os.W_OK):
        return f"{path}: is not there any more; put it back, or run the command again"
    closed, what, mode = _closed(path)
    if mode == "w" and closed.exists() and os.statvfs(closed).f_flag & os.ST_RDONLY:
        return _read_only(closed)
    is_own = not closed.exists() or closed.stat().st_uid == os.geteuid()
    words = ["chmod", *(["-R"] if "X" in mode else []), f"{'u' if is_own else 'a'}+{mode}", str(closed)]
    if not is_own:
        words.insert(0, "sudo")
    return f"{closed}: {what}; change that with: {shlex.join(words)}"


def _closed(path: Path) -> tuple[Path, str, str]:
    """The first thing on the way to a path that refuses, how it does, and the permission that it lacks."""
    for folder in reversed(path.parents):
        if not os.access(folder, os.X_OK):
            return folder, "may not be entered", "rwX"
    if not os.path.lexists(path):
        # Not there yet: whoever makes it writes into what is there.
        return _nearest(path), "nothing may be written in it", "w"
    is_folder = stat.S_ISDIR(path.stat().st_mode)
    if not os.access(path, os.R_OK | (os.X_OK if is_folder else 0)):
        return path, "may not be read", "rwX" if is_folder else "r"
    if not os.access(path, os.W_OK):
        return path, "nothing may be written in it" if is_folder else "may not be written", "w"
    return path.parent, "nothing may be changed in it", "w"


def _nearest(path: Path) -> Path:
    """The folder above a path that is there."""
    return next((parent for parent in path.parents if parent.exists()), path)


def _finished_name(path: Path) -> Path:
    """The name that something will get that is written under another one."""
    for number, part in enumerate(path.parts):
        if found := _UNFINISHED.fullmatch(part):
            return Path(*path.parts[:number], found[1])
    return path


@contextlib.contextmanager
def room_for(folder: Path, *sizes: int) -> Iterator[None]:
    """Make sure that a library finds room for files that it cuts short, or ends the process, on a full disk.

    Space is set aside and given back, which also meets quotas and the limit of the shell; behind the block a
    little must still be there, else what was written may have been cut.

    Parameters
    ----------
    folder : Path
        Where the files are written.
    *sizes : int
        Bytes of each file, at most.

    Raises
    ------
    OSError
        If there is no room.
    """
    require_room(folder, *sizes)
    yield
    require_room(folder, _LAST_BYTES)


def require_room(folder: Path, *sizes: int) -> None:
    """Raise `OSError` unless there is room for files of these sizes, in bytes, in a folder."""
    with contextlib.ExitStack() as stack:
        for number, size in enumerate(sizes):
            scratch = folder / f".room.{number}.partial"
            try:
                # Left by a kill, or a link that somebody laid there to a file of the user's.
                scratch.unlink(missing_ok=True)
                handle = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                stack.callback(scratch.unlink, missing_ok=True)
                stack.callback(os.close, handle)
                # macOS has no such call; there what was written is checked, and that is all.
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(handle, 0, max(1, size))
            except OSError as error:
                if error.errno not in _UNKNOWN:
                    raise OSError(error.errno, error.strerror, str(folder)) from error
