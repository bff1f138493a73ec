"""What the matches of one pair say about the focal lengths of its two photos.

A pair speaks twice. Its *vote* is the focal length of the six-point solution with the most inliers (one focal
length for both photos). Its *misfit curve* says how much worse every other focal length would explain its
matches. The curve matters because many pairs determine nothing: wherever the optical axes meet at equal
distances, as around an object or under a robot arm, every focal length fits (Sturm, "On focal length
calibration from two views", CVPR 2001). Such a pair votes at random, and its flat curve admits it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from corrsfm.geometry import essential_from_pose

__all__ = [
    "CANDIDATE_RATIOS",
    "MIN_NUM_MATCHES",
    "PairEvidence",
    "PairPoints",
    "densest_votes",
    "misfit",
    "mode_of_votes",
    "objections",
    "weigh_pair",
]

MIN_NUM_MATCHES = 60
"""Fewer matches say too little about a focal length."""

CANDIDATE_RATIOS: NDArray[np.float64] = np.exp(np.arange(np.log(0.4), np.log(4.2), 0.1))
"""(24,) focal lengths over the longest side that curves are measured at: ultra-wide phones to long zooms."""

MAX_ERROR_PX = 1.5
# A curve needs only the shape of the misfit; more matches cost time and change little.
_MAX_NUM_MATCHES = 120
_MIN_NUM_INLIERS = 30
# The solution with most inliers is mostly found among the first hundred; a thousand cover 30 % inliers.
_MIN_VOTE_ITERATIONS, _MAX_VOTE_ITERATIONS = 100, 1000
# Each candidate starts from the pose of its neighbour and needs few new ones; without any, a planar scene
# follows the wrong one of its two poses.
_CURVE_ITERATIONS = 15
# Width of the kernel around a vote, in log f: 5 %.
_KERNEL_WIDTH = 0.05
# A pair refuses a focal length that turns this share of its inliers into outliers.
_REFUSED_SHARE = 0.1


@dataclass(frozen=True, kw_only=True)
class PairPoints:
    """Matched points of a pair.

    Attributes
    ----------
    name0, name1 : str
    points0_px, points1_px : (M, 2) float64
        Pixels minus the principal point.
    """

    name0: str
    name1: str
    points0_px: NDArray[np.float64]
    points1_px: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points0_px)


@dataclass(frozen=True, kw_only=True)
class PairEvidence:
    """Vote and misfit curve of a pair.

    Attributes
    ----------
    name0, name1 : str
    ratio : float
        The vote, over the longest side.
    num_inliers : int
        Matches, of 120 at most, within 1.5 px of the vote's epipolar geometry.
    curve : (24,) float64
        Misfit with each of `CANDIDATE_RATIOS` for both photos, see `misfit`.
    points : PairPoints
        The matches looked at.
    """

    name0: str
    name1: str
    ratio: float
    num_inliers: int
    curve: NDArray[np.float64]
    points: PairPoints


def weigh_pair(pair: PairPoints, longest_side_px: float, *, seed: int = 0) -> PairEvidence | None:
    """Vote and misfit curve of a pair whose photos are supposed to share a focal length.

    Parameters
    ----------
    pair : PairPoints
        If there are more than 120 matches, 120 spread evenly over their order are used.
    longest_side_px : float
        Of the photos.
    seed : int
        Of the random samples; equal seeds give equal evidence.

    Returns
    -------
    PairEvidence or None
        None with fewer than 60 matches, or if fewer than 30 agree with any focal length.
    """
    if len(pair) < MIN_NUM_MATCHES:
        return None
    pair = _thinned(pair)
    solution, information = poselib.estimate_shared_focal_relative_pose(
        pair.points0_px,
        pair.points1_px,
        np.zeros(2),
        {
            "max_epipolar_error": MAX_ERROR_PX,
            "min_iterations": _MIN_VOTE_ITERATIONS,
            "max_iterations": _MAX_VOTE_ITERATIONS,
            "seed": seed,
        },
        {},
    )
    ratio = float(solution.camera1.focal()) / longest_side_px
    if information["num_inliers"] < _MIN_NUM_INLIERS or not (np.isfinite(ratio) and ratio > 0):
        return None
    return PairEvidence(
        name0=pair.name0,
        name1=pair.name1,
        ratio=ratio,
        num_inliers=int(information["num_inliers"]),
        curve=_curve(pair, longest_side_px, ratio, solution.pose, seed),
        points=pair,
    )


def misfit(
    pair: PairPoints,
    focal0_px: float,
    focal1_px: float,
    *,
    seed: int = 0,
    pose: poselib.CameraPose | None = None,
) -> tuple[float, poselib.CameraPose]:
    """How badly the matches fit two given focal lengths, at the best pose found for these.

    Parameters
    ----------
    pair : PairPoints
    focal0_px, focal1_px : float
    seed : int
    pose : poselib.CameraPose, optional
        Where the search starts.

    Returns
    -------
    misfit : float
        Sum over the matches of ``min(d² / t², 1)`` with the Sampson distance d and t = 1.5 px: the number of
        outliers, and a part of an outlier for every inlier.
    pose : poselib.CameraPose
        The best one.
    """
    pose, _ = poselib.estimate_relative_pose(
        pair.points0_px,
        pair.points1_px,
        _pinhole(focal0_px),
        _pinhole(focal1_px),
        {
            "max_epipolar_error": MAX_ERROR_PX,
            "min_iterations": _CURVE_ITERATIONS,
            "max_iterations": _CURVE_ITERATIONS,
            "seed": seed,
        },
        {},
        pose,
    )
    essential = essential_from_pose(pose.R, pose.t)
    squared = _sampson_sq_px(pair, essential, focal0_px, focal1_px)
    return float(np.minimum(squared / MAX_ERROR_PX**2, 1.0).sum()), pose


def mode_of_votes(ratios: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Mode of weighted votes under a Gaussian kernel of 5 % in log f.

    Parameters
    ----------
    ratios, weights : (K,) float64
        Focal lengths over the longest side, and what each counts.
    """
    return densest_votes(ratios, weights, 1)[0]


