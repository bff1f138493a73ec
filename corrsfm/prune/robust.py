"""Robust estimation of two-view geometry: LO-RANSAC by COLMAP, MAGSAC++ by OpenCV, and the errors to a model.

A part of the prune stage. A camera whose focal length is only a guess never gets an essential matrix: the
guess would be forced onto the estimate, so a fundamental matrix is estimated instead, as COLMAP does.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import mean_focal_px, to_pycolmap
from corrsfm.colmap.log import colmap_log
from corrsfm.geometry import symmetric_epipolar_distance_sq
from corrsfm.types import Camera, Correspondences, TwoViewModel

__all__ = [
    "TwoViewEstimate",
    "lo_ransac",
    "magsac",
    "msac_scores",
    "normalised_residuals",
    "sampson_errors_px",
]

# Seven points fix a fundamental matrix; one more is the least that can support it.
MIN_NUM_INLIERS = 8

_CONFIDENCE = 0.9999
_MAX_MAGSAC_ITERATIONS = 10_000
# Errors of inliers follow a χ distribution, whose 99 % quantile is 3.64 σ; OpenCV's threshold is σ.
_MAGSAC_QUANTILE = 3.64


@dataclass(frozen=True, kw_only=True)
class TwoViewEstimate:
    """What a robust estimator found among the putative matches of one pair.

    Attributes
    ----------
    model : TwoViewModel or None
        None if nothing was found; then no match is an inlier.
    inlier_mask : (M,) bool
        Inliers among the candidates, in the order of the putative matches.
    """

    model: TwoViewModel | None
    inlier_mask: NDArray[np.bool_]


def _usable(pair: Correspondences, candidates: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Indices of the candidates with finite coordinates."""
    finite = np.isfinite(pair.points0).all(axis=1) & np.isfinite(pair.points1).all(axis=1)
    finite &= np.isfinite(pair.normalised).all(axis=1)
    return np.flatnonzero(candidates & finite)


# ---------------------------------------------------------------------------------------------- LO-RANSAC


def lo_ransac(
    pairs: Sequence[Correspondences],
    candidates: Sequence[NDArray[np.bool_]],
    *,
    max_error_px: float,
    seed: int = 0,
    threads: int = 0,
) -> list[TwoViewEstimate]:
    """Two-view geometry of many pairs by COLMAP's own estimator and rules, on all threads.

    Essential, fundamental and homography matrices compete where both focal lengths are known, fundamental
    and homography where not. Called from Python threads the estimator holds the interpreter's lock, so the
    pairs travel through a temporary COLMAP database, whose verification runs on native threads. The result
    of a pair depends neither on the other pairs nor on the number of threads.

    Parameters
    ----------
    pairs : sequence of Correspondences
    candidates : sequence of (M,) bool
        The matches of each pair that may take part.
    max_error_px : float
        Inlier threshold on the Sampson error, pixels.
    seed : int
    threads : int
        0 for all cores.

    Returns
    -------
    list of TwoViewEstimate
    """
    rows = [_usable(pair, mask) for pair, mask in zip(pairs, candidates, strict=True)]
    todo = [index for index, row in enumerate(rows) if len(row) >= MIN_NUM_INLIERS]
    estimates = [TwoViewEstimate(model=None, inlier_mask=np.zeros(len(pair), bool)) for pair in pairs]
    if not todo:
        return estimates
    with tempfile.TemporaryDirectory(prefix="corrsfm-") as folder:
        path = Path(folder) / "verify.db"
        _write_pairs(path, [(pairs[index], rows[index]) for index in todo])
        with colmap_log():
            pycolmap.geometric_verification(
                path,
                pycolmap.GeometricVerifierOptions(num_threads=threads if threads > 0 else -1),
                pycolmap.ExistingMatchedPairingOptions(),
                _colmap_options(max_error_px, seed),
            )
        with pycolmap.Database.open(path) as database:
            for position, index in enumerate(todo):
                geometry = database.read_two_view_geometry(2 * position + 1, 2 * position + 2)
                estimates[index] = _from_colmap(geometry, rows[index], len(pairs[index]))
    return estimates


def _colmap_options(max_error_px: float, seed: int) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_NUM_INLIERS
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    return options


