"""HDF5 files of others: opened only if everything in them is their own and can be named."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import h5py

__all__ = ["lies_elsewhere", "open_hdf5"]


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
