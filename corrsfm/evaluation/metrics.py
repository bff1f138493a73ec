"""The measures of the pruning and reconstruction literature, in plain numpy.

Two names that papers mix up are kept apart here. *AUC@t* is the exact area under the recall curve of the
pose error up to t degrees. *mAP@t* is the older measure: the share of pairs below 5, 10, … t degrees,
averaged. The second is about 1.8 times the first at five degrees: never compare one with the other.

Everything is in percent unless the name says otherwise, and a pair without an estimate has error ``inf``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from corrsfm.geometry import Pose, angle_between_deg, camera_centre, relative_pose, rotation_angle_deg

__all__ = [
    "POSE_THRESHOLDS_DEG",
    "Interval",
    "align_similarity",
    "auc_contributions",
    "bootstrap_mean",
    "extent_of",
    "homography_corner_error",
    "paired_bootstrap",
    "pose_auc",
    "pose_map",
    "position_errors",
    "precision_recall_f",
    "relative_pose_errors",
]


POSE_THRESHOLDS_DEG = (5.0, 10.0, 20.0)
"""Thresholds of the pose error that papers report."""


def _errors(errors: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(errors, np.float64).ravel()
    if len(values) == 0:
        raise ValueError("no errors: a score over zero pairs does not exist")
    if np.isnan(values).any() or (values < 0).any():
        raise ValueError("errors must not be negative or NaN; a failure is inf")
    return values


def pose_auc(errors: ArrayLike, thresholds: Sequence[float] = POSE_THRESHOLDS_DEG) -> list[float]:
    """Exact area under the recall curve, by the trapezoid rule.

    The curve runs through (0, 0) and (e_i, i / n) for the sorted errors e_i, and stays level from the last
    error below the threshold to the threshold.

    Parameters
    ----------
    errors : (n,) array_like
        One error per pair, in the unit of the thresholds; failures are inf.
    thresholds : sequence of float

    Returns
    -------
    list of float
        Percent, one per threshold.
    """
    ordered = np.sort(_errors(errors))
    areas = []
    for threshold in thresholds:
        below = ordered[ordered < threshold]
        recall = np.arange(len(below) + 1) / len(ordered)
        curve_x = np.concatenate([[0.0], below, [threshold]])
        curve_y = np.append(recall, recall[-1])
        area = np.sum(np.diff(curve_x) * (curve_y[1:] + curve_y[:-1]) / 2.0)
        areas.append(float(100.0 * area / threshold))
    return areas


def auc_contributions(errors: ArrayLike, threshold: float) -> NDArray[np.float64]:
    """What each pair adds to AUC@threshold: ``100 · clip(1 − e / threshold, 0, 1)``.

    Their mean equals the area under the step curve, which `pose_auc` exceeds by at most 50 / n percent. As
    a mean over pairs it can be resampled cheaply.
    """
    return 100.0 * np.clip(1.0 - _errors(errors) / threshold, 0.0, 1.0)


def pose_map(errors: ArrayLike, thresholds: Sequence[float] = POSE_THRESHOLDS_DEG) -> list[float]:
    """Mean over 5, 10, … threshold degrees of the percentage of pairs below that many degrees."""
    values = _errors(errors)
    scores = []
    for threshold in thresholds:
        edges = np.arange(5.0, threshold + 1e-9, 5.0)
        scores.append(float(100.0 * np.mean([np.mean(values < edge) for edge in edges])))
    return scores


def precision_recall_f(predicted: ArrayLike, actual: ArrayLike) -> tuple[float, float, float]:
    """Precision, recall and F of one pair, in percent.

    Each is averaged over pairs, so the mean F is not the F of the means. A measure whose denominator is zero
    is zero.

    Parameters
    ----------
    predicted, actual : (M,) array_like of bool
    """
    predicted = np.asarray(predicted, bool)
    actual = np.asarray(actual, bool)
    hits = float(np.sum(predicted & actual))
    precision = hits / max(float(np.sum(predicted)), 1.0)
    recall = hits / max(float(np.sum(actual)), 1.0)
    total = precision + recall
    return 100.0 * precision, 100.0 * recall, 100.0 * (2.0 * precision * recall / total if total else 0.0)


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A mean and the 95 % interval around it that resampling the pairs gives."""

    mean: float
    low: float
    high: float


def bootstrap_mean(values: ArrayLike, *, num_resamples: int = 2000, seed: int = 0) -> Interval:
    """Percentile bootstrap interval of a mean over pairs.

    Parameters
    ----------
    values : (n,) array_like
        One value per pair.
    num_resamples : int
    seed : int
        Equal seeds and equal n draw the same pairs, so intervals of two methods are comparable.
    """
    values = np.asarray(values, np.float64).ravel()
    if len(values) == 0:
        raise ValueError("no values to resample")
    generator = np.random.default_rng(seed)
    means = np.empty(num_resamples)
    for index in range(num_resamples):
        means[index] = values[generator.integers(0, len(values), len(values))].mean()
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(mean=float(values.mean()), low=float(low), high=float(high))


