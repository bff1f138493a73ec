"""Geometric verification of the matches in a COLMAP database."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from corrsfm.colmap.sqlite import PAIR_BASE
from corrsfm.types import Camera

__all__ = ["default_verification_error_px", "verify_few_pairs", "verify_pairs"]


_COPY_FEW = f"""
    CREATE TEMP TABLE seen AS
        SELECT pair_id / {PAIR_BASE} AS image_id FROM wanted UNION SELECT pair_id % {PAIR_BASE} FROM wanted;
    INSERT INTO few.cameras SELECT * FROM main.cameras;
    INSERT INTO few.rigs SELECT * FROM main.rigs;
    INSERT INTO few.rig_sensors SELECT * FROM main.rig_sensors;
    INSERT INTO few.images SELECT * FROM main.images WHERE image_id IN seen;
    INSERT INTO few.frames SELECT * FROM main.frames WHERE frame_id IN
        (SELECT frame_id FROM main.frame_data WHERE sensor_type = 0 AND data_id IN seen);
    INSERT INTO few.frame_data SELECT * FROM main.frame_data
        WHERE frame_id IN (SELECT frame_id FROM few.frames);
    INSERT INTO few.keypoints SELECT * FROM main.keypoints WHERE image_id IN seen;
    INSERT INTO few.matches SELECT * FROM main.matches WHERE pair_id IN wanted;
"""

# Ctrl-C is obeyed between batches of pairs.
_PAIRS_PER_BATCH = 100


def default_verification_error_px(cameras: Sequence[Camera]) -> float:
    """Inlier threshold of the verification that suits photos of a size.

    COLMAP's 4 px leave room for the distortion of unknown lenses, which grows with the photos. In photos of
    1,000 px they also let matches through that are precise to 4 px only: on six validation and training
    scenes of such photos, pruned by the network, pose AUC@1° of whole reconstructions rose from 50 to 54 with
    2 px.

    Parameters
    ----------
    cameras : sequence of Camera

    Returns
    -------
    float
        0.2 % of the median longest side, between 2 and 4 px.
    """
    longest = np.median([max(camera.width, camera.height) for camera in cameras]) if cameras else 0.0
    return float(np.clip(0.002 * longest, 2.0, 4.0))


def verify_few_pairs(
    path: Path,
    pair_ids: Collection[int],
    min_num_inliers: int,
    max_error_px: float,
    seed: int,
    num_threads: int,
) -> None:
    """Verify some pairs of a database as `verify_pairs` would.

    They are verified in a database of their own beside it, which takes no time for the others: COLMAP looks
    at every pair to see which have no geometry.
    """
    few = path.with_name(f".{path.name}.few")
    few.unlink(missing_ok=True)
    try:
        pycolmap.Database.open(few).close()
        with contextlib.closing(sqlite3.connect(path)) as database:
            database.execute("ATTACH ? AS few", (str(few),))
            with database:
                database.execute("CREATE TEMP TABLE wanted (pair_id INTEGER PRIMARY KEY)")
                database.executemany("INSERT INTO wanted VALUES (?)", [(number,) for number in pair_ids])
                for statement in _COPY_FEW.split(";")[:-1]:
                    database.execute(statement)
        verify_pairs(few, min_num_inliers, max_error_px, seed, num_threads)
        with contextlib.closing(sqlite3.connect(path)) as database:
            database.execute("ATTACH ? AS few", (str(few),))
            with database:
                database.execute(
                    "INSERT OR REPLACE INTO main.two_view_geometries SELECT * FROM few.two_view_geometries"
                )
    finally:
        few.unlink(missing_ok=True)


def verify_pairs(path: Path, min_num_inliers: int, max_error_px: float, seed: int, num_threads: int) -> None:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = min_num_inliers
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    pycolmap.geometric_verification(
        path,
        pycolmap.GeometricVerifierOptions(num_threads=num_threads or -1),
        pycolmap.ExistingMatchedPairingOptions(batch_size=_PAIRS_PER_BATCH),
        options,
    )
