"""What surrounds a command: streams that are closed or full, the environment, memory."""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import re
import select
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

import click

from corrsfm.cli.signals import Interruption, interrupted_by
from corrsfm.disk import explain, is_of_the_disk
from corrsfm.errors import ConfigError, CorrsfmError, printable

__all__ = ["drop_bad_settings", "guarded_streams", "require_current_folder", "told"]

_NO_MEMORY = re.compile(
    r"allocate|out of memory|insufficient memory|bad_alloc|failed to map segment|cannot map|start new thread",
    re.IGNORECASE,
)


class _Stream(io.FileIO):
    """The raw end of a standard stream, which waits where another program made it non-blocking."""

    def write(self, data: Any) -> int:
        while (written := super().write(data)) is None:
            select.select([], [self], [])
        return written


class _Log(_Stream):
    """Standard error: a line that cannot be written is lost, and the work goes on."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError:
            return len(data)


class _Results(_Stream):
    """Standard output: a result that cannot be written is an error, but is tried only once."""

    _has_failed = False

    def write(self, data: Any) -> int:
        if self._has_failed:
            return len(data)
        try:
            return super().write(data)
        except BrokenPipeError as error:
            self._has_failed = True
            # As programs end that do not ignore the signal: silently, its reader has seen enough.
            raise click.exceptions.Exit(128 + signal.SIGPIPE) from error
        except OSError as error:
            self._has_failed = True
            raise click.ClickException(
                f"standard output: cannot be written ({error.strerror}); send it to a file on a disk with "
                "free space and run the same command again, finished work is kept"
            ) from error


@contextlib.contextmanager
def guarded_streams() -> Iterator[None]:
    """Let nothing that standard streams may be, closed, full or of another encoding, stop the work.

    Streams that the caller has replaced, as tests do, stay as they are.
    """
    before = sys.stdin, sys.stdout, sys.stderr
    _open_closed_ones()
    if sys.stdin is None:
        sys.stdin = io.TextIOWrapper(io.BufferedReader(io.FileIO(0, closefd=False)))
    if sys.stdout is sys.__stdout__:
        sys.stdout = _text_over(_Results(1, "w", closefd=False), before[1])
    if sys.stderr is sys.__stderr__:
        sys.stderr = _text_over(_Log(2, "w", closefd=False), before[2])
    try:
        yield
    finally:
        sys.stdin, sys.stdout, sys.stderr = before


def _open_closed_ones() -> None:
    """Give closed standard streams to the null device.

    Otherwise the next file that is opened gets the number, a database say, and is written to by any library
    that says something on standard error.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            handle = os.open(os.devnull, os.O_RDWR)
            os.dup2(handle, number)
            if handle != number:
                os.close(handle)


def _text_over(raw: io.FileIO, before: Any) -> io.TextIOWrapper:
    encoding = before.encoding if before is not None else "utf-8"
    return io.TextIOWrapper(
        io.BufferedWriter(raw), encoding=encoding, errors="backslashreplace", line_buffering=True
    )


def drop_bad_settings() -> None:
    """Drop what tqdm would read from the environment and stumble over when it is imported."""
    for name in [name for name in os.environ if name.upper().startswith("TQDM_")]:
        if name != "TQDM_DISABLE" and not (
            name in ("TQDM_MININTERVAL", "TQDM_MAXINTERVAL") and _is_duration(os.environ[name])
        ):
            del os.environ[name]


def _is_duration(text: str) -> bool:
    try:
        return 0 <= float(text) < math.inf
    except ValueError:
        return False


def require_current_folder() -> None:
    """Refuse to work in a folder that is gone, in which libraries end the process.

    Raises
    ------
    ConfigError
        If it is.
    """
    try:
        os.getcwd()
    except OSError as error:
        raise ConfigError(
            f"the current folder is gone or cannot be read ({error.strerror}); change to one that exists, "
            "with: cd"
        ) from error


@contextlib.contextmanager
def told(how_to_go_on: Callable[[], str]) -> Iterator[None]:
    """Turn errors that a user can do something about into a line.

    Parameters
    ----------
    how_to_go_on : callable
        What to do after an interruption, or with more memory.
    """
    try:
        yield
    except (click.ClickException, click.exceptions.Exit) as error:
        # What was interrupted may say that something is missing or broken.
        if number := interrupted_by():
            raise Interruption(number, how_to_go_on()) from error
        raise
    except (Exception, KeyboardInterrupt) as error:
        number = interrupted_by()
        if number or isinstance(error, KeyboardInterrupt):
            raise Interruption(number or signal.SIGINT, how_to_go_on()) from error
        if isinstance(error, CorrsfmError):
            raise click.ClickException(printable(str(error))) from error
        # A full disk or a closed folder may be met anywhere; other errors are faults of corrsfm.
        if isinstance(error, OSError) and is_of_the_disk(error):
            raise click.ClickException(printable(explain(error))) from error
        if reason := _lack_of_memory(error):
            raise click.ClickException(
                f"not enough memory ({printable(reason)}); {_memory_limit()}close other programs or lower "
                f"--threads, then {how_to_go_on()}"
            ) from error
        raise


def _lack_of_memory(error: BaseException | None) -> str:
    """What an error, or one that it comes from, says of too little memory; empty if nothing."""
    while error is not None:
        text = (str(error).strip() or type(error).__name__).splitlines()[0]
        is_meant = isinstance(error, MemoryError) or (
            isinstance(error, OSError) and error.errno == errno.ENOMEM
        )
        # Libraries have classes of their own.
        if is_meant or _NO_MEMORY.search(text):
            return text
        error = error.__cause__ or error.__context__
    return ""


def _memory_limit() -> str:
    """The limit of this process for a message, if it has one."""
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return ""
    return f"this process may have {limit / 1e6:,.0f} MB, raise that with: ulimit -v unlimited; or "
