"""The verified pairs of a COLMAP database."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.sqlite import database_errors
from corrsfm.errors import DatabaseError
from corrsfm.types import Pair, VerifiedPair

__all__ = ["names_of_verified_pairs", "read_verified_matches", "read_verified_pairs"]


def read_verified_pairs(path: Path, pairs: Iterable[Pair] = ()) -> list[VerifiedPair]:
    """Counts of every pair in a database, sorted by names.

    Parameters
    ----------
    path : Path
    pairs : iterable of Pair
        Further pairs to look up. COLMAP's tables do not list pairs without matches; those of ``pairs`` that
        are on record as pruned to nothing are returned with zero matches.

    Raises
    ------
    DatabaseError
        If there is no such database or it is in use.
    """
    if not path.exists():
        raise DatabaseError(f"{path}: no such database; try: corrsfm prune WORKSPACE")
    with colmap_log(), database_errors(path), pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ids = {name: image_id for image_id, name in names.items()}
        num_matches = dict(zip(*database.read_num_matches(), strict=True))
        for name0, name1 in pairs:
            known = name0 in ids and name1 in ids
            if known and database.exists_matches(ids[name0], ids[name1]):
                num_matches.setdefault(pycolmap.image_pair_to_pair_id(ids[name0], ids[name1]), 0)
        num_inliers = dict(zip(*database.read_two_view_geometry_num_inliers(), strict=True))
        verified = []
        for pair_id in {**num_matches, **num_inliers}:
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            name0, name1 = sorted((names[id0], names[id1]))
            verified.append(
                VerifiedPair(
                    name0=name0,
                    name1=name1,
                    num_matches=num_matches.get(pair_id, 0),
                    num_inliers=num_inliers.get(pair_id, 0),
                )
            )
    return sorted(verified, key=lambda pair: (pair.name0, pair.name1))


def names_of_verified_pairs(path: Path) -> list[Pair]:
    """The pairs with a two-view geometry, sorted; quicker than `read_verified_pairs`.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    with colmap_log(), database_errors(path), pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        counts = zip(*database.read_two_view_geometry_num_inliers(), strict=True)
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id, num in counts if num > 0]
    return sorted((min(names[a], names[b]), max(names[a], names[b])) for a, b in pairs)


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
    if not path.exists():
        raise DatabaseError(f"{path}: no such database; try: corrsfm prune WORKSPACE")
    found: dict[Pair, NDArray[np.int32]] = {}
    with colmap_log(), database_errors(path), pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        for pair_id, geometry in _geometries(database, names, pairs):
            if not len(geometry.inlier_matches):
                continue
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.asarray(geometry.inlier_matches, np.int32).reshape(-1, 2)
            if names[id0] > names[id1]:
                id0, id1, matches = id1, id0, matches[:, ::-1]
            found[names[id0], names[id1]] = np.ascontiguousarray(matches)
    return dict(sorted(found.items()))


def _geometries(
    database: pycolmap.Database, names: dict[int, str], pairs: Iterable[Pair] | None
) -> Iterator[tuple[int, pycolmap.TwoViewGeometry]]:
    """The geometries of all pairs, or of some, by COLMAP's id of the pair; its smaller image id is first."""
    if pairs is None:
        yield from zip(*database.read_two_view_geometries(), strict=True)
        return
    ids = {name: image_id for image_id, name in names.items()}
    for name0, name1 in pairs:
        if name0 in ids and name1 in ids:
            id0, id1 = sorted((ids[name0], ids[name1]))
            if database.exists_two_view_geometry(id0, id1):
                yield pycolmap.image_pair_to_pair_id(id0, id1), database.read_two_view_geometry(id0, id1)
