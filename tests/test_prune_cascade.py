import dataclasses

import numpy as np
import pytest
from two_view_pairs import make_pair

from corrsfm.config import PruneConfig, PruneMethod
from corrsfm.geometry import essential_from_pose
from corrsfm.prune import build_pruner, checkpoint_sha256
from corrsfm.prune.cascade import (
    MIN_INLIERS,
    CascadePruner,
    estimated_precision,
    is_beyond_doubt,
    select_explained,
)
from corrsfm.prune.robust import best_model, msac_scores, sampson_errors_px
from corrsfm.types import PruneResult, TwoViewModel


def cascade(network=None):
    return CascadePruner(network, max_ratio=0.8, max_error_px=4.0, seed=0, threads=1)


def true_model(labelled):
    return TwoViewModel(kind="essential", matrix=essential_from_pose(labelled.rotation, labelled.translation))


def wrong_model():
    return TwoViewModel(kind="essential", matrix=essential_from_pose(np.eye(3), [0.1, 0.2, 1.0]))


class Recorder:
    """A network that keeps given matches and remembers the pairs it was asked about."""

    def __init__(self, masks):
        self.masks, self.asked = masks, []

    def __call__(self, pairs):
        self.asked.extend(pair.name for pair in pairs)
        return [
            PruneResult(scores=self.masks[pair.name].astype(np.float32), inlier_mask=self.masks[pair.name])
            for pair in pairs
        ]


def test_doubt_ends_at_many_inliers_of_a_high_ratio():
    def first(num):
        return np.arange(200) < num

    assert is_beyond_doubt(first(MIN_INLIERS), first(MIN_INLIERS))
    assert not is_beyond_doubt(first(MIN_INLIERS - 1), first(MIN_INLIERS))
    assert not is_beyond_doubt(first(MIN_INLIERS), first(200))
    assert not is_beyond_doubt(first(0), first(0))


def test_best_model_explains_most_of_the_judges():
    labelled = make_pair(seed=1, num=200, inlier_ratio=0.4, noise_px=0.5)
    pair = labelled.as_correspondences()
    true, wrong = true_model(labelled), wrong_model()
    everything = np.ones(200, bool)
    assert best_model([wrong, true, true], pair, everything, max_error_px=4.0) == 1
    assert best_model([], pair, everything, max_error_px=4.0) is None
    # Only judges vote: among those that agree with the wrong model it wins.
    agreeing = sampson_errors_px(wrong, pair) < np.minimum(4.0, sampson_errors_px(true, pair))
    assert agreeing.any()
    assert best_model([true, wrong], pair, agreeing, max_error_px=4.0) == 1


def test_challenger_needs_the_margin():
    labelled = make_pair(seed=1, num=200, inlier_ratio=0.4, noise_px=0.5)
    pair = labelled.as_correspondences()
    # A slightly turned model explains a little less.
    turned = TwoViewModel(
        kind="essential",
        matrix=essential_from_pose(labelled.rotation, labelled.translation + [0.0, 0.001, 0.0]),
    )
    models, judges = [turned, true_model(labelled)], np.ones(200, bool)
    first, second = (
        msac_scores(sampson_errors_px(model, pair), 4.0).sum(dtype=np.float64) for model in models
    )
    assert first < second < 1.5 * first
    assert best_model(models, pair, judges, max_error_px=4.0) == 1
    assert best_model(models, pair, judges, max_error_px=4.0, margin=0.5) == 0


def test_precision_is_estimated_from_matches_known_to_be_wrong():
    pair = make_pair(seed=0, num=300, inlier_ratio=0.5).as_correspondences()
    index = np.arange(300)
    candidates, background = index < 100, index >= 100
    pair = dataclasses.replace(
        pair, mutual=candidates, ratios=np.where(background, 0.95, 0.5).astype(np.float32)
    )
    # One in ten of the background agrees by chance (21 of 220 with the prior's 1 of 20), so 42 unexplained
    # candidates stand for 42 · 21 / 199 wrong ones among the 58 explained.
    explained = (index < 58) | ((index >= 100) & (index % 10 == 0))
    expected = 1 - 42 * (21 / 199) / 58
    assert estimated_precision(pair, candidates, explained) == pytest.approx(expected)
    assert estimated_precision(pair, candidates, np.zeros(300, bool)) == 0.0
    assert estimated_precision(pair, candidates, index < 100) == 1.0
    assert estimated_precision(pair, candidates, index % 10 == 0) < 0.1


