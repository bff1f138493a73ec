"""A COLMAP database of any version: keypoints, descriptors and matches, read without changing it."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.sqlite import PAIR_BASE, is_sqlite, is_truncated, require_tables, uri_for_reading
from corrsfm.errors import InputError
from corrsfm.importing.checks import features_from, matches_from
from corrsfm.types import Features, Matches, Pair

__all__ = ["DatabaseSource", "open_database"]

_SIFT_SIZE = 128
_TABLES = {"images", "keypoints", "descriptors", "matches"}
_AGAIN = "the database is damaged, copy or make it again"
_MOST_SHOWN = 20


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
        require_tables(connection, _TABLES)
        self._ids = self._find_images()
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

    def _find_images(self) -> dict[str, int]:
        """Ids by name of the images that have keypoints."""
        found: dict[str, int] = {}
        rows = self._connection.execute(
            "SELECT name, image_id FROM images WHERE image_id IN (SELECT image_id FROM keypoints)"
        )
        for name, image_id in rows:
            if type(image_id) is not int or type(name) is not str:
                raise InputError(
                    f"{self.label}: image {_shown(image_id)} is called {_shown(name)}, expected a number "
                    f"and a text; {_AGAIN}"
                )
            if name in found:
                raise InputError(f"{self.label}: {name}: is there twice; {_AGAIN}")
            found[name] = image_id
        return found

    def _find_pairs(self) -> dict[Pair, tuple[int, bool]]:
        name_of = {image_id: name for name, image_id in self._ids.items()}
        found: dict[Pair, tuple[int, bool]] = {}
        for (pair_id,) in self._connection.execute("SELECT pair_id FROM matches WHERE rows > 0"):
            if type(pair_id) is not int:
                raise InputError(
                    f"{self.label}: matches of pair {_shown(pair_id)}, expected a whole number; {_AGAIN}"
                )
            ids = divmod(pair_id, PAIR_BASE)
            if not all(image_id in name_of for image_id in ids):
                raise InputError(
                    f"{self.label}: matches of images {ids[0]} and {ids[1]}, which have no keypoints; "
                    f"{_AGAIN}"
                )
            name0, name1 = (name_of[image_id] for image_id in ids)
            pair = (min(name0, name1), max(name0, name1))
            if name0 == name1 or pair in found:
                what = "a photo is matched with itself" if name0 == name1 else "the pair is there twice"
                raise InputError(
                    f"{self.label}: {' – '.join(pair)}: {what}; delete the row of matches with pair_id "
                    f"{pair_id}, or leave all matches with --rematch"
                )
            found[pair] = pair_id, name0 > name1
        return found

    def _descriptors(self, where: str, image_id: int, num: int) -> NDArray | None:
        """(N, D) bytes of SIFT or floats of another kind; None if there are none."""
        columns = "cols, type" if self._types else "cols, 0"
        row = self._connection.execute(
            f"SELECT {columns} FROM descriptors WHERE image_id = ? AND rows > 0", (image_id,)
        ).fetchone()
        if row is None:
            return None if num else np.zeros((0, 0), np.float32)
        if type(row[1]) is not int:
            raise InputError(f"{where}: descriptors of type {_shown(row[1])}, expected a number; {_AGAIN}")
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
            raise InputError(
                f"{where}: {table} of {_shown(num_rows)} × {_shown(num_columns)} numbers are "
                f"{type(data).__name__}, expected whole numbers and bytes; {_AGAIN}"
            )
        data = data or b""
        if not num_rows and not data:
            return np.zeros((0, 2), dtype)
        if num_rows < 1 or num_columns < 1 or len(data) != num_rows * num_columns * dtype.itemsize:
            raise InputError(
                f"{where}: {table} of {num_rows} × {num_columns} numbers are {len(data)} bytes long; {_AGAIN}"
            )
        return np.frombuffer(data, dtype).reshape(num_rows, num_columns)


def _shown(value: Any) -> str:
    """What stands in place of a number or name, cut short."""
    shown = repr(value[:_MOST_SHOWN] if isinstance(value, str | bytes) else value)
    return shown if len(shown) <= 2 * _MOST_SHOWN else f"{shown[:_MOST_SHOWN]}…"


def _shapes(
    keypoints: NDArray[np.float32],
) -> tuple[NDArray[np.floating] | None, NDArray[np.floating] | None]:
    """Scales and orientations (N,) of COLMAP's keypoints, with 2, 4 or, as affine shapes, 6 numbers."""
    if keypoints.shape[1] == 2:
        return None, None
    if keypoints.shape[1] == 4:
        return keypoints[:, 2], keypoints[:, 3]
    a11, a12, a21, a22 = keypoints[:, 2:].astype(np.float64).T
    return (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2, np.arctan2(a21, a11)
