"""Distances and depths of matches between two registered photos."""

import numpy as np
import pytest
from scene_of_points import CAMERA, bend, turn

from corrsfm.reconstruction.epipolar import TwoViews
from corrsfm.reconstruction.views import Rays, View

SAME = np.array([[0, 0]])


def two_views(rotation, translation, point0, point1, focal0=500.0, focal1=500.0) -> TwoViews:
    """A photo at the origin and one with the given pose, and one keypoint in each, normalised."""
    return TwoViews(
        View(camera=CAMERA, rotation=np.eye(3), translation=np.zeros(3)),
        View(camera=CAMERA, rotation=rotation, translation=np.array(translation, float)),
        Rays(points=np.array([point0], float), focal_px=focal0),
        Rays(points=np.array([point1], float), focal_px=focal1),
    )


def test_a_keypoint_off_its_line_is_as_far_as_it_was_moved() -> None:
    # The camera moves along x: epipolar lines are horizontal. 0.01 of 500 px is 5 px.
    two = two_views(np.eye(3), [-1, 0, 0], [0.1, 0.2], [-0.1, 0.21])
    assert two.line_distance_px(SAME) == pytest.approx([5.0])
    # Both keypoints may be corrected: half of it each, in quadrature.
    assert two.sampson_distance_px(SAME) == pytest.approx([5.0 / np.sqrt(2)])


def test_far_points_need_no_translation() -> None:
    two = two_views(np.eye(3), [0, 0, 0], [0.1, 0.2], [0.106, 0.208])
    assert two.far_distance_px(SAME) == pytest.approx([5.0])
    assert np.isnan(two.sampson_distance_px(SAME)).all()
    behind = two_views(turn("y", 180.0), [0, 0, 0], [0.1, 0.2], [0.1, 0.2])
    assert np.isnan(behind.far_distance_px(SAME)).all()


def test_a_photo_of_long_focal_length_is_moved_by_more_pixels() -> None:
    two = two_views(np.eye(3), [-1, 0, 0], [0.1, 0.2], [-0.1, 0.21], focal0=300.0, focal1=400.0)
    assert two.line_distance_px(SAME) == pytest.approx([4.0])
    # Distances d0 + d1 = 0.01 with the least 300² d0² + 400² d1²: 0.01 · 300 · 400 / 500 px.
    assert two.sampson_distance_px(SAME) == pytest.approx([2.4])


@pytest.mark.parametrize(
    ("x1", "in_front"),
    [(-0.1, True), (0.05, True), (0.15, False)],
    ids=["depth 5", "depth 20", "the rays part"],
)
def test_depths_tell_points_in_front(x1: float, in_front: bool) -> None:
    two = two_views(np.eye(3), [-1, 0, 0], [0.1, 0.2], [x1, 0.2])
    assert two.in_front(SAME).tolist() == [in_front]


def test_a_point_behind_one_photo_only_is_not_in_front() -> None:
    # Photo 1 stands beyond the point and looks the same way.
    two = two_views(np.eye(3), [0, 0, -8.0], [0.1, 0.2], [-0.1 * 5 / 3, -0.2 * 5 / 3])
    assert two.sampson_distance_px(SAME) == pytest.approx([0.0], abs=1e-9)
    assert two.in_front(SAME).tolist() == [False]


def test_the_angle_of_two_rays_is_that_at_the_point() -> None:
    # Both cameras at distance 1 from the point, one unit apart: an equilateral triangle.
    two = two_views(np.eye(3), [-1, 0, 0], [np.tan(np.pi / 6), 0], [-np.tan(np.pi / 6), 0])
    assert two.ray_angles_deg(SAME) == pytest.approx([60.0])


def test_a_camera_that_only_turned_has_no_epipolar_line() -> None:
    two = two_views(turn("y", 10.0), [0, 0, 0], [0.0, 0.0], [np.tan(np.radians(10)), 0.0])
    assert np.isnan(two.sampson_distance_px(SAME)).all()
    assert np.isnan(two.line_distance_px(SAME)).all()
    assert two.in_front(SAME).tolist() == [False]
    assert two.ray_angles_deg(SAME) == pytest.approx([0.0], abs=1e-9)


def test_a_pixel_without_a_ray_is_far_from_everything() -> None:
    two = two_views(np.eye(3), [-1, 0, 0], [np.nan, np.nan], [0.1, 0.2])
    assert not (two.sampson_distance_px(SAME) < 1e9).any()
    assert not (two.line_distance_px(SAME) < 1e9).any()
    assert not two.in_front(SAME).any()


def test_no_matches_have_no_distances() -> None:
    two = two_views(np.eye(3), [-1, 0, 0], [0, 0], [0, 0])
    none = np.zeros((0, 2), int)
    for values in (two.sampson_distance_px(none), two.line_distance_px(none), two.in_front(none)):
        assert values.shape == (0,)


def test_bending_keeps_the_camera_where_it_stands() -> None:
    view = View(camera=CAMERA, rotation=turn("x", 20.0), translation=np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(bend(view, 7.0).centre, view.centre, atol=1e-12)