def test_kept_matches_follow_the_estimated_precision():
    pair = make_pair(seed=0, num=1000, inlier_ratio=0.5).as_correspondences()
    index = np.arange(1000)
    ratios = np.where(index < 100, 0.5, np.where(index < 200, 0.85, 0.95)).astype(np.float32)
    pair = dataclasses.replace(pair, mutual=index < 300, ratios=ratios)

    def kept(num_strict, num_loose, num_background):
        errors_px = np.full(1000, 99.0)
        errors_px[:num_strict] = errors_px[100 : 100 + num_loose] = errors_px[200:250] = 1.0
        errors_px[300 : 300 + num_background] = 1.0
        return np.flatnonzero(select_explained(pair, errors_px, max_ratio=0.8, max_error_px=4.0)).tolist()

    network = index < 30

    def kept_with_network(num_strict, num_loose, num_background):
        errors_px = np.full(1000, 99.0)
        errors_px[:num_strict] = errors_px[100 : 100 + num_loose] = 1.0
        errors_px[300 : 300 + num_background] = 1.0
        mask = select_explained(
            pair, errors_px, max_ratio=0.8, max_error_px=4.0, network_kept=network | (index == 100)
        )
        return np.flatnonzero(mask).tolist()

    assert kept_with_network(60, 30, 80) == [*range(30), 100]
    assert kept(90, 80, 35) == [*range(90), *range(100, 180)]
    assert kept(60, 30, 80) == [*range(60)]
    assert kept(10, 10, 80) == []


def test_models_of_different_kinds_are_compared_in_pixels():
    labelled = make_pair(seed=1, num=100, inlier_ratio=1.0, noise_px=1.0)
    pair = labelled.as_correspondences()
    inverse = np.linalg.inv(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    essential = true_model(labelled)
    fundamental = TwoViewModel(kind="fundamental", matrix=inverse.T @ essential.matrix @ inverse)
    np.testing.assert_allclose(
        sampson_errors_px(fundamental, pair), sampson_errors_px(essential, pair), rtol=1e-3, atol=1e-3
    )


def test_msac_scores_fall_from_one_to_zero_at_the_threshold():
    np.testing.assert_allclose(
        msac_scores(np.array([0.0, 2.0, 4.0, 9.0, np.inf]), 4.0), [1.0, 0.75, 0.0, 0.0, 0.0]
    )


def test_network_is_asked_only_about_doubtful_pairs():
    easy = make_pair(seed=0, num=400, inlier_ratio=0.6, noise_px=0.5).as_correspondences()
    hard = make_pair(seed=2, num=400, inlier_ratio=0.08, noise_px=0.5).as_correspondences()
    easy, hard = dataclasses.replace(easy, name="easy"), dataclasses.replace(hard, name="hard")
    network = Recorder({"hard": np.zeros(400, bool)})
    easy_result, hard_result = cascade(network)([easy, hard])
    assert network.asked == ["hard"]
    assert easy_result.decided_by == "beyond doubt"
    assert hard_result.decided_by in ("ratio", "loose ratio")
    (loransac,) = build_pruner(PruneConfig(method=PruneMethod.LORANSAC), seed=0, threads=1)([easy])
    assert easy_result.inlier_mask[loransac.inlier_mask].mean() > 0.95


def test_network_wins_where_the_ratio_test_fails():
    labelled = make_pair(seed=3, num=800, inlier_ratio=0.15, noise_px=0.3)
    right = labelled.label_distances < 1e-5
    generator = np.random.default_rng(0)
    # Repeated structure: wrong matches look distinctive and right ones do not, so ratio tests mislead.
    pair = dataclasses.replace(
        labelled.as_correspondences(),
        name="hard",
        ratios=np.where(right, 0.95, 0.85).astype(np.float32),
        mutual=right | (generator.random(800) < 0.3),
    )
    (result,) = cascade(Recorder({"hard": right}))([pair])
    assert result.decided_by == "network"
    assert np.median(sampson_errors_px(result.model, pair)[right]) < 1.0
    assert not result.inlier_mask[~pair.mutual].any()


def test_loose_ratio_wins_where_the_strict_one_leaves_too_little():
    labelled = make_pair(seed=4, num=300, inlier_ratio=0.3, noise_px=0.3)
    right = labelled.label_distances < 1e-5
    pair = dataclasses.replace(
        labelled.as_correspondences(), ratios=np.where(right, 0.85, 0.95).astype(np.float32)
    )
    (result,) = cascade()([pair])
    assert result.decided_by == "loose ratio"
    assert result.inlier_mask[right].mean() > 0.9


def test_pair_without_any_hypothesis_is_pruned_to_nothing():
    (result,) = cascade()([make_pair(seed=0, num=5, inlier_ratio=1.0).as_correspondences()])
    assert result.decided_by == "nothing"
    assert not result.inlier_mask.any()
    assert result.model is None


def test_cascade_without_a_checkpoint_is_classical(monkeypatch, tmp_path):
    from corrsfm.model import weights

    monkeypatch.setattr(weights, "DEFAULT_CHECKPOINT", None)
    config = PruneConfig(method=PruneMethod.CASCADE)
    assert checkpoint_sha256(config) is None
    pruner = build_pruner(config)
    assert pruner.name == "cascade"
    assert "network=[]" in pruner.fingerprint


@pytest.mark.parametrize("method", ["none", "ratio", "loransac", "magsac"])
def test_classical_methods_have_no_checkpoint(method):
    assert checkpoint_sha256(PruneConfig(method=PruneMethod(method))) is None
