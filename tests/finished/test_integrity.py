"""Damaged files are named, and the command that is named makes them again."""

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from rendered_scene import CONFIG
from scene_to_grow import SceneToGrow, contents, make_scene_to_grow

from corrsfm.cli import main
from corrsfm.finished.check import check_workspace
from corrsfm.finished.integrity import find_damage
from corrsfm.workspace import Workspace


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SceneToGrow:
    return make_scene_to_grow(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def workspace(made: SceneToGrow, tmp_path: Path) -> Path:
    return made.copy(tmp_path / "own").workspace


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_model(path: Path) -> None:
    cut(path / "0" / "images.bin")


def lose_keypoints(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        group = file[sorted(file)[0]]
        kept = group["keypoints"][:5]
        del group["keypoints"]
        group["keypoints"] = kept


def name_too_many(path: Path) -> None:
    def change(name: str, item: h5py.Dataset) -> None:
        if name.endswith("/matches0"):
            values = item[()]
            values[values >= 0] = np.iinfo(values.dtype).max
            item[...] = values

    with h5py.File(path, "r+") as file:
        file.visititems(change)


@pytest.mark.parametrize(
    ("attribute", "damage", "stage"),
    [
        ("images_json", cut, "images"),
        ("features", cut, "features"),
        ("features", lose_keypoints, "features"),
        ("pairs", Path.unlink, "pairs"),
        ("matches", cut, "matches"),
        ("matches", Path.unlink, "matches"),
        ("pruned", cut, "pruned matches"),
        ("pruned", name_too_many, "pruned matches"),
        ("database", cut, "verified matches"),
        ("sparse", cut_model, "models"),
        ("sparse", shutil.rmtree, "models"),
    ],
)
def test_damage_is_named_and_its_remedy_mends_it(
    workspace: Path, attribute: str, damage: Callable[[Path], object], stage: str
) -> None:
    path = getattr(Workspace(workspace), attribute)
    damage(path)
    before = contents(workspace)
    result = check_workspace(workspace)
    assert contents(workspace) == before
    assert not result.is_usable
    first = result.findings[0]
    assert first.kind == "damage" and str(path) in first.text
    shown = CliRunner().invoke(main, ["check", str(workspace)])
    assert shown.exit_code == 1 and first.next_step in shown.output
    for command in first.next_step.split("; "):
        program, *words = shlex.split(command)
        if program == "rm":
            for word in words[1:]:
                shutil.rmtree(word, ignore_errors=True)
                Path(word).unlink(missing_ok=True)
            continue
        outcome = CliRunner().invoke(main, ["-q", *words, "--threads", str(CONFIG.run.threads)])
        assert outcome.exit_code == 0, (command, outcome.output)
    assert find_damage(Workspace(workspace)) == []
    assert check_workspace(workspace).is_usable


def test_a_whole_scene_has_no_damage(workspace: Path) -> None:
    assert find_damage(Workspace(workspace)) == []
    result = json.loads(CliRunner().invoke(main, ["check", str(workspace), "--json"]).output)
    assert result["num_registered"] > 2 and result["is_usable"]
