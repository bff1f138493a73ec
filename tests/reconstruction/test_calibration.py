"""Focal lengths that cannot be, and mapping that holds them at first."""

import logging
import math
from pathlib import Path

import pycolmap
import pytest

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.models import observation_errors
from corrsfm.config import ReconstructionConfig
from corrsfm.reconstruction import mapper as reconstruction
from corrsfm.reconstruction.calibration import (
    describe_impossible,
    focal_length_ratios,
    has_possible_cameras,
    has_prior_focal_lengths,
    is_plausible,
    refine_intrinsics,
    restore_priors,
)
from corrsfm.reconstruction.mapper import reconstruct


def synthesize(path: Path) -> pycolmap.Reconstruction:
    """A database of exact matches of ten photos with a camera each, and its true model."""
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(path) as database:
        return pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=10, num_cameras_per_rig=1, num_frames_per_rig=1, num_points3D=150,
                camera_has_prior_focal_length=False,
            ),
            database,
        )  # fmt: skip


def set_focal_length(model: pycolmap.Reconstruction, number: int, factor: float) -> None:
    camera = model.cameras[sorted(model.cameras)[number]]
    for index in camera.focal_length_idxs():
        camera.params[index] *= factor


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    return synthesize(tmp_path / "database.db")


def test_a_model_read_from_files_learns_which_focal_lengths_were_known(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for camera in database.read_all_cameras()[:-1]:
            camera.has_prior_focal_length = True
            database.update_camera(camera)
    (tmp_path / "model").mkdir()
    model.write_binary(tmp_path / "model")
    read = pycolmap.Reconstruction(tmp_path / "model")
    assert len(focal_length_ratios(read)) == 10
    restore_priors(read, tmp_path / "database.db")
    assert len(focal_length_ratios(read)) == 1 and not has_prior_focal_lengths(read)


def test_equal_cameras_are_plausible(model: pycolmap.Reconstruction) -> None:
    ratios = focal_length_ratios(model)
    assert len(ratios) == 10 and ratios[0] == ratios[-1]
    assert is_plausible(model)


def test_a_focal_length_that_no_camera_has_is_not_plausible(model: pycolmap.Reconstruction) -> None:
    set_focal_length(model, 3, 1e6)
    assert not is_plausible(model)


def test_two_lenses_are_plausible_but_not_many_different_focal_lengths(
    model: pycolmap.Reconstruction,
) -> None:
    for number in range(2):
        set_focal_length(model, number, 3.0)
    assert is_plausible(model)
    set_focal_length(model, 2, 3.0)
    assert not is_plausible(model)


@pytest.mark.parametrize("factor", [-1.0, 0.0, math.nan, math.inf])
def test_a_model_whose_focal_length_left_the_positive_numbers_is_none(
    model: pycolmap.Reconstruction, factor: float
) -> None:
    assert has_possible_cameras(model)
    set_focal_length(model, 3, factor)
    assert not has_possible_cameras(model)
    assert reconstruction._ranked([model], 3) == []


def test_known_focal_lengths_are_believed(model: pycolmap.Reconstruction) -> None:
    set_focal_length(model, 3, 1e6)
    for camera in model.cameras.values():
        camera.has_prior_focal_length = True
    assert is_plausible(model)


def test_refinement_finds_the_focal_lengths(model: pycolmap.Reconstruction) -> None:
    true = focal_length_ratios(model)
    for number in range(10):
        set_focal_length(model, number, 1.03)
    assert observation_errors(model).mean() > 1.0
    with colmap_log():
        refine_intrinsics(model, num_threads=1)
    assert observation_errors(model).mean() < 0.01
    assert focal_length_ratios(model) == pytest.approx(true, rel=1e-3)


def test_mapping_that_bends_is_done_again_with_intrinsics_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    synthesize(tmp_path / "database.db")
    true_mapping, refined = pycolmap.incremental_mapping, []

    def bend(*arguments, **callbacks):
        refined.append(arguments[3].ba_refine_focal_length)
        mapped = true_mapping(*arguments, **callbacks)
        if refined[-1]:
            # As where focal lengths ran away: one cannot be, and a photo is lost.
            set_focal_length(mapped[0], 0, 1e6)
            mapped[0].deregister_frame(sorted(mapped[0].reg_frame_ids())[-1])
        return mapped

    monkeypatch.setattr(reconstruction.pycolmap, "incremental_mapping", bend)
    with caplog.at_level(logging.WARNING):
        (summary,) = reconstruct(
            tmp_path / "database.db", None, tmp_path / "sparse", config=ReconstructionConfig(), num_threads=1
        )
    assert refined == [True, False]
    assert summary.num_images == 10
    assert summary.mean_error_px < 0.01
    assert "looks wrong" not in caplog.text


def test_focal_lengths_that_no_camera_has_are_named_and_zoomed_ones_are_not(
    model: pycolmap.Reconstruction,
) -> None:
    assert describe_impossible(model) == "" and not has_prior_focal_lengths(model)
    for number in range(3):
        set_focal_length(model, number, 3.0)
    assert not is_plausible(model) and describe_impossible(model) == ""
    set_focal_length(model, 9, 1e6)
    assert describe_impossible(model).startswith("focal lengths from ")
    for camera in model.cameras.values():
        camera.has_prior_focal_length = True
    assert describe_impossible(model) == "" and has_prior_focal_lengths(model)
