"""The exchange layout for labelled pairs: what is written is what is read, published files included."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from two_view_pairs import make_pair

from corrsfm.colmap.cameras import pinhole_parameters
from corrsfm.errors import InputError
from corrsfm.geometry import essential_from_pose, symmetric_epipolar_distance_sq
from corrsfm.labelled.oanet import OANetPair, read_pairs, select_per_scene, write_pairs
from corrsfm.types import Camera

ARRAYS = (
    "correspondences",
    "label_distances",
    "rotation",
    "translation",
    "ratios",
    "mutual",
    "log_scale_ratios",
    "rotations",
)


@pytest.mark.parametrize("num", [0, 1, 50])
def test_layout_round_trips_exactly(tmp_path: Path, num: int):
    pairs = [make_pair(seed=seed, num=num, scene=f"scene {seed}") for seed in range(12)]
    assert write_pairs(tmp_path / "pairs.h5", pairs) == 12
    for written, read in zip(pairs, read_pairs(tmp_path / "pairs.h5"), strict=True):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(read, name), getattr(written, name), err_msg=name)
            assert getattr(read, name).dtype == getattr(written, name).dtype, name
        assert (read.camera0, read.camera1, read.scene) == (written.camera0, written.camera1, written.scene)


def _write_published(path: Path, num_pairs: int = 11, label_columns: int = 1) -> None:
    """A file as the public tools write it: no sizes, scenes or keypoint angles; principal point from 0."""
    with h5py.File(path, "w") as handle:
        for index in range(num_pairs):
            values = {
                "xs": np.full((1, 3, 4), index, np.float32),
                "ys": np.tile(np.float32([[0.0], [1e-5], [0.1]]), (1, label_columns)),
                "Rs": np.eye(3),
                "ts": np.float64([[0], [0], [1]]),
                "ratios": np.float32([0.5, 0.6, 0.9]),
                "mutuals": np.float32([1, 0, 1]),
                "cx1s": 319.5,
                "cy1s": 239.5,
                "cx2s": 319.5,
                "cy2s": 239.5,
                "f1s": np.array([500.0, 510.0]),
                "f2s": 600.0,
            }
            for name, value in values.items():
                handle.require_group(name).create_dataset(str(index), data=value)


@pytest.mark.parametrize("label_columns", [1, 2])
def test_published_files_are_read_in_order_with_our_pixel_convention(tmp_path: Path, label_columns: int):
    _write_published(tmp_path / "yfcc.h5", label_columns=label_columns)
    pairs = list(read_pairs(tmp_path / "yfcc.h5"))
    assert [pair.correspondences[0, 0] for pair in pairs] == list(range(11))
    pair = pairs[0]
    assert pair.inliers().tolist() == [True, True, False]
    assert pair.mutual.tolist() == [True, False, True]
    assert pair.camera0.params == (500.0, 510.0, 320.0, 240.0)
    assert pair.camera1.params == (600.0, 600.0, 320.0, 240.0)
    assert (pair.camera0.width, pair.camera0.height) == (640, 480)
    assert pair.scene == "" and not pair.rotations.any()


def test_pixels_follow_from_the_cameras(tmp_path: Path):
    _write_published(tmp_path / "yfcc.h5")
    correspondences = list(read_pairs(tmp_path / "yfcc.h5"))[2].as_correspondences()
    assert correspondences.points0[0].tolist() == [2 * 500 + 320, 2 * 510 + 240]
    assert correspondences.points1[0].tolist() == [2 * 600 + 320, 2 * 600 + 240]


def test_labels_are_distances_to_the_pose_that_is_stored():
    pair = make_pair(seed=3, num=40)
    essential = essential_from_pose(pair.rotation, pair.translation)
    distances = symmetric_epipolar_distance_sq(essential, pair.correspondences)
    np.testing.assert_allclose(pair.label_distances, distances, rtol=1e-4, atol=1e-9)


def test_choice_per_scene_is_seeded_bounded_and_independent_of_other_scenes():
    scenes = ["a"] * 10 + ["b"] * 3 + ["c"] * 20
    chosen = select_per_scene(scenes, 5, seed=1)
    assert [scenes[i] for i in chosen] == ["a"] * 5 + ["b"] * 3 + ["c"] * 5
    assert chosen == select_per_scene(scenes, 5, seed=1) != select_per_scene(scenes, 5, seed=2)
    assert select_per_scene(scenes[:10], 5, seed=1) == chosen[:5]


def test_reading_a_choice_gives_the_chosen_pairs(tmp_path: Path):
    write_pairs(tmp_path / "p.h5", [make_pair(seed=i, num=9, scene="ab"[i % 2]) for i in range(10)])
    chosen = select_per_scene(["ab"[i % 2] for i in range(10)], 2, seed=0)
    names = [pair.name for pair in read_pairs(tmp_path / "p.h5", max_per_scene=2)]
    assert names == [f"p.h5 pair {i}" for i in chosen]


def test_what_is_no_such_file_is_named_with_what_to_do(tmp_path: Path):
    (tmp_path / "text.h5").write_text("no")
    with pytest.raises(InputError, match=r"text\.h5: cannot be read as HDF5"):
        list(read_pairs(tmp_path / "text.h5"))
    with h5py.File(tmp_path / "other.h5", "w") as handle:
        handle.create_group("xs")
    with pytest.raises(InputError, match=r"lacks the groups ys, Rs.*corrsfm train prepare"):
        list(read_pairs(tmp_path / "other.h5"))


def test_a_damaged_pair_is_named(tmp_path: Path):
    _write_published(tmp_path / "yfcc.h5")
    with h5py.File(tmp_path / "yfcc.h5", "a") as handle:
        del handle["Rs"]["7"]
    with pytest.raises(InputError, match=r"yfcc\.h5: pair 7 is damaged"):
        list(read_pairs(tmp_path / "yfcc.h5"))


@pytest.mark.parametrize("group", ["xs", "Rs", "ts", "f1s", "cx2s"])
def test_a_number_that_is_not_finite_is_named(tmp_path: Path, group: str):
    _write_published(tmp_path / "yfcc.h5")
    with h5py.File(tmp_path / "yfcc.h5", "a") as handle:
        handle[group]["7"][...] = np.nan
    with pytest.raises(InputError, match=r"yfcc\.h5: pair 7 is damaged"):
        list(read_pairs(tmp_path / "yfcc.h5"))


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (500.0, 320.0, 240.0)),
        ("SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.1)),
        ("RADIAL", (500.0, 320.0, 240.0, 0.1, 0.0)),
        ("PINHOLE", (500.0, 500.0, 320.0, 240.0)),
        ("OPENCV", (500.0, 500.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0)),
    ],
)
def test_pinhole_part_of_every_camera_model(model: str, params: tuple[float, ...]):
    camera = Camera(model=model, width=640, height=480, params=params)
    assert pinhole_parameters(camera) == (500.0, 500.0, 320.0, 240.0)


def test_wrong_shapes_are_refused_at_construction():
    pair = make_pair(seed=0, num=5)
    with pytest.raises(ValueError, match="ratios: expected shape"):
        OANetPair(**{**pair.__dict__, "ratios": np.zeros(4, np.float32)})
