"""Threads, devices and versions that this process runs on."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import itertools
import os
import platform
import select
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from corrsfm import __version__
from corrsfm.errors import ConfigError

__all__ = [
    "count_threads",
    "end_with_parent",
    "find_device",
    "hear_interruptions",
    "keep_freed_memory",
    "threaded",
    "unheard_by_children",
    "use_threads",
    "versions",
]

RECORDED_PACKAGES = ("torch", "pycolmap", "opencv-python-headless", "numpy", "h5py")

_PR_SET_PDEATHSIG = 1
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3

K = TypeVar("K")
R = TypeVar("R")


def count_threads(wanted: int) -> int:
    """Number of threads to use; 0 means every core that this process may use."""
    if wanted:
        return wanted
    # A batch job may use fewer cores than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def find_device(name: str) -> str:
    """Torch device that an option names.

    Parameters
    ----------
    name : str
        auto (CUDA if there is a GPU, else CPU), cpu, cuda or cuda:N.

    Raises
    ------
    ConfigError
        If there is no such device.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=name).cpu()  # copied back because the device "meta" allocates nothing
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        if reason.startswith("Expected one of"):  # torch then lists every device it knows of
            reason = "there is no such device"
        raise ConfigError(
            f"--device {name}: torch {torch.__version__} cannot use it here ({reason}); "
            "try auto, cpu, cuda or cuda:0"
        ) from error
    return name


def use_threads(num_threads: int) -> None:
    """Set how many threads torch uses for one operation."""
    import torch

    torch.set_num_threads(num_threads)


def threaded(work: Callable[[K], R], keys: Iterable[K], num_threads: int) -> Iterator[tuple[K, R]]:
    """Results of ``work`` in the order of the keys, a few ahead of the consumer."""
    with ThreadPoolExecutor(num_threads) as pool:
        waiting: list[tuple[K, Any]] = []
        iterator = iter(keys)
        try:
            while True:
                for key in itertools.islice(iterator, 2 * num_threads - len(waiting)):
                    waiting.append((key, pool.submit(work, key)))
                if not waiting:
                    return
                key, future = waiting.pop(0)
                yield key, future.result()
        finally:
            for _, future in waiting:
                future.cancel()


def end_with_parent(sentinel: int) -> None:
    """Kill this process once the one that started it is gone, whatever ended that one.

    Parameters
    ----------
    sentinel : int
        A file descriptor that nothing is written to and that closes with the parent: a pipe of which it holds
        the other end.
    """

    def watch() -> None:
        select.select([sentinel], [], [])
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    # The thread waits for native code that holds the interpreter, Linux does not. Others have no prctl.
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))


@contextlib.contextmanager
def unheard_by_children() -> Iterator[None]:
    """Start processes, or threads that start some, which do not get the Ctrl-C that a terminal sends to all.

    They would answer it with a traceback each. This process hears it as before, at the latest afterwards.
    """
    from multiprocessing import resource_tracker

    # Started later, by the first of these processes, it would unblock the signal again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def hear_interruptions() -> None:
    """In a process that was started `unheard_by_children`: from now on let Ctrl-C end it, without a word."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def versions(packages: Iterable[str] = RECORDED_PACKAGES) -> dict[str, str]:
    """Versions of corrsfm, of Python and of the installed packages among these."""
    found = {"corrsfm": __version__, "python": platform.python_version()}
    for package in packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def keep_freed_memory() -> None:
    """Let this process take blocks of some megabytes that it has freed again, in place of new ones.

    glibc gives them back to the system at once, and each page of a new block costs a fault: a tenth of
    the time of a network whose features take that much. Other C libraries are left as they are.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 2**25)  # the largest that it takes
        mallopt(_M_TRIM_THRESHOLD, 2**27)
