"""Which pairs of a database were verified, and from what: a table of ours beside COLMAP's, which ignores it.

A database whose photos, cameras and options have not changed keeps the pairs whose matches have not changed
either; only the others are written and verified again.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Mapping, Set
from pathlib import Path

from corrsfm.colmap.sqlite import database_errors, id_of_pair, require_colmap_tables
from corrsfm.types import Pair

__all__ = ["forget_pairs", "image_ids", "recorded_pairs", "remember_pairs"]

_TABLES = """
    CREATE TABLE IF NOT EXISTS corrsfm_about (base TEXT NOT NULL);
    CREATE TABLE IF NOT EXISTS corrsfm_pairs (pair_id INTEGER PRIMARY KEY, fingerprint TEXT NOT NULL);
"""


def recorded_pairs(path: Path, base: str) -> dict[int, str]:
    """COLMAP's pair id → fingerprint of the pairs that a database holds, verified.

    Parameters
    ----------
    path : Path
    base : str
        Fingerprint of everything that all pairs depend on.

    Returns
    -------
    dict
        Empty if the database is damaged or was made from something else, or another program changed pairs.
    """
    with database_errors(path):
        try:
            return _recorded_pairs(path, base)
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:
            return {}


def _recorded_pairs(path: Path, base: str) -> dict[int, str]:
    with _connection(path) as database:
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
        if not {"corrsfm_about", "corrsfm_pairs", "matches", "two_view_geometries"} <= tables:
            return {}
        if database.execute("SELECT base FROM corrsfm_about").fetchall() != [(base,)]:
            return {}
        others = database.execute(
            "SELECT count(*) FROM matches WHERE pair_id NOT IN (SELECT pair_id FROM corrsfm_pairs)"
        ).fetchone()
        if others != (0,):
            return {}
        return dict(
            database.execute("SELECT pair_id, fingerprint FROM corrsfm_pairs JOIN matches USING (pair_id)")
        )


def image_ids(path: Path) -> dict[str, int]:
    """Name → id of the images of a database."""
    with database_errors(path), _connection(path) as database:
        return _image_ids(database)


def _image_ids(database: sqlite3.Connection) -> dict[str, int]:
    return dict(database.execute("SELECT name, image_id FROM images"))


def forget_pairs(path: Path, pair_ids: Set[int]) -> None:
    """Drop pairs from a database, with their matches and geometries; all or nothing."""
    with database_errors(path), _connection(path) as database, database:
        for table in ("corrsfm_pairs", "two_view_geometries", "matches"):
            database.executemany(f"DELETE FROM {table} WHERE pair_id = ?", [(number,) for number in pair_ids])


def remember_pairs(path: Path, base: str, fingerprints: Mapping[Pair, str]) -> None:
    """Record pairs as verified.

    Parameters
    ----------
    path : Path
    base : str
        As for `recorded_pairs`.
    fingerprints : mapping
    """
    with database_errors(path), _connection(path) as database:
        database.executescript(_TABLES)
        ids = _image_ids(database)
        with database:
            database.execute("DELETE FROM corrsfm_about")
            database.execute("INSERT INTO corrsfm_about VALUES (?)", (base,))
            database.executemany(
                "INSERT OR REPLACE INTO corrsfm_pairs VALUES (?, ?)",
                ((id_of_pair(ids[name0], ids[name1]), text) for (name0, name1), text in fingerprints.items()),
            )


@contextlib.contextmanager
def _connection(path: Path) -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(path, timeout=5)) as database:
        require_colmap_tables(database)
        yield database
