"""Photos taken out of a model and registered again."""

from pathlib import Path
from typing import Any

import pycolmap
import pytest
from scene_of_points import bend
from synthetic_database import synthesize

from corrsfm.reconstruction.agreement import agreement
from corrsfm.reconstruction.candidates import (
    Candidate,
    MapperKind,
    StartingCameras,
    map_candidate,
)
from corrsfm.reconstruction.registration import register_again
from corrsfm.reconstruction.views import views_of


def misplace(model: pycolmap.Reconstruction, number: int) -> str:
    """Turn a photo of a model by 40 degrees; its name."""
    name, view = list(views_of(model).items())[number]
    wrong = bend(view, 40.0)
    (image,) = [image for image in model.images.values() if image.name == name]
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(wrong.rotation), wrong.translation)
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, pose)
    return name


def test_a_misplaced_photo_finds_its_place(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db")
    wrong = pycolmap.Reconstruction(truth)
    name = misplace(wrong, 3)
    assert agreement(views_of(wrong), views_of(truth)).share < 1.0
    # As a kill may have left it.
    (tmp_path / "work" / "given").mkdir(parents=True)
    again = register_again(wrong, [name], tmp_path / "database.db", tmp_path / "work")
    assert again is not None
    common = agreement(views_of(again), views_of(truth))
    assert (common.num_photos, common.share) == (8, 1.0)
    assert not (tmp_path / "work").exists()
    assert wrong.num_reg_images() == 8


def test_a_model_of_other_cameras_than_the_database_s_is_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path)
    candidate = Candidate(mapper=MapperKind.INCREMENTAL, cameras=StartingCameras.SEPARATE)
    model = map_candidate(candidate, path, tmp_path / "separate")
    assert model is not None and len({image.camera_id for image in model.images.values()}) == 8
    name = misplace(model, 3)
    before = path.read_bytes()
    again = register_again(model, [name], path, tmp_path / "work", cameras=StartingCameras.SEPARATE)
    assert again is not None
    assert agreement(views_of(again), views_of(truth)).share == 1.0
    assert {image.name: image.camera_id for image in again.images.values()} == {
        image.name: image.camera_id for image in model.images.values()
    }
    assert path.read_bytes() == before


def test_a_photo_without_pairs_stays_out(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db")
    image = truth.images[truth.reg_image_ids()[0]]
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for pair_id in database.read_two_view_geometry_num_inliers()[0]:
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            if image.image_id in pair:
                database.delete_two_view_geometry(*pair)
    again = register_again(truth, [image.name], tmp_path / "database.db", tmp_path / "work")
    assert again is not None
    assert sorted(views_of(again)) == sorted(set(views_of(truth)) - {image.name})


def test_nothing_is_left_to_start_from(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db")
    names = list(views_of(truth))[1:]
    assert register_again(truth, names, tmp_path / "database.db", tmp_path / "work") is None
    assert not (tmp_path / "work").exists()


def test_mapping_on_from_there_has_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = synthesize(tmp_path / "database.db")
    bounds = []

    def mapping(*given: Any, **_: Any) -> dict[int, pycolmap.Reconstruction]:
        bounds.append(given[3].max_runtime_seconds)
        return {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)
    name = next(iter(truth.images.values())).name
    for given in ({}, {"max_runtime_seconds": 7}):
        assert register_again(truth, [name], tmp_path / "database.db", tmp_path / "work", **given) is None
    assert bounds[0] <= 0 and bounds[1] == 7
    assert not (tmp_path / "work").exists()


def test_a_camera_that_cannot_be_is_no_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bundle adjustment may take a focal length through zero where a photo hangs on false matches."""
    truth = synthesize(tmp_path / "database.db")
    impossible = pycolmap.Reconstruction(truth)
    camera = next(iter(impossible.cameras.values()))
    camera.params = [-14.2, *camera.params[1:]]
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_, **__: {0: impossible})
    name = next(iter(views_of(truth)))
    assert register_again(truth, [name], tmp_path / "database.db", tmp_path / "work") is None