def densest_votes(ratios: NDArray[np.float64], weights: NDArray[np.float64], num: int) -> list[float]:
    """The highest local maxima of the votes' density, the highest first."""
    grid = np.arange(
        np.log(CANDIDATE_RATIOS[0]) - 0.3, np.log(CANDIDATE_RATIOS[-1]) + 0.3, 0.1 * _KERNEL_WIDTH
    )
    votes = np.clip(np.log(ratios), grid[0], grid[-1])
    density = np.exp(-0.5 * ((votes[:, None] - grid) / _KERNEL_WIDTH) ** 2).T @ weights
    padded = np.concatenate([[-1.0], density, [-1.0]])
    tops = np.flatnonzero((density > padded[:-2]) & (density >= padded[2:]))
    return [float(np.exp(grid[top])) for top in tops[np.argsort(-density[tops], kind="stable")][:num]]


def objections(
    misfits: NDArray[np.float64], best: NDArray[np.float64], num_inliers: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How much each pair objects to focal lengths.

    Parameters
    ----------
    misfits : (P, ...) float64
        Of P pairs.
    best : (P,) float64
        The smallest misfit of each pair.
    num_inliers : (P,) float64

    Returns
    -------
    (P, ...) float64
        From 0 (as good as the pair's best) to 1 (refused: a tenth of the inliers is lost, or more).
    """
    shape = (-1, *[1] * (misfits.ndim - 1))
    excess = (misfits - best.reshape(shape)) / num_inliers.reshape(shape)
    return np.clip(excess / _REFUSED_SHARE, 0.0, 1.0)


def _thinned(pair: PairPoints) -> PairPoints:
    if len(pair) <= _MAX_NUM_MATCHES:
        return pair
    kept = np.linspace(0, len(pair) - 1, _MAX_NUM_MATCHES).astype(np.intp)
    return PairPoints(
        name0=pair.name0,
        name1=pair.name1,
        points0_px=np.ascontiguousarray(pair.points0_px[kept]),
        points1_px=np.ascontiguousarray(pair.points1_px[kept]),
    )


def _curve(
    pair: PairPoints, longest_side_px: float, ratio: float, pose: poselib.CameraPose, seed: int
) -> NDArray[np.float64]:
    """Misfit at every candidate, found outwards from the one that is nearest to the vote."""
    nearest = int(np.argmin(np.abs(np.log(CANDIDATE_RATIOS / ratio))))
    curve = np.empty(len(CANDIDATE_RATIOS))
    curve[nearest], start = _misfit_of_shared(pair, nearest, longest_side_px, pose, seed)
    for indices in (range(nearest + 1, len(curve)), range(nearest - 1, -1, -1)):
        pose = start
        for index in indices:
            curve[index], pose = _misfit_of_shared(pair, index, longest_side_px, pose, seed)
    return curve


def _misfit_of_shared(
    pair: PairPoints, index: int, longest_side_px: float, pose: poselib.CameraPose, seed: int
) -> tuple[float, poselib.CameraPose]:
    focal_px = float(CANDIDATE_RATIOS[index] * longest_side_px)
    return misfit(pair, focal_px, focal_px, seed=seed, pose=pose)


def _pinhole(focal_px: float) -> dict[str, object]:
    return {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal_px, 0.0, 0.0]}


def _sampson_sq_px(
    pair: PairPoints, essential: NDArray[np.float64], focal0_px: float, focal1_px: float
) -> NDArray[np.float64]:
    """(M,) squared Sampson distances in px²."""
    ones = np.ones((len(pair), 1))
    points0, points1 = np.hstack([pair.points0_px, ones]), np.hstack([pair.points1_px, ones])
    fundamental = (
        np.array([1 / focal1_px, 1 / focal1_px, 1.0])[:, None]
        * essential
        * np.array([1 / focal0_px, 1 / focal0_px, 1.0])
    )
    line_in_1, line_in_0 = points0 @ fundamental.T, points1 @ fundamental
    gradient_sq = np.sum(line_in_1[:, :2] ** 2, axis=1) + np.sum(line_in_0[:, :2] ** 2, axis=1)
    algebraic_sq = np.sum(points1 * line_in_1, axis=1) ** 2
    # A point on both epipoles has no distance to speak of.
    return np.divide(algebraic_sq, gradient_sq, out=np.zeros(len(pair)), where=gradient_sq > 0)
