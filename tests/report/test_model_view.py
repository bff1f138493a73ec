"""The view of the model: what it shows at first."""

import cv2  # noqa: F401  (before pycolmap)
import numpy as np
import pycolmap
import pytest

from corrsfm.report.model_view import make_view, plotly_view
from corrsfm.report.pictures import draw_views


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=80
        )
    )


def with_outliers(model: pycolmap.Reconstruction, distances: list[float]) -> pycolmap.Reconstruction:
    """The model with its first points moved away along x."""
    changed = pycolmap.Reconstruction(model)
    for number, distance in zip(sorted(changed.points3D), distances, strict=False):
        changed.points3D[number].xyz = np.array([distance, 0.0, 0.0])
    return changed


def projected(view, points):
    """Where the first look shows points: right and up as shares of half the picture's height."""
    from corrsfm.report.model_view import _HALF_VIEW, _first_look

    scene = _first_look(view)
    axes = [np.array(scene[f"{axis}axis"]["range"]) for axis in "xyz"]
    eye, centre = (np.array([*scene["camera"][key].values()]) for key in ("eye", "center"))
    ratio = np.array([*scene["aspectratio"].values()])
    box = np.array([(low + high) / 2 for low, high in axes]), np.array([high - low for low, high in axes])
    towards = (eye - centre) / np.linalg.norm(eye - centre)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    seen = (points - box[0]) / box[1] * ratio - eye
    depth = -seen @ towards
    assert (depth > 0).all()
    return np.column_stack([seen @ right, seen @ np.cross(towards, right)]) / depth[:, None] / _HALF_VIEW


def test_view_is_upright_and_looks_along_y(model) -> None:
    view = make_view(model)
    assert view.points.shape == (len(view.colours), 3)
    assert len(view.names) == len(view.centres) == 4
    np.testing.assert_allclose(view.frusta[:, 0], view.centres, atol=1e-12)
    # The upper corners of the pictures are higher than the lower ones, on average over the photos.
    upper, lower = view.frusta[:, 1:3, 2].mean(), view.frusta[:, 3:5, 2].mean()
    assert upper > lower
    # Distances survive the turn.
    centres = np.array(
        [image.projection_center() for image in sorted(model.images.values(), key=lambda i: i.name)]
    )
    np.testing.assert_allclose(
        np.linalg.norm(view.centres - view.centres[0], axis=1), np.linalg.norm(centres - centres[0], axis=1)
    )


def test_outliers_stay_in_the_view_and_do_not_decide_its_frame(model) -> None:
    plain, wild = make_view(model), make_view(with_outliers(model, [150.0, -120.0]))
    assert len(wild.points) == len(plain.points)
    size = np.linalg.norm(plain.high - plain.low)
    np.testing.assert_allclose(wild.low, plain.low, atol=0.1 * size)
    np.testing.assert_allclose(wild.high, plain.high, atol=0.1 * size)
    assert np.ptp(wild.points, axis=0).max() > 5 * size


def test_points_too_far_to_draw_are_left_out(model) -> None:
    assert len(make_view(with_outliers(model, [1e9])).points) == len(make_view(model).points) - 1


def test_cameras_fill_the_first_look_with_or_without_outliers(model) -> None:
    for one in (model, with_outliers(model, [150.0, -120.0])):
        view = make_view(one)
        shown = projected(view, view.centres)
        assert np.abs(shown[:, 1]).max() < 1.0 and np.abs(shown[:, 0]).max() < 1.2
        assert np.ptp(shown, axis=0).max() > 1.0


def test_an_empty_model_and_one_without_points_can_be_drawn() -> None:
    pytest.importorskip("plotly")
    empty = make_view(pycolmap.Reconstruction())
    assert empty.points.shape == empty.centres.shape == (0, 3)
    assert "Plotly.newPlot" in plotly_view(empty)


def test_photos_that_look_down_are_seen_from_above(model) -> None:
    down = pycolmap.Reconstruction(model)
    for number, image in enumerate(sorted(down.images.values(), key=lambda image: image.name)):
        # Each turned by another quarter about the axis that it looks along, which is -z of the world.
        quarter = np.pi / 2 * number
        cos, sin = np.cos(quarter), np.sin(quarter)
        rotation = np.array([[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]])
        centre = np.array([float(number), float(number**2 % 3), 10.0])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        image.frame.set_cam_from_world(image.camera_id, pose)
    view = make_view(down)
    looks = view.frusta[:, 1:].mean(axis=1) - view.frusta[:, 0]
    assert (looks[:, 2] < -0.99 * np.linalg.norm(looks, axis=1)).all()


def test_still_views_leave_out_what_is_outside_the_frame() -> None:
    points = np.array([[0.5, 0.5, 0.5], [9.0, 9.0, 9.0]])
    colours = np.array([[0, 0, 0], [255, 0, 0]], np.uint8)
    drawn = draw_views(points, colours, np.zeros((0, 3)), (np.zeros(3), np.ones(3)), side=50)
    assert drawn.shape == (50, 100, 3)
    assert (drawn == 0).all(axis=2).any() and not (drawn == (0, 0, 255)).all(axis=2).any()
