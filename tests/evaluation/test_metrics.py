"""The measures on errors and geometry small enough to score by hand."""

import numpy as np
import pytest

from corrsfm.evaluation.metrics import (
    align_similarity,
    auc_contributions,
    bootstrap_mean,
    homography_corner_error,
    paired_bootstrap,
    pose_auc,
    pose_map,
    position_errors,
    precision_recall_f,
    relative_pose_errors,
)
from corrsfm.evaluation.records import auc_intervals


def _rotation_about_y(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def test_auc_of_hand_made_errors_is_exact():
    # Curve through (0,0) (1,.25) (3,.5) and level to 5: .125 + .75 + 1 = 1.875 of 5.
    assert pose_auc([3.0, 1.0, 7.0, np.inf], [5.0]) == pytest.approx([37.5], abs=1e-12)
    # Up to 10 also (7,.75) and level: .125 + .75 + 2.5 + 2.25 = 5.625 of 10.
    assert pose_auc([3.0, 1.0, 7.0, np.inf], [10.0]) == pytest.approx([56.25], abs=1e-12)


def test_auc_of_perfect_and_of_failed_pairs():
    assert pose_auc([0.0, 0.0], [5.0, 20.0]) == [100.0, 100.0]
    assert pose_auc([np.inf, 180.0], [5.0, 20.0]) == [0.0, 0.0]


def test_the_interval_of_an_auc_surrounds_that_auc():
    errors = np.array([0.5, 4.0, 12.0])
    (area,) = pose_auc(errors, [5.0])
    mean, low, high = auc_intervals(errors, [5.0], 0)["5"]
    assert mean == pytest.approx(area, abs=1e-3)
    assert low < area < high
    # One pair has no spread.
    assert auc_intervals(errors[:1], [5.0], 0)["5"] == [pytest.approx(pose_auc(errors[:1], [5.0])[0])] * 3


@pytest.mark.parametrize("threshold", [5.0, 10.0, 20.0])
def test_auc_is_the_mean_of_contributions_up_to_half_a_step(threshold):
    errors = np.random.default_rng(3).gamma(1.0, 8.0, 4000)
    errors[::10] = np.inf
    area = pose_auc(errors, [threshold])[0]
    mean = auc_contributions(errors, threshold).mean()
    last = errors[errors < threshold].max()
    # The trapezoid cuts the steps in half: e_last / (2 n t) more than the step curve, exactly.
    assert area - mean == pytest.approx(100 * last / (2 * 4000 * threshold), abs=1e-9)
    assert abs(area - mean) < 0.02


def test_map_counts_bins_of_five_degrees():
    errors = [1.0, 4.0, 6.0, 12.0, 19.0, np.inf, np.inf, np.inf, np.inf, np.inf]
    assert pose_map(errors) == pytest.approx([20.0, 25.0, (20 + 30 + 40 + 50) / 4])


def test_scores_over_nothing_and_negative_errors_are_refused():
    with pytest.raises(ValueError, match="zero pairs"):
        pose_auc([])
    with pytest.raises(ValueError, match="negative or NaN"):
        pose_map([np.nan])


def test_precision_recall_f_by_hand():
    predicted = [True, True, True, False, False]
    actual = [True, False, False, True, False]
    assert precision_recall_f(predicted, actual) == pytest.approx((100 / 3, 50.0, 40.0))


def test_precision_recall_f_of_nothing_is_zero():
    assert precision_recall_f(np.zeros(4, bool), np.ones(4, bool)) == (0.0, 0.0, 0.0)
    assert precision_recall_f(np.zeros(0, bool), np.zeros(0, bool)) == (0.0, 0.0, 0.0)


def test_bootstrap_is_repeatable_and_covers_the_mean():
    values = np.random.default_rng(0).normal(50, 10, 400)
    interval = bootstrap_mean(values, seed=4)
    assert interval == bootstrap_mean(values, seed=4)
    assert interval.low < interval.mean < interval.high
    # The standard error is 10 / sqrt(400) = .5, so the interval is about 2 · 1.96 · .5 wide.
    assert interval.high - interval.low == pytest.approx(1.96, rel=0.15)


def test_paired_bootstrap_removes_the_spread_both_methods_share():
    generator = np.random.default_rng(1)
    baseline = generator.normal(50, 30, 300)
    better = baseline + generator.normal(1.0, 0.5, 300)
    difference = paired_bootstrap(better, baseline)
    assert difference.low > 0.8 and difference.high < 1.2
    assert paired_bootstrap(baseline, baseline).high == 0.0


def test_corner_error_of_a_shift_is_its_length():
    shift = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
    assert homography_corner_error(shift, np.eye(3), 640, 480) == pytest.approx(5.0)
    # Any scale of a homography is the same homography.
    assert homography_corner_error(-2 * shift, shift, 640, 480) == pytest.approx(0.0, abs=1e-9)


def test_corner_at_infinity_is_a_failure():
    assert homography_corner_error(np.diag([1.0, 1, 0]), np.eye(3), 640, 480) == np.inf


def test_alignment_recovers_a_similarity_exactly():
    source = np.random.default_rng(2).normal(size=(7, 3))
    rotation = _rotation_about_y(40.0)
    scale, found, translation = align_similarity(source, 2.5 * source @ rotation.T + [1, -2, 3])
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(found, rotation, atol=1e-12)
    np.testing.assert_allclose(translation, [1, -2, 3], atol=1e-12)


def test_alignment_never_mirrors():
    source = np.random.default_rng(2).normal(size=(7, 3))
    _, rotation, _ = align_similarity(source, source * [1, 1, -1])
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_alignment_of_points_on_a_line_is_refused():
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="one line"):
        align_similarity(line, line)


