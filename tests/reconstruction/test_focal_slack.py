"""How far poses hang on the focal length: little in a deep scene, much along a flat wall."""

import numpy as np
import pycolmap
import pytest

from corrsfm.reconstruction.focal_slack import measure_focal_slack

NOISE_PX = 0.7


def model_of(points: np.ndarray, rotations: list[np.ndarray], centres: np.ndarray) -> pycolmap.Reconstruction:
    """A model in which every photo sees every point, up to noise; the camera is not known from EXIF."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 800.0, 1000, 800)
    model.add_camera_with_trivial_rig(camera)
    random = np.random.default_rng(0)
    point_ids = [model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8)) for point in points]
    for number, (rotation, centre) in enumerate(zip(rotations, centres, strict=True), 1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        projected = np.array([camera.img_from_cam(rotation @ (point - centre)) for point in points])
        keypoints = projected + random.normal(0, NOISE_PX, projected.shape)
        image = pycolmap.Image(name=f"{number}.jpg", keypoints=keypoints, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
        for index, point_id in enumerate(point_ids):
            model.add_observation(point_id, pycolmap.TrackElement(number, index))
    return model


def turned(angles_deg: np.ndarray) -> list[np.ndarray]:
    """Rotations about y."""
    return [
        np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
        for a in np.radians(angles_deg)
    ]


def around(radius: float, distance: float) -> pycolmap.Reconstruction:
    """Six photos on an arc, all from one distance of the middle of a ball of points."""
    points = np.random.default_rng(1).normal(size=(150, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    rotations = turned(np.linspace(0, 60, 6))
    centres = np.array([rotation.T @ [0, 0, -distance] for rotation in rotations])
    return model_of(points, rotations, centres)


def past_a_wall() -> pycolmap.Reconstruction:
    """Six photos on a line before a flat wall, turned as if the line were the outside of a bend."""
    points = np.random.default_rng(1).uniform([-4, -3, 10], [4, 3, 10.01], (150, 3))
    centres = np.column_stack([np.linspace(-4, 4, 6), np.zeros(6), np.zeros(6)])
    return model_of(points, turned(np.linspace(-15, 15, 6)), centres)


def test_a_flat_wall_leaves_the_focal_length_open_and_a_deep_scene_does_not() -> None:
    wall, deep = measure_focal_slack(past_a_wall()), measure_focal_slack(around(3.0, 10.0))
    assert wall is not None and deep is not None
    assert wall.is_large and not deep.is_large
    assert wall.factor > 1.15 > 1.05 > deep.factor > 1


def test_known_focal_lengths_are_not_open() -> None:
    wall = past_a_wall()
    given = wall.cameras[1]
    given.has_prior_focal_length = True
    assert measure_focal_slack(wall) is None
    # One photo of unknown focal length among five of known: these hold it.
    unknown = pycolmap.Camera(camera_id=2, model=given.model, width=given.width, height=given.height,
                              params=given.params.copy())  # fmt: skip
    mixed = pycolmap.Reconstruction()
    for camera in (given, unknown):
        mixed.add_camera_with_trivial_rig(camera)
    for image in wall.images.values():
        xy = np.array([point.xy for point in image.points2D])
        copy = pycolmap.Image(
            name=image.name, keypoints=xy, camera_id=2 if image.image_id == 3 else 1, image_id=image.image_id
        )
        mixed.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in wall.points3D.values():
        mixed.add_point3D(point.xyz, point.track)
    slack = measure_focal_slack(mixed)
    assert slack is not None and not slack.is_large
    assert slack.pose_change_deg < 0.2


def test_the_model_is_not_changed() -> None:
    model = around(3.0, 10.0)
    before = {image_id: image.cam_from_world().matrix() for image_id, image in model.images.items()}
    params = model.cameras[1].params.copy()
    measure_focal_slack(model)
    np.testing.assert_array_equal(model.cameras[1].params, params)
    for image_id, pose in before.items():
        np.testing.assert_array_equal(model.images[image_id].cam_from_world().matrix(), pose)
    assert model.num_points3D() == 150


@pytest.mark.parametrize("num_points", [0, 1, 19])
def test_too_few_points_say_nothing(num_points: int) -> None:
    model = around(3.0, 10.0)
    for point_id in sorted(model.points3D)[num_points:]:
        model.delete_point3D(point_id)
    assert measure_focal_slack(model) is None


def test_two_photos_say_nothing() -> None:
    model = around(3.0, 10.0)
    for frame_id in sorted(model.frames)[2:]:
        model.deregister_frame(frame_id)
    assert measure_focal_slack(model) is None
