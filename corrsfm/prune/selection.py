"""Which matches the network sees, how its logits become scores, and which matches are kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from corrsfm.config import OperatingPoint
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.types import Correspondences

__all__ = ["score_matches", "select_candidates", "select_kept"]

# Scores from which on a match is kept, see `select_kept`.
POSE_MIN_SCORE = 0.5
SFM_MIN_SCORE = 0.3
CONFIDENT_SCORE = 0.7
MIN_NUM_CONFIDENT = 20


def select_candidates(pair: Correspondences, max_candidates: int) -> NDArray[np.intp]:
    """The matches that the network sees.

    Parameters
    ----------
    pair : Correspondences
    max_candidates : int

    Returns
    -------
    (K,) int
        Increasing indices of the at most ``max_candidates`` finite matches of smallest ratio; among equal
        ratios the first ones.
    """
    usable = np.flatnonzero(np.isfinite(pair.normalised).all(axis=1))
    if len(usable) <= max_candidates:
        return usable
    order = np.argsort(np.nan_to_num(pair.ratios[usable], nan=np.inf), kind="stable")
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
    probable = scores > POSE_MIN_SCORE
    agreement = float(np.mean(residuals[probable] < INLIER_THRESHOLD)) if probable.any() else 0.0
    return np.where(unseen, agreement * np.exp(-residuals / INLIER_THRESHOLD), scores).astype(np.float32)


def select_kept(
    pair: Correspondences, scores: NDArray[np.float32], operating_point: OperatingPoint
) -> NDArray[np.bool_]:
    """The matches to keep at an operating point.

    Scores decide, not the distance to the network's matrix: a robust estimator that follows makes a better
    matrix from well-chosen matches than the weighted eight-point algorithm. The scores were chosen on 240
    validation pairs with the bundled checkpoint, whose model card has the numbers.

    Parameters
    ----------
    pair : Correspondences
    scores : (M,) float32
        Confidence of the network in each match, in [0, 1].
    operating_point : OperatingPoint
        ``pose``: score above 0.5. ``sfm``: mutual matches with a score above 0.3; of a pair with fewer than
        20 above 0.7, which usually shows two places, only those. (The network learned from overlapping
        photos and finds structure everywhere: of 114 pairs of a validation scene that share nothing, 110
        passed COLMAP's verification without this. Of 119 such pairs of two validation scenes 8 % have 20, of
        449 that share 50 points or more 92 %.)

    Returns
    -------
    (M,) bool
    """
    if operating_point is OperatingPoint.POSE:
        return scores > POSE_MIN_SCORE
    confident = pair.mutual & (scores > CONFIDENT_SCORE)
    if np.count_nonzero(confident) < MIN_NUM_CONFIDENT:
        return confident
    return pair.mutual & (scores > SFM_MIN_SCORE)
