"""Estimators of the relative pose from filtered matches, under one interface.

All of them get the same rays, pixels through the full known camera, so that it does not matter how a library
treats distortion. Thresholds are pixels of the original photos unless a docstring says otherwise.
"""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.cameras import mean_focal_px, normalise_points, to_pycolmap
from corrsfm.errors import ConfigError, DependencyError
from corrsfm.geometry import pose_error_deg, symmetric_epipolar_distance_sq
from corrsfm.labelled.oanet import OANetPair
from corrsfm.types import Correspondences, PruneResult

__all__ = [
    "ESTIMATORS",
    "PoseEstimate",
    "PoseEstimator",
    "estimator_fingerprint",
    "parse_estimator",
    "pose_errors_deg",
    "weighted_eight_point",
]

# The paper's cheirality mask and RANSAC settings, normalised units.
_CHEIRALITY_RESIDUAL = 3e-5
_LITERATURE_THRESHOLD = 1e-3
_CONFIDENCE = 0.99999
_MAX_ITERATIONS = 10000
# PoseLib's defaults: fewer would handicap it on unfiltered matches.
_POSELIB_ITERATIONS = 100000
_POSELIB_CONFIDENCE = 0.9999
# OpenCV's default. With more, its old RANSAC takes minutes for a pair.
_LITERATURE_ITERATIONS = 1000


@dataclass(frozen=True, kw_only=True)
class PoseEstimate:
    """Pose ``cam1_from_cam0`` of a pair.

    Attributes
    ----------
    rotation : (3, 3) float64
    translation : (3,) float64
        Unit length.
    inlier_mask : (M,) bool
        Matches that agree, in the order of all putative matches.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    inlier_mask: NDArray[np.bool_]


def pose_errors_deg(pose: PoseEstimate | None, pair: OANetPair) -> tuple[float, float]:
    """Rotation and translation error of an estimate in degrees; both infinite without one."""
    if pose is None:
        return math.inf, math.inf
    return pose_error_deg(pose.rotation, pose.translation, pair.rotation, pair.translation)


PoseEstimator = Callable[[Correspondences, PruneResult, int], PoseEstimate | None]
"""Takes matches, the result of a filter and a seed; returns None if it finds no pose."""


def _rays(correspondences: Correspondences) -> NDArray[np.float64]:
    """Normalised coordinates (M, 4) with the distortion of the known cameras removed."""
    sides = []
    for camera, points, columns in (
        (correspondences.camera0, correspondences.points0, slice(0, 2)),
        (correspondences.camera1, correspondences.points1, slice(2, 4)),
    ):
        if camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
            sides.append(correspondences.normalised[:, columns].astype(np.float64))
        else:
            sides.append(normalise_points(camera, points))
    return np.hstack(sides)


def _in_all(mask: NDArray[np.bool_], kept: NDArray[np.int64], num: int) -> NDArray[np.bool_]:
    full = np.zeros(num, bool)
    full[kept[mask]] = True
    return full


def _pose_from_essential(
    essential: NDArray[Any] | None,
    rays: NDArray[np.float64],
    mask: NDArray[np.bool_],
    kept: NDArray[np.int64],
    num: int,
) -> PoseEstimate | None:
    """Pose with most points in front of both cameras; ``essential`` may be several stacked matrices."""
    import cv2

    if essential is None or len(essential) < 3 or not np.isfinite(essential).all() or mask.sum() == 0:
        return None
    best, best_count = None, 0
    for start in range(0, len(essential) - 2, 3):
        count, rotation, translation, *_ = cv2.recoverPose(
            essential[start : start + 3],
            np.ascontiguousarray(rays[:, :2]),
            np.ascontiguousarray(rays[:, 2:]),
            np.eye(3),
            1e9,
            mask=mask.astype(np.uint8)[:, None],
        )
        if count > best_count and np.isfinite(translation).all():
            best, best_count = (np.asarray(rotation, np.float64), np.asarray(translation, np.float64)), count
    if best is None:
        return None
    return PoseEstimate(rotation=best[0], translation=best[1].ravel(), inlier_mask=_in_all(mask, kept, num))


def _opencv(
    correspondences: Correspondences,
    result: PruneResult,
    seed: int,
    *,
    method: str,
    threshold_px: float | None,
) -> PoseEstimate | None:
    """``cv2.findEssentialMat``. OpenCV seeds itself with a constant, so the seed shuffles the matches."""
    import cv2

    kept = np.random.default_rng(seed).permutation(np.flatnonzero(result.inlier_mask))
    if len(kept) < 6:
        return None
    if method == "USAC_PROSAC":
        # Progressive sampling takes the best first; the ratio breaks the ties of saturated scores.
        kept = kept[np.lexsort((correspondences.ratios[kept], -result.scores[kept]))]
    rays = _rays(correspondences)[kept]
    threshold = _LITERATURE_THRESHOLD
    if threshold_px is not None:
        threshold = threshold_px / mean_focal_px(correspondences.camera0, correspondences.camera1)
    try:
        essential, mask = cv2.findEssentialMat(
            np.ascontiguousarray(rays[:, :2]),
            np.ascontiguousarray(rays[:, 2:]),
            np.eye(3),
            method=getattr(cv2, method),
            prob=_CONFIDENCE,
            threshold=threshold,
            maxIters=_LITERATURE_ITERATIONS if method == "RANSAC" else _MAX_ITERATIONS,
        )
    except cv2.error:
        # USAC raises on some degenerate samples instead of returning an empty matrix.
        return None
    if mask is None:
        return None
    return _pose_from_essential(essential, rays, mask.ravel() > 0, kept, len(correspondences))


def _opencv_fundamental(
    correspondences: Correspondences, result: PruneResult, seed: int, *, threshold_px: float | None
) -> PoseEstimate | None:
    """``cv2.findFundamentalMat`` with USAC, whose degeneracy test is DEGENSAC's, then E from F."""
    import cv2

    kept = np.random.default_rng(seed).permutation(np.flatnonzero(result.inlier_mask))
    if len(kept) < 8:
        return None
    rays = _rays(correspondences)[kept]
    focal = mean_focal_px(correspondences.camera0, correspondences.camera1)
    try:
        fundamental, mask = cv2.findFundamentalMat(
            np.ascontiguousarray(rays[:, :2] * focal),
            np.ascontiguousarray(rays[:, 2:] * focal),
            cv2.USAC_DEFAULT,
            1.0 if threshold_px is None else threshold_px,
            _CONFIDENCE,
            _MAX_ITERATIONS,
        )
    except cv2.error:
        return None
    if fundamental is None or mask is None or fundamental.shape != (3, 3):
        return None
    scaling = np.diag([focal, focal, 1.0])
    left, _, right = np.linalg.svd(scaling @ fundamental @ scaling)
    essential = left @ np.diag([1.0, 1.0, 0.0]) @ right
    return _pose_from_essential(essential, rays, mask.ravel() > 0, kept, len(correspondences))


