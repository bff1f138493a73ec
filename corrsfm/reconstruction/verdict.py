"""The verdict on a model: good, doubtful or wrong, why, and what to do next.

Each kind of evidence is judged alone, and the worst one decides. The bounds are set on training and
validation scenes; `results/` has the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import first_few
from corrsfm.reconstruction.choice import SAME_MODEL
from corrsfm.reconstruction.explained import ENOUGH_UNCONTRADICTED_SHARE, Explained
from corrsfm.reconstruction.focal_slack import FocalSlack

__all__ = ["Evidence", "Grade", "Verdict", "judge", "thickness"]

# Of the matches of pairs that are not contradicted.
_WRONG_EXPLAINED = 0.70
_GOOD_REGISTERED = 0.90
_GOOD_SUPPORT = 0.80
# Of the verified matches between registered photos. Repetitive scenes have many small false pairs.
_GOOD_CONTRADICTED, _WRONG_CONTRADICTED = 0.20, 0.50
# Of the registered photos.
_WRONG_MISPLACED = 0.2
_SMALLEST_ANGLE_DEG = 2.0
# Thickness of the points over their extent: a wall with reliefs has more.
_SMALLEST_THICKNESS = 0.003
_FEWEST_POINTS = 10
# Of the squared errors. The models of 44 training and validation scenes stay below 0.21, but for one drone's.
_LARGEST_LENS_MISFIT = 0.25


class Grade(StrEnum):
    """How far to trust a model."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    WRONG = "wrong"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What to think of a model.

    Attributes
    ----------
    grade : Grade
    reasons : tuple of str
        Clauses, the gravest first; for a good model its strengths.
    next_steps : tuple of str
        What to try, in order; for a good model at most how to make it more exact.
    """

    grade: Grade
    reasons: tuple[str, ...]
    next_steps: tuple[str, ...] = ()

    def __str__(self) -> str:
        step = f"; try {self.next_steps[0]}" if self.next_steps else ""
        return f"{self.grade}: {'; '.join(self.reasons)}{step}"


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Everything that a verdict is drawn from.

    Attributes
    ----------
    num_photos : int
        Photos of the scene.
    explained : Explained
    support : float or None
        How far the best other candidate agrees (`corrsfm.reconstruction.choice.Choice.support`); None if no
        other was mapped.
    could_try_more : bool
        Whether a larger ``--max-models-tried`` would bring other candidates.
    implausible_intrinsics : str
        What no camera can have, such as "focal lengths from 0.02 to 0.9 times the longest side"; empty if
        all are plausible.
    has_prior_focal_lengths : bool
        All focal lengths come from EXIF, the user or the votes of pairs.
    focal_slack : FocalSlack or None
        How far the poses hang on the focal length; None if it was not open or nothing could be measured.
    lens_misfit : float or None
        Share of the squared errors that a richer lens model would take away; None if it was not measured.
    thickness : float or None
        Smallest over largest extent of the points (`thickness`); None if there are too few.
    is_folded : bool or None
        Whether repeated structure lies on top of itself; None without evidence either way.
    conflicts : sequence of str
        The conflicting pairs, as "name0 – name1".
    """

    num_photos: int
    explained: Explained
    support: float | None = None
    could_try_more: bool = True
    implausible_intrinsics: str = ""
    has_prior_focal_lengths: bool = False
    focal_slack: FocalSlack | None = None
    lens_misfit: float | None = None
    thickness: float | None = None
    is_folded: bool | None = None
    conflicts: Sequence[str] = ()


@dataclass(frozen=True)
class _Finding:
    grade: Grade
    reason: str
    step: str


def thickness(points: NDArray[np.floating]) -> float | None:
    """How far points are from lying on one plane.

    Parameters
    ----------
    points : (P, 3) float
        In any frame and unit.

    Returns
    -------
    float or None
        Extent across the best plane over the largest extent along it, both between the 5 % and the 95 %
        quantile; 0 for a plane, None with fewer than ten points or without any extent.
    """
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _FEWEST_POINTS:
        return None
    # Far outliers would turn the axes.
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    points = points[distances <= np.quantile(distances, 0.9)]
    _, axes = np.linalg.eigh(np.cov(points.T))
    extents = np.ptp(np.quantile(points @ axes, [0.05, 0.95], axis=0), axis=0)
    return float(extents[0] / extents[2]) if extents[2] > 0 else None


