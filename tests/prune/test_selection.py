"""What the network sees of a pair, and what is kept of its answer."""

import dataclasses

import numpy as np
import pytest
from two_view_pairs import make_pair

from corrsfm.config import MatchInput, NetworkUsage, OperatingPoint
from corrsfm.errors import InputError
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


def test_a_network_of_mutual_matches_has_only_those_as_candidates():
    ratios = np.array([0.9, 0.1, 0.5, 0.7, 0.5, 0.2], np.float32)
    mutual = np.array([True, False, True, True, False, True])
    pair = dataclasses.replace(make_matches(6), ratios=ratios, mutual=mutual)
    assert select_candidates(pair, 6, MatchInput.MUTUAL).tolist() == [0, 2, 3, 5]
    # The bound counts mutual matches, not those of smaller ratio beside them.
    assert select_candidates(pair, 3, MatchInput.MUTUAL).tolist() == [2, 3, 5]


def test_a_pair_that_does_not_say_what_is_mutual_is_refused_where_that_matters():
    pair = dataclasses.replace(make_matches(6), mutual_known=False, name="a – b")
    assert len(select_candidates(pair, 6)) == 6
    with pytest.raises(InputError, match=r"a – b: .*correspondences_from_points\(\.\.\., mutual=\.\.\.\)"):
        select_candidates(pair, 6, MatchInput.MUTUAL)
    empty = dataclasses.replace(make_matches(0), mutual_known=False)
    assert len(select_candidates(empty, 6, MatchInput.MUTUAL)) == 0


def test_operating_points_keep_what_they_promise():
    usage = NetworkUsage()
    pair = make_matches(100)
    pair = dataclasses.replace(pair, mutual=np.arange(100) % 2 == 0)
    scores = np.full(100, 0.2, np.float32)
    scores[:40], scores[40:80] = 0.95, 0.4
    pose = select_kept(pair, scores, OperatingPoint.POSE, usage, 100)
    assert np.flatnonzero(pose).tolist() == list(range(40))
    sfm = select_kept(pair, scores, OperatingPoint.SFM, usage, 100)
    assert np.flatnonzero(sfm).tolist() == list(range(0, 80, 2))
    # Twenty confident ones are enough of 100 candidates and too few of 1,000 for a share of 4 %.
    shared = NetworkUsage(min_confident_share=0.04)
    for num_candidates, last in ((100, 80), (500, 80), (1000, 40)):
        sfm = select_kept(pair, scores, OperatingPoint.SFM, shared, num_candidates)
        assert np.flatnonzero(sfm).tolist() == list(range(0, last, 2))
    # One confident mutual match less: the pair is doubtful, and only the confident ones stay.
    scores[0] = 0.69
    sfm = select_kept(pair, scores, OperatingPoint.SFM, usage, 100)
    assert np.flatnonzero(sfm).tolist() == list(range(2, 40, 2))


def test_unseen_matches_are_scored_by_a_matrix_as_far_as_it_is_trusted():
    logits = np.array([3.0, 3.0, 3.0, 3.0, -3.0, -np.inf, -np.inf], np.float32)
    residuals = np.array([0, 0, 0, 1, 0, 0, 1], np.float32)
    scores = score_matches(logits, residuals)
    np.testing.assert_allclose(scores[:5], 1 / (1 + np.exp([-3.0, -3, -3, -3, 3])), rtol=1e-6)
    np.testing.assert_allclose(scores[5:], [0.75, 0.0], atol=1e-7)
    nothing = score_matches(np.full(3, -np.inf, np.float32), np.full(3, np.inf, np.float32))
    np.testing.assert_array_equal(nothing, 0)
