"""The hold that one process has on a workspace, here or on another machine that sees the same files.

On one machine the kernel's lock says the truth: it goes when its process does. Between machines it may be
missing, for a file system that locks within each machine only, or outlive a machine that lost power. So the
lock file also names its holder, who renews its time of change every few seconds. A hold of another machine
that was not renewed for a minute is over. Its holder, if it only slept, ends itself when it wakes.
"""

from __future__ import annotations

import contextlib
import enum
import errno
import fcntl
import json
import logging
import os
import shlex
import signal
import socket
import stat
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path

from corrsfm.disk import explain, is_of_the_disk
from corrsfm.errors import WorkspaceError
from corrsfm.workspace.heard import PASSING

__all__ = ["BEAT_SECONDS", "LEASE_SECONDS", "hold", "hold_for_reading"]

logger = logging.getLogger("corrsfm")

BEAT_SECONDS = 5.0
LEASE_SECONDS = 60.0
POLL_SECONDS = 0.5
# Two that take over an expired hold at once: the later one's file stays, and the other sees it after this.
SETTLE_SECONDS = 1.0
HOST = socket.gethostname()
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
_MAX_BYTES = 4096


@dataclass(frozen=True)
class _Holder:
    """Who holds a workspace; the token tells two holds of one process apart."""

    host: str
    process: int
    token: str

    def __str__(self) -> str:
        return f"process {self.process} on {self.host}"

    @property
    def is_here(self) -> bool:
        return self.host == HOST


class _State(enum.Enum):
    FREE = enum.auto()
    HELD = enum.auto()
    EXPIRED = enum.auto()
    """The machine of the holder has vanished and left its lock in the kernel."""
    UNSURE = enum.auto()
    """The kernel knows of no holder, and one of another machine was there a moment ago."""
    REPLACED = enum.auto()
    """Another lock file has come in the place of the open one."""


@contextlib.contextmanager
def hold(path: Path, *, wait: bool = False, make: bool = False) -> Iterator[None]:
    """Hold the folder of a lock file for this process.

    Parameters
    ----------
    path : Path
        The lock file.
    wait : bool
        Wait for another holder instead of failing.
    make : bool
        Make the folder again if another holder removed it.

    Raises
    ------
    WorkspaceError
        If another process holds it, or nothing can be written there.
    """
    me = _Holder(HOST, os.getpid(), uuid.uuid4().hex)
    with _take(path, me, wait=wait, make=make) as file:
        stopped = threading.Event()
        heart = threading.Thread(target=_beat, args=(path, file, me, stopped), daemon=True)
        heart.start()
        try:
            yield
        finally:
            stopped.set()
            heart.join()
            with contextlib.suppress(OSError):
                file.truncate(0)


def _take(path: Path, me: _Holder, *, wait: bool, make: bool) -> FileIO:
    """The open lock file, once this process holds it."""
    seen: float | None = None
    while True:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(_open(path, make=make))
            is_locked = _lock(file, path)
            state, holder = _judge(file, path, me, is_locked)
            if state is _State.FREE:
                _write(file, path, me, is_locked=bool(is_locked))
                if is_locked or holder == me:
                    stack.pop_all()
                    return file
            renewed = os.fstat(file.fileno()).st_mtime
        if state is _State.EXPIRED:
            logger.warning(
                "%s: taken over from another corrsfm (%s), which has vanished", path.parent, holder
            )
            _replace(path, me)
        if state in (_State.FREE, _State.EXPIRED):
            time.sleep(SETTLE_SECONDS)
        if state not in (_State.HELD, _State.UNSURE):
            continue
        who = _named(holder)
        may_be_dead = state is _State.UNSURE and seen in (None, renewed)
        if not wait and not may_be_dead:
            raise WorkspaceError(
                f"{path.parent}: another corrsfm works in this folder{who}; wait for it or choose another one"
            )
        if seen is None:
            logger.warning("%s: waiting for another corrsfm%s to end", path.parent, who, extra=PASSING)
        seen = renewed
        time.sleep(POLL_SECONDS)


@contextlib.contextmanager
def hold_for_reading(path: Path) -> Iterator[None]:
    """Keep writers out of the folder of a lock file, as far as the file system tells them; changes nothing.

    Raises
    ------
    WorkspaceError
        If another process holds it.
    """
    with contextlib.ExitStack() as stack:
        # Without a lock file, or the right to read it, there is nobody to tell of.
        with contextlib.suppress(OSError):
            # A pipe in its place would hold the opening up.
            file = stack.enter_context(FileIO(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "r"))
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                is_held = _is_renewed_elsewhere(file, path)
            except BlockingIOError:
                is_held = True
            if is_held:
                who = _named(_read(file))
                raise WorkspaceError(f"{path.parent}: another corrsfm works in this folder{who}; wait for it")
        yield


def _is_renewed_elsewhere(file: FileIO, path: Path) -> bool:
    """Whether another machine, whose lock the kernel here does not see, renews its hold."""
    holder, seen = _read(file), os.fstat(file.fileno()).st_mtime
    if holder is None or holder.is_here or abs(_now(path.parent) - seen) > LEASE_SECONDS:
        return False
    who = _named(holder)
    logger.warning(
        "%s: another corrsfm%s was here; looking whether it still is", path.parent, who, extra=PASSING
    )
    while abs(_now(path.parent) - seen) <= LEASE_SECONDS:
        time.sleep(POLL_SECONDS)
        if os.fstat(file.fileno()).st_mtime != seen:
            return _read(file) is not None
    return False


