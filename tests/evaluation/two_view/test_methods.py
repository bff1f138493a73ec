"""Two-view methods: every filter and every estimator keeps one contract, and each does what its name says."""

import dataclasses
import sys

import cv2
import numpy as np
import pytest
from two_view_pairs import make_pair

from corrsfm.errors import ConfigError, DependencyError
from corrsfm.evaluation.two_view.estimators import ESTIMATORS, parse_estimator, weighted_eight_point
from corrsfm.evaluation.two_view.filters import OracleFilter, SideFilter, parse_filter
from corrsfm.evaluation.two_view.methods import CLASSICAL_METHODS, parse_method
from corrsfm.geometry import essential_from_pose, pose_error_deg
from corrsfm.types import Camera, Correspondences, PruneResult, TwoViewModel

FILTERS = (
    "nn", "mutual", "ratio0.8", "ratio0.8+mutual", "adalam", "oracle", "none", "ratio", "loransac", "magsac",
)  # fmt: skip
METHODS = sorted({f"{name}/w8pt" for name in FILTERS} | {f"ratio0.8+mutual/{name}" for name in ESTIMATORS})


def test_every_method_of_the_tables_is_under_contract():
    for method in CLASSICAL_METHODS:
        filter_name, estimator_name = method.split("/")
        assert estimator_name in ESTIMATORS
        assert parse_filter(filter_name).name == filter_name


@pytest.mark.parametrize("name", METHODS)
def test_contract_of_two_view_methods(name: str):
    method = parse_method(name, device="cpu", threads=1)
    pairs = [
        make_pair(seed=seed, num=num) for seed, num in ((0, 0), (1, 3), (2, 7), (3, 60), (4, 0), (5, 61))
    ]
    outputs = method(pairs, seed=3)
    assert [len(output.result) for output in outputs] == [0, 3, 7, 60, 0, 61]
    assert [output.pose is None for output in outputs[:2]] == [True, True]
    for pair, output in zip(pairs, outputs, strict=True):
        assert output.filter_seconds >= 0 and output.estimator_seconds >= 0
        if output.pose is not None:
            assert output.pose.inlier_mask.shape == (len(pair),)
            np.testing.assert_allclose(output.pose.rotation @ output.pose.rotation.T, np.eye(3), atol=1e-6)
            assert np.linalg.norm(output.pose.translation) == pytest.approx(1.0)
    # The same seed gives the same answer, alone or among others.
    again = method(pairs[3:4], seed=3)[0]
    np.testing.assert_array_equal(again.result.inlier_mask, outputs[3].result.inlier_mask)
    # Least squares on wrong matches may rightly find no pose; a robust estimator has to.
    assert (again.pose is None) == (outputs[3].pose is None)
    assert again.pose is not None or name.endswith("/w8pt")
    if again.pose is not None:
        for field in ("rotation", "translation", "inlier_mask"):
            np.testing.assert_array_equal(getattr(again.pose, field), getattr(outputs[3].pose, field))


def smooth_pair(num: int):
    """A pair as of a plane in front of the camera, half of whose matches go astray; and which do not."""
    generator = np.random.default_rng(0)
    pair = make_pair(seed=0, num=num)
    right = np.arange(num) < num // 2
    start = generator.uniform(-0.5, 0.5, (num, 2)) * [1.2, 0.9]
    end = np.where(right[:, None], 0.9 * start + [0.02, -0.01], generator.uniform(-0.5, 0.5, (num, 2)))
    return dataclasses.replace(
        pair,
        correspondences=np.hstack([start, end]).astype(np.float32),
        ratios=np.where(right, 0.7, 0.9).astype(np.float32),
        mutual=np.ones(num, bool),
        log_scale_ratios=np.full(num, np.log(0.9), np.float32),
        rotations=np.zeros(num, np.float32),
    ), right


@pytest.mark.parametrize(("name", "num"), [("adalam", 600), ("gms", 4000)])
def test_neighbourhood_filters_keep_what_moves_together(name: str, num: int):
    if name == "gms" and not hasattr(cv2, "xfeatures2d"):
        pytest.skip("needs OpenCV with its contributed modules")
    pair, right = smooth_pair(num)
    broken = pair.correspondences.copy()
    broken[::100] = np.nan
    for points in (pair.correspondences, broken):
        (result,) = parse_filter(name)([dataclasses.replace(pair, correspondences=points)])
        assert result.inlier_mask[right].mean() > 0.9
        assert result.inlier_mask[~right].mean() < 0.1
    assert not result.inlier_mask[::100].any()


def test_the_ratio_test_of_sift_is_not_applied_to_other_features():
    pair = dataclasses.replace(make_pair(seed=0, num=100), ratios=np.full(100, 0.9, np.float32))
    kept = [parse_filter("ratio", is_sift=is_sift)([pair])[0].inlier_mask for is_sift in (True, False)]
    assert not kept[0].any()
    np.testing.assert_array_equal(kept[1], pair.mutual)


def test_gms_without_the_contributed_modules_says_what_to_install(monkeypatch):
    monkeypatch.delattr(cv2, "xfeatures2d", raising=False)
    with pytest.raises(DependencyError, match="pip install opencv-contrib-python-headless"):
        parse_filter("gms")


