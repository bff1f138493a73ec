"""Photos of two focal lengths that were proposed to share a camera: two zoom settings, or two phones.

A pair of two such photos votes for a focal length of neither. So every pair is asked how it fits two focal
lengths, with each of its photos at either, and photos are labelled so that the pairs object least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corrsfm.database.focal_evidence import (
    CANDIDATE_RATIOS,
    PairEvidence,
    densest_votes,
    misfit,
    objections,
)

__all__ = ["Split", "split_in_two"]

# Focal lengths closer than 12 % are not told apart; few zooms reach farther than a factor of three.
_MIN_FACTOR, _MAX_FACTOR = 1.12, 3.1
# One of the two focal lengths is where votes are dense; number of such places tried.
_NUM_ANCHORS = 3


@dataclass(frozen=True, kw_only=True)
class Split:
    """Photos in two groups.

    Attributes
    ----------
    names : tuple of tuple of str
        Photos of each group, sorted; all photos of any pair, once.
    ratios : tuple of float
        Focal length of each group over the longest side, one of the candidates.
    objection : float
        Mean objection of the pairs to these, from 0 to 1.
    """

    names: tuple[tuple[str, ...], tuple[str, ...]]
    ratios: tuple[float, float]
    objection: float


def split_in_two(evidence: Sequence[PairEvidence], longest_side_px: float, *, seed: int = 0) -> Split | None:
    """The two focal lengths, and who has which, that meet the least objection.

    Parameters
    ----------
    evidence : sequence of PairEvidence
    longest_side_px : float
    seed : int

    Returns
    -------
    Split or None
        None if no votes are dense anywhere.
    """
    names = sorted({name for pair in evidence for name in (pair.name0, pair.name1)})
    ends = np.array([[names.index(pair.name0), names.index(pair.name1)] for pair in evidence])
    num_inliers = np.array([pair.num_inliers for pair in evidence], np.float64)
    curves = np.array([pair.curve for pair in evidence])
    weights = num_inliers / num_inliers.sum()
    found: tuple[float, tuple[int, int], NDArray[np.intp]] | None = None
    for anchor in _anchors(curves, np.array([pair.ratio for pair in evidence]), num_inliers):
        mixed = np.array([_mixed_misfits(pair, anchor, longest_side_px, seed) for pair in evidence])
        best = np.minimum(np.nanmin(mixed, axis=(1, 2)), curves.min(axis=1))
        for other in np.flatnonzero(np.isfinite(mixed[0, 0])):
            misfits = np.stack(
                [curves[:, anchor], mixed[:, 0, other], mixed[:, 1, other], curves[:, other]], axis=1
            )
            objected = objections(misfits, best, num_inliers) * weights[:, None]
            objection, labels = _label(objected.reshape(-1, 2, 2), ends, len(names))
            if found is None or objection < found[0]:
                found = objection, (anchor, int(other)), labels
    if found is None:
        return None
    first, second = (
        tuple(name for name, own in zip(names, found[2], strict=True) if own == label) for label in (0, 1)
    )
    ratios = float(CANDIDATE_RATIOS[found[1][0]]), float(CANDIDATE_RATIOS[found[1][1]])
    return Split(names=(first, second), ratios=ratios, objection=found[0])


def _anchors(
    curves: NDArray[np.float64], ratios: NDArray[np.float64], num_inliers: NDArray[np.float64]
) -> list[int]:
    """Candidates where the votes of pairs that know what they say are dense."""
    refused = np.mean(objections(curves, curves.min(axis=1), num_inliers) >= 1.0, axis=1)
    peaks = densest_votes(ratios, num_inliers * refused**2, _NUM_ANCHORS)
    return sorted({int(np.argmin(np.abs(np.log(CANDIDATE_RATIOS / peak)))) for peak in peaks})


def _mixed_misfits(pair: PairEvidence, anchor: int, longest_side_px: float, seed: int) -> NDArray[np.float64]:
    """(2, 24) misfit with one photo at the anchor and the other (first row: photo 1) at each candidate.

    NaN where the two are too close to be told apart or too far to be of one set of photos.
    """
    misfits = np.full((2, len(CANDIDATE_RATIOS)), np.nan)
    focals_px = CANDIDATE_RATIOS * longest_side_px
    factors = np.exp(np.abs(np.log(CANDIDATE_RATIOS / CANDIDATE_RATIOS[anchor])))
    wanted = (factors > _MIN_FACTOR) & (factors < _MAX_FACTOR)
    for indices in (range(anchor + 1, len(misfits[0])), range(anchor - 1, -1, -1)):
        poses: list = [None, None]
        for index in (index for index in indices if wanted[index]):
            for row, (one, two) in enumerate(((anchor, index), (index, anchor))):
                misfits[row, index], poses[row] = misfit(
                    pair.points, float(focals_px[one]), float(focals_px[two]), seed=seed, pose=poses[row]
                )
    return misfits


def _label(
    objected: NDArray[np.float64], ends: NDArray[np.intp], num_photos: int
) -> tuple[float, NDArray[np.intp]]:
    """Give each photo one of two focal lengths so that the pairs object least.

    Photo by photo, until none changes (iterated conditional modes), from three starts: all of one, all of the
    other, and each photo what its own pairs would share.

    Parameters
    ----------
    objected : (P, 2, 2) float64
        By the labels of the two photos.
    ends : (P, 2) intp
        Photos of each pair.
    num_photos : int
    """
    alone = np.zeros((num_photos, 2))
    for side in (0, 1):
        np.add.at(alone, ends[:, side], objected[:, [0, 1], [0, 1]])
    starts = [np.zeros(num_photos, np.intp), np.ones(num_photos, np.intp), alone.argmin(axis=1)]
    results = [_settled(start, objected, ends) for start in starts]
    return min(results, key=lambda result: result[0])


def _settled(
    labels: NDArray[np.intp], objected: NDArray[np.float64], ends: NDArray[np.intp]
) -> tuple[float, NDArray[np.intp]]:
    labels = labels.copy()
    rows = np.arange(len(ends))
    for _ in range(2 * len(labels)):
        before = labels.copy()
        for photo in range(len(labels)):
            costs = np.zeros(2)
            first, second = ends[:, 0] == photo, ends[:, 1] == photo
            for label in (0, 1):
                costs[label] = objected[first, label, labels[ends[first, 1]]].sum()
                costs[label] += objected[second, labels[ends[second, 0]], label].sum()
            if costs[1 - labels[photo]] < costs[labels[photo]]:
                labels[photo] = 1 - labels[photo]
        if np.array_equal(before, labels):
            break
    return float(objected[rows, labels[ends[:, 0]], labels[ends[:, 1]]].sum()), labels