def _named(holder: _Holder | None) -> str:
    if holder is None:
        return ""
    if holder.is_here and _is_stopped(holder.process):
        return f" ({holder}, which is stopped; let it go on with: kill -CONT {holder.process})"
    return f" ({holder})"


def _is_stopped(process: int) -> bool:
    """Whether a process of this machine was stopped, by Ctrl-Z say, as far as the system tells."""
    try:
        state = Path(f"/proc/{process}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return state == "T"


def _judge(file: FileIO, path: Path, me: _Holder, is_locked: bool | None) -> tuple[_State, _Holder | None]:
    """Whether an open lock file may be taken, and who holds or held it."""
    if is_locked and not _is_at(file, path):
        return _State.REPLACED, None
    holder = _read(file)
    if holder is None or holder == me or holder.is_here:
        is_held = not is_locked
        if is_locked is None:
            is_held = holder not in (None, me) and _is_alive(holder.process)
        return (_State.HELD if is_held else _State.FREE), holder
    # Nobody who holds it now has renewed it in the future: a clock was set back, or the file copied.
    if abs(_now(path.parent) - os.fstat(file.fileno()).st_mtime) > LEASE_SECONDS:
        return (_State.EXPIRED if is_locked is False else _State.FREE), holder
    return (_State.UNSURE if is_locked else _State.HELD), holder


def _open(path: Path, *, make: bool) -> FileIO:
    try:
        if make:
            path.parent.mkdir(parents=True, exist_ok=True)
        # A link in its place could lead to any file, and a pipe hold up whoever reads it.
        file = FileIO(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666), "r+")
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            return file
        file.close()
        raise IsADirectoryError
    except IsADirectoryError as error:
        removal = shlex.join(["rm", "-r", str(path)])
        raise WorkspaceError(
            f"{path}: is a folder, pipe or device, expected a file; run: {removal}"
        ) from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            removal = shlex.join(["rm", str(path)])
            raise WorkspaceError(f"{path}: is a link, expected a file; run: {removal}") from error
        if isinstance(error, PermissionError) and _is_of_another(path.parent):
            opening = shlex.join(["sudo", "chmod", "-R", "a+rwX", str(path.parent)])
            raise WorkspaceError(
                f"{path.parent}: belongs to another user and may not be written; work on a copy of it, "
                f"or open it, with: {opening}"
            ) from error
        if is_of_the_disk(error):
            copy = ", or work on a copy of the folder" if isinstance(error, PermissionError) else ""
            raise WorkspaceError(f"{explain(error)}{copy}") from error
        raise WorkspaceError(
            f"{path.parent}: nothing can be written there ({error.strerror}); work on a copy of the folder"
        ) from error


def _is_of_another(folder: Path) -> bool:
    try:
        return folder.stat().st_uid != os.geteuid()
    except OSError:
        return False


def _lock(file: FileIO, path: Path) -> bool | None:
    """Whether the kernel gives the lock; None if the file system has none."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        raise WorkspaceError(f"{path.parent}: cannot be locked ({error.strerror})") from error
    return True


def _is_at(file: FileIO, path: Path) -> bool:
    """Whether an open file is still the one at a path; a take-over replaces it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def _read(file: FileIO) -> _Holder | None:
    """The holder that a lock file names; None if it is empty or of an older corrsfm."""
    try:
        values = json.loads(os.pread(file.fileno(), _MAX_BYTES, 0))
        return _Holder(str(values["host"]), int(values["process"]), str(values["token"]))
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return None


def _write(file: FileIO, path: Path, me: _Holder, *, is_locked: bool) -> None:
    try:
        file.truncate(0)
        os.pwrite(file.fileno(), json.dumps(asdict(me)).encode(), 0)
        os.fsync(file.fileno())
    except OSError as error:
        # With the kernel's lock, a full disk costs no more than the name of the holder.
        if not is_locked:
            raise WorkspaceError(f"{path.parent}: nothing can be written there ({error.strerror})") from error


def _replace(path: Path, me: _Holder) -> None:
    """Put a new lock file in the place of one that its holder can no longer let go."""
    temporary = path.with_name(f".{path.name}.{me.token}")
    try:
        temporary.write_text(json.dumps(asdict(me)), encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise WorkspaceError(f"{path.parent}: nothing can be written there ({error.strerror})") from error


def _now(folder: Path) -> float:
    """The time by the clock that stamps files in a folder, which may be that of another machine."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            return os.fstat(file.fileno()).st_mtime
    except OSError:
        return time.time()


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _beat(path: Path, file: FileIO, me: _Holder, stopped: threading.Event) -> None:
    """Renew a hold until it is let go; end this process if another one took over."""
    while not stopped.wait(BEAT_SECONDS):
        # A network that stutters, or a folder that is being removed, is no other holder.
        with contextlib.suppress(OSError):
            with open(path, "rb", buffering=0) as current:
                holder = _read(current)
            if holder is not None and holder != me:
                logger.error(
                    "%s: this process did not move for more than %g s and was taken over by another corrsfm "
                    "(%s); it ends",
                    path.parent, LEASE_SECONDS, holder,
                )  # fmt: skip
                os.kill(os.getpid(), signal.SIGTERM)
                return
            os.utime(file.fileno())
