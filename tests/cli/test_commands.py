"""The command line: every command has help and a home, results on stdout, errors that end with a code."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from photos import write_photos

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.cli import main
from corrsfm.errors import CheckpointError

STAGE_COMMANDS = ("run", "extract", "pairs", "match", "prune", "reconstruct")
SMALL = ["--max-features", "60", "--threads", "1", "--device", "cpu"]


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    write_photos(tmp_path / "photos", 4)
    return tmp_path / "photos"


@pytest.fixture
def scene(tmp_path: Path, photos: Path) -> Path:
    result = invoke("-q", "extract", photos, tmp_path / "scene", *SMALL)
    assert result.exit_code == 0, result.output
    return tmp_path / "scene"


def commands(group: click.Group = main, prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for name, command in group.commands.items():
        path = (*prefix, name)
        found += commands(command, path) if isinstance(command, click.Group) else [path]
    return found


def test_commands_are_listed_in_the_order_of_a_reconstruction() -> None:
    order = ["run", "extract", "import", "pairs", "match", "prune", "reconstruct", "report"]
    assert list(main.commands)[:8] == order


@pytest.mark.parametrize("path", commands(), ids=" ".join)
def test_every_command_and_option_has_help(path: tuple[str, ...]) -> None:
    command: click.Command = main
    for name in path:
        assert isinstance(command, click.Group)
        command = command.commands[name]
    assert command.help
    options = [parameter for parameter in command.params if isinstance(parameter, click.Option)]
    assert options
    assert not [option.name for option in options if not option.help]
    assert not [flag for option in options for flag in option.opts if "_" in flag]
    assert invoke(*path, "--help").exit_code == 0


@pytest.mark.parametrize("name", STAGE_COMMANDS)
def test_steps_share_seed_device_threads_overwrite_and_json(name: str) -> None:
    flags = {flag for parameter in main.commands[name].params for flag in parameter.opts}
    assert {"--seed", "--device", "--threads", "--overwrite", "--json"} <= flags


def test_extract_leaves_what_it_promises(scene: Path) -> None:
    for name in ("images.txt", "features.db", "pairs.txt", "matches.db"):
        assert (scene / name).exists(), name
    assert (scene / "images.txt").read_text().split() == ["0.png", "1.png", "2.png", "3.png"]
    assert (scene / "pairs.txt").read_text().splitlines()[0] == "0.png 1.png"


def test_steps_print_json_on_stdout_and_nothing_else(scene: Path, photos: Path) -> None:
    result = invoke("extract", photos, scene, *SMALL, "--json")
    values = json.loads(result.stdout)
    assert [value["stage"] for value in values] == ["images", "features", "pairs", "matches"]
    assert values[1] == {
        "stage": "features",
        "num_items": 4,
        "num_reused": 4,
        "seconds": 0.0,
        "skipped": True,
    }


def test_prune_writes_the_database(scene: Path) -> None:
    result = invoke("-q", "prune", scene, "--method", "ratio")
    assert result.exit_code == 0, result.output
    assert list((scene / "pruned").iterdir()) and (scene / "database.db").exists()


def test_commands_that_are_named_for_a_workspace_with_a_dash_can_be_pasted(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scene, tmp_path / "-scene")
    said = invoke("reconstruct", "--", "-scene").stderr
    assert said.endswith(f"run: corrsfm prune {tmp_path / '-scene'}\n")


def test_a_workspace_among_photos_to_check_is_not_passed_over(scene: Path, photos: Path) -> None:
    for words in ((scene, photos), (photos, scene)):
        result = invoke("check", *words)
        assert result.exit_code == 1
        assert f"{scene}: is a workspace; look at it alone, with: corrsfm check {scene}" in result.stderr


def test_underscores_in_flags_are_accepted(scene: Path) -> None:
    assert invoke("-q", "prune", scene, "--method", "ratio", "--max_ratio", "0.7").exit_code == 0


def test_mapping_nothing_ends_with_the_reason_and_a_code(scene: Path) -> None:
    assert invoke("-q", "prune", scene, "--method", "ratio", "--min-num-inliers", "1000").exit_code == 0
    result = invoke("-q", "reconstruct", scene)
    assert result.exit_code == 1
    assert "no model could be made" in result.stderr and "--min-num-inliers" in result.stderr
    assert result.stderr.endswith(f"\nevery photo and pair: corrsfm report {scene}\n")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["extract", "{empty}", "{new}"], "empty"),
        (["extract", "{missing}", "{new}"], "missing"),
        (["extract", "{photos}", "{photos}/"], "is the folder of the photos; choose another"),
        (["run", "{photos}", "{photos}/../photos"], "is the folder of the photos; choose another"),
        (["prune", "{empty}"], "not a corrsfm workspace"),
        (["match", "{missing}"], "not a corrsfm workspace"),
        (["reconstruct", "{scene}"], "no verified matches yet; run: corrsfm prune"),
        (["prune", "{scene}", "--method", "corradaptor", "--model", "{missing}"], "missing"),
        (["pairs", "{scene}", "--pairing", "file"], "--pairs-file"),
        (["pairs", "{scene}", "--pairing", "file", "--pairs-file", "{pairs}"], "nobody.png"),
        (["extract", "{photos}", "{scene}", "--max-features", "0"], "max_features is 0, expected at least 1"),
        (["match", "{scene}", "--device", "cuda:77"], "--device cuda:77"),
        (["run", "{photos}", "{new}", "--pipeline", "{pairs}"], "not valid TOML"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_bad_input_gets_a_clear_error(arguments: list[str], text: str, scene: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "pairs.txt").write_text("0.png nobody.png\n")
    places = {
        "empty": tmp_path / "empty",
        "missing": tmp_path / "missing",
        "new": tmp_path / "new",
        "scene": scene,
        "photos": tmp_path / "photos",
        "pairs": tmp_path / "pairs.txt",
    }
    result = invoke(*[argument.format(**places) for argument in arguments])
    assert result.exit_code == 1, result.output
    assert text in result.stderr.partition("Error: ")[2]
    assert "Traceback" not in result.output


def test_unknown_choices_are_usage_errors(scene: Path) -> None:
    assert invoke("prune", scene, "--method", "magic").exit_code == 2


def test_one_photo_is_not_enough(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 1)
    result = invoke("extract", tmp_path / "photos", tmp_path / "scene")
    assert result.exit_code == 1 and "the only photo is '0.png'" in result.stderr


def test_flags_override_the_pipeline_file(tmp_path: Path, photos: Path) -> None:
    # The run fails in mapping or not; what counts is the recorded option.
    (tmp_path / "p.toml").write_text(
        '[features]\nmax_features = 50\n[prune]\nmethod = "ratio"\nmax_ratio = 0.7\n'
    )
    invoke("-q", "run", photos, tmp_path / "scene", "--pipeline", tmp_path / "p.toml", "--max-ratio", "0.6")
    stages = json.loads((tmp_path / "scene" / "workspace.json").read_text())["stages"]
    assert stages["features"]["config"]["max_features"] == 50
    assert stages["pruned matches"]["config"]["max_ratio"] == 0.6
    assert stages["pruned matches"]["config"]["method"] == "ratio"


@pytest.mark.parametrize(
    ("command", "target"),
    [("run", "corrsfm.pipeline.run_scene"), ("batch", "corrsfm.batch.run_collection")],
)
def test_an_interruption_says_how_to_go_on(
    command: str, target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(target, interrupted)
    plain = invoke(command, tmp_path, tmp_path / "out")
    assert plain.exit_code == 130 and "interrupted; run the same command again to go on" in plain.stderr
    anew = invoke(command, tmp_path, tmp_path / "out", "--overwrite")
    assert anew.exit_code == 130 and "run the same command without --overwrite to go on" in anew.stderr


@pytest.mark.parametrize(
    ("command", "option", "text"),
    [
        ("run", ("--device", "gpu"), "--device gpu: torch"),
        ("run", ("--model", "nothing.pt"), "nothing.pt: no such checkpoint"),
        ("extract", ("--device", "gpu"), "--device gpu: torch"),
    ],
)
def test_what_cannot_be_used_is_found_before_any_work(
    command: str, option: tuple[str, str], text: str, photos: Path, tmp_path: Path
) -> None:
    result = invoke(command, photos, tmp_path / "new", *option)
    assert result.exit_code == 1 and text in result.stderr
    assert not (tmp_path / "new").exists()


def test_a_checkpoint_that_no_method_needs_is_not_looked_for(photos: Path, tmp_path: Path) -> None:
    pipeline.check_options(cfg.RunConfig(device="cpu"), cfg.PruneConfig(method=cfg.PruneMethod.RATIO))
    with pytest.raises(CheckpointError):
        pipeline.check_options(cfg.RunConfig(device="cpu"), cfg.PruneConfig(model=tmp_path / "nothing.pt"))


def test_a_log_has_a_line_for_every_stage_and_no_progress_bars(photos: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "corrsfm", "run", photos, tmp_path / "out", "--method", "ratio", *SMALL]
    # Whether a model comes out of such photos does not matter here.
    text = subprocess.run(command, check=False, capture_output=True, text=True, timeout=100).stderr
    assert "\r" not in text
    stages = ("images", "features", "pairs", "matches", "kept matches", "verified matches")
    firsts = [line[:17].strip() for line in text.splitlines()]
    assert [first for first in firsts if first in stages] == list(stages)


def test_batch_goes_on_after_a_failing_scene(tmp_path: Path) -> None:
    write_photos(tmp_path / "collection" / "a", 1)
    write_photos(tmp_path / "collection" / "b" / "images", 1)
    result = invoke("batch", tmp_path / "collection", tmp_path / "out", "--json", *SMALL)
    assert result.exit_code == 1
    values = json.loads(result.stdout)
    assert [(value["scene"], value["succeeded"]) for value in values] == [("a", False), ("b", False)]
    assert all("Error:" in value["message"] for value in values)
    assert "2 of 2 scenes failed" in result.stderr
