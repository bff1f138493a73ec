from pathlib import Path

import pytest

from corrsfm.workspace import Workspace
from tools.whole_scenes import SETTINGS, measure


def test_the_known_cameras_score_full_marks(repository: Path) -> None:
    scene = repository / "sample_scenes" / "courtyard"
    run = measure(scene, scene, seed=3)
    assert run["auc5"] == pytest.approx(100.0)
    assert run["seed"] == 3
    assert run["num_registered"] == run["num_photos"] == 14


def test_a_run_without_a_model_is_a_failure_of_every_pair(repository: Path, tmp_path: Path) -> None:
    run = measure(tmp_path / "none", repository / "sample_scenes" / "courtyard", seed=0)
    assert (run["auc5"], run["num_registered"], run["num_photos"]) == (0.0, 0, 14)


def test_a_workspace_whose_mapping_failed_is_a_failure_of_every_pair(
    repository: Path, tmp_path: Path
) -> None:
    Workspace(tmp_path / "scene", create=True)
    run = measure(tmp_path / "scene", repository / "sample_scenes" / "courtyard", seed=0)
    assert (run["auc5"], run["num_registered"], run["num_photos"]) == (0.0, 0, 14)


def test_settings_have_names_of_their_own() -> None:
    names = [setting.name for setting in SETTINGS]
    assert len(names) == len(set(names)) >= 15
