"""A workspace under several seeds: it stays as it is, finished seeds are kept, and what cannot be is said."""

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner, Result
from rendered_scene import CONFIG, render_scene

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.cli import main
from corrsfm.colmap.models import find_model, read_model, read_models, write_model
from corrsfm.errors import ReconstructionError, WorkspaceError
from corrsfm.evaluation.scenes.evidence import evidence_of
from corrsfm.evaluation.scenes.score import evaluate_scene
from corrsfm.evaluation.scenes.seeds import evaluate_seeds, why_one_model
from corrsfm.evaluation.tables import render_table
from corrsfm.reconstruction import stage as reconstruction_stage
from corrsfm.reconstruction.views import views_of
from corrsfm.workspace import Workspace

# Not the default, so that it must come from run.json.
SEED = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``truth`` and a finished workspace ``scene``, pruned by a method that draws at random."""
    folder = tmp_path_factory.mktemp("made")
    images, _ = render_scene(folder)
    config = dataclasses.replace(
        CONFIG,
        prune=cfg.PruneConfig(method=cfg.PruneMethod.LORANSAC),
        run=dataclasses.replace(CONFIG.run, seed=SEED),
    )
    pipeline.run_scene(images, folder / "scene", config)
    return folder


@pytest.fixture
def scene(made: Path, tmp_path: Path) -> Path:
    """A copy of the workspace that a test may change."""
    return shutil.copytree(made / "scene", tmp_path / "scene")


def evaluate(scene: Path, made: Path, *flags: object) -> Result:
    command = ["evaluate", "scene", scene, "--ground-truth", made / "truth", "--threads", 1, *flags]
    return CliRunner().invoke(main, [str(word) for word in command])


def contents(scene: Path) -> dict[str, str]:
    """Hash of every file of a workspace, those of further seeds left out."""
    return {
        str(path.relative_to(scene)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(scene.rglob("*"))
        if path.is_file() and ".seeds" not in path.parts
    }


def test_a_workspace_stays_as_it_is_beside_its_seeds(scene: Path, made: Path) -> None:
    before = contents(scene)
    result = evaluate(scene, made, "--seeds", 3, "--json")
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert contents(scene) == before
    assert [seed["seed"] for seed in values["seeds"]] == [SEED, SEED + 1, SEED + 2]
    assert sorted(path.name for path in (scene / ".seeds").iterdir()) == ["4", "5"]
    own = evaluate_scene(scene, made / "truth").to_dict()
    assert {key: values[key] for key in own} == own == values["seeds"][0]["ground_truth"]
    assert (
        values["seeds"][0]["grade"] == json.loads((scene / "evidence.json").read_text())["verdict"]["grade"]
    )


def test_the_table_shows_every_seed_the_median_and_the_worst(scene: Path, made: Path) -> None:
    text = evaluate(scene, made, "--seeds", 2).stdout
    values = evaluate_seeds(scene, made / "truth", 2, CONFIG.run)
    assert text.endswith("\n\n" + render_table({"kind": "scene", **values}) + "\n")
    assert f"registered          {values['num_registered']} of 4 photos" in text
    rows = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| ")]
    assert rows == ["| seed", "| ---", "| 3", "| 4", "| median", "| worst", "| known cameras"]
    assert max(len(line) for line in text.splitlines() if line.startswith("| ")) <= 100


def test_known_cameras_are_judged_by_the_matches_too(scene: Path, made: Path, tmp_path: Path) -> None:
    values = evaluate_seeds(scene, made / "truth", 1, CONFIG.run)
    known = values["known_cameras"]
    assert known["num_photos"] == 4
    assert known["explained_share"] > 0.9
    assert "perhaps they are off" not in render_table({"kind": "scene", **values})
    bent = read_model(find_model(made / "truth"))
    for image in bent.images.values():
        if image.image_id % 2:
            turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, 0.3])), np.zeros(3))
            bent.frame(image.frame_id).rig_from_world = turn * image.cam_from_world()
    write_model(bent, tmp_path / "bent")
    values = evaluate_seeds(scene, tmp_path / "bent", 1, CONFIG.run)
    assert values["known_cameras"]["explained_share"] < 0.5
    assert "perhaps they are off" in render_table({"kind": "scene", **values})


def test_known_cameras_of_photos_of_another_size_are_not_judged(
    scene: Path, made: Path, tmp_path: Path
) -> None:
    other = read_model(find_model(made / "truth"))
    for camera in other.cameras.values():
        camera.width *= 2
    write_model(other, tmp_path / "other")
    assert evaluate_seeds(scene, tmp_path / "other", 1, CONFIG.run)["known_cameras"] is None


def test_finished_seeds_are_kept_and_a_killed_one_goes_on(
    scene: Path, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    map_database = reconstruction_stage.map_database
    mapped = []

    def map_and_be_killed(*args: object, seed: int, **options: object) -> object:
        mapped.append(seed)
        if mapped == [4, 5]:
            raise KeyboardInterrupt
        return map_database(*args, seed=seed, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(reconstruction_stage, "map_database", map_and_be_killed)
    with pytest.raises(KeyboardInterrupt):
        evaluate_seeds(scene, made / "truth", 4, CONFIG.run)
    values = evaluate_seeds(scene, made / "truth", 4, CONFIG.run)
    assert mapped == [4, 5, 5, 6]
    assert evaluate_seeds(scene, made / "truth", 4, CONFIG.run) == values
    assert mapped == [4, 5, 5, 6]
    # Fewer seeds are the first of them.
    assert evaluate_seeds(scene, made / "truth", 2, CONFIG.run)["seeds"] == values["seeds"][:2]
    shutil.rmtree(scene / ".seeds")
    pipeline.report(Workspace(scene))
    again = evaluate_seeds(scene, made / "truth", 2, CONFIG.run)
    assert again["median"] == evaluate_seeds(scene, made / "truth", 2, CONFIG.run)["median"]
    assert mapped == [4, 5, 5, 6, 4]


def test_seeds_follow_the_options_of_the_workspace(scene: Path, made: Path) -> None:
    run = dataclasses.replace(CONFIG.run, seed=SEED)
    evaluate_seeds(scene, made / "truth", 2, run)
    workspace = Workspace(scene)
    pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.RATIO, max_ratio=0.7), run)
    pipeline.verify_matches(workspace, cfg.DatabaseConfig(min_num_inliers=10), run)
    pipeline.reconstruct(workspace, cfg.ReconstructionConfig(max_models_tried=2), run)
    # run.json is of the models before: the seed is the one handed in.
    values = evaluate_seeds(scene, made / "truth", 2, dataclasses.replace(run, seed=8))
    assert [seed["seed"] for seed in values["seeds"]] == [8, 9]
    values = evaluate_seeds(scene, made / "truth", 2, run)
    assert [seed["seed"] for seed in values["seeds"]] == [SEED, SEED + 1]
    other = Workspace(scene / ".seeds" / "4")
    for stage in ("pruned matches", "verified matches", "models"):
        assert other.require(stage).config == workspace.require(stage).config
    assert (scene / ".seeds/4/pruned/ratio.db").stat().st_ino == workspace.pruned.stat().st_ino


def test_a_seed_that_fails_is_a_result(scene: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ReconstructionError("no model today")

    monkeypatch.setattr(reconstruction_stage, "map_database", fail)
    values = evaluate_seeds(scene, made / "truth", 2, CONFIG.run)
    assert [seed["failure"] for seed in values["seeds"]] == [None, "no model today"]
    assert values["auc"]["10"] > 0 and values["worst"]["auc"]["10"] == 0
    assert "| 4 | 0 | 0 | 0.0 | 0 | 0.0 | 0.0 | 0.0 | failed |" in render_table({"kind": "scene", **values})


def test_one_seed_or_a_bare_model_is_measured_alone(scene: Path, made: Path) -> None:
    own = evaluate_scene(scene, made / "truth").to_dict()
    result = evaluate(scene, made, "--seeds", 1)
    assert result.stdout.endswith("\none model: --seeds 1\n") and "median " in result.stdout
    assert json.loads(evaluate(scene, made, "--seeds", 1, "--json").stdout) == own
    assert evaluate(scene / "sparse" / "0", made).stdout.endswith("\none model: it is not in a workspace\n")
    (scene / "features.db").unlink()
    assert evaluate(scene, made).stdout.endswith("\none model: features.db of its workspace is gone\n")
    assert not (scene / ".seeds").exists()


def test_putative_matches_are_needed_only_by_methods_that_draw_at_random(scene: Path) -> None:
    workspace = Workspace(scene)
    workspace.matches.rename(scene / "away.db")
    assert why_one_model(scene) == "matches.db of its workspace is gone"
    (scene / "away.db").rename(workspace.matches)
    run = dataclasses.replace(CONFIG.run, seed=SEED)
    pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), run)
    workspace.matches.unlink()
    assert why_one_model(scene) == ""


@pytest.mark.parametrize("num_seeds", ["0", "-2", "many"])
def test_a_number_of_seeds_that_makes_no_sense_is_refused(made: Path, num_seeds: str) -> None:
    result = evaluate(made / "scene", made, "--seeds", num_seeds)
    assert result.exit_code == 2 and "Invalid value for '--seeds'" in result.output


def test_a_workspace_that_another_process_holds_is_left_alone(scene: Path, made: Path) -> None:
    with Workspace(scene).lock(), pytest.raises(WorkspaceError, match="another corrsfm works"):
        evaluate_seeds(scene, made / "truth", 2, CONFIG.run)
    assert not (scene / ".seeds").exists()


def test_what_a_model_explains_is_counted_where_mapping_left_no_record(scene: Path) -> None:
    workspace = Workspace(scene)
    views = views_of(read_models(workspace.sparse)[0])
    recorded = evidence_of(workspace, views)
    workspace.evidence.unlink()
    assert evidence_of(workspace, views) == dataclasses.replace(recorded, grade=None)
    assert recorded.grade is not None