def paired_bootstrap(
    values: ArrayLike, baseline: ArrayLike, *, num_resamples: int = 2000, seed: int = 0
) -> Interval:
    """Interval of the mean difference ``values − baseline`` over the same pairs.

    Resampling pairs, not methods, removes the spread that both share. A difference whose interval contains
    zero shows nothing.
    """
    values, baseline = np.asarray(values, np.float64), np.asarray(baseline, np.float64)
    if values.shape != baseline.shape:
        raise ValueError(f"paired values differ in shape: {values.shape} and {baseline.shape}")
    return bootstrap_mean(values - baseline, num_resamples=num_resamples, seed=seed)


def homography_corner_error(estimate: ArrayLike, truth: ArrayLike, width: float, height: float) -> float:
    """Mean distance of the four image corners under two homographies.

    Parameters
    ----------
    estimate, truth : (3, 3) array_like
        Map pixels of image 0 (first pixel's centre at the origin) to pixels of image 1.
    width, height : float
        Size of image 0 in pixels.

    Returns
    -------
    float
        Pixels of image 1; inf if a corner goes to infinity.
    """
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [width - 1, height - 1, 1], [0, height - 1, 1]], float)
    with np.errstate(divide="ignore", invalid="ignore"):
        warped = [corners @ np.asarray(matrix, np.float64).T for matrix in (estimate, truth)]
        distance = np.linalg.norm(
            warped[0][:, :2] / warped[0][:, 2:] - warped[1][:, :2] / warped[1][:, 2:], axis=1
        )
        mean = float(distance.mean())
    return mean if np.isfinite(mean) else float("inf")


def align_similarity(
    source: ArrayLike, target: ArrayLike
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Least-squares similarity ``target ≈ scale · R · source + t`` (Umeyama 1991).

    Parameters
    ----------
    source, target : (n, 3) array_like
        Corresponding points, n ≥ 3 and not all on one line.

    Returns
    -------
    scale : float
    rotation : (3, 3) float64
    translation : (3,) float64

    Raises
    ------
    ValueError
        If the points leave the similarity undetermined.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 3:
        raise ValueError(f"alignment needs at least 3 pairs of points, got {source.shape}, {target.shape}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred_source, centred_target = source - mean_source, target - mean_target
    spread = np.linalg.svd(centred_source, compute_uv=False)
    if spread[1] <= 1e-9 * max(float(spread[0]), 1e-300):
        raise ValueError("alignment is undetermined: the points lie on one line")
    left, singular, right = np.linalg.svd(centred_target.T @ centred_source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(np.sum(singular * signs) / np.sum(centred_source**2))
    return scale, rotation, mean_target - scale * rotation @ mean_source


def position_errors(positions: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Distances of camera centres to the true ones after the best similarity alignment.

    Parameters
    ----------
    positions, truth : (n, 3) array_like
        Camera centres of the same photos, n ≥ 3.

    Returns
    -------
    (n,) float64
        In the units of ``truth``.
    """
    scale, rotation, translation = align_similarity(positions, truth)
    aligned = scale * np.asarray(positions, np.float64) @ rotation.T + translation
    return np.linalg.norm(aligned - np.asarray(truth, np.float64), axis=1)


def extent_of(centres: NDArray[np.float64]) -> float:
    """Diagonal of the box around camera centres (n, 3); 0 if they differ by rounding only, or without any."""
    if not len(centres):
        return 0.0
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    return extent if extent > 1e-9 * np.abs(centres).max() else 0.0


def relative_pose_errors(
    poses: Mapping[str, Pose], truth: Mapping[str, Pose], pairs: Sequence[tuple[str, str]] | None = None
) -> NDArray[np.float64]:
    """Error of the relative pose of every pair of photos of a reconstruction.

    Needs no alignment: the larger of the angle between the rotations and the angle between the translation
    directions, sign included, because a reconstruction knows which way a camera moved. Where the true
    cameras share their centre only the rotation counts.

    Parameters
    ----------
    poses, truth : mapping of name to (rotation, translation)
        ``cam_from_world``.
    pairs : sequence of (str, str), optional
        Pairs to judge; all pairs of ``truth`` in sorted order if not given.

    Returns
    -------
    (P,) float64
        Degrees; inf for pairs with a photo that is not in ``poses``.
    """
    names = sorted(truth)
    if pairs is None:
        pairs = [(first, second) for i, first in enumerate(names) for second in names[i + 1 :]]
    centres = np.array([camera_centre(pose) for pose in truth.values()])
    extent = extent_of(centres)
    errors = np.full(len(pairs), np.inf)
    for index, (first, second) in enumerate(pairs):
        if first not in poses or second not in poses:
            continue
        rotation, translation = relative_pose(*poses[first], *poses[second])
        true_rotation, true_translation = relative_pose(*truth[first], *truth[second])
        error = rotation_angle_deg(rotation @ true_rotation.T)
        if extent and np.linalg.norm(true_translation) > 1e-6 * extent:
            error = max(error, angle_between_deg(translation, true_translation))
        errors[index] = error
    return errors
