"""pycolmap's log: quiet on the terminal, kept in a file.

The log is one per process (glog), so `colmap_log` is not for use from several threads at once.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pycolmap

from corrsfm.files import make_folder, remove, unfinished_name

__all__ = ["colmap_log", "pycolmap_version"]

_SILENT = 3


def pycolmap_version() -> str:
    """Major and minor version, between which results may differ; for fingerprints."""
    return ".".join(pycolmap.__version__.split(".")[:2])


@contextlib.contextmanager
def colmap_log(log_file: Path | None = None) -> Iterator[None]:
    """Keep pycolmap quiet; collect its messages in a file.

    Parameters
    ----------
    log_file : Path, optional
        The messages are appended to it when the block ends, also when it fails. Without it they are dropped;
        pycolmap's own default would be the terminal and files in the temporary folder of the machine.
    """
    _give_back_termination()
    log = pycolmap.logging
    before = (log.minloglevel, log.alsologtostderr, log.logtostderr, log.stderrthreshold)
    log.alsologtostderr = log.logtostderr = False
    # Errors go to the terminal too unless this is higher; those that matter are told in our words.
    log.stderrthreshold = _SILENT
    log.minloglevel = _SILENT if log_file is None else 0
    try:
        if log_file is None:
            yield
        else:
            with _folder_beside(log_file) as folder:
                # One file for all levels: messages of a level go to the files of all lower levels, too.
                log.set_log_destination(log.INFO, str(folder / "colmap."))
                for level in (log.WARNING, log.ERROR, log.FATAL):
                    log.set_log_destination(level, "")
                try:
                    yield
                finally:
                    # Closing the destination flushes it.
                    log.set_log_destination(log.INFO, "")
                    _append(sorted(folder.iterdir()), log_file)
    finally:
        log.minloglevel, log.alsologtostderr, log.logtostderr, log.stderrthreshold = before


@contextlib.contextmanager
def _folder_beside(log_file: Path) -> Iterator[Path]:
    """An empty folder with a name of its own, so that what a killed process left is found and removed."""
    folder = unfinished_name(log_file)
    # Ctrl-C may come as soon as it is there.
    try:
        remove(folder)
        make_folder(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _give_back_termination() -> None:
    """Undo what importing pycolmap does to SIGTERM.

    It prints a stack trace of native code, as if something had crashed. The handler that Python knows of is
    set again; only the main thread may.
    """
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def _append(sources: list[Path], target: Path) -> None:
    # glog also leaves a link named after the program beside its file.
    texts = [source.read_bytes() for source in sources if source.is_file() and not source.is_symlink()]
    # A log that cannot be written, on a full disk say, must not hide the error that is being logged.
    with contextlib.suppress(OSError), open(target, "ab") as file:
        file.write(b"".join(texts))
