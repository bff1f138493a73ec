"""Geometric verification of the matches in a COLMAP database."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from corrsfm.types import Camera

__all__ = ["default_verification_error_px", "verify_pairs"]


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
