"""Runs commands of corrsfm in forked children: with limits, watched, and without paying for the imports."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import os
import re
import resource
import signal
import stat
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = [
    "Outcome",
    "call",
    "contents",
    "differences",
    "end_session",
    "fork",
    "in_child",
    "leftovers",
    "preload",
    "run_command",
]

TIME_LIMIT_S = 60.0
# Above what the packages take when they are loaded.
EXTRA_ADDRESS_BYTES = 4 << 30
LARGEST_FILE_BYTES = 1 << 30
NOBODY = 65534
_PR_SET_SECUREBITS = 28
GRACE_S = 2.0

_HASHED_BYTES = 1 << 26
_LEFT = re.compile(r"(\.partial|\.old|\.tmp|-journal|-wal|-shm)$")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a command ended.

    Attributes
    ----------
    code : int
        Exit status; negative for a signal.
    out, err : str
    seconds : float
    peak_mb : float
        Largest resident memory, that of the packages included.
    hung : bool
        It was killed after the time limit.
    orphans : int
        Processes that it left running; they are killed.
    """

    code: int
    out: str
    err: str
    seconds: float
    peak_mb: float
    hung: bool = False
    orphans: int = 0


def preload() -> None:
    """Import everything once, before the first fork, and check that no thread runs that a fork would lose."""
    os.environ["TQDM_DISABLE"] = "1"
    import cv2  # noqa: I001  before pycolmap, see test_architecture.py
    import click.formatting
    import torch

    import corrsfm.cli
    import corrsfm.evaluation.scenes.compare
    import corrsfm.evaluation.scenes.score
    import corrsfm.evaluation.two_view.homography
    import corrsfm.evaluation.two_view.methods
    import corrsfm.evaluation.two_view.pose
    import corrsfm.export.scene
    import corrsfm.finished.add
    import corrsfm.finished.check
    import corrsfm.finished.localize
    import corrsfm.forecast
    import corrsfm.importing.scene
    import corrsfm.pipeline
    import corrsfm.training.loop
    import corrsfm.training.plots
    import corrsfm.training.prepare
    import corrsfm.training.synthetic  # noqa: F401

    # Needed for the first error, when a command without root's rights may not read the packages any more.
    click.formatting.wrap_text("")
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    with contextlib.suppress(ImportError):
        import pillow_heif  # noqa: F401
    assert len(os.listdir("/proc/self/task")) == 1


def fork(function: Callable[[], object]) -> int:
    """The process id of a forked child that calls a function; it ends with 1 and a traceback on an error."""
    if pid := os.fork():
        return pid
    code = 1
    try:
        function()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def in_child(function: Callable[[], Any]) -> Any:
    """The JSON value that a function gives in a forked child, so that this process starts no threads."""
    read, write = os.pipe()

    def tell() -> None:
        os.close(read)
        with os.fdopen(write, "w", encoding="utf-8", errors="surrogateescape") as pipe:
            json.dump(function(), pipe)

    pid = fork(tell)
    os.close(write)
    with os.fdopen(read, encoding="utf-8", errors="surrogateescape") as pipe:
        text = pipe.read()
    _, status = os.waitpid(pid, 0)
    if status:
        raise RuntimeError("the preparation of a case failed, see above")
    return json.loads(text)


def call(arguments: Sequence[str]) -> int:
    """The exit status of `corrsfm ARGUMENTS` in this process; tracebacks go to standard error."""
    from corrsfm.cli import main

    try:
        main(list(arguments), prog_name="corrsfm")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def run_command(
    arguments: Sequence[str],
    folder: Path,
    *,
    as_nobody: bool = False,
    as_owner: bool = False,
    limit_s: float = TIME_LIMIT_S,
    kill_after_s: float | None = None,
    first: Callable[[], None] = lambda: None,
) -> Outcome:
    """Run `corrsfm ARGUMENTS` in a forked child with bounded memory and time.

    Parameters
    ----------
    arguments : sequence of str
    folder : Path
        Holds the working directory ``work``; temporary files, home and output go beside it.
    as_nobody : bool
        Without the rights of root, for which no file is unreadable.
    as_owner : bool
        The same, but as the owner of the files: root without the powers that make it root.
    limit_s : float
        After that it counts as hung.
    kill_after_s : float, optional
        Kill it (SIGKILL) after this time, as the memory killer would.
    first : callable, optional
        Called in the child before the command.
    """
    for name in ("work", "tmp", "home"):
        (folder / name).mkdir(exist_ok=True)
        if as_nobody:
            os.chmod(folder / name, 0o777)
    # The child may be killed before it gets there.
    for name in ("out", "err"):
        (folder / name).write_bytes(b"")
    started = time.monotonic()
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            _enter(folder, as_nobody)
            if as_owner:
                _drop_powers()
            first()
            code = call(arguments)
        finally:
            with contextlib.suppress(BaseException):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code & 0xFF)
    wanted = limit_s if kill_after_s is None else kill_after_s
    status, usage, ended = _wait(pid, started + wanted)
    if not ended:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        _, status, usage = os.wait4(pid, 0)
    seconds = time.monotonic() - started
    return Outcome(
        code=os.waitstatus_to_exitcode(status),
        out=(folder / "out").read_text("utf-8", "surrogateescape"),
        err=(folder / "err").read_text("utf-8", "surrogateescape"),
        seconds=seconds,
        peak_mb=usage.ru_maxrss / 1024,
        hung=not ended and kill_after_s is None,
        orphans=end_session(pid),
    )