def _write_pairs(path: Path, pairs: Sequence[tuple[Correspondences, NDArray[np.intp]]]) -> None:
    """A database with images ``2i + 1`` and ``2i + 2`` for pair i, whose keypoints are its candidates."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for position, (pair, rows) in enumerate(pairs):
            for side, camera, points in (
                (1, pair.camera0, pair.points0[rows]),
                (2, pair.camera1, pair.points1[rows]),
            ):
                number = 2 * position + side
                database.write_camera(to_pycolmap(camera, number), use_camera_id=True)
                image = pycolmap.Image(name=str(number), camera_id=number)
                image.image_id = number
                database.write_image(image, use_image_id=True)
                database.write_keypoints(number, points)
            order = np.arange(len(rows), dtype=np.uint32)
            database.write_matches(2 * position + 1, 2 * position + 2, np.stack([order, order], axis=1))


def _from_colmap(geometry: pycolmap.TwoViewGeometry, rows: NDArray[np.intp], num: int) -> TwoViewEstimate:
    mask = np.zeros(num, bool)
    mask[rows[np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)[:, 0]]] = True
    uncalibrated = geometry.config == int(pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
    model = None
    if mask.any():
        if geometry.E is not None and not uncalibrated:
            model = TwoViewModel(kind="essential", matrix=np.array(geometry.E, np.float64))
        elif geometry.F is not None:
            model = TwoViewModel(kind="fundamental", matrix=np.array(geometry.F, np.float64))
    return TwoViewEstimate(model=model, inlier_mask=mask)


# ------------------------------------------------------------------------------------------------- MAGSAC++


def magsac(
    pairs: Sequence[Correspondences],
    candidates: Sequence[NDArray[np.bool_]],
    *,
    max_error_px: float,
    seed: int = 0,
    threads: int = 0,
) -> list[TwoViewEstimate]:
    """Two-view geometry by OpenCV's USAC framework with MAGSAC++ scoring and local optimisation.

    Parameters and result as for `lo_ransac`. MAGSAC++ weighs errors up to ``max_error_px`` instead of
    cutting there, but a match is an inlier by the same rule: a Sampson error below ``max_error_px``.
    """
    with ThreadPoolExecutor(threads if threads > 0 else None) as pool:
        return list(
            pool.map(lambda pair, mask: _magsac_pair(pair, mask, max_error_px, seed), pairs, candidates)
        )


def _magsac_pair(
    pair: Correspondences, candidates: NDArray[np.bool_], max_error_px: float, seed: int
) -> TwoViewEstimate:
    rows = _usable(pair, candidates)
    nothing = TwoViewEstimate(model=None, inlier_mask=np.zeros(len(pair), bool))
    if len(rows) < MIN_NUM_INLIERS:
        return nothing
    params = cv2.UsacParams()
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.final_polisher = cv2.MAGSAC
    params.confidence = _CONFIDENCE
    params.maxIterations = _MAX_MAGSAC_ITERATIONS
    params.randomGeneratorState = seed
    params.threshold = max_error_px / _MAGSAC_QUANTILE
    calibrated = pair.camera0.has_prior_focal_length and pair.camera1.has_prior_focal_length
    try:
        if calibrated:
            points = pair.normalised[rows].astype(np.float64)
            params.threshold /= mean_focal_px(pair.camera0, pair.camera1)
            eye = np.eye(3)
            matrix, _ = cv2.findEssentialMat(points[:, :2], points[:, 2:], eye, eye, None, None, params)
        else:
            matrix, _ = cv2.findFundamentalMat(
                pair.points0[rows].astype(np.float64), pair.points1[rows].astype(np.float64), params
            )
    except cv2.error:
        # OpenCV refuses some degenerate sets, such as identical points, instead of finding nothing.
        return nothing
    if matrix is None or np.shape(matrix) != (3, 3) or not np.isfinite(matrix).all() or not np.any(matrix):
        return nothing
    kind: Literal["essential", "fundamental"] = "essential" if calibrated else "fundamental"
    model = TwoViewModel(kind=kind, matrix=np.asarray(matrix, np.float64))
    inlier_mask = candidates & (sampson_errors_px(model, pair) < max_error_px)
    if np.count_nonzero(inlier_mask) < MIN_NUM_INLIERS:
        return nothing
    return TwoViewEstimate(model=model, inlier_mask=inlier_mask)


# --------------------------------------------------------------------------------------- errors to a model


def _calibration_matrix(camera: Camera) -> NDArray[np.float64]:
    return np.asarray(to_pycolmap(camera).calibration_matrix(), np.float64)


def _residual_of_nothing(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Set distances of non-finite coordinates to infinity."""
    return np.where(np.isfinite(values), values, np.inf)


def sampson_errors_px(model: TwoViewModel, pair: Correspondences) -> NDArray[np.float64]:
    """Distance of every match to a model.

    Parameters
    ----------
    model : TwoViewModel
        Essential or fundamental.
    pair : Correspondences

    Returns
    -------
    (M,) float64
        Sampson errors in pixels; infinite where coordinates are not finite. An essential matrix is judged
        in normalised coordinates, scaled by the mean focal length.
    """
    if model.kind == "essential":
        points, scale = pair.normalised.astype(np.float64), mean_focal_px(pair.camera0, pair.camera1)
    else:
        points, scale = np.hstack([pair.points0, pair.points1]).astype(np.float64), 1.0
    ones = np.ones((len(points), 1))
    x0, x1 = np.hstack([points[:, :2], ones]), np.hstack([points[:, 2:], ones])
    with np.errstate(all="ignore"):
        line_in_1, line_in_0 = x0 @ model.matrix.T, x1 @ model.matrix
        slope_sq = (line_in_1[:, :2] ** 2).sum(axis=1) + (line_in_0[:, :2] ** 2).sum(axis=1)
        errors = scale * np.abs((x1 * line_in_1).sum(axis=1)) / np.sqrt(slope_sq)
    return _residual_of_nothing(errors)


def normalised_residuals(model: TwoViewModel, pair: Correspondences) -> NDArray[np.float32]:
    """Squared symmetric epipolar distances in normalised coordinates, whatever the kind of the model.

    Returns
    -------
    (M,) float32
        Infinite where coordinates are not finite.
    """
    matrix = model.matrix
    if model.kind == "fundamental":
        matrix = _calibration_matrix(pair.camera1).T @ matrix @ _calibration_matrix(pair.camera0)
        matrix = matrix / np.linalg.norm(matrix)
    with np.errstate(all="ignore"):
        return _residual_of_nothing(symmetric_epipolar_distance_sq(matrix, pair.normalised)).astype(
            np.float32
        )


def msac_scores(errors_px: NDArray[np.float64], max_error_px: float) -> NDArray[np.float32]:
    """How well a model explains each match: 1 on its epipolar line, 0 from ``max_error_px`` on.

    Returns
    -------
    (M,) float32
        ``1 − min(error² / max_error², 1)``; the sum over the matches is the MSAC score of the model.
    """
    return (1.0 - np.minimum((errors_px / max_error_px) ** 2, 1.0)).astype(np.float32)
