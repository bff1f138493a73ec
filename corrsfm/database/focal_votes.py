"""Focal length of a shared camera from its pairs, and whether the photos share a camera at all.

Every pair whose photos are proposed to share a camera votes and hands in a misfit curve
(`corrsfm.database.focal_evidence`). A pair *refuses* a focal length that costs it a tenth of its inliers;
between its best one and there it objects in part. The focal length is the one that meets the least
objection, each pair counting by its inliers. It is trusted if votes lie around it, each counting by how
many other focal lengths its pair refuses. Where photos of different cameras are taken for those of one, votes
lie in several places or flee to infinity.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from corrsfm.database.focal_evidence import (
    CANDIDATE_RATIOS,
    MIN_NUM_MATCHES,
    PairEvidence,
    PairPoints,
    mode_of_votes,
    objections,
    weigh_pair,
)
from corrsfm.database.focal_groups import split_in_two
from corrsfm.machine import threaded

__all__ = ["FocalGroup", "FocalVotes", "VoteDecision", "count_votes", "pairs_that_vote"]

MAX_NUM_PAIRS = 45
# A vote within 15 % of the focal length agrees with it.
_AGREES_WITHIN = 0.15

# Bounds of the decision, see `_decide`; measured in the note on cameras by evidence.
_LEAST_KNOWLEDGE, _MUCH_KNOWLEDGE = 2.0, 4.0
_WEAK_AGREEMENT, _MIN_AGREEMENT, _STRONG_AGREEMENT = 0.35, 0.5, 0.65
_SCATTERED_BELOW = 0.4
_LITTLE_OBJECTION, _MAX_OBJECTION = 0.2, 0.35
_MIN_NUM_UNANIMOUS, _NO_OBJECTION = 6, 0.04
_LONG_RATIO = 2.0
# Focal lengths that meet 2 % more objection than the best are as good; decided ones lie in such a range.
_AS_GOOD, _LARGEST_RANGE_FACTOR = 0.02, 1.4

# Smallest group, and the most objection that two groups may leave: this much, and this share of the
# objection to one focal length.
_MIN_GROUP_SIZE = 3
_LARGEST_LEFT, _LARGEST_SHARE_LEFT = 0.2, 0.6


class VoteDecision(StrEnum):
    """What the votes of a proposed camera say."""

    DECIDED = "decided"
    UNDECIDED = "undecided"
    SCATTERED = "scattered"
    TWO_GROUPS = "two groups"


@dataclass(frozen=True, kw_only=True)
class FocalGroup:
    """Photos with one focal length.

    Attributes
    ----------
    names : tuple of str
        Sorted.
    focal_px, focal_ratio : float
        In pixels, and over the longest side.
    """

    names: tuple[str, ...]
    focal_px: float
    focal_ratio: float


@dataclass(frozen=True, kw_only=True)
class FocalVotes:
    """The outcome for one proposed camera.

    Attributes
    ----------
    decision : VoteDecision
        ``decided``: one camera of that focal length. ``two groups``: two cameras, see ``groups``.
        ``scattered``: photos of many cameras. ``undecided``: too few votes that know what they say.
    focal_px, focal_ratio : float
        The focal length that meets the least objection, whatever the decision; NaN without votes.
    mode_ratio : float
        The mode of the votes, weighted by inliers, under a Gaussian kernel of 5 %; NaN without votes.
    num_votes : int
    knowledge : float
        Number of votes, each counted by the share of other focal lengths that its pair refuses.
    agreement : float
        Share of the votes, weighted by inliers and the square of that share, within 15 % of the focal length.
    objection : float
        Mean objection to the focal length, from 0 (none) to 1 (all pairs refuse it).
    range_ratios : tuple of float
        The smallest and the largest focal length over the longest side that meet about as little objection.
    groups : tuple of FocalGroup
        Two groups, the one with the larger focal length last; else empty.
    """

    decision: VoteDecision
    focal_px: float = float("nan")
    focal_ratio: float = float("nan")
    mode_ratio: float = float("nan")
    num_votes: int = 0
    knowledge: float = 0.0
    agreement: float = 0.0
    objection: float = 0.0
    range_ratios: tuple[float, float] = (float("nan"), float("nan"))
    groups: tuple[FocalGroup, ...] = ()


def count_votes(
    pairs: Sequence[PairPoints],
    longest_side_px: float,
    *,
    seed: int = 0,
    may_split: bool = True,
    num_threads: int = 1,
) -> FocalVotes:
    """Let the pairs of a proposed camera vote.

    Parameters
    ----------
    pairs : sequence of PairPoints
        Pairs of two photos of the camera, in any order; of many pairs, `pairs_that_vote` chooses.
    longest_side_px : float
        Of the photos.
    seed : int
        Of the random samples. Equal seeds and pairs give equal votes, in whatever order the pairs come.
    may_split : bool
        Whether to look for two groups; if not, what would be two groups is ``scattered``.
    num_threads : int
        Pairs weighed at a time; the votes are the same.
    """
    chosen = pairs_that_vote(pairs)
    weigh = functools.partial(weigh_pair, longest_side_px=longest_side_px, seed=seed)
    evidence = [vote for _, vote in threaded(weigh, chosen, num_threads) if vote is not None]
    if not evidence:
        return FocalVotes(decision=VoteDecision.UNDECIDED)
    votes = _shared(evidence, longest_side_px)
    # Below, there is too little objection for a second focal length to remove.
    doubted = votes.decision is not VoteDecision.DECIDED and votes.objection > _NO_OBJECTION
    doubted &= votes.knowledge >= _MUCH_KNOWLEDGE
    groups = _two_groups(evidence, longest_side_px, votes.objection, seed) if may_split and doubted else ()
    return dataclasses.replace(votes, decision=VoteDecision.TWO_GROUPS, groups=groups) if groups else votes


def pairs_that_vote(pairs: Sequence[PairPoints], max_num: int = MAX_NUM_PAIRS) -> list[PairPoints]:
    """The pairs with 60 matches or more, and of many the strongest ones of every photo in turn.

    Returns
    -------
    list of PairPoints
        Sorted by names, at most ``max_num``.
    """
    able = sorted((pair for pair in pairs if len(pair) >= MIN_NUM_MATCHES), key=_names)
    if len(able) <= max_num:
        return able
    of_photo: dict[str, list[PairPoints]] = defaultdict(list)
    for pair in sorted(able, key=lambda pair: (-len(pair), _names(pair))):
        for name in _names(pair):
            of_photo[name].append(pair)
    chosen: dict[tuple[str, str], PairPoints] = {}
    while len(chosen) < max_num:
        for name in sorted(of_photo):
            left = [pair for pair in of_photo[name] if _names(pair) not in chosen]
            of_photo[name] = left
            if left and len(chosen) < max_num:
                chosen[_names(left[0])] = left[0]
    return sorted(chosen.values(), key=_names)


def _names(pair: PairPoints) -> tuple[str, str]:
    return pair.name0, pair.name1


def _shared(evidence: Sequence[PairEvidence], longest_side_px: float) -> FocalVotes:
    """Outcome if all photos share a camera."""
    curves = np.array([pair.curve for pair in evidence])
    ratios = np.array([pair.ratio for pair in evidence])
    num_inliers = np.array([pair.num_inliers for pair in evidence], np.float64)
    objected = objections(curves, curves.min(axis=1), num_inliers)
    pooled = num_inliers @ objected / num_inliers.sum()
    lowest = int(pooled.argmin())
    ratio = _between_candidates(pooled, lowest)
    refused = np.mean(objected >= 1.0, axis=1)
    weights = num_inliers * refused**2
    agrees = np.abs(np.log(ratios / ratio)) < _AGREES_WITHIN
    agreement = float(weights[agrees].sum() / weights.sum()) if weights.sum() > 0 else 0.0
    knowledge, objection = float(refused.sum()), float(pooled[lowest])
    as_good = CANDIDATE_RATIOS[pooled <= pooled[lowest] + _AS_GOOD]
    return FocalVotes(
        decision=_decide(ratio, as_good, len(evidence), knowledge, agreement, objection),
        focal_px=ratio * longest_side_px,
        focal_ratio=ratio,
        mode_ratio=mode_of_votes(ratios, num_inliers),
        num_votes=len(evidence),
        knowledge=knowledge,
        agreement=agreement,
        objection=objection,
        range_ratios=(float(as_good[0]), float(as_good[-1])),
    )


def _decide(
    ratio: float,
    as_good: NDArray[np.float64],
    num_votes: int,
    knowledge: float,
    agreement: float,
    objection: float,
) -> VoteDecision:
    """One camera, many, or not known.

    Different cameras taken for one either disagree or flee to long focal lengths, where every camera looks
    alike; a long focal length therefore needs more agreement. Pairs that all accept a narrow range of focal
    lengths have decided too, though none of them alone could; if the range is wide, nothing speaks against
    one camera, and nothing for a focal length.
    """
    unanimous = num_votes >= _MIN_NUM_UNANIMOUS and objection <= _NO_OBJECTION
    bounded = CANDIDATE_RATIOS[0] < as_good[0] and as_good[-1] < CANDIDATE_RATIOS[-1]
    wide = as_good[-1] > _LARGEST_RANGE_FACTOR * as_good[0]
    if ratio > _LONG_RATIO:
        wanted = _STRONG_AGREEMENT
    elif knowledge >= _MUCH_KNOWLEDGE and objection <= _LITTLE_OBJECTION:
        wanted = _WEAK_AGREEMENT
    else:
        wanted = _MIN_AGREEMENT
    agreed = agreement >= wanted and objection <= _MAX_OBJECTION
    if bounded and not wide and knowledge >= _LEAST_KNOWLEDGE and (unanimous or agreed):
        return VoteDecision.DECIDED
    if knowledge < _MUCH_KNOWLEDGE or (unanimous and wide):
        return VoteDecision.UNDECIDED
    scattered = agreement < _SCATTERED_BELOW or objection > _MAX_OBJECTION or not bounded
    return VoteDecision.SCATTERED if scattered else VoteDecision.UNDECIDED


def _between_candidates(pooled: NDArray[np.float64], lowest: int) -> float:
    """The minimum of a parabola through the lowest value and its neighbours."""
    if not 0 < lowest < len(pooled) - 1:
        return float(CANDIDATE_RATIOS[lowest])
    left, middle, right = pooled[lowest - 1 : lowest + 2]
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if bend > 0 else 0.0
    step = np.log(CANDIDATE_RATIOS[1] / CANDIDATE_RATIOS[0])
    return float(CANDIDATE_RATIOS[lowest] * np.exp(shift * step))


def _two_groups(
    evidence: Sequence[PairEvidence], longest_side_px: float, shared_objection: float, seed: int
) -> tuple[FocalGroup, ...]:
    """Two groups with the focal lengths that their own pairs object to least.

    None if two focal lengths meet nearly the objection of one, or if a group is too small.
    """
    split = split_in_two(evidence, longest_side_px, seed=seed)
    if split is None or split.objection > min(_LARGEST_LEFT, _LARGEST_SHARE_LEFT * shared_objection):
        return ()
    groups = []
    for names, candidate_ratio in zip(split.names, split.ratios, strict=True):
        inside = [pair for pair in evidence if pair.name0 in names and pair.name1 in names]
        if len(names) < _MIN_GROUP_SIZE or not inside:
            return ()
        ratio = _shared(inside, longest_side_px).focal_ratio
        # A group of few pairs may have two minima; the one that both kinds of pairs chose counts.
        if abs(np.log(ratio / candidate_ratio)) > _AGREES_WITHIN:
            ratio = candidate_ratio
        groups.append(FocalGroup(names=names, focal_px=ratio * longest_side_px, focal_ratio=ratio))
    return tuple(sorted(groups, key=lambda group: group.focal_ratio))
