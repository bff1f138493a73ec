"""`corrsfm export`: what it says, what it prints for machines, and how it ends."""

import json
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from finished_scene import FinishedScene, make_finished_scene

from corrsfm.cli import main
from corrsfm.cli.export import NEXT
from corrsfm.export import ExportTarget


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> FinishedScene:
    return make_finished_scene(tmp_path_factory.mktemp("cli") / "made", camera="SIMPLE_RADIAL")


def test_export_says_what_it_wrote_what_it_left_out_and_what_to_paste_next(
    scene: FinishedScene, tmp_path: Path
) -> None:
    out = tmp_path / "my splat"
    result = invoke("export", scene.workspace, out, "--for", "splat")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [
        f"{out}: 5 of 6 photos, 60 points",
        "left out, not in sparse/0: lost.png",
        f"why: corrsfm report {scene.workspace}",
        f"next: python train.py -s '{out}'",
    ]


def test_export_prints_json_for_machines(scene: FinishedScene, tmp_path: Path) -> None:
    result = invoke(
        "export", scene.workspace, tmp_path / "poses.csv", "--for", "csv", "--scale", "1.png", "2.png", 2,
        "--crop", "--json",
    )  # fmt: skip
    values = json.loads(result.stdout)
    assert values["target"] == "csv" and values["output"] == str(tmp_path / "poses.csv")
    assert values["left_out"] == ["lost.png"] and values["scale"] > 0
    assert values["num_points"] + values["num_cropped"] == 60
    assert values["rotation"] == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


def test_refusals_end_with_a_code_and_a_sentence(scene: FinishedScene) -> None:
    result = invoke("export", scene.workspace, scene.workspace, "--for", "splat")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ") and "is the workspace; choose another folder" in result.stderr


def test_what_to_paste_next_is_shell(tmp_path: Path) -> None:
    assert ExportTarget.NERFSTUDIO in NEXT
    for command in NEXT.values():
        assert subprocess.run(["bash", "-n", "-c", command.replace("{}", "out")]).returncode == 0
