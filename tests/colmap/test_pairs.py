"""Reading a COLMAP database leaves it as it is, and gives what pycolmap gives."""

import contextlib
import sqlite3
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_database import synthesize

from corrsfm.colmap.pairs import names_of_verified_pairs, read_verified_matches, read_verified_pairs
from corrsfm.errors import DatabaseError


def inliers_by_pycolmap(path: Path) -> dict[frozenset, set]:
    """Pair → the names and keypoints of its matches."""
    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        found = {}
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
            pair = [names[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id)]
            found[frozenset(pair)] = {
                frozenset(zip(pair, map(int, match), strict=True)) for match in geometry.inlier_matches
            }
    return found


def test_reading_changes_no_byte_and_agrees_with_pycolmap(tmp_path: Path) -> None:
    path = tmp_path / "a #1 %41?.db"
    synthesize(path)
    before = path.read_bytes()
    pairs = read_verified_pairs(path)
    matches = read_verified_matches(path)
    some = read_verified_matches(path, [(pairs[0].name1, pairs[0].name0), ("no", "such")])
    assert names_of_verified_pairs(path) == list(matches) == [(pair.name0, pair.name1) for pair in pairs]
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    np.testing.assert_array_equal(some[pairs[0].name0, pairs[0].name1], next(iter(matches.values())))
    assert len(some) == 1
    told = {
        frozenset(pair): {frozenset(zip(pair, map(int, match), strict=True)) for match in rows}
        for pair, rows in matches.items()
    }
    assert told == inliers_by_pycolmap(path)


def test_what_a_killed_program_wrote_last_is_read_and_stays_where_it_is(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize(path)
    num_pairs = len(read_verified_pairs(path))
    # A copy of the files of a program that has not closed them.
    (tmp_path / "copy").mkdir()
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA journal_mode = WAL")
        other.execute("DELETE FROM two_view_geometries")
        other.execute("DELETE FROM matches")
        for file in tmp_path.glob("database.db*"):
            (tmp_path / "copy" / file.name).write_bytes(file.read_bytes())
    before = (tmp_path / "copy" / "database.db").read_bytes()
    assert num_pairs and not read_verified_pairs(tmp_path / "copy" / "database.db")
    assert (tmp_path / "copy" / "database.db").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("UPDATE two_view_geometries SET data = x'00'", "damaged, pair"),
        ("DELETE FROM images WHERE image_id = 1", "damaged, it has no photo 1"),
        ("DROP TABLE images", "no such table: images; delete the file and make it again"),
    ],
)
def test_damage_is_named(tmp_path: Path, change: str, told: str) -> None:
    path = tmp_path / "database.db"
    synthesize(path)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("PRAGMA foreign_keys = OFF")
        database.execute(change)
    with pytest.raises(DatabaseError, match=told):
        read_verified_matches(path)