def judge(evidence: Evidence) -> Verdict:
    """Draw the verdict.

    Parameters
    ----------
    evidence : Evidence

    Returns
    -------
    Verdict
        ``wrong`` if any kind of evidence says so, else ``doubtful`` likewise, else ``good``.
    """
    findings = [finding for check in _CHECKS if (finding := check(evidence)) is not None]
    if not findings:
        explained, num = evidence.explained, len(evidence.explained.registered)
        reasons = [
            f"{num} of {evidence.num_photos} photos registered, {_percent(explained.share)} of the verified "
            "matches explained"
        ]
        if evidence.support is not None:
            share = _percent(evidence.support)
            reasons.append(f"another candidate agrees about {share} of the relative poses")
        steps = []
        # The photos are where they belong; how exactly is another matter.
        if evidence.lens_misfit is not None and evidence.lens_misfit > _LARGEST_LENS_MISFIT:
            share = _percent(evidence.lens_misfit)
            reasons.append(f"but a richer lens model would take away {share} of the squared errors")
            steps.append("--camera-model OPENCV --refine-principal-point for more exact poses")
        return Verdict(grade=Grade.GOOD, reasons=tuple(reasons), next_steps=tuple(steps))
    findings.sort(key=lambda finding: finding.grade is not Grade.WRONG)
    return Verdict(
        grade=findings[0].grade,
        reasons=tuple(finding.reason for finding in findings),
        next_steps=tuple(dict.fromkeys(finding.step for finding in findings)),
    )


def _no_pairs(evidence: Evidence) -> _Finding | None:
    if evidence.explained.num_verified:
        return None
    return _Finding(
        Grade.WRONG,
        "no pair of photos is verified, so nothing holds the model",
        "photos that overlap more, or more features",
    )


def _intrinsics(evidence: Evidence) -> _Finding | None:
    if not evidence.implausible_intrinsics:
        return None
    return _Finding(
        Grade.WRONG,
        f"no camera has {evidence.implausible_intrinsics}",
        "--camera-mode single if one camera took all photos, or --camera-params if they are known",
    )


def _fold(evidence: Evidence) -> _Finding | None:
    if not evidence.is_folded:
        return None
    pairs = f" (such as {first_few(evidence.conflicts)})" if evidence.conflicts else ""
    return _Finding(
        Grade.WRONG,
        f"photos that the model puts side by side do not share what both should see{pairs}: it may be folded "
        "where the scene repeats itself",
        "photos that show the surroundings between the repeated parts",
    )


def _registered(evidence: Evidence) -> _Finding | None:
    num = len(evidence.explained.registered)
    share = num / evidence.num_photos if evidence.num_photos else 0.0
    if share >= _GOOD_REGISTERED:
        return None
    # A part of the scene may be right as far as it goes.
    return _Finding(
        Grade.DOUBTFUL if num > 1 else Grade.WRONG,
        f"only {num} of {evidence.num_photos} photos are in the model",
        "photos between those in the model and those left out",
    )


def _explained(evidence: Evidence) -> _Finding | None:
    # Photos left out and contradicted pairs are findings of their own; this one tells a bent model.
    explained = evidence.explained
    share = explained.share_of_supported
    if not explained.num_explained or explained.is_enough(share):
        return None
    # Two ways of mapping rarely bend a model alike; false matches of repeated texture explain the rest.
    if (evidence.support or 0.0) >= SAME_MODEL and share >= ENOUGH_UNCONTRADICTED_SHARE:
        return None
    return _Finding(
        Grade.DOUBTFUL if share >= _WRONG_EXPLAINED else Grade.WRONG,
        f"the model explains only {_percent(share)} of the matches of the pairs that agree with it",
        _other_candidates(evidence),
    )


