"""A COLMAP database of any version: keypoints, descriptors and matches, read without changing it."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.sqlite import PAIR_BASE, is_sqlite, is_truncated, uri_for_reading
from corrsfm.errors import InputError
from corrsfm.importing.checks import features_from, matches_from
from corrsfm.types import Features, Matches, Pair

__all__ = ["DatabaseSource", "open_database"]

_SIFT_SIZE = 128
_TABLES = {"images", "keypoints", "descriptors", "matches"}


@contextlib.contextmanager
def open_database(path: Path, *, with_matches: bool) -> Iterator[DatabaseSource]:
    """Open a database for reading.

    Raises
    ------
    InputError
        If it is missing, damaged or no COLMAP database, or in use.
    """
    if not path.is_file() or not is_sqlite(path):
        what = "is not a COLMAP database" if path.exists() else "no such file"
        raise InputError(f"{path}: {what}; expected a database.db with keypoints")
    if is_truncated(path):
        raise InputError(f"{path}: damaged, its end is missing; copy or make it again")
    try:
        with contextlib.closing(sqlite3.connect(uri_for_reading(path), uri=True)) as connection:
            yield DatabaseSource(path, connection, with_matches=with_matches)
    except sqlite3.Error as error:
        raise InputError(
            f"{path}: cannot be read as a COLMAP database ({error}); close other programs that use it, or "
            "make it again"
        ) from error


class DatabaseSource:
    """A database; see `corrsfm.importing.Source`."""

    def __init__(self, path: Path, connection: sqlite3.Connection, *, with_matches: bool) -> None:
        self._connection = connection
        self.label = str(path)
        # A view may never end.
        views = connection.execute("SELECT name FROM sqlite_master WHERE type = 'view'").fetchall()
        if strange := sorted({str(name) for (name,) in views} & _TABLES):
            raise InputError(f"{path}: {', '.join(strange)} is a view; COLMAP's databases hold tables")
        rows = connection.execute(
            "SELECT name, image_id FROM images WHERE image_id IN (SELECT image_id FROM keypoints)"
        )
        self._ids = {str(name): int(image_id) for name, image_id in rows}
        self.names = sorted(self._ids)
        if not self.names:
            raise InputError(f"{path}: holds no keypoints; extract features there first")
        self._types = "type" in {row[1] for row in connection.execute("PRAGMA table_info(descriptors)")}
        self._pair_ids: dict[Pair, tuple[int, bool]] = {}
        if with_matches:
            self._pair_ids = self._find_pairs()
        self.pairs = sorted(self._pair_ids)

    def features(self, name: str, image_size: tuple[int, int]) -> Features:
        """See `corrsfm.importing.Source`."""
        where = f"{self.label}: {name}"
        keypoints = self._array(where, "keypoints", self._ids[name], np.dtype(np.float32))
        if keypoints.shape[1] not in (2, 4, 6):
            raise InputError(f"{where}: keypoints of {keypoints.shape[1]} numbers, expected 2, 4 or 6")
        scales, orientations = _shapes(keypoints)
        return features_from(
            where,
            keypoints[:, :2],
            self._descriptors(where, self._ids[name], len(keypoints)),
            image_size,
            scales=scales,
            orientations=orientations,
        )

    def matches(self, pair: Pair, num0: int, num1: int) -> Matches:
        """See `corrsfm.importing.Source`."""
        pair_id, swapped = self._pair_ids[pair]
        where = f"{self.label}: {' – '.join(pair)}"
        indices = self._array(where, "matches", pair_id, np.dtype(np.uint32)).astype(np.int64)
        if indices.shape[1] != 2:
            raise InputError(f"{where}: matches of {indices.shape[1]} numbers, expected 2")
        return matches_from(where, indices[:, ::-1] if swapped else indices, num0, num1, None)

    def remarks(self) -> list[str]:
        """See `corrsfm.importing.Source`."""
        return []

    def _find_pairs(self) -> dict[Pair, tuple[int, bool]]:
        name_of = {image_id: name for name, image_id in self._ids.items()}
        found: dict[Pair, tuple[int, bool]] = {}
        for (pair_id,) in self._connection.execute("SELECT pair_id FROM matches WHERE rows > 0"):
            ids = divmod(int(pair_id), PAIR_BASE)
            if not all(image_id in name_of for image_id in ids):
                raise InputError(
                    f"{self.label}: matches of images {ids[0]} and {ids[1]}, which have no keypoints"
                )
            name0, name1 = (name_of[image_id] for image_id in ids)
            found[min(name0, name1), max(name0, name1)] = int(pair_id), name0 > name1
        return found

    def _descriptors(self, where: str, image_id: int, num: int) -> NDArray | None:
        """(N, D) bytes of SIFT or floats of another kind; None if there are none."""
        columns = "cols, type" if self._types else "cols, 0"
        row = self._connection.execute(
            f"SELECT {columns} FROM descriptors WHERE image_id = ? AND rows > 0", (image_id,)
        ).fetchone()
        if row is None:
            return None if num else np.zeros((0, 0), np.float32)
        is_sift = row[0] == _SIFT_SIZE and row[1] <= 0
        stored = self._array(where, "descriptors", image_id, np.dtype(np.uint8))
        if is_sift:
            return stored
        if stored.shape[1] % 4:
            raise InputError(f"{where}: descriptors of {stored.shape[1]} bytes are neither SIFT's nor floats")
        return np.ascontiguousarray(stored).view(np.float32)

    def _array(self, where: str, table: str, key: int, dtype: np.dtype) -> NDArray:
        column = "pair_id" if table == "matches" else "image_id"
        num_rows, num_columns, data = self._connection.execute(
            f"SELECT rows, cols, data FROM {table} WHERE {column} = ?", (key,)
        ).fetchone()
        if type(num_rows) is not int or type(num_columns) is not int or not isinstance(data, bytes | None):
            raise InputError(f"{where}: {table} are {num_rows!r} × {num_columns!r}; the database is damaged")
        data = data or b""
        values = np.frombuffer(data[: len(data) - len(data) % dtype.itemsize], dtype)
        if num_rows < 0 or num_columns < 0 or len(data) != num_rows * num_columns * dtype.itemsize:
            raise InputError(
                f"{where}: {table} of {num_rows} × {num_columns} numbers are {len(data)} bytes long; "
                "the database is damaged"
            )
        return values.reshape(num_rows, num_columns or 2)


def _shapes(
    keypoints: NDArray[np.float32],
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Scales and orientations (N,) of COLMAP's keypoints, with 2, 4 or, as affine shapes, 6 numbers."""
    if keypoints.shape[1] == 2:
        return None, None
    if keypoints.shape[1] == 4:
        return keypoints[:, 2], keypoints[:, 3]
    a11, a12, a21, a22 = keypoints[:, 2:].T
    return (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2, np.arctan2(a21, a11)
