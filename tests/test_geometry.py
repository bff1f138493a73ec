"""Two-view geometry against values known by hand."""

import numpy as np
import pytest

from corrsfm.geometry import (
    angle_between_deg,
    cross_matrix,
    essential_from_pose,
    pose_error_deg,
    relative_pose,
    rotation_angle_deg,
    symmetric_epipolar_distance_sq,
)


def rotation_about_z(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_cross_matrix_multiplies_like_the_cross_product() -> None:
    np.testing.assert_array_equal(cross_matrix([1, 2, 3]) @ [4, 5, 6], np.cross([1, 2, 3], [4, 5, 6]))


def test_relative_pose_takes_points_of_camera_0_to_camera_1() -> None:
    rng = np.random.default_rng(0)
    rotation0, rotation1 = rotation_about_z(20), rotation_about_z(-35)
    translation0, translation1, point = rng.standard_normal((3, 3))
    rotation, translation = relative_pose(rotation0, translation0, rotation1, translation1)
    in_cam0, in_cam1 = rotation0 @ point + translation0, rotation1 @ point + translation1
    np.testing.assert_allclose(rotation @ in_cam0 + translation, in_cam1, atol=1e-12)


def test_true_correspondences_lie_on_their_epipolar_lines() -> None:
    rng = np.random.default_rng(1)
    rotation, translation = rotation_about_z(15), np.array([0.3, -0.2, 0.1])
    in_cam0 = rng.uniform(-1, 1, (50, 3)) + [0, 0, 5]
    in_cam1 = in_cam0 @ rotation.T + translation
    correspondences = np.hstack([in_cam0[:, :2] / in_cam0[:, 2:], in_cam1[:, :2] / in_cam1[:, 2:]])
    distances = symmetric_epipolar_distance_sq(essential_from_pose(rotation, translation), correspondences)
    assert distances.shape == (50,) and distances.max() < 1e-25


def test_symmetric_epipolar_distance_of_a_sideways_motion_is_twice_the_squared_row_offset() -> None:
    # Translation along x, no rotation: epipolar lines are rows, so both distances are the difference in y.
    essential = essential_from_pose(np.eye(3), [2.0, 0, 0])
    np.testing.assert_allclose(
        symmetric_epipolar_distance_sq(essential, [[0.1, 0.2, 0.4, 0.23], [0, 0, 1, 0]]),
        [2 * 0.03**2, 0],
        atol=1e-15,
    )


def test_essential_matrix_has_unit_scale_and_zero_translation_gives_zero() -> None:
    np.testing.assert_allclose(
        np.linalg.norm(essential_from_pose(rotation_about_z(3), [5, 1, 2])), np.sqrt(2)
    )
    assert not essential_from_pose(np.eye(3), [0, 0, 0]).any()


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 0.5, 90.0, 179.999, 180.0])
def test_rotation_angle_is_exact_at_both_ends(degrees: float) -> None:
    assert rotation_angle_deg(rotation_about_z(degrees)) == pytest.approx(degrees, abs=1e-9)


def test_angle_between_vectors() -> None:
    assert angle_between_deg([1, 0, 0], [0, 3, 0]) == pytest.approx(90)
    assert angle_between_deg([1, 0, 0], [-2, 0, 0]) == pytest.approx(180)
    assert angle_between_deg([1, 0, 0], [0, 0, 0]) == 180


def test_pose_error_ignores_sign_and_length_of_the_translation() -> None:
    rotation_error, direction_error = pose_error_deg(
        rotation_about_z(12), [-3, 0, 0], rotation_about_z(2), [1, 0, 0]
    )
    assert rotation_error == pytest.approx(10) and direction_error == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("translation", [[0, 0, 0], [np.nan, 0, 0]])
def test_a_translation_without_direction_has_the_largest_error(translation: list[float]) -> None:
    assert pose_error_deg(np.eye(3), translation, np.eye(3), [1, 0, 0])[1] == 90