def _contradicted(evidence: Evidence) -> _Finding | None:
    explained = evidence.explained
    if explained.are_contradicted_within(_GOOD_CONTRADICTED):
        return None
    inside = [pair for pair in explained.pairs if pair.is_registered and pair.num_verified]
    worst = first_few(f"{pair.name0} – {pair.name1}" for pair in explained.contradicted)
    return _Finding(
        Grade.DOUBTFUL if explained.are_contradicted_within(_WRONG_CONTRADICTED) else Grade.WRONG,
        f"{len(explained.contradicted)} of {len(inside)} verified pairs contradict it ({worst})",
        "leaving out the photos that most contradicted pairs have in common",
    )


def _misplaced(evidence: Evidence) -> _Finding | None:
    names = evidence.explained.misplaced
    if not names or not evidence.explained.num_explained:
        return None
    few = len(names) <= _WRONG_MISPLACED * len(evidence.explained.registered)
    return _Finding(
        Grade.DOUBTFUL if few else Grade.WRONG,
        f"many matches contradict the place of {first_few(names)}",
        "leaving these photos out, or more photos around them",
    )


def _support(evidence: Evidence) -> _Finding | None:
    if evidence.support is None or evidence.support >= _GOOD_SUPPORT:
        return None
    # A model without confirmation may still be right.
    return _Finding(
        Grade.DOUBTFUL,
        f"the best other candidate agrees about {_percent(evidence.support)} of the relative poses only"
        if evidence.support
        else "no other candidate comes near it",
        _other_candidates(evidence),
    )


def _loose_ends(evidence: Evidence) -> _Finding | None:
    names = evidence.explained.loose_ends
    # One stray photo at the edge of a large model harms nothing else.
    if not names or len(names) <= 0.1 * len(evidence.explained.registered):
        return None
    if len(evidence.explained.registered) < 3:
        return _Finding(
            Grade.DOUBTFUL, "two photos make a model that nothing checks", "a third photo of the same scene"
        )
    return _Finding(
        Grade.DOUBTFUL,
        f"held by one pair only: {first_few(names)}",
        "photos next to these, so that three of them see the same points",
    )


def _motion(evidence: Evidence) -> _Finding | None:
    angle = evidence.explained.widest_angle_deg
    if not evidence.explained.num_explained or angle >= _SMALLEST_ANGLE_DEG:
        return None
    return _Finding(
        Grade.DOUBTFUL,
        f"the camera hardly moved: rays to a point differ by {angle:.1f}° at most",
        "photos from places further apart",
    )


def _plane(evidence: Evidence) -> _Finding | None:
    thickness = evidence.thickness
    flat = thickness is not None and math.isfinite(thickness) and thickness < _SMALLEST_THICKNESS
    if not flat or evidence.has_prior_focal_lengths:
        return None
    return _Finding(
        Grade.DOUBTFUL,
        "all points lie on one plane, which leaves the focal lengths open",
        "photos that also show something in front of the plane or behind it, or --camera-params",
    )


def _focal_slack(evidence: Evidence) -> _Finding | None:
    slack = evidence.focal_slack
    if slack is None or not slack.is_large:
        return None
    return _Finding(
        Grade.DOUBTFUL,
        f"the photos leave the focal length open: one that is {100 * (slack.factor - 1):.0f} % longer or "
        f"shorter fits nearly as well and moves the cameras by {slack.pose_change_deg:.1f}°",
        "--camera-params with a calibrated focal length, or photos at other distances and heights",
    )


def _other_candidates(evidence: Evidence) -> str:
    more = "a larger --max-models-tried" if evidence.could_try_more else "another --seed"
    return f"{more}, or photos closer to each other"


def _percent(share: float) -> str:
    # Rounded down: 99.97 % is not everything.
    return f"{math.floor(1000 * share) / 10:g} %"


_CHECKS: tuple[Callable[[Evidence], _Finding | None], ...] = (
    _no_pairs,
    _intrinsics,
    _fold,
    _registered,
    _explained,
    _contradicted,
    _misplaced,
    _support,
    _loose_ends,
    _motion,
    _plane,
    _focal_slack,
)
