"""A journal of finished items that survives a kill: an SQLite file, one transaction an item.

An HDF5 file that is killed while being written is lost as a whole, so items wait here until the HDF5 file of
their stage is written in one go. A killed process loses at most the item in work.
"""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import WorkspaceError

__all__ = ["Journal"]


class Journal:
    """Items by key, each with a fingerprint; opened at first use.

    Parameters
    ----------
    path : Path
        A file that is no readable journal is started afresh: it holds nothing worth more than that.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None

    def _connect(self) -> sqlite3.Connection:
        if self._connection is None:
            try:
                self._connection = self._open()
            except sqlite3.DatabaseError:
                self.discard()
                self._connection = self._open()
        return self._connection

    def _open(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, isolation_level=None)
        # In WAL mode a killed process loses only the transaction in work.
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")
        connection.execute(
            "CREATE TABLE IF NOT EXISTS items (key TEXT PRIMARY KEY, fingerprint TEXT, item BLOB)"
        )
        return connection

    def add(
        self, key: str, fingerprint: str, arrays: Mapping[str, NDArray], attributes: Mapping[str, Any]
    ) -> None:
        """Write an item; it is safe when this returns.

        Raises
        ------
        WorkspaceError
            If the disk is full or the file cannot be written.
        """
        buffer = io.BytesIO()
        np.savez(buffer, **arrays, **{f"@{name}": np.asarray(value) for name, value in attributes.items()})  # type: ignore[arg-type]
        try:
            self._connect().execute(
                "INSERT OR REPLACE INTO items VALUES (?, ?, ?)", (key, fingerprint, buffer.getvalue())
            )
        except sqlite3.OperationalError as error:
            raise WorkspaceError(
                f"{self.path}: cannot be written ({error}); free some disk space and run again, "
                "finished work is kept"
            ) from error

    def fingerprints(self) -> dict[str, str]:
        """Key → fingerprint of every item; empty without a file."""
        if not self.path.exists():
            return {}
        return dict(self._connect().execute("SELECT key, fingerprint FROM items"))

    def read(self, key: str, fingerprint: str) -> tuple[dict[str, NDArray], dict[str, Any]] | None:
        """Arrays and attributes of the item with that key and fingerprint; None if there is none."""
        row = (
            self._connect()
            .execute("SELECT item FROM items WHERE key = ? AND fingerprint = ?", (key, fingerprint))
            .fetchone()
        )
        if row is None:
            return None
        with np.load(io.BytesIO(row[0]), allow_pickle=False) as stored:
            values = dict(stored)
        arrays = {name: value for name, value in values.items() if not name.startswith("@")}
        return arrays, {name[1:]: value.item() for name, value in values.items() if name.startswith("@")}

    def discard(self) -> None:
        """Delete the file and all items."""
        self.close()
        for suffix in ("", "-wal", "-shm"):
            Path(f"{self.path}{suffix}").unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; its items stay for the next run."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
