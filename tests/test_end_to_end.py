"""The sample scenes from photos to models, as a user runs them: accuracy bands, kills, every mapper."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pycolmap
import pytest
from phone_video import FOCAL_PX, film

from corrsfm.colmap.models import poses_of
from corrsfm.config import Mapper, PruneMethod
from corrsfm.evaluation.metrics import position_errors, relative_pose_errors
from corrsfm.evaluation.scenes.score import evaluate_scene
from corrsfm.geometry import camera_centre

pytestmark = pytest.mark.slow

SCENES = sorted(
    path.parent for path in (Path(__file__).resolve().parents[1] / "sample_scenes").glob("*/images")
)


def run_command(scene: Path, workspace: Path, *flags: object) -> list[str]:
    words = ["-m", "corrsfm", "-q", "run", scene / "images", workspace, "--json", *flags]
    return [sys.executable, *[str(word) for word in words]]


def run(scene: Path, workspace: Path, *flags: object) -> dict:
    """Run a scene and return its report."""
    result = subprocess.run(run_command(scene, workspace, *flags), capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def assert_within_bands(scene: Path, workspace: Path, report: dict) -> None:
    bands = json.loads((scene / "expected.json").read_text())
    model = report["models"][0]
    score = evaluate_scene(workspace, scene)
    assert len(model["image_names"]) >= bands["registered_photos_min"]
    assert model["num_points"] >= bands["points_min"]
    assert model["median_error_px"] <= bands["median_reprojection_error_px_max"]
    assert score.position_error_max is not None
    assert score.position_error_max <= bands["camera_position_error_max"] * score.extent


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
@pytest.mark.parametrize("method", [PruneMethod.LORANSAC, PruneMethod.CASCADE])
def test_sample_scenes_reconstruct_within_their_bands(
    scene: Path, method: PruneMethod, tmp_path: Path
) -> None:
    report = run(scene, tmp_path / "scene", "--method", method)
    assert_within_bands(scene, tmp_path / "scene", report)
    for name in ("run.json", "report.json", "report.html", "database.db", "sparse/0/cameras.bin"):
        assert (tmp_path / "scene" / name).stat().st_size > 0, name


@pytest.mark.parametrize("mapper", [Mapper.GLOBAL, Mapper.HIERARCHICAL])
def test_the_other_mappers_register_the_easy_scene(mapper: Mapper, tmp_path: Path) -> None:
    report = run(SCENES[-1], tmp_path / "scene", "--mapper", mapper)
    assert len(report["models"][0]["image_names"]) >= 12


def test_a_run_killed_again_and_again_ends_like_a_straight_one(tmp_path: Path) -> None:
    scene = SCENES[-1]
    flags = ("--max-features", 1500, "--threads", 1)
    straight = run(scene, tmp_path / "straight", *flags)
    command = run_command(scene, tmp_path / "killed", *flags)
    seconds, num_kills = 2.0, 0
    while True:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            assert process.wait(timeout=seconds) == 0
            break
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            num_kills += 1
            # Longer each time, so that whatever cannot be resumed in pieces gets its turn.
            seconds *= 1.4
    assert num_kills >= 2
    killed = json.loads((tmp_path / "killed" / "report.json").read_text())
    assert killed["pairs"] == straight["pairs"]
    assert killed["models"][0]["image_names"] == straight["models"][0]["image_names"]
    again = time.monotonic()
    run(scene, tmp_path / "killed", *flags)
    assert time.monotonic() - again < 60
    assert not list((tmp_path / "killed").glob("*.partial"))


def test_a_phone_video_is_reconstructed_from_its_sharp_frames(tmp_path: Path) -> None:
    video = film(tmp_path / "walk.mp4")
    workspace = tmp_path / "scene"
    words = [
        "-m",
        "corrsfm",
        "-q",
        "run",
        str(video.path),
        str(workspace),
        "--json",
        "--max-features",
        "1500",
    ]
    result = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    names = json.loads(result.stdout)["models"][0]["image_names"]
    frames = json.loads((workspace / "frames" / "frames.json").read_text())["frames"]
    assert len(names) == len(frames) >= 12
    assert not video.blurred & {frame["number"] for frame in frames}
    model = pycolmap.Reconstruction(workspace / "sparse" / "0")
    assert len(model.cameras) == 1
    assert next(iter(model.cameras.values())).mean_focal_length() == pytest.approx(FOCAL_PX, rel=0.03)
    poses = poses_of(model)
    truth = {frame["name"]: video.poses[frame["number"]] for frame in frames}
    centres = [[camera_centre(found[name]) for name in names] for found in (poses, truth)]
    assert position_errors(*centres).max() < 0.03  # metres, on a walk of 3 m
    assert relative_pose_errors(poses, truth).max() < 1.0