def test_position_errors_are_zero_after_alignment_and_in_units_of_the_truth():
    truth = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], float)
    np.testing.assert_allclose(position_errors(0.1 * truth + 7, truth), 0, atol=1e-12)
    # Moving the corners of a square up and down in turn cannot be aligned away: 1 unit each.
    bent = truth + np.array([[0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, -1]])
    errors = position_errors(bent, truth)
    assert errors.max() == pytest.approx(errors.min())
    assert 0.9 < errors[0] <= 1.0


def test_relative_pose_errors_need_no_alignment_and_count_missing_photos():
    truth = {
        "a": (np.eye(3), np.zeros(3)),
        "b": (_rotation_about_y(10), np.array([-1.0, 0, 0])),
        "c": (np.eye(3), np.array([0.0, -1, 0])),
    }
    world = _rotation_about_y(70)
    moved = {
        name: (rotation @ world.T, 3.0 * (translation - rotation @ world.T @ np.array([1.0, 2, 3])))
        for name, (rotation, translation) in truth.items()
    }
    np.testing.assert_allclose(relative_pose_errors(moved, truth), 0, atol=1e-6)
    del moved["b"]
    assert relative_pose_errors(moved, truth).tolist()[::2] == [np.inf, np.inf]
    assert relative_pose_errors(moved, truth)[1] == pytest.approx(0, abs=1e-6)


def test_relative_pose_error_is_the_larger_angle_and_knows_the_sign():
    truth = {"a": (np.eye(3), np.zeros(3)), "b": (np.eye(3), np.array([1.0, 0, 0]))}
    turned = {"a": truth["a"], "b": (_rotation_about_y(3), np.array([1.0, 0, 0]))}
    assert relative_pose_errors(turned, truth) == pytest.approx([3.0])
    backwards = {"a": truth["a"], "b": (np.eye(3), np.array([-1.0, 0, 0]))}
    assert relative_pose_errors(backwards, truth) == pytest.approx([180.0])


def test_true_cameras_in_one_place_are_judged_by_rotation_alone():
    truth = {
        "a": (np.eye(3), np.zeros(3)),
        "b": (_rotation_about_y(5), np.zeros(3)),
        "c": (np.eye(3), np.ones(3)),
    }
    estimate = {**truth, "b": (_rotation_about_y(7), np.array([0.01, 0, 0]))}
    assert relative_pose_errors(estimate, truth, [("a", "b")]) == pytest.approx([2.0])
