"""Upright, to scale, without stray points: what is exported is the same scene in better axes."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from export_readers import read_nerfstudio
from finished_scene import FinishedScene, make_finished_scene
from scene_of_points import turn

from corrsfm import export_scene
from corrsfm.errors import InputError
from corrsfm.export.world import common_up, crop_to_bulk, scale_of, turn_to_z
from corrsfm.geometry import Pose
from corrsfm.images.cameras import PhotoInfo

# COLMAP's camera axes of a level camera that looks along +y in a world with z up.
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def tilted(yaw_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> Pose:
    """A camera turned about the vertical, then tilted down, then rolled."""
    rotation = turn("z", roll_deg) @ turn("x", pitch_deg) @ LEVEL @ turn("z", yaw_deg)
    return rotation, np.zeros(3)


def test_up_of_level_cameras_is_up() -> None:
    np.testing.assert_allclose(
        common_up([tilted(yaw, 0) for yaw in range(0, 360, 40)]), [0, 0, 1], atol=1e-12
    )


@pytest.mark.parametrize("pitch_deg", [-50.0, 30.0, 55.0])
def test_tilt_does_not_turn_up_even_when_cameras_look_one_way(pitch_deg: float) -> None:
    # From a balcony: all look down and to one side; the mean of their vertical axes leans by the tilt.
    poses = [tilted(yaw, pitch_deg) for yaw in (-40, -20, 0, 20, 40)]
    np.testing.assert_allclose(common_up(poses), [0, 0, 1], atol=1e-9)


def test_cameras_that_do_not_turn_have_the_mean_of_their_vertical_axes() -> None:
    up = common_up([tilted(0, 0), tilted(0, 10), tilted(0, -10)])
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)


def test_a_little_roll_moves_up_by_no_more() -> None:
    rng = np.random.default_rng(0)
    poses = [tilted(yaw, 40, roll) for yaw, roll in zip(range(0, 360, 15), rng.normal(0, 2, 24), strict=True)]
    assert np.degrees(np.arccos(common_up(poses)[2])) < 2


def test_photos_on_their_side_among_others_are_refused() -> None:
    poses = [tilted(yaw, 0, roll) for yaw in (0, 90, 180, 270) for roll in (0, 180)]
    with pytest.raises(InputError, match="no common up"):
        common_up(poses)


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0.6, 0, 0.8]])
def test_up_is_turned_to_z_by_a_rotation(up: list[float]) -> None:
    rotation = turn_to_z(np.array(up, float))
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def leaning_scene(root: Path) -> FinishedScene:
    """A scene whose cameras are level in a world that leans."""
    scene = make_finished_scene(root, folder="")
    lean = turn("x", 70) @ turn("y", 20)
    for i, image in enumerate(scene.model.images.values()):
        rotation = tilted(60.0 * i, 20)[0] @ lean.T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.1 * i, 0.0, 3.0]))
        image.frame.rig_from_world = pose
    scene.model.write_binary(scene.workspace / "sparse" / "0")
    return scene


def test_upright_exports_level_cameras(tmp_path: Path) -> None:
    scene = leaning_scene(tmp_path / "made")
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio", upright=True)
    read = read_nerfstudio(tmp_path / "out")
    # The horizontal axis of each camera is level; OpenGL's second axis points up.
    np.testing.assert_allclose(read.camera_to_worlds[:, 2, 0], 0, atol=1e-9)
    np.testing.assert_allclose(read.camera_to_worlds[:, 2, 1], np.cos(np.radians(20)), atol=1e-9)
    np.testing.assert_array_equal(read.applied_transform, np.eye(3, 4))


def test_photos_on_their_side_are_upright_by_their_exif(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = leaning_scene(tmp_path / "made")
    on_side = {"2.png", "4.png"}
    side = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for image in scene.model.images.values():
        if image.name in on_side:  # shown upright after a quarter turn clockwise: flag 6
            pose = image.cam_from_world()
            turned = pycolmap.Rotation3d(side @ np.array(pose.rotation.matrix()))
            image.frame.rig_from_world = pycolmap.Rigid3d(turned, side @ pose.translation)
    scene.model.write_binary(scene.workspace / "sparse" / "0")
    monkeypatch.setattr(
        "corrsfm.export.scene.read_photo_info",
        lambda path: PhotoInfo(width=1, height=1, orientation=6 if path.name in on_side else 1),
    )
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio", upright=True)
    read = read_nerfstudio(tmp_path / "out")
    for path, matrix in zip(read.paths, read.camera_to_worlds, strict=True):
        level = matrix[:3, 1] if path.name in on_side else matrix[:3, 0]
        assert level[2] == pytest.approx(0, abs=1e-9)


def test_two_photos_set_the_scale_and_the_result_leads_back(scene: FinishedScene, tmp_path: Path) -> None:
    result = export_scene(scene.workspace, tmp_path / "out", "nerfstudio", scale=("1.png", "3.png", 2.5))
    read = read_nerfstudio(tmp_path / "out")
    centres = {
        path.name: matrix[:3, 3] for path, matrix in zip(read.paths, read.camera_to_worlds, strict=True)
    }
    assert np.linalg.norm(centres["1.png"] - centres["3.png"]) == pytest.approx(2.5)
    original = scene.model.find_image_with_name("1.png").projection_center()
    np.testing.assert_allclose(read.original_poses()[0][:3, 3], result.scale * original, atol=1e-9)


@pytest.mark.parametrize(
    ("photo0", "photo1", "metres", "text"),
    [
        ("1.png", "nowhere.png", 1.0, "not in the model: nowhere.png; it has 1.png"),
        ("1.png", "1.png", 1.0, "taken at one place"),
        ("1.png", "2.png", 0.0, "a distance of 0 m; expected one from 1e-06 to 1e\\+09 m"),
        ("1.png", "2.png", 1e300, r"a distance of 1e\+300 m"),
        ("1.png", "2.png", float("nan"), "a distance of nan m"),
    ],
)
def test_a_scale_that_cannot_be_is_refused(
    scene: FinishedScene, photo0: str, photo1: str, metres: float, text: str
) -> None:
    with pytest.raises(InputError, match=text):
        scale_of(scene.model, photo0, photo1, metres)


def test_crop_drops_the_stray_point_and_keeps_the_bulk(scene: FinishedScene) -> None:
    model = pycolmap.Reconstruction(scene.model)
    stray = next(iter(model.points3D))
    model.points3D[stray].xyz = [50.0, 0.0, 0.0]
    assert crop_to_bulk(model) == 1
    assert stray not in model.points3D and model.num_points3D() == scene.model.num_points3D() - 1
    assert crop_to_bulk(pycolmap.Reconstruction()) == 0


def test_the_model_of_the_workspace_is_not_changed(scene: FinishedScene, tmp_path: Path) -> None:
    before = (scene.workspace / "sparse" / "0" / "images.bin").read_bytes()
    export_scene(scene.workspace, tmp_path / "a.csv", "csv", upright=True, crop=True)
    assert (scene.workspace / "sparse" / "0" / "images.bin").read_bytes() == before