@pytest.mark.parametrize("estimator", sorted(ESTIMATORS))
def test_estimators_find_the_pose_of_right_matches(estimator: str):
    pair = make_pair(seed=11, num=300, inlier_ratio=0.6)
    (output,) = parse_method(f"oracle/{estimator}")([pair], seed=0)
    rotation_error, translation_error = pose_error_deg(
        output.pose.rotation, output.pose.translation, pair.rotation, pair.translation
    )
    assert max(rotation_error, translation_error) < 0.5
    assert not (output.pose.inlier_mask & ~pair.inliers()).any()


@pytest.mark.parametrize("estimator", sorted(set(ESTIMATORS) - {"w8pt"}))
def test_robust_estimators_survive_wrong_matches(estimator: str):
    pair = make_pair(seed=12, num=300, inlier_ratio=0.6)
    (output,) = parse_method(f"nn/{estimator}")([pair], seed=0)
    errors = pose_error_deg(output.pose.rotation, output.pose.translation, pair.rotation, pair.translation)
    assert max(errors) < 2.0


@pytest.mark.parametrize("estimator", ["ransac", "magsac", "colmap", "poselib"])
def test_estimators_undo_the_distortion_of_known_cameras(estimator: str):
    pair = make_pair(seed=13, num=400, inlier_ratio=1.0)
    plain = pair.as_correspondences()
    strength = 0.2
    camera = Camera(model="SIMPLE_RADIAL", width=640, height=480, params=(500.0, 320.0, 240.0, strength))

    def distorted(rays: np.ndarray) -> np.ndarray:
        rays = rays.astype(np.float64)
        radius_sq = np.sum(rays**2, axis=1, keepdims=True)
        return (rays * (1 + strength * radius_sq) * 500.0 + [320.0, 240.0]).astype(np.float32)

    seen = Correspondences(
        **{
            **plain.__dict__,
            "points0": distorted(plain.normalised[:, :2]),
            "points1": distorted(plain.normalised[:, 2:]),
            "camera0": camera,
            "camera1": camera,
        }
    )
    keep = PruneResult(scores=np.ones(400, np.float32), inlier_mask=np.ones(400, bool))
    pose = parse_estimator(estimator)(seen, keep, 0)
    assert max(pose_error_deg(pose.rotation, pose.translation, pair.rotation, pair.translation)) < 0.1


def test_side_filters_keep_what_they_say():
    pair = make_pair(seed=1, num=50)
    for text, expected in (
        ("nn", np.ones(50, bool)),
        ("mutual", pair.mutual),
        ("ratio0.75", pair.ratios <= 0.75),
        ("ratio0.9+mutual", (pair.ratios <= 0.9) & pair.mutual),
    ):
        parsed = parse_filter(text)
        assert parsed.name == text and isinstance(parsed, SideFilter)
        np.testing.assert_array_equal(parsed([pair])[0].inlier_mask, expected)


def test_oracle_keeps_the_right_matches():
    pair = make_pair(seed=1, num=50, inlier_ratio=0.3)
    result = OracleFilter()([pair])[0]
    np.testing.assert_array_equal(result.inlier_mask, pair.label_distances < 1e-4)
    assert result.inlier_mask.sum() >= 15


def test_eight_point_is_exact_on_exact_matches_and_ignores_zero_weights():
    pair = make_pair(seed=5, num=40, inlier_ratio=0.5)
    weights = (pair.label_distances < 1e-10).astype(float)
    assert 15 < weights.sum() < 30
    found = weighted_eight_point(pair.correspondences.astype(np.float64), weights)
    expected = essential_from_pose(pair.rotation, pair.translation)
    found *= np.sign(np.sum(found * expected))
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_eight_point_estimator_prefers_the_essential_matrix_of_the_filter():
    pair = make_pair(seed=6, num=40, inlier_ratio=0.5)
    essential = essential_from_pose(pair.rotation, pair.translation)
    result = PruneResult(
        scores=np.zeros(40, np.float32),
        inlier_mask=np.zeros(40, bool),
        model=TwoViewModel(kind="essential", matrix=essential),
    )
    pose = parse_estimator("w8pt")(pair.as_correspondences(), result, 0)
    np.testing.assert_allclose(pose.rotation, pair.rotation, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ratio0.8", "expected FILTER/ESTIMATOR"),
        ("ratio/nothing", "no estimator 'nothing'; there are ransac, usac"),
        ("nn/poselib:-1", "positive number of pixels"),
        ("nn/poselib:x", "positive number of pixels"),
        ("guess/poselib", "no filter 'guess'; expected nn, mutual"),
        ("ratio1.8/poselib", "no filter 'ratio1.8'"),
        ("corradaptor@loose/w8pt", "no prune method .* POINT of sfm, pose"),
    ],
)
def test_names_that_mean_nothing_are_explained(text: str, message: str):
    with pytest.raises(ConfigError, match=message):
        parse_method(text)


def test_missing_poselib_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    with pytest.raises(DependencyError, match=r"corrsfm\[evaluate\]"):
        parse_method("nn/poselib")([make_pair(seed=0, num=20)])
