"""What the network sees of a pair, and what is kept of its answer."""

import dataclasses

import numpy as np
from two_view_pairs import make_pair

from corrsfm.config import OperatingPoint
from corrsfm.prune.selection import score_matches, select_candidates, select_kept
from corrsfm.types import Correspondences


def make_matches(num: int) -> Correspondences:
    return make_pair(seed=0, num=num).as_correspondences()


def test_candidates_are_the_finite_matches_of_best_ratio_in_order():
    pair = make_matches(6)
    normalised = pair.normalised.copy()
    normalised[1, 0] = np.nan
    ratios = np.array([0.9, 0.1, 0.5, np.nan, 0.5, 0.2], np.float32)
    pair = dataclasses.replace(pair, normalised=normalised, ratios=ratios)
    assert select_candidates(pair, 6).tolist() == [0, 2, 3, 4, 5]
    assert select_candidates(pair, 3).tolist() == [2, 4, 5]
    assert select_candidates(pair, 2).tolist() == [2, 5]


def test_operating_points_keep_what_they_promise():
    pair = make_matches(100)
    pair = dataclasses.replace(pair, mutual=np.arange(100) % 2 == 0)
    scores = np.full(100, 0.2, np.float32)
    scores[:40], scores[40:80] = 0.95, 0.4
    assert np.flatnonzero(select_kept(pair, scores, OperatingPoint.POSE)).tolist() == list(range(40))
    sfm = select_kept(pair, scores, OperatingPoint.SFM)
    assert np.flatnonzero(sfm).tolist() == list(range(0, 80, 2))
    # One confident mutual match less: the pair is doubtful, and only the confident ones stay.
    scores[0] = 0.69
    sfm = select_kept(pair, scores, OperatingPoint.SFM)
    assert np.flatnonzero(sfm).tolist() == list(range(2, 40, 2))


def test_unseen_matches_are_scored_by_a_matrix_as_far_as_it_is_trusted():
    logits = np.array([3.0, 3.0, 3.0, 3.0, -3.0, -np.inf, -np.inf], np.float32)
    residuals = np.array([0, 0, 0, 1, 0, 0, 1], np.float32)
    scores = score_matches(logits, residuals)
    np.testing.assert_allclose(scores[:5], 1 / (1 + np.exp([-3.0, -3, -3, -3, 3])), rtol=1e-6)
    np.testing.assert_allclose(scores[5:], [0.75, 0.0], atol=1e-7)
    nothing = score_matches(np.full(3, -np.inf, np.float32), np.full(3, np.inf, np.float32))
    np.testing.assert_array_equal(nothing, 0)
