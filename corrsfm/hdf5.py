"""HDF5 files: new ones, and those of others if everything in them is their own and can be named."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py

__all__ = ["create_hdf5", "lies_elsewhere", "open_hdf5"]


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading; its links are looked at before anything behind them is opened.

    Raises
    ------
    OSError
        If it is not an HDF5 file.
    ValueError
        If a link leads into another file, which may be any of this machine and may never end, or a name is
        not UTF-8.
    """
    with h5py.File(path, "r") as file:
        # An error raised while h5py goes through them would come out as another.
        if strange := file.id.links.visit(_strange_link, info=True):
            raise ValueError(strange)
        yield file


def _strange_link(name: bytes, info: h5py.h5l.LinkInfo) -> str | None:
    try:
        text = name.decode("utf-8")
    except UnicodeDecodeError:
        return f"the name {ascii(name[:60])[1:]} is not UTF-8"
    if info.type not in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT):
        return f"{text[:60]} is a link into another file; copy what it names into this one"
    return None


def lies_elsewhere(dataset: h5py.Dataset) -> bool:
    """Whether the values of a dataset would be read from another file, which may be any of this machine."""
    return bool(dataset.is_virtual or dataset.external)


class _CarefulFile(io.FileIO):
    """Keeps an error of the disk instead of raising it: met as it closes, HDF5 ends the process."""

    error: OSError | None = None

    def flush(self) -> None:
        """Nothing is held back; HDF5 looks for this on the class itself."""

    def write(self, content: Any, /) -> int:
        """Write all of it, unless something was lost before."""
        left = memoryview(content).cast("B")
        size = left.nbytes
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = OSError(error.errno, error.strerror, str(self.name))
        return size

    def check(self) -> None:
        """Raise the first error of writing, if there was one."""
        if self.error is not None:
            raise self.error


@contextlib.contextmanager
def create_hdf5(path: Path) -> Iterator[tuple[h5py.File, Callable[[], None]]]:
    """Open a new file for writing, with a function that raises what the disk has objected to so far.

    Raises
    ------
    OSError
        If the file cannot be made, or at the end if something could not be written.
    """
    with _CarefulFile(path, "w+") as raw:
        try:
            with h5py.File(raw, "w") as file:
                yield file, raw.check
        finally:
            # Also where HDF5 stumbled over what is missing: this is why.
            raw.check()
