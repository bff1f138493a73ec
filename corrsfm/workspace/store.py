"""Items of one kind in an HDF5 file, with a journal that survives a kill.

Finished items go to a journal next to the file (`corrsfm.workspace.journal`); the file itself is written in
one go and renamed into place when its stage is complete. `corrsfm.workspace.hloc` says what lies in it.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Generic

import h5py
import numpy as np

from corrsfm.errors import WorkspaceError
from corrsfm.files import atomic_path
from corrsfm.workspace.hloc import Arrays, Attributes, K, Kind, T
from corrsfm.workspace.journal import Journal

__all__ = ["ItemStore"]

FORMAT_VERSION = 1
_SECONDS = "seconds"


def _why_unreadable(error: OSError) -> str:
    """Explain why HDF5 could not read a file, so that nobody deletes a whole one."""
    if error.errno is None:
        # HDF5 objects to the content: no signature, truncated, a wrong byte.
        return f"not a readable HDF5 file ({error}); delete it and run again"
    if "unable to lock" in str(error):
        if error.errno in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES):
            cause = "in use by another program; close it there and run again"
        else:
            cause = "cannot be locked; run again"
        return f"{cause}, on a file system without locks with HDF5_USE_FILE_LOCKING=FALSE in the environment"
    if isinstance(error, PermissionError):
        return "may not be read; check the permissions of the file and its folder"
    return f"cannot be read ({error}); check the disk and run again"


def _own(dataset: h5py.Dataset, file: h5py.File) -> h5py.Dataset:
    """A dataset that lies in a file; refuses one that would be read from another, which may be any file."""
    if dataset.is_virtual or dataset.external or dataset.file.filename != file.filename:
        raise ValueError("its values lie in another file")
    return dataset


class ItemStore(Generic[K, T]):
    """Items of one kind in an HDF5 file, with a journal of those finished since it was written.

    Parameters
    ----------
    path : Path
        The HDF5 file; the journal lies beside it with the suffix ``.journal``.
    kind : Kind
    """

    def __init__(self, path: Path, kind: Kind[K, T]) -> None:
        self.path = path
        self.kind = kind
        self.journal = Journal(path.with_suffix(path.suffix + ".journal"))

    # reading ------------------------------------------------------------------------------------------------

    @contextmanager
    def _open(self) -> Iterator[h5py.File]:
        try:
            file = h5py.File(self.path, "r")
        except FileNotFoundError as error:
            raise WorkspaceError(f"{self.path}: missing; run the step that makes it") from error
        except OSError as error:
            raise WorkspaceError(f"{self.path}: {_why_unreadable(error)}") from error
        with file:
            version = file.attrs.get("version", FORMAT_VERSION)
            if version != FORMAT_VERSION:
                raise WorkspaceError(
                    f"{self.path}: format version {version}, this corrsfm reads {FORMAT_VERSION}"
                )
            yield file

    @contextmanager
    def reader(self) -> Iterator[Callable[[K], T]]:
        """Open the file once and yield a function that reads an item by key.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or (from the function) if it holds no such item.
        """
        with self._open() as file:

            def read(key: K) -> T:
                group = self._group(file, key)
                try:
                    return self.kind.decode(
                        {
                            name: _own(value, file)[()]
                            for name, value in group.items()
                            if isinstance(value, h5py.Dataset)
                        },
                        group.attrs,
                    )
                except OSError as error:
                    raise WorkspaceError(f"{self.path}: {key}: {_why_unreadable(error)}") from error
                except KeyError as error:
                    raise WorkspaceError(
                        f"{self.path}: {key} lacks {error}; move the file away and run again"
                    ) from error
                except ValueError as error:
                    raise WorkspaceError(
                        f"{self.path}: {key}: {error}; move the file away and run again"
                    ) from error

            yield read

    def read(self, key: K) -> T:
        """Read one item; see `reader`."""
        with self.reader() as read:
            return read(key)

    def fingerprints(self, keys: Iterable[K]) -> dict[K, str]:
        """Fingerprints of items in the file; of items that another tool wrote, a hash of what they hold.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or holds no such item.
        """
        with self._open() as file:
            return {key: self._fingerprint(file, key) for key in keys}

    def held(self, keys: Iterable[K]) -> dict[K, str]:
        """Fingerprints of those of the items that the file holds; see `fingerprints`."""
        with self._open() as file:
            return {key: self._fingerprint(file, key) for key in keys if self.kind.group(key) in file}

    def attributes(self, keys: Iterable[K]) -> Iterator[tuple[K, Attributes]]:
        """Attributes of items, read without their datasets.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or holds no such item.
        """
        with self._open() as file:
            for key in keys:
                yield key, dict(self._group(file, key).attrs)

    def _group(self, file: h5py.File, key: K) -> h5py.Group:
        group = file.get(self.kind.group(key))
        if group is None:
            raise WorkspaceError(f"{self.path}: holds nothing for {key}; run the step that makes it again")
        return group

    def _fingerprint(self, file: h5py.File, key: K) -> str:
        group = self._group(file, key)
        if "fingerprint" in group.attrs:
            return str(group.attrs["fingerprint"])
        digest = hashlib.sha256()
        for name in sorted(group):
            if isinstance(group[name], h5py.Dataset):
                digest.update(name.encode())
                digest.update(np.ascontiguousarray(group[name][()]).tobytes())
        return digest.hexdigest()

    def finished(self, wanted: Mapping[K, str]) -> set[K]:
        """Keys whose item is already there with the wanted fingerprint, in the file or the journal."""
        found: set[K] = set()
        if self.path.exists():
            with self._open() as file:
                for key, fingerprint in wanted.items():
                    if self.kind.group(key) in file and self._fingerprint(file, key) == fingerprint:
                        found.add(key)
        waiting = self.journal.fingerprints()
        found |= {
            key for key, fingerprint in wanted.items() if waiting.get(self.kind.group(key)) == fingerprint
        }
        return found

    # writing ------------------------------------------------------------------------------------------------

    def add(self, key: K, fingerprint: str, item: T, seconds: float = 0.0) -> None:
        """Put an item, and the seconds it took, into the journal; it is safe when this returns.

        Raises
        ------
        WorkspaceError
            If the disk is full or the journal cannot be written.
        """
        arrays, attributes = self.kind.encode(item)
        self.journal.add(self.kind.group(key), fingerprint, arrays, {**attributes, _SECONDS: seconds})

    def commit(
        self, wanted: Mapping[K, str], progress: Callable[[Iterable[K]], Iterable[K]] = iter
    ) -> tuple[int, float]:
        """Make the HDF5 file hold exactly the wanted items, from itself and the journal; all or nothing.

        Parameters
        ----------
        wanted : mapping
            Key → fingerprint.
        progress : callable
            Passes the keys on one by one as they are written; for a progress bar.

        Returns
        -------
        num_new : int
            Items that came from the journal; the others were in the file before.
        seconds : float
            That these took to make, over all runs.

        Raises
        ------
        WorkspaceError
            If an item is in neither, or the disk is full.
        """
        self._require_space()
        try:
            with atomic_path(self.path) as temporary, h5py.File(temporary, "w") as target:
                target.attrs["format"] = f"corrsfm-{self.kind.label}"
                target.attrs["version"] = FORMAT_VERSION
                seconds = self._fill(target, wanted, progress)
        # HDF5 notices some failures of writing only when it closes the file, which is a RuntimeError.
        except (OSError, RuntimeError) as error:
            raise WorkspaceError(
                f"{self.path}: cannot be written ({error}); free some disk space and run again, "
                "finished work is kept"
            ) from error
        self.discard_journal()
        return len(seconds), sum(seconds)

    def _require_space(self) -> None:
        # HDF5 may crash the process when the disk fills up. The new file is no larger than its sources.
        needed = self.journal.num_bytes() + (self.path.stat().st_size if self.path.exists() else 0)
        free = shutil.disk_usage(self.path.parent).free
        if free < needed:
            raise WorkspaceError(
                f"{self.path}: writing it needs {needed / 1e6:.0f} MB, {free / 1e6:.0f} MB are free; "
                "free some disk space and run again, finished work is kept"
            )

    def _fill(
        self,
        target: h5py.File,
        wanted: Mapping[K, str],
        progress: Callable[[Iterable[K]], Iterable[K]],
    ) -> list[float]:
        """Write all items; the seconds of those from the journal."""
        seconds = []
        with self._open() if self.path.exists() else nullcontext() as source:
            for key in progress(wanted):
                name, fingerprint = self.kind.group(key), wanted[key]
                item = self.journal.read(name, fingerprint)
                if item is not None:
                    arrays, attributes = item
                    # Not for the file: the same input gives the same bytes.
                    seconds.append(float(attributes.pop(_SECONDS, 0.0)))
                    self._write_group(target, name, fingerprint, arrays, attributes)
                elif source is not None and name in source and self._fingerprint(source, key) == fingerprint:
                    source.copy(source[name], target, name=name, shallow=False)
                else:
                    raise WorkspaceError(f"{self.path}: {key} was never finished; run again")
        return seconds

    @staticmethod
    def _write_group(
        target: h5py.File, name: str, fingerprint: str, arrays: Arrays, attributes: Attributes
    ) -> None:
        group = target.create_group(name)
        group.attrs["fingerprint"] = fingerprint
        group.attrs.update(attributes)
        for entry, values in arrays.items():
            group.create_dataset(entry, data=values)

    def discard_journal(self) -> None:
        """Forget everything that is only in the journal."""
        self.journal.discard()

    def close(self) -> None:
        """Close the journal; its items stay for the next run."""
        self.journal.close()
