"""A journal of finished items that survives a kill: an SQLite file, one transaction an item.

An HDF5 file that is killed while being written is lost as a whole, so items wait here until the HDF5 file of
their stage is written in one go. A killed process loses at most the item it was writing.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sqlite3
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import WorkspaceError

__all__ = ["Journal"]

logger = logging.getLogger("corrsfm")

# SQLite keeps recent transactions in these files beside the database.
_SUFFIXES = ("", "-wal", "-shm")


class Journal:
    """Items by key, each with a fingerprint; opened at first use.

    Every method raises `WorkspaceError` if the file cannot be used as it is: the disk is full, another
    program holds it, it may not be written. A damaged file is renamed to ``<name>.damaged`` with a warning,
    and what it held counts as not done.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None

    def _connect(self) -> sqlite3.Connection:
        if self._connection is None:
            self._connection = sqlite3.connect(self.path, isolation_level=None)
            # In WAL mode a killed process loses only its open transaction.
            self._connection.execute("PRAGMA journal_mode=WAL")
            self._connection.execute("PRAGMA synchronous=NORMAL")
            self._connection.execute(
                "CREATE TABLE IF NOT EXISTS items (key TEXT PRIMARY KEY, fingerprint TEXT, item BLOB)"
            )
        return self._connection

    def _execute(self, statement: str, parameters: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """Rows of a statement; a damaged file is replaced by a new one first."""
        try:
            try:
                return self._connect().execute(statement, parameters).fetchall()
            except sqlite3.OperationalError:
                raise
            except sqlite3.DatabaseError as error:
                self._set_aside(error)
                return self._connect().execute(statement, parameters).fetchall()
        except sqlite3.OperationalError as error:
            self.close()
            raise WorkspaceError(f"{self.path}: {_remedy(error)}; finished work is kept") from error

    def _set_aside(self, error: sqlite3.DatabaseError) -> None:
        self.close()
        aside = self.path.with_name(f"{self.path.name}.damaged")
        for suffix in _SUFFIXES:
            with contextlib.suppress(FileNotFoundError):
                os.replace(f"{self.path}{suffix}", f"{aside}{suffix}")
        logger.warning(
            "%s: damaged (%s); kept as %s, what it held is done again", self.path, error, aside.name
        )

    def add(
        self, key: str, fingerprint: str, arrays: Mapping[str, NDArray], attributes: Mapping[str, Any]
    ) -> None:
        """Write an item; it is safe when this returns."""
        buffer = io.BytesIO()
        np.savez(buffer, **arrays, **{f"@{name}": np.asarray(value) for name, value in attributes.items()})  # type: ignore[arg-type]
        self._execute("INSERT OR REPLACE INTO items VALUES (?, ?, ?)", (key, fingerprint, buffer.getvalue()))

    def fingerprints(self) -> dict[str, str]:
        """Key → fingerprint of every item; empty without a file."""
        if not self.path.exists():
            return {}
        return {key: fingerprint for key, fingerprint in self._execute("SELECT key, fingerprint FROM items")}

    def read(self, key: str, fingerprint: str) -> tuple[dict[str, NDArray], dict[str, Any]] | None:
        """Arrays and attributes of the item with that key and fingerprint; None if there is none."""
        rows = self._execute("SELECT item FROM items WHERE key = ? AND fingerprint = ?", (key, fingerprint))
        if not rows:
            return None
        try:
            with np.load(io.BytesIO(rows[0][0]), allow_pickle=False) as stored:
                values = dict(stored)
        except (ValueError, EOFError, zipfile.BadZipFile) as error:
            # SQLite stores no checksums; the archive of an item does.
            self._execute("DELETE FROM items WHERE key = ?", (key,))
            logger.warning("%s: %s is damaged (%s) and not used", self.path, key, error)
            return None
        arrays = {name: value for name, value in values.items() if not name.startswith("@")}
        return arrays, {name[1:]: value.item() for name, value in values.items() if name.startswith("@")}

    def num_bytes(self) -> int:
        """Size on disk."""
        paths = [Path(f"{self.path}{suffix}") for suffix in _SUFFIXES]
        return sum(path.stat().st_size for path in paths if path.exists())

    def discard(self) -> None:
        """Delete the file and all items."""
        self.close()
        for suffix in _SUFFIXES:
            Path(f"{self.path}{suffix}").unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; its items stay for the next run."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def _remedy(error: sqlite3.OperationalError) -> str:
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return f"is in use by another program ({error}); close it there and run again"
    if name.startswith(("SQLITE_READONLY", "SQLITE_PERM", "SQLITE_CANTOPEN")):
        return f"cannot be written ({error}); check the permissions of the file and its folder and run again"
    return f"cannot be written ({error}); free some disk space and run again"
