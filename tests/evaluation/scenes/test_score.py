"""Reconstructions against known cameras: perfect ones, incomplete ones, bent ones, and both file layouts."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner

from corrsfm.cli import main
from corrsfm.cli.evaluate import _score_lines
from corrsfm.errors import InputError
from corrsfm.evaluation.scenes.score import evaluate_scene, find_model, read_poses, score_poses


@pytest.fixture(scope="module")
def truth_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("truth")
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=8, num_points3D=20)
    pycolmap.set_random_seed(1)
    pycolmap.synthesize_dataset(options).write_binary(str(folder))
    return folder


def _moved(truth_dir: Path, target: Path, keep: int | None = None, text: bool = False) -> Path:
    """The true model scaled, turned and shifted, with only the first photos if asked."""
    model = pycolmap.Reconstruction(str(truth_dir))
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9]))
    model.transform(pycolmap.Sim3d(3.0, turn, np.array([1.0, 2.0, 3.0])))
    names = sorted(image.name for image in model.images.values())
    for image in list(model.images.values()):
        if keep is not None and image.name not in names[:keep]:
            model.deregister_frame(image.frame_id)
    target.mkdir()
    (model.write_text if text else model.write_binary)(str(target))
    return target


@pytest.mark.parametrize("text", [False, True])
def test_moved_and_scaled_truth_is_perfect(truth_dir: Path, tmp_path: Path, text: bool):
    score = evaluate_scene(_moved(truth_dir, tmp_path / "model", text=text), truth_dir)
    assert (score.num_photos, score.num_registered) == (8, 8)
    assert all(value > 99.99 for value in score.auc.values()) and list(score.auc) == ["1", "5", "10"]
    assert score.position_error_max < 1e-6 * score.extent


def test_missing_photos_are_failures_of_their_pairs(truth_dir: Path, tmp_path: Path):
    score = evaluate_scene(_moved(truth_dir, tmp_path / "model", keep=5), truth_dir)
    assert (score.num_photos, score.num_registered) == (8, 5)
    # 10 of the 28 pairs are registered and perfect.
    assert score.auc["10"] == pytest.approx(100 * 10 / 28, abs=1e-3)
    assert score.position_error_mean == pytest.approx(0, abs=1e-6)


def test_workspace_stands_for_its_largest_model(truth_dir: Path, tmp_path: Path):
    (tmp_path / "sparse").mkdir()
    (tmp_path / "images.txt").write_text("the list of photos of a workspace\n")
    model = _moved(truth_dir, tmp_path / "sparse" / "0")
    assert find_model(tmp_path) == find_model(tmp_path / "sparse") == find_model(model) == model
    assert evaluate_scene(tmp_path, truth_dir).num_registered == 8


def test_camera_files_are_the_same_truth(truth_dir: Path, tmp_path: Path):
    folder = tmp_path / "cameras"
    for name, (rotation, translation) in read_poses(truth_dir).items():
        path = folder / "nested" / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"rotation": rotation.tolist(), "translation": translation.tolist()}))
    read, expected = read_poses(folder), read_poses(truth_dir)
    assert list(read) == [f"nested/{name}" for name in expected]
    for name, (rotation, translation) in expected.items():
        np.testing.assert_allclose(read[f"nested/{name}"][0], rotation)
        np.testing.assert_allclose(read[f"nested/{name}"][1], translation)


def test_one_moved_camera_shows_in_pairs_and_positions():
    truth = {
        name: (np.eye(3), -np.array(centre, float))
        for name, centre in {"a": [0, 0, 0], "b": [4, 0, 0], "c": [4, 4, 0], "d": [0, 4, 0]}.items()
    }
    poses = {**truth, "d": (np.eye(3), -np.array([0.0, 4.0, 0.4]))}
    score = score_poses(poses, truth)
    assert score.extent == pytest.approx(np.sqrt(32))
    # Half of the pairs are exact; the three with d are off by the angle of 0.4 over 4 or 4√2.
    angles = np.degrees([np.arctan(0.1), np.arctan(0.1), np.arctan(0.4 / np.sqrt(32))])
    assert score.median_pair_error_deg == pytest.approx(angles[2] / 2)
    assert 0 < score.position_error_max < 0.4
    assert score.position_error_percent == pytest.approx(100 * score.position_error_mean / score.extent)


def test_centres_on_a_line_have_no_position_error_but_relative_poses():
    truth = {str(i): (np.eye(3), np.array([float(i), 0, 0])) for i in range(4)}
    score = score_poses(truth, truth)
    assert score.position_error_mean is None and score.position_error_percent is None
    assert score.auc["1"] == 100.0


def test_two_photos_can_be_judged():
    truth = {str(i): (np.eye(3), np.array([float(i), 0, 0])) for i in range(2)}
    assert score_poses(truth, truth).position_error_max is None
    assert score_poses({}, truth).auc["10"] == 0.0


def test_what_cannot_be_compared_is_explained(truth_dir: Path, tmp_path: Path):
    with pytest.raises(InputError, match="no ground truth found; expected a COLMAP model"):
        evaluate_scene(truth_dir, tmp_path)
    with pytest.raises(InputError, match="holds no COLMAP model .* and no sparse/0"):
        evaluate_scene(tmp_path, truth_dir)
    camera = {"rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}
    (tmp_path / "a.jpg.json").write_text(json.dumps(camera))
    with pytest.raises(InputError, match="only 1 known cameras"):
        evaluate_scene(truth_dir, tmp_path)
    (tmp_path / "b.jpg.json").write_text(json.dumps(camera))
    with pytest.raises(InputError, match="share no photo name"):
        evaluate_scene(truth_dir, tmp_path)
    (tmp_path / "b.jpg.json").write_text(json.dumps({**camera, "rotation": np.ones((3, 3)).tolist()}))
    with pytest.raises(InputError, match=r"b\.jpg\.json: 'rotation' is not a rotation matrix"):
        read_poses(tmp_path)
    (tmp_path / "b.jpg.json").write_text("{}")
    with pytest.raises(InputError, match=r"b\.jpg\.json: not a camera file \(lacks 'rotation'\)"):
        read_poses(tmp_path)
    for impossible in (float("nan"), float("inf"), None, 1e300, 10**400):
        (tmp_path / "b.jpg.json").write_text(json.dumps({**camera, "translation": [0, impossible, 0]}))
        with pytest.raises(InputError, match=r"b\.jpg\.json: "):
            read_poses(tmp_path)
    (tmp_path / "workspace.json").write_text("{}")
    with pytest.raises(InputError, match="for a workspace run: corrsfm reconstruct"):
        read_poses(tmp_path)
    shutil.copytree(truth_dir, tmp_path / "sparse" / "0")
    assert read_poses(tmp_path).keys() == read_poses(truth_dir).keys()


def test_known_cameras_of_one_place_have_no_share_of_an_extent() -> None:
    values = {
        "num_registered": 3, "num_photos": 3, "auc": {"5": 90.0}, "position_error_mean": 0.1,
        "position_error_median": 0.1, "position_error_max": 0.2, "position_error_percent": None,
    }  # fmt: skip
    assert list(_score_lines(values))[-1].endswith("in units of the ground truth")


def test_nothing_is_said_of_positions_where_all_known_cameras_stand_in_one_place() -> None:
    turns = [cv2.Rodrigues(np.array([0.0, 0.1 * number, 0.0]))[0] for number in range(4)]
    place = np.array([5.0, 5.0, 5.0])
    truth = {str(number): (turn, -turn @ place) for number, turn in enumerate(turns)}
    poses = {name: (turn, np.array([0.0, float(name), 1.0])) for name, (turn, _) in truth.items()}
    score = score_poses(poses, truth)
    assert score.position_error_max is None and score.auc["5"] == pytest.approx(100.0)


def test_command_prints_the_score(truth_dir: Path, tmp_path: Path):
    model = _moved(truth_dir, tmp_path / "model", keep=2)
    command = ["evaluate", "scene", str(model), "--ground-truth", str(truth_dir)]
    text = CliRunner().invoke(main, command)
    assert text.exit_code == 0, text.output
    assert "registered          2 of 8 photos" in text.output
    assert "undetermined: fewer than 3 registered photos" in text.output
    values = json.loads(CliRunner().invoke(main, [*command, "--json"]).stdout)
    assert values == evaluate_scene(model, truth_dir).to_dict()
    full = CliRunner().invoke(main, ["evaluate", "scene", str(truth_dir), "--ground-truth", str(truth_dir)])
    assert "pose AUC@1°         100.0 %" in full.output and "% of its extent" in full.output
