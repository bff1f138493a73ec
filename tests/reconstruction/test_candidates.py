"""Candidates: one function from a description and a database to a model."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_database import synthesize

from corrsfm.reconstruction.agreement import agreement
from corrsfm.reconstruction.calibration import Refinement
from corrsfm.reconstruction.candidates import (
    Candidate,
    MapperKind,
    StartingCameras,
    candidate_bank,
    change_cameras,
    find_cameras_on_trial,
    has_unknown_focal_lengths,
    map_candidate,
)
from corrsfm.reconstruction.views import views_of


def spoil_focal_length(path: Path, factor: float) -> float:
    """Change the focal length on record; the true one."""
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
        true = camera.mean_focal_length()
        for index in camera.focal_length_idxs():
            camera.params[index] *= factor
        database.update_camera(camera)
    return true


def test_the_bank_holds_every_candidate_once_and_not_the_first_model() -> None:
    bank = candidate_bank(seed=5, on_trial=StartingCameras.SEPARATE, calibrate=True, num_seeds=2)
    assert len(bank) == len({candidate.name for candidate in bank}) == 2 * 3 * 4 - 1
    assert Candidate(mapper=MapperKind.INCREMENTAL, seed=5) not in bank
    assert {candidate.seed for candidate in bank} == {5, 6}
    assert {candidate.cameras for candidate in bank[:3]} == {StartingCameras.AS_IS}


def test_a_shared_camera_is_tried_before_one_for_each_photo_confirms_itself() -> None:
    bank = candidate_bank(seed=5, on_trial=StartingCameras.SHARED, calibrate=True)
    assert {candidate.cameras for candidate in bank[:4]} == {StartingCameras.SHARED}


def test_other_cameras_are_tried_only_where_they_are_on_trial() -> None:
    bank = candidate_bank(seed=0, on_trial=None, calibrate=True)
    assert {candidate.cameras for candidate in bank} == {StartingCameras.AS_IS, StartingCameras.CALIBRATED}
    assert len(bank) == 3 * 2 * 4 - 1


def test_known_focal_lengths_are_not_calibrated_and_each_mapper_has_its_turn_first() -> None:
    bank = candidate_bank(seed=0, on_trial=None, calibrate=False)
    assert len(bank) == 3 * 4 - 1
    assert [candidate.mapper for candidate in bank[:3]] == [
        MapperKind.GLOBAL, MapperKind.RELAXED, MapperKind.HELD,
    ]  # fmt: skip


def test_held_intrinsics_leave_only_candidates_that_do_not_change_them() -> None:
    bank = candidate_bank(
        seed=0,
        on_trial=StartingCameras.SEPARATE,
        calibrate=True,
        refinement=Refinement(intrinsics=False),
    )
    assert {candidate.cameras for candidate in bank} == {StartingCameras.AS_IS}
    assert {candidate.mapper for candidate in bank} == set(MapperKind) - {MapperKind.HELD}


@pytest.mark.parametrize("mapper", sorted(set(MapperKind) - {MapperKind.HELD}))
def test_a_candidate_keeps_intrinsics_that_are_not_to_be_refined(tmp_path: Path, mapper: MapperKind) -> None:
    synthesize(tmp_path / "database.db")
    true = spoil_focal_length(tmp_path / "database.db", 1.05)
    model = map_candidate(
        Candidate(mapper=mapper), tmp_path / "database.db", tmp_path / "candidate",
        refinement=Refinement(intrinsics=False),
    )  # fmt: skip
    assert model is not None
    assert model.cameras[1].mean_focal_length() == pytest.approx(1.05 * true)


@pytest.mark.parametrize("mapper", list(MapperKind))
def test_every_mapper_finds_the_true_model(tmp_path: Path, mapper: MapperKind) -> None:
    truth = synthesize(tmp_path / "database.db")
    model = map_candidate(Candidate(mapper=mapper), tmp_path / "database.db", tmp_path / "candidate")
    assert model is not None
    common = agreement(views_of(truth), views_of(model))
    assert (common.num_photos, common.share) == (8, 1.0)
    assert sorted(path.name for path in (tmp_path / "candidate").iterdir()) == ["candidate.json", "model"]


def test_what_a_candidate_calibrates_stays_its_own(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db")
    true = spoil_focal_length(tmp_path / "database.db", 1.2)
    candidate = Candidate(mapper=MapperKind.HELD, cameras=StartingCameras.CALIBRATED)
    model = map_candidate(candidate, tmp_path / "database.db", tmp_path / "candidate")
    assert model is not None
    assert agreement(views_of(truth), views_of(model)).share == 1.0
    assert model.cameras[1].mean_focal_length() == pytest.approx(true, rel=0.02)
    assert not model.cameras[1].has_prior_focal_length
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        (camera,) = database.read_all_cameras()
    assert camera.mean_focal_length() == pytest.approx(1.2 * true)
    assert not camera.has_prior_focal_length


@pytest.mark.parametrize("mapper", list(MapperKind))
def test_photos_of_a_shared_camera_get_one_each_and_share_one_again(
    tmp_path: Path, mapper: MapperKind
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path)
    assert find_cameras_on_trial(path) is StartingCameras.SEPARATE
    assert has_unknown_focal_lengths(path)
    separate = map_candidate(
        Candidate(mapper=mapper, cameras=StartingCameras.SEPARATE), path, tmp_path / "separate"
    )
    assert separate is not None and agreement(views_of(truth), views_of(separate)).share == 1.0
    assert len({image.camera_id for image in separate.images.values()}) == separate.num_reg_images() == 8
    with pycolmap.Database.open(path) as database:
        assert database.num_cameras() == 1
    change_cameras(path, StartingCameras.SEPARATE)
    assert find_cameras_on_trial(path) is StartingCameras.SHARED
    shared = map_candidate(
        Candidate(mapper=mapper, cameras=StartingCameras.SHARED), path, tmp_path / "shared"
    )
    assert shared is not None and agreement(views_of(truth), views_of(shared)).share == 1.0
    assert {image.camera_id for image in shared.images.values()} == {1}


def synthesize_with_known_focal_length(folder: Path) -> Path:
    path = folder / "database.db"
    synthesize(path)
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
        camera.has_prior_focal_length = True
        database.update_camera(camera)
    return path


def test_cameras_of_known_focal_length_are_not_on_trial(tmp_path: Path) -> None:
    path = synthesize_with_known_focal_length(tmp_path)
    assert find_cameras_on_trial(path) is None
    assert not has_unknown_focal_lengths(path)
    for to in (StartingCameras.SEPARATE, StartingCameras.SHARED):
        change_cameras(path, to)
        with pycolmap.Database.open(path) as database:
            assert (database.num_cameras(), database.num_rigs()) == (1, 1)


def test_equal_candidates_give_equal_models(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    for mapper in MapperKind:
        candidate = Candidate(mapper=mapper, seed=3)
        one, other = (
            map_candidate(candidate, tmp_path / "database.db", tmp_path / f"{mapper}-{turn}") for turn in "ab"
        )
        assert one is not None and other is not None
        for view, again in zip(views_of(one).values(), views_of(other).values(), strict=True):
            np.testing.assert_array_equal(view.rotation, again.rotation)
            np.testing.assert_array_equal(view.translation, again.translation)


def test_a_finished_candidate_is_read_and_not_mapped_again(tmp_path: Path) -> None:
    path = synthesize_with_known_focal_length(tmp_path)
    candidate = Candidate(mapper=MapperKind.INCREMENTAL)
    first = map_candidate(candidate, path, tmp_path / "candidate")
    finished = (tmp_path / "candidate/candidate.json").read_text()
    again = map_candidate(candidate, path, tmp_path / "candidate")
    assert first is not None and again is not None
    assert list(views_of(first)) == list(views_of(again))
    assert json.loads(finished)["seconds"] > 0
    assert (tmp_path / "candidate/candidate.json").read_text() == finished
    # Files of models do not say it, and the verdict hangs on it.
    for model in (first, again):
        assert all(camera.has_prior_focal_length for camera in model.cameras.values())


def test_what_an_interrupted_run_left_is_replaced(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    (tmp_path / "candidate/model").mkdir(parents=True)
    (tmp_path / "candidate/model/cameras.bin").write_bytes(b"half")
    model = map_candidate(
        Candidate(mapper=MapperKind.INCREMENTAL), tmp_path / "database.db", tmp_path / "candidate"
    )
    assert model is not None and model.num_reg_images() == 8


@pytest.mark.parametrize("mapper", list(MapperKind))
@pytest.mark.parametrize("cameras", list(StartingCameras))
def test_a_database_without_pairs_gives_no_model(
    tmp_path: Path, mapper: MapperKind, cameras: StartingCameras
) -> None:
    synthesize(tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        database.clear_two_view_geometries()
    candidate = Candidate(mapper=mapper, cameras=cameras)
    for _ in range(2):  # the second time it is read
        assert map_candidate(candidate, tmp_path / "database.db", tmp_path / "candidate") is None
