"""The compact pair file: what goes in comes out within the quantisation, labels included."""

import dataclasses
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from labelled_scene import make_scene

from corrsfm.errors import InputError
from corrsfm.geometry import essential_from_pose, relative_pose, symmetric_epipolar_distance_sq
from corrsfm.labelled.compact import (
    CompactScene,
    lacks_shapes,
    read_labelled_pairs,
    read_scenes,
    write_scenes,
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CompactScene]:
    path = tmp_path_factory.mktemp("compact") / "pairs.h5"
    scene = make_scene()
    assert write_scenes(path, [make_scene("attic", seed=1), scene]) == 12
    return path, scene


def test_round_trip_is_exact_within_the_quantisation(written):
    path, scene = written
    attic, read = read_scenes(path)
    assert (attic.name, read.name) == ("attic", "yard")
    assert read.image_names == scene.image_names and read.cameras == scene.cameras
    for name in (
        "rotations",
        "translations",
        "keypoint_offsets",
        "pairs",
        "covisible",
        "match_offsets",
        "neighbours",
        "mutual",
    ):
        np.testing.assert_array_equal(getattr(read, name), getattr(scene, name), err_msg=name)
    assert np.abs(read.keypoints - scene.keypoints).max() <= 0.5 * 960 / 65535 + 1e-4
    assert np.abs(read.corrections - scene.corrections).max() < 1e-5
    assert np.abs(read.ratios - scene.ratios).max() <= 0.5 / 255 + 1e-6
    assert np.abs(read.log_scales - scene.log_scales).max() < 2e-3
    turn = np.abs(read.orientations - scene.orientations)
    assert np.minimum(turn, 2 * np.pi - turn).max() < 1e-4


def test_labels_use_the_full_camera_and_inputs_the_pinhole(written):
    path, scene = written
    pairs = [pair for pair in read_labelled_pairs(path) if pair.scene == "yard"]
    assert len(pairs) == 6
    pair = pairs[0]
    assert len(pair) == 59  # one keypoint has no neighbour
    assert pair.label_distances[:29].max() < 1e-8
    essential = essential_from_pose(
        *relative_pose(scene.rotations[0], scene.translations[0], scene.rotations[1], scene.translations[1])
    )
    by_pinhole = symmetric_epipolar_distance_sq(essential, pair.correspondences)[:29]
    assert by_pinhole.max() > 100 * pair.label_distances[:29].max()
    # Pixels come back through the camera that the record names.
    np.testing.assert_allclose(pair.as_correspondences().points0[0], scene.keypoints[0], atol=0.02)


def test_drawing_pairs_of_a_scene_does_not_depend_on_other_scenes(written, tmp_path):
    path, scene = written
    write_scenes(tmp_path / "one.h5", [scene])
    both = [pair for pair in read_labelled_pairs(path, num_per_scene=2, seed=4) if pair.scene == "yard"]
    alone = list(read_labelled_pairs(tmp_path / "one.h5", num_per_scene=2, seed=4))
    assert len(alone) == 2
    for first, second in zip(both, alone, strict=True):
        np.testing.assert_array_equal(first.correspondences, second.correspondences)


def test_a_file_tells_features_without_scale(written, tmp_path):
    assert not lacks_shapes(written[0])
    scene = written[1]
    none = np.full(len(scene.log_scales), np.nan, np.float32)
    write_scenes(tmp_path / "aliked.h5", [dataclasses.replace(scene, log_scales=none)])
    assert lacks_shapes(tmp_path / "aliked.h5")


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("mutual", lambda values: values[:-1], "not one flag a match"),
        ("rotations", lambda values: 2.0 * values, "a rotation is none"),
        ("pairs", lambda values: np.repeat(values[:, :1], 2, axis=1), "paired with itself|one neighbour"),
    ],
)
def test_values_that_cannot_be_are_damage(written, tmp_path, name, change, problem):
    path = tmp_path / "pairs.h5"
    shutil.copy(written[0], path)
    with h5py.File(path, "r+") as file:
        group = file[sorted(file)[0]]
        values = change(group[name][()])
        del group[name]
        group[name] = values
    with pytest.raises(InputError, match=f"is damaged .*({problem})"):
        read_scenes(path)


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "text.h5").write_text("no")
    with pytest.raises(InputError, match=r"text\.h5: cannot be read as HDF5 .*corrsfm train prepare"):
        read_scenes(tmp_path / "text.h5")


def test_what_would_be_read_from_another_file_is_refused(tmp_path):
    path = tmp_path / "pairs.h5"
    os.mkfifo(tmp_path / "pipe.h5")  # opening it would not end
    virtual = h5py.VirtualLayout((5, 2), "u2", maxshape=(None, 2))
    every = slice(0, h5py.h5s.UNLIMITED)
    virtual[every, :] = h5py.VirtualSource("pipe.h5", "x", (5, 2), maxshape=(None, 2))[every, :]
    for plant, text in (
        (
            lambda group: group.__setitem__("pairs", h5py.ExternalLink("pipe.h5", "/x")),
            "pairs is a link",
        ),
        (
            lambda group: group.create_virtual_dataset("pairs", virtual),
            "values of 'pairs' lie",
        ),
        (lambda group: group.create_dataset(b"\xff", data=1), "is not UTF-8"),
    ):
        write_scenes(path, [make_scene()])
        with h5py.File(path, "r+") as file:
            del file["yard/pairs"]
            plant(file["yard"])
        with pytest.raises(InputError, match=text):
            read_scenes(path)
