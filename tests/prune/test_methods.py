import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from two_view_pairs import CAMERA, make_pair

from corrsfm.config import Precision, PruneConfig, PruneMethod
from corrsfm.prune import build_pruner, depends_on_seed, make_correspondences, side_information
from corrsfm.types import Correspondences, Features, Matches, PruneResult

METHODS = ["none", "ratio", "loransac", "magsac", "corradaptor", "cascade"]


def make(seed=0, num=300, inlier_ratio=0.5, calibrated=True, relief=False) -> Correspondences:
    labelled = make_pair(seed=seed, num=num, inlier_ratio=inlier_ratio, noise_px=0.5, relief=relief)
    pair = labelled.as_correspondences()
    camera = dataclasses.replace(CAMERA, has_prior_focal_length=calibrated)
    return dataclasses.replace(pair, camera0=camera, camera1=camera)


def subset(pair: Correspondences, rows) -> Correspondences:
    arrays = {
        name: getattr(pair, name)[rows]
        for name in ("points0", "points1", "normalised", "ratios", "mutual", "log_scale_ratios", "rotations")
    }
    return dataclasses.replace(pair, **arrays)


def right_matches(seed=0, num=300, inlier_ratio=0.5):
    return make_pair(seed=seed, num=num, inlier_ratio=inlier_ratio).label_distances < 1e-9


def build(method, **options):
    return build_pruner(PruneConfig(method=PruneMethod(method), **options), device="cpu", seed=3, threads=1)


@pytest.fixture(params=METHODS)
def build_one(request):
    return lambda: build(request.param, precision=Precision.FLOAT32)


@pytest.fixture
def pruner(build_one):
    return build_one()


def assert_sound(result, pair):
    assert len(result) == len(pair)
    assert result.scores.dtype == np.float32
    assert result.inlier_mask.dtype == bool
    assert np.isfinite(result.scores).all()
    assert (result.scores >= 0).all() and (result.scores <= 1).all()
    assert not np.isnan(result.residuals).any() or (result.model is None and np.isnan(result.residuals).all())
    if result.model is not None:
        assert np.isfinite(result.model.matrix).all()
    assert result.decided_by


def test_pruner_has_the_name_of_its_method(pruner):
    assert pruner.name in METHODS
    assert pruner.name in pruner.fingerprint


@pytest.mark.parametrize("method", METHODS)
def test_methods_whose_results_depend_on_the_seed_are_known(method):
    config = PruneConfig(method=PruneMethod(method))
    pruners = [build_pruner(config, device="cpu", seed=seed, threads=1) for seed in (0, 1)]
    assert depends_on_seed(config) == (pruners[0].fingerprint != pruners[1].fingerprint)


def test_pruner_of_no_pairs_gives_no_results(pruner):
    assert pruner([]) == []


@pytest.mark.parametrize("num", [0, 1, 4, 5, 7, 8, 10])
def test_pruner_accepts_few_matches(pruner, num):
    pair = make(num=num, inlier_ratio=0.7)
    (result,) = pruner([pair])
    assert_sound(result, pair)


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("case", ["one point", "line", "no motion", "outliers", "not finite"])
def test_pruner_accepts_degenerate_matches(pruner, case, calibrated):
    pair = make(num=60, calibrated=calibrated)
    generator = np.random.default_rng(0)
    normalised = pair.normalised.copy()
    if case == "one point":
        normalised[:] = normalised[0]
    elif case == "line":
        normalised[:, 1] = 0.5 * normalised[:, 0]
        normalised[:, 3] = 0.5 * normalised[:, 2]
    elif case == "no motion":
        normalised[:, 2:] = normalised[:, :2]
    elif case == "outliers":
        normalised = generator.uniform(-0.5, 0.5, normalised.shape).astype(np.float32)
    else:
        normalised[::3] = np.nan
        normalised[1::3, 2] = np.inf
    points = normalised * np.float32(500) + np.array([320, 240, 320, 240], np.float32)
    pair = dataclasses.replace(
        pair,
        normalised=normalised,
        points0=points[:, :2],
        points1=points[:, 2:],
        mutual=np.ones(60, bool),
        ratios=np.full(60, 0.5, np.float32),
    )
    (result,) = pruner([pair])
    assert_sound(result, pair)


def test_pruner_repeats_itself(pruner, build_one):
    pairs = [make(seed, inlier_ratio=0.2) for seed in range(3)]
    first = pruner(pairs)
    for before, after in zip(first, build_one()(pairs), strict=True):
        np.testing.assert_array_equal(before.inlier_mask, after.inlier_mask)
        np.testing.assert_array_equal(before.scores, after.scores)


def test_result_of_a_pair_does_not_depend_on_the_others(pruner):
    pairs = [make(0), make(1, num=0), make(2, num=150, inlier_ratio=0.3), make(3, num=40)]
    for pair, together in zip(pairs, pruner(pairs), strict=True):
        (alone,) = pruner([pair])
        # On a CPU no method computes pairs together, so not even rounding may differ.
        np.testing.assert_array_equal(alone.inlier_mask, together.inlier_mask)
        np.testing.assert_array_equal(alone.scores, together.scores)


