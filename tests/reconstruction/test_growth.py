"""Photos put into a finished model by its points: where they belong, and nothing else moves."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from synthetic_database import synthesize

import corrsfm.reconstruction.growth as growth_module
from corrsfm.colmap.cameras import camera_from_pycolmap
from corrsfm.colmap.pairs import read_verified_matches
from corrsfm.reconstruction.agreement import relative_pose_differences_deg
from corrsfm.reconstruction.candidates import Candidate, MapperKind, StartingCameras, map_candidate
from corrsfm.reconstruction.growth import grow
from corrsfm.reconstruction.resection import Landmarks, Sightings, find_sightings, resect
from corrsfm.reconstruction.views import views_of


def without(model: pycolmap.Reconstruction, names: list[str], folder: Path) -> pycolmap.Reconstruction:
    """A model as it is read from disk, without some photos."""
    rest = pycolmap.Reconstruction(model)
    for name in names:
        rest.deregister_frame(rest.find_image_with_name(name).frame_id)
    folder.mkdir()
    rest.write_binary(folder)
    return pycolmap.Reconstruction(folder)


@pytest.mark.parametrize("known", [True, False])
def test_photos_find_their_places_and_the_others_stay(known: bool, tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "d.db")
    names = sorted(views_of(truth))
    new = [names[2], names[6]]
    model = without(truth, new, tmp_path / "rest")
    before = {name: image.cam_from_world().matrix() for name, image in _images(model).items()}
    growth = grow(
        model, new, tmp_path / "d.db", read_verified_matches(tmp_path / "d.db"),
        known_focal=dict.fromkeys(new, known),
    )  # fmt: skip
    assert set(growth.registered) == set(new) and not growth.failed
    assert relative_pose_differences_deg(views_of(growth.model), views_of(truth)).max() < 0.01
    after = {name: image.cam_from_world().matrix() for name, image in _images(growth.model).items()}
    assert all((after[name] == pose).all() for name, pose in before.items())
    assert growth.model.num_reg_images() == 8 and model.num_reg_images() == 6


def test_a_photo_that_is_refused_does_not_keep_others_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = synthesize(tmp_path / "d.db")
    names = sorted(views_of(truth))
    odd, new = names[2], [names[2], names[6]]
    tried = growth_module._attempts

    def attempts(*arguments: Any) -> dict[str, Any]:
        found = tried(*arguments)
        return {
            name: dataclasses.replace(one, pose=None) if name == odd else one for name, one in found.items()
        }

    monkeypatch.setattr(growth_module, "_attempts", attempts)
    growth = grow(
        without(truth, new, tmp_path / "rest"), new, tmp_path / "d.db",
        read_verified_matches(tmp_path / "d.db"), known_focal=dict.fromkeys(new, True),
    )  # fmt: skip
    assert list(growth.registered) == [names[6]] and list(growth.failed) == [odd]
    assert growth.failed[odd].why_not.endswith(
        "agree with one pose, but of a focal length that no camera has"
    )


def test_a_model_with_other_cameras_than_the_database_grows_too(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "d.db")
    candidate = Candidate(mapper=MapperKind.INCREMENTAL, cameras=StartingCameras.SEPARATE)
    whole = map_candidate(candidate, tmp_path / "d.db", tmp_path / "work")
    assert whole is not None and len({image.camera_id for image in whole.images.values()}) == 8
    new = [sorted(views_of(whole))[4]]
    growth = grow(
        without(whole, new, tmp_path / "rest"), new, tmp_path / "d.db",
        read_verified_matches(tmp_path / "d.db"), known_focal=dict.fromkeys(new, False),
    )  # fmt: skip
    assert set(growth.registered) == set(new)
    assert relative_pose_differences_deg(views_of(growth.model), views_of(truth)).max() < 0.5


def test_photos_without_matches_are_told_apart_from_those_with_few(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "d.db")
    names = sorted(views_of(truth))
    model = without(truth, names[:2], tmp_path / "rest")
    verified = read_verified_matches(tmp_path / "d.db")
    few = {
        pair: matches[:4] for pair, matches in verified.items() if names[0] in pair and names[1] not in pair
    }
    growth = grow(model, names[:2], tmp_path / "d.db", few, known_focal=dict.fromkeys(names[:2], True))
    assert not growth.registered and list(growth.failed) == names[:2]
    assert "points of the model, 15 are needed" in growth.failed[names[0]].why_not
    assert growth.failed[names[1]].why_not == "no match with any photo of the model"


def test_a_keypoint_may_have_several_points_and_false_ones_do_not_count(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "d.db")
    landmarks = Landmarks(truth)
    name = landmarks.photos[0]
    image = truth.find_image_with_name(name)
    seen = np.flatnonzero(landmarks.of_keypoints(name) >= 0)
    right = landmarks.of_keypoints(name)[seen]
    sightings = Sightings(
        keypoints=np.r_[seen, seen].astype(np.int32),
        point_ids=np.r_[right, np.roll(right, 1)],
        num_matches=2 * len(seen),
    )
    camera = truth.cameras[image.camera_id]
    found = resect(
        np.array([point.xy for point in image.points2D]), sightings, landmarks,
        camera_from_pycolmap(camera),
        focal_is_open=False,
    )  # fmt: skip
    assert found.pose is not None and found.num_inliers == len(seen)
    np.testing.assert_allclose(found.pose[0], image.cam_from_world().rotation.matrix(), atol=1e-6)
    np.testing.assert_array_equal(np.sort(found.sightings.point_ids), np.sort(right))


def test_matches_with_photos_outside_the_model_lead_nowhere(tmp_path: Path) -> None:
    landmarks = Landmarks(synthesize(tmp_path / "d.db"))
    sightings = find_sightings({"elsewhere.jpg": np.array([[0, 0]], np.int32)}, landmarks)
    assert len(sightings) == 0 and sightings.num_matches == 0


def _images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    return {image.name: image for image in model.images.values() if image.has_pose}