def _colmap(
    correspondences: Correspondences, result: PruneResult, seed: int, *, threshold_px: float | None
) -> PoseEstimate | None:
    """COLMAP's LO-RANSAC for essential matrices, with COLMAP's budget for two-view geometries."""
    import pycolmap

    kept = np.flatnonzero(result.inlier_mask)
    if len(kept) < 6:
        return None
    options = pycolmap.RANSACOptions(
        max_error=1.0 if threshold_px is None else threshold_px,
        confidence=0.9999,
        min_num_trials=1000,
        max_num_trials=_MAX_ITERATIONS,
        random_seed=seed,
    )
    found = pycolmap.estimate_essential_matrix(
        correspondences.points0[kept].astype(np.float64),
        correspondences.points1[kept].astype(np.float64),
        to_pycolmap(correspondences.camera0),
        to_pycolmap(correspondences.camera1),
        options,
    )
    if found is None:
        return None
    pose = found["cam2_from_cam1"]
    return PoseEstimate(
        rotation=np.asarray(pose.rotation.matrix(), np.float64),
        translation=np.asarray(pose.translation, np.float64),
        inlier_mask=_in_all(np.asarray(found["inlier_mask"], bool).ravel(), kept, len(correspondences)),
    )


def _poselib(
    correspondences: Correspondences, result: PruneResult, seed: int, *, threshold_px: float | None
) -> PoseEstimate | None:
    """PoseLib's LO-RANSAC with its own refinement, the estimator of recent matching papers."""
    try:
        import poselib
    except ImportError as error:
        raise DependencyError("poselib", "the estimator 'poselib'", "evaluate") from error
    kept = np.flatnonzero(result.inlier_mask)
    if len(kept) < 6:
        return None
    cameras = [
        {"model": c.model, "width": c.width, "height": c.height, "params": list(c.params)}
        for c in (correspondences.camera0, correspondences.camera1)
    ]
    pose, information = poselib.estimate_relative_pose(
        correspondences.points0[kept].astype(np.float64),
        correspondences.points1[kept].astype(np.float64),
        *cameras,
        {
            "max_epipolar_error": 1.0 if threshold_px is None else threshold_px,
            "seed": seed,
            "success_prob": _POSELIB_CONFIDENCE,
            "max_iterations": _POSELIB_ITERATIONS,
        },
        {},
    )
    length = float(np.linalg.norm(pose.t))
    if information["num_inliers"] < 5 or not np.isfinite(length) or length == 0:
        return None
    return PoseEstimate(
        rotation=np.asarray(pose.R, np.float64),
        translation=np.asarray(pose.t, np.float64) / length,
        inlier_mask=_in_all(np.asarray(information["inliers"], bool), kept, len(correspondences)),
    )