def test_pruner_keeps_order_of_matches(pruner):
    pair, right = make(num=400, relief=True), right_matches(num=400)
    (result,) = pruner([pair])
    assert result.inlier_mask[right].mean() > 0.8
    assert result.scores[right].mean() > result.scores[~right].mean() + 0.2


@pytest.mark.parametrize("method", ["loransac", "magsac"])
@pytest.mark.parametrize("calibrated", [True, False])
def test_robust_methods_find_the_right_matches(method, calibrated):
    pair, right = make(inlier_ratio=0.3, calibrated=calibrated), right_matches(inlier_ratio=0.3)
    (result,) = build(method)([pair])
    assert result.model.kind == ("essential" if calibrated else "fundamental")
    assert result.inlier_mask[right].mean() > 0.9
    assert right[result.inlier_mask].mean() > 0.95
    assert np.median(result.residuals[right]) < 1e-5 < np.median(result.residuals[~right])


def test_pair_without_enough_matches_is_pruned_to_nothing_by_robust_methods():
    for method in ("loransac", "magsac"):
        (result,) = build(method)([make(num=5, inlier_ratio=1.0)])
        assert not result.inlier_mask.any()
        assert result.model is None


def test_none_keeps_everything_and_ratio_keeps_mutual_matches_below_the_ratio():
    pair = make()
    assert build("none")([pair])[0].inlier_mask.all()
    expected = pair.mutual & (pair.ratios <= np.float32(0.6))
    np.testing.assert_array_equal(build("ratio", max_ratio=0.6)([pair])[0].inlier_mask, expected)


def test_fingerprint_changes_with_every_option_that_matters():
    fingerprints = {build("loransac", max_error_px=error).fingerprint for error in (2.0, 4.0)}
    fingerprints |= {build("loransac", max_ratio=0.7).fingerprint, build("ratio").fingerprint}
    assert len(fingerprints) == 4


def test_importing_the_stage_loads_nothing_heavy():
    code = "import sys, corrsfm.prune; print([m for m in ('torch', 'pycolmap', 'cv2') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


def test_residuals_of_another_number_of_matches_are_refused():
    with pytest.raises(ValueError, match="residuals: expected shape"):
        PruneResult(
            scores=np.zeros(3, np.float32), inlier_mask=np.zeros(3, bool), residuals=np.zeros(2, np.float32)
        )


# ------------------------------------------------------------------------------------- correspondences


def features(points, scales, orientations) -> Features:
    num = len(points)
    return Features(
        keypoints=np.asarray(points, np.float32).reshape(num, 2),
        scales=np.asarray(scales, np.float32),
        orientations=np.asarray(orientations, np.float32),
        scores=np.ones(num, np.float32),
        descriptors=np.zeros((num, 128), np.uint8),
        image_size=(640, 480),
    )


def test_correspondences_follow_the_matches():
    features0 = features([[320, 240], [820, 240]], [1, 2], [0.0, 3.0])
    features1 = features([[320, 740], [320, 240]], [2, 8], [0.5, -3.0])
    matches = Matches(
        indices=np.array([[0, 0], [1, 1]], np.int32),
        ratios=np.array([0.5, 0.9], np.float32),
        mutual=np.array([True, False]),
    )
    pair = make_correspondences(features0, features1, matches, CAMERA, CAMERA, "a – b")
    np.testing.assert_allclose(pair.normalised, [[0, 0, 0, 1], [1, 0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(pair.log_scale_ratios, np.log([2, 4]), rtol=1e-6)
    np.testing.assert_allclose(pair.rotations, [0.5, 2 * np.pi - 6.0], rtol=1e-5)
    assert pair.name == "a – b"


def test_side_information_has_the_documented_channels():
    pair = make(num=20)
    five = side_information(pair, 5)
    np.testing.assert_array_equal(five[:, 0], pair.ratios)
    np.testing.assert_array_equal(five[:, 1], pair.mutual.astype(np.float32))
    np.testing.assert_array_equal(five[:, 2], pair.log_scale_ratios)
    np.testing.assert_allclose(np.arctan2(five[:, 4], five[:, 3]), pair.rotations, atol=1e-6)
    np.testing.assert_array_equal(side_information(pair, 2), five[:, :2])
    assert side_information(pair, 0).shape == (20, 0)
    with pytest.raises(ValueError, match="no layout of 3 side channels"):
        side_information(pair, 3)


def test_side_information_is_finite_whatever_comes_in():
    pair = make(num=3)
    bad = np.array([np.nan, np.inf, -np.inf], np.float32)
    pair = dataclasses.replace(pair, ratios=bad, log_scale_ratios=bad, rotations=bad)
    expected = [[1, 0, 1, 0], [1, 3, 1, 0], [0, -3, 1, 0]]
    np.testing.assert_array_equal(side_information(pair, 5)[:, [0, 2, 3, 4]], expected)
