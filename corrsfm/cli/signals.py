"""Ctrl-C, SIGTERM and SIGHUP: a command clears up, says how to go on, and ends with the status of shells."""

from __future__ import annotations

import contextlib
import importlib.machinery
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType, ModuleType
from typing import Any

import click

__all__ = ["Interruption", "interrupted_by", "interruptible"]

# Long enough for whatever swallowed an interruption to return to the work, or for an import to get on.
AGAIN_AFTER_SECONDS = 0.05
# Native code may not return for minutes; who sent SIGTERM sends SIGKILL after ten seconds or so.
CLEARING_UP_SECONDS = 8.0
_ENDING = (signal.SIGTERM, signal.SIGHUP)


class Interruption(click.ClickException):
    """A command was interrupted; its exit status is what shells give, so that schedulers can tell.

    Parameters
    ----------
    number : int
        Of the signal.
    how_to_go_on : str
    """

    def __init__(self, number: int, how_to_go_on: str) -> None:
        word = "interrupted" if number == signal.SIGINT else "terminated"
        super().__init__(f"{word}; {how_to_go_on}")
        self.exit_code = 128 + number  # type: ignore[misc]


class _Caught:
    """The first signal that came, whatever became of the exception."""

    number = 0

    def handle(self, number: int, frame: FrameType | None) -> None:
        self.number = self.number or number
        # In the middle of it native code takes the exception for a broken package, or ends the process.
        if _is_importing(frame):
            _come_again(number)
        else:
            raise KeyboardInterrupt


_caught = _Caught()


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _come_again(number: int) -> None:
    # As itself: where Ctrl-C is ignored, as in background jobs, that would be lost.
    main = threading.main_thread().ident
    again = threading.Timer(AGAIN_AFTER_SECONDS, signal.pthread_kill, [main, number])
    again.daemon = True
    again.start()


def interrupted_by() -> int:
    """The signal that this command got; 0 if none."""
    return _caught.number


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise `KeyboardInterrupt` as Ctrl-C does, and remember which it was.

    A library may turn the exception into another error or drop it. Signals that are ignored, as Ctrl-C is in
    background jobs of a shell, or that the caller handles, stay as they are; and all of them outside the main
    thread.
    """
    _caught.number = 0
    usual: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}
    usual |= dict.fromkeys(_ENDING, signal.SIG_DFL)
    in_main_thread = threading.current_thread() is threading.main_thread()
    ours = {
        number: was for number, was in usual.items() if in_main_thread and signal.getsignal(number) is was
    }
    if not ours:
        yield
        return
    hook = sys.unraisablehook
    sys.unraisablehook = _interrupt_again
    sys.meta_path.insert(0, _PycolmapFinder)
    with _watching():
        for number in ours:
            signal.signal(number, _caught.handle)
        try:
            yield
        finally:
            for number, was in ours.items():
                signal.signal(number, was)
            sys.meta_path.remove(_PycolmapFinder)
            sys.unraisablehook = hook
            if _caught.number:
                _be_quiet()


def _interrupt_again(dropped: Any) -> None:
    """Repeat an interruption that came where Python has nobody to tell, as in a destructor."""
    if isinstance(dropped.exc_value, KeyboardInterrupt):
        _come_again(_caught.number or signal.SIGINT)
    else:
        sys.__unraisablehook__(dropped)


def _be_quiet() -> None:
    """Keep libraries from reporting, while Python ends, that what was interrupted has not ended well."""
    sys.unraisablehook = lambda _: None
    logging.disable(logging.CRITICAL)


@contextlib.contextmanager
def _watching() -> Iterator[None]:
    """End this process a few seconds after SIGTERM or SIGHUP, should native code not let Python handle it."""
    inner, outer = socket.socketpair()
    with inner, outer:
        outer.setblocking(False)
        # Python's handler only takes a note, but it writes the signal's number here at once.
        before = signal.set_wakeup_fd(outer.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=_end_in_time, args=(inner.dup(),), daemon=True).start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)


def _end_in_time(numbers: socket.socket) -> None:
    # It is for the main thread, which may hold it back.
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    with numbers:
        while received := numbers.recv(1):
            if received[0] in _ENDING:
                time.sleep(CLEARING_UP_SECONDS)
                os._exit(128 + received[0])


class _PycolmapFinder:
    """Takes back from pycolmap, once it is loaded, what it does to SIGTERM.

    It prints a stack trace of native code, as if something had crashed.
    """

    @classmethod
    def find_spec(cls, name: str, path: Any, target: ModuleType | None = None) -> Any:
        """As `importlib.abc.MetaPathFinder.find_spec`; nothing for other modules."""
        if name != "pycolmap":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = _then_give_back(spec.loader.exec_module)  # type: ignore[method-assign]
        return spec


def _then_give_back(load: Any) -> Any:
    def load_and_give_back(module: ModuleType) -> None:
        if threading.current_thread() is not threading.main_thread():
            load(module)
            return
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
        try:
            load(module)
        finally:
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    return load_and_give_back