def weighted_eight_point(rays: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Essential matrix by weighted least squares on the epipolar constraint.

    Parameters
    ----------
    rays : (M, 4) float64
        Normalised ``x0 y0 x1 y1``, M ≥ 8.
    weights : (M,) float64
        Non-negative.

    Returns
    -------
    (3, 3) float64
        With singular values 1, 1, 0.
    """
    scalings, points = [], []
    for side in (rays[:, :2], rays[:, 2:]):
        # Centred and scaled to a mean distance of √2, or the system is badly conditioned (Hartley 1997).
        centre = np.average(side, axis=0, weights=weights)
        spread = np.average(np.linalg.norm(side - centre, axis=1), weights=weights)
        scale = np.sqrt(2.0) / max(float(spread), 1e-12)
        scalings.append(np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]]))
        points.append(np.column_stack([(side - centre) * scale, np.ones(len(side))]))
    rows = np.einsum("ni,nj->nij", points[1], points[0]).reshape(-1, 9)
    _, vectors = np.linalg.eigh(rows.T @ (rows * weights[:, None]))
    matrix = scalings[1].T @ vectors[:, 0].reshape(3, 3) @ scalings[0]
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, 0.0]) @ right


def _eight_point(
    correspondences: Correspondences, result: PruneResult, seed: int, *, threshold_px: float | None
) -> PoseEstimate | None:
    """The filter's own essential matrix, or the eight-point one weighted by its scores; no RANSAC.

    The threshold is ignored. Points in front of the cameras are counted among matches closer than 3e-5
    (squared, normalised), as in the paper.
    """
    del seed, threshold_px
    rays = correspondences.normalised.astype(np.float64)
    if result.model is not None and result.model.kind == "essential":
        essential = result.model.matrix
    else:
        weights = np.where(result.inlier_mask, np.maximum(result.scores, 1e-6), 0.0).astype(np.float64)
        if np.count_nonzero(weights) < 8:
            return None
        essential = weighted_eight_point(rays, weights)
    mask = symmetric_epipolar_distance_sq(essential, rays) < _CHEIRALITY_RESIDUAL
    return _pose_from_essential(essential, rays, mask, np.arange(len(rays)), len(rays))


ESTIMATORS: dict[str, Callable[..., PoseEstimate | None]] = {
    "ransac": partial(_opencv, method="RANSAC"),
    "usac": partial(_opencv, method="USAC_DEFAULT"),
    "accurate": partial(_opencv, method="USAC_ACCURATE"),
    "magsac": partial(_opencv, method="USAC_MAGSAC"),
    "prosac": partial(_opencv, method="USAC_PROSAC"),
    "degensac": _opencv_fundamental,
    "colmap": _colmap,
    "poselib": _poselib,
    "w8pt": _eight_point,
}
"""Estimators by name. ``ransac`` is the literature's: OpenCV's old one at 1e-3 in normalised units."""

_PACKAGES = {"colmap": "pycolmap", "poselib": "poselib", "w8pt": "numpy"}


def estimator_fingerprint(text: str) -> str:
    """Text that changes whenever results may: name, budget, version of the library."""
    package = _PACKAGES.get(text.partition(":")[0], "opencv-python-headless")
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        version = "absent"
    budget = (_CONFIDENCE, _MAX_ITERATIONS, _LITERATURE_ITERATIONS, _POSELIB_CONFIDENCE, _POSELIB_ITERATIONS)
    return f"{text}, {package} {version}, {budget}"


_DEFAULT_PX = {"ransac": None, "w8pt": None}


def parse_estimator(text: str) -> PoseEstimator:
    """Build an estimator from ``NAME`` or ``NAME:PIXELS``; the default threshold is one pixel.

    Raises
    ------
    ConfigError
        If the estimator is unknown or the threshold is not a positive number.
    """
    name, _, threshold = text.partition(":")
    if name not in ESTIMATORS:
        raise ConfigError(f"no estimator '{name}'; there are {', '.join(ESTIMATORS)}")
    threshold_px = _DEFAULT_PX.get(name, 1.0)
    if threshold:
        try:
            threshold_px = float(threshold)
        except ValueError:
            threshold_px = -1.0
        if not threshold_px > 0:
            raise ConfigError(f"estimator '{text}': the threshold must be a positive number of pixels")
    return partial(ESTIMATORS[name], threshold_px=threshold_px)