def _enter(folder: Path, as_nobody: bool) -> None:
    """Make this process a fresh one: a session, streams, limits and folders of its own."""
    os.setsid()
    for number, name in ((1, "out"), (2, "err")):
        handle = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(handle, number)
        os.close(handle)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.chdir(folder / "work")
    os.environ |= {"TMPDIR": str(folder / "tmp"), "HOME": str(folder / "home"), "COLUMNS": "200"}
    import tempfile

    tempfile.tempdir = None
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + EXTRA_ADDRESS_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if as_nobody:
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)


def _drop_powers() -> None:
    """Give up all capabilities of this process and of those that it starts."""
    libc = ctypes.CDLL(None, use_errno=True)
    no_powers_of_root, version_3 = 0b11, 0x20080522
    for failed in (
        libc.prctl(_PR_SET_SECUREBITS, no_powers_of_root, 0, 0, 0),
        libc.capset((ctypes.c_uint32 * 2)(version_3, 0), (ctypes.c_uint32 * 6)()),
    ):
        if failed:
            raise OSError(ctypes.get_errno(), "the powers of root cannot be given up here")


def _wait(pid: int, until: float) -> tuple[int, Any, bool]:
    """Status and usage of a child, and whether it ended in time."""
    pause = 0.001
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            return status, usage, True
        left = until - time.monotonic()
        if left <= 0:
            return 0, None, False
        time.sleep(min(pause, left))
        pause = min(2 * pause, 0.02)


def end_session(session: int) -> int:
    """Kill what is left of a session; how many processes that were."""
    found = _members(session)
    # Helpers of multiprocessing end by themselves when they notice that their parent is gone.
    until = time.monotonic() + GRACE_S
    while found and time.monotonic() < until:
        time.sleep(0.02)
        found = _members(session)
    for process in found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return len(found)


def _members(session: int) -> list[int]:
    found = []
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        try:
            text = Path(f"/proc/{entry}/stat").read_text("utf-8", "replace")
            state, _, _, owner = text.rpartition(")")[2].split()[:4]
        except (OSError, ValueError):
            continue
        if int(owner) == session and state != "Z":
            found.append(int(entry))
    return found


def contents(root: Path) -> dict[str, tuple[Any, ...]]:
    """Path → kind, permissions and content of everything below a folder; links are not followed."""
    found: dict[str, tuple[Any, ...]] = {}

    def visit(folder: bytes) -> None:
        with contextlib.suppress(OSError), os.scandir(folder) as entries:
            for entry in entries:
                status = entry.stat(follow_symlinks=False)
                name = os.fsdecode(os.path.relpath(entry.path, os.fsencode(root)))
                mode = status.st_mode
                detail: Any = None
                if stat.S_ISLNK(mode):
                    detail = os.readlink(entry.path)
                elif stat.S_ISREG(mode):
                    detail = status.st_size
                    if status.st_size <= _HASHED_BYTES:
                        with open(entry.path, "rb") as stream:
                            detail = hashlib.file_digest(stream, "sha256").hexdigest()
                found[name] = (stat.S_IFMT(mode), detail)
                if stat.S_ISDIR(mode):
                    visit(entry.path)

    visit(os.fsencode(root))
    return found


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Paths that are new, gone or changed."""
    return sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))


def leftovers(paths: dict[str, Any]) -> list[str]:
    """Paths that something half finished has left."""
    return sorted(name for name in paths if _LEFT.search(name))
