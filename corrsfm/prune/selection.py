"""Which matches the network sees, how its logits become scores, and which matches are kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from corrsfm.config import MatchInput, NetworkUsage, OperatingPoint
from corrsfm.errors import InputError
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.types import Correspondences

__all__ = ["readable_matches", "score_matches", "select_candidates", "select_kept"]

_PROBABLE = 0.5


def readable_matches(pair: Correspondences, match_input: MatchInput) -> NDArray[np.bool_]:
    """The matches of the kind that a network reads.

    Returns
    -------
    (M,) bool

    Raises
    ------
    InputError
        If the network reads mutual matches and nobody said which of the pair's are.
    """
    if match_input is MatchInput.ALL:
        return np.ones(len(pair), bool)
    if len(pair) and not pair.mutual_known:
        raise InputError(
            f"{pair.name}: does not say which matches are mutual nearest neighbours, and this network reads "
            "only those; give correspondences_from_points(..., mutual=...), True where a match is the "
            "nearest neighbour in both directions, or use a checkpoint that reads all matches"
        )
    return pair.mutual


def select_candidates(
    pair: Correspondences, max_candidates: int, match_input: MatchInput = MatchInput.ALL
) -> NDArray[np.intp]:
    """The matches that the network sees.

    Parameters
    ----------
    pair : Correspondences
    max_candidates : int
    match_input : MatchInput
        What kind of matches it reads.

    Returns
    -------
    (K,) int
        Increasing indices of the at most ``max_candidates`` finite matches of that kind of smallest ratio, or
        of largest score if they have scores instead; among equals the first ones.

    Raises
    ------
    InputError
        See `readable_matches`.
    """
    finite = np.isfinite(pair.normalised).all(axis=1)
    usable = np.flatnonzero(finite & readable_matches(pair, match_input))
    if len(usable) <= max_candidates:
        return usable
    rank = pair.ratios if pair.scores is None else -pair.scores
    order = np.argsort(np.nan_to_num(rank[usable], nan=np.inf), kind="stable")
    return np.sort(usable[order[:max_candidates]])


def score_matches(logits: NDArray[np.float32], residuals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Confidence in every match, whether the network saw it or not.

    Parameters
    ----------
    logits : (M,) float32
        Last logit of each match; −inf for those that the network did not see.
    residuals : (M,) float32
        Squared distances to the network's matrix; infinite without one.

    Returns
    -------
    (M,) float32
        The logistic function of the logit. For an unseen match ``a · exp(−residual / INLIER_THRESHOLD)``,
        where a is the share of the probable matches that the matrix explains.
    """
    unseen = np.isneginf(logits)
    with np.errstate(over="ignore"):  # exp(∞) has the right limit
        scores = 1.0 / (1.0 + np.exp(-logits))
    probable = scores > _PROBABLE
    agreement = float(np.mean(residuals[probable] < INLIER_THRESHOLD)) if probable.any() else 0.0
    return np.where(unseen, agreement * np.exp(-residuals / INLIER_THRESHOLD), scores).astype(np.float32)


def select_kept(
    pair: Correspondences,
    scores: NDArray[np.float32],
    operating_point: OperatingPoint,
    usage: NetworkUsage,
    num_candidates: int,
) -> NDArray[np.bool_]:
    """The matches to keep at an operating point.

    Scores decide, not the distance to the network's matrix: a robust estimator that follows makes a better
    matrix from well-chosen matches than the weighted eight-point algorithm. Which scores, a checkpoint says;
    those of the bundled one were chosen on 240 validation pairs, and its model card has the numbers.

    Parameters
    ----------
    pair : Correspondences
    scores : (M,) float32
        Confidence of the network in each match, in [0, 1].
    operating_point : OperatingPoint
        ``pose``: score above ``pose_min_score``. ``sfm``: mutual matches with a score above
        ``sfm_min_score``; of a pair with fewer than ``min_num_confident`` above ``confident_score``, or fewer
        than the share ``min_confident_share``, only those: it usually shows two places. (The networks learned
        from overlapping photos and find structure everywhere: of 114 pairs of a validation scene that share
        nothing, 110 passed COLMAP's verification without this.)
    usage : NetworkUsage
    num_candidates : int
        Matches that the network saw.

    Returns
    -------
    (M,) bool
    """
    if operating_point is OperatingPoint.POSE:
        return scores > usage.pose_min_score
    confident = pair.mutual & (scores > usage.confident_score)
    needed = max(usage.min_num_confident, usage.min_confident_share * num_candidates)
    if np.count_nonzero(confident) < needed:
        return confident
    return pair.mutual & (scores > usage.sfm_min_score)
