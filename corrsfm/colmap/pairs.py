"""The verified pairs of a COLMAP database, read without changing it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.sqlite import PAIR_BASE, id_of_pair, open_for_reading
from corrsfm.errors import DatabaseError
from corrsfm.types import Pair, VerifiedPair

__all__ = ["names_of_verified_pairs", "read_verified_matches", "read_verified_pairs"]


def read_verified_pairs(path: Path, pairs: Iterable[Pair] = ()) -> list[VerifiedPair]:
    """Counts of every pair in a database, sorted by names.

    Parameters
    ----------
    path : Path
    pairs : iterable of Pair
        Further pairs to look up: those of them that are on record as pruned to nothing are returned with zero
        matches.

    Raises
    ------
    DatabaseError
        If there is no such database or it cannot be read.
    """
    with open_for_reading(path) as database:
        names = _names(database)
        recorded = dict(database.execute("SELECT pair_id, rows FROM matches"))
        num_inliers = dict(database.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0"))
    looked_up = _ids_of_pairs(names, pairs)
    num_matches = {pair_id: rows for pair_id, rows in recorded.items() if rows > 0 or pair_id in looked_up}
    return sorted(
        (
            VerifiedPair(
                name0=min(names_of_pair),
                name1=max(names_of_pair),
                num_matches=num_matches.get(pair_id, 0),
                num_inliers=num_inliers.get(pair_id, 0),
            )
            for pair_id in num_matches.keys() | num_inliers.keys()
            for names_of_pair in [_names_of_pair(names, pair_id, path)]
        ),
        key=lambda pair: (pair.name0, pair.name1),
    )


def names_of_verified_pairs(path: Path) -> list[Pair]:
    """The pairs with a two-view geometry, sorted; quicker than `read_verified_pairs`.

    Raises
    ------
    DatabaseError
        If there is no such database or it cannot be read.
    """
    with open_for_reading(path) as database:
        names = _names(database)
        rows = database.execute("SELECT pair_id FROM two_view_geometries WHERE rows > 0").fetchall()
    found = (_names_of_pair(names, pair_id, path) for (pair_id,) in rows)
    return sorted((min(pair), max(pair)) for pair in found)


def read_verified_matches(path: Path, pairs: Iterable[Pair] | None = None) -> dict[Pair, NDArray[np.int32]]:
    """The matches of every pair with a two-view geometry that agree with it.

    Parameters
    ----------
    path : Path
    pairs : iterable of Pair, optional
        Read only those of these that have a geometry.

    Returns
    -------
    dict of Pair to (K, 2) int32
        Keypoint indices in the photos of the pair; pairs sorted, each with its smaller name first, K ≥ 1.

    Raises
    ------
    DatabaseError
        If there is no such database or it cannot be read.
    """
    query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0"
    found: dict[Pair, NDArray[np.int32]] = {}
    with open_for_reading(path) as database:
        names = _names(database)
        if pairs is None:
            stored = database.execute(query).fetchall()
        else:
            wanted = [(pair_id,) for pair_id in sorted(_ids_of_pairs(names, pairs))]
            stored = [row for one in wanted for row in database.execute(f"{query} AND pair_id = ?", one)]
    for pair_id, num, data in stored:
        if len(data) != 8 * num:
            raise DatabaseError(f"{path}: damaged, pair {pair_id}; delete the file and make it again")
        name0, name1 = _names_of_pair(names, pair_id, path)
        matches = np.frombuffer(data, "<u4").reshape(num, 2).astype(np.int32)
        if name0 > name1:
            name0, name1, matches = name1, name0, np.ascontiguousarray(matches[:, ::-1])
        found[name0, name1] = matches
    return dict(sorted(found.items()))


def _names(database: sqlite3.Connection) -> dict[int, str]:
    return dict(database.execute("SELECT image_id, name FROM images"))


def _names_of_pair(names: dict[int, str], pair_id: int, path: Path) -> Pair:
    """Names of a pair's photos, that of the smaller id first."""
    try:
        return names[pair_id // PAIR_BASE], names[pair_id % PAIR_BASE]
    except KeyError as error:
        raise DatabaseError(
            f"{path}: damaged, it has no photo {error}; delete the file and make it again"
        ) from error


def _ids_of_pairs(names: dict[int, str], pairs: Iterable[Pair]) -> set[int]:
    """Ids of those pairs whose photos are both known."""
    ids = {name: image_id for image_id, name in names.items()}
    return {id_of_pair(ids[name0], ids[name1]) for name0, name1 in pairs if name0 in ids and name1 in ids}
