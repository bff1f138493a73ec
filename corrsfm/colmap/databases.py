"""Copies of a COLMAP database for other programs: for some of its photos, or in the schema of COLMAP 3.8."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections.abc import Iterable
from pathlib import Path

from corrsfm.colmap.sqlite import PAIR_BASE, copy_database, copy_errors

__all__ = ["convert_to_3_8", "copy_photos_of"]

_WGS84 = 0

_DROP_OTHERS = f"""
    DELETE FROM keypoints WHERE image_id NOT IN kept;
    DELETE FROM descriptors WHERE image_id NOT IN kept;
    DELETE FROM matches WHERE pair_id / {PAIR_BASE} NOT IN kept OR pair_id % {PAIR_BASE} NOT IN kept;
    DELETE FROM two_view_geometries
        WHERE pair_id / {PAIR_BASE} NOT IN kept OR pair_id % {PAIR_BASE} NOT IN kept;
    DELETE FROM pose_priors WHERE corr_sensor_type = 0 AND corr_data_id NOT IN kept;
    DELETE FROM frame_data WHERE sensor_type = 0 AND data_id NOT IN kept;
    DELETE FROM frames WHERE frame_id NOT IN (SELECT frame_id FROM frame_data);
    DELETE FROM images WHERE image_id NOT IN kept;
    DROP TABLE kept;
    DROP TABLE IF EXISTS corrsfm_about;
    DROP TABLE IF EXISTS corrsfm_pairs;
"""

_SCHEMA_3_8 = f"""
    CREATE TABLE cameras (
        camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL,
        width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
    CREATE TABLE images (
        image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, name TEXT NOT NULL UNIQUE,
        camera_id INTEGER NOT NULL, prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL,
        prior_tx REAL, prior_ty REAL, prior_tz REAL,
        CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < {PAIR_BASE}),
        FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
    CREATE UNIQUE INDEX index_name ON images(name);
    CREATE TABLE keypoints (
        image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
        FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
    CREATE TABLE descriptors (
        image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
        FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
    CREATE TABLE matches (
        pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE two_view_geometries (
        pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
        config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
    PRAGMA user_version = 3800;
"""

_FILL_3_8 = """
    INSERT INTO main.cameras SELECT camera_id, model, width, height, params, prior_focal_length
        FROM source.cameras;
    INSERT INTO main.images (image_id, name, camera_id) SELECT image_id, name, camera_id FROM source.images;
    INSERT INTO main.keypoints SELECT image_id, rows, cols, data FROM source.keypoints;
    INSERT INTO main.descriptors SELECT image_id, rows, cols, data FROM source.descriptors;
    INSERT INTO main.matches SELECT pair_id, rows, cols, data FROM source.matches;
    INSERT INTO main.two_view_geometries
        SELECT pair_id, rows, cols, data, config, F, E, H, qvec, tvec FROM source.two_view_geometries;
"""


def copy_photos_of(source: Path, target: Path, names: Iterable[str]) -> None:
    """Copy a database with some of its photos and what hangs on them; ids stay.

    Parameters
    ----------
    source : Path
        Not changed.
    target : Path
        Must not exist; ends up as one file, without a write-ahead log.
    names : iterable of str

    Raises
    ------
    DatabaseError
        If the source cannot be read or the target not written.
    """
    copy_database(source, target)
    with copy_errors(source, target), contextlib.closing(sqlite3.connect(target)) as database:
        with database:
            database.execute("CREATE TABLE kept (image_id INTEGER PRIMARY KEY)")
            database.executemany(
                "INSERT INTO kept SELECT image_id FROM images WHERE name = ?", [(name,) for name in names]
            )
        database.executescript(_DROP_OTHERS)
        database.execute("PRAGMA journal_mode = DELETE")
        database.execute("VACUUM")


def convert_to_3_8(source: Path, target: Path) -> None:
    """Write a database of today in the schema that COLMAP 3.8 opens; GPS positions become its priors.

    Rigs, frames and the cameras of two-view geometries have no place there.

    Parameters
    ----------
    source : Path
    target : Path
        Must not exist.

    Raises
    ------
    DatabaseError
        If the source cannot be read or the target not written.
    """
    with copy_errors(source, target), contextlib.closing(sqlite3.connect(target)) as database:
        database.executescript(_SCHEMA_3_8)
        database.execute("ATTACH ? AS source", (str(source),))
        database.executescript(_FILL_3_8)
        priors = database.execute(
            "SELECT position, corr_data_id FROM source.pose_priors"
            " WHERE corr_sensor_type = 0 AND coordinate_system = ? AND position IS NOT NULL",
            (_WGS84,),
        ).fetchall()
        with database:
            database.executemany(
                "UPDATE main.images SET prior_tx = ?, prior_ty = ?, prior_tz = ? WHERE image_id = ?",
                [(*struct.unpack("<3d", position), image_id) for position, image_id in priors],
            )
