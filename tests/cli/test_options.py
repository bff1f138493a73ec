"""Flags from config dataclasses: those that the user typed and that have no effect are named."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from corrsfm.cli import main
from corrsfm.cli.options import config_options, pipeline_options
from corrsfm.config import PairsConfig, PipelineConfig, PruneConfig


@click.command()
@config_options(pairs=PairsConfig, prune=PruneConfig)
def step(pairs: PairsConfig, prune: PruneConfig) -> None:
    """A command with two configs."""


@click.command()
@pipeline_options
def whole(config: PipelineConfig) -> None:
    """A command with a pipeline file."""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            "--max-ratio 0.7 --max-error-px 2",
            ["--max-ratio, --max-error-px: no effect with --method corradaptor"],
        ),
        ("--max-ratio 0.7 --model a.pt --method cascade", []),
        ("--method ratio --model a.pt", ["--model: no effect with --method ratio"]),
        ("--method magsac --max-error-px 2 --max-ratio 0.9", []),
        ("--method none --max-ratio 0.9", ["--max-ratio: no effect with --method none"]),
        ("--pairs-file a.txt", []),
        (
            "--pairing sequential --pairing spatial --sequential-overlap 3 --pairs-file a.txt",
            ["--pairs-file: no effect with --pairing sequential+spatial"],
        ),
        ("--num-spatial 3", ["--num-spatial: no effect with --pairing auto"]),
        (
            "--num-spatial 3 --method none --precision float32",
            ["--num-spatial: no effect with --pairing auto", "--precision: no effect with --method none"],
        ),
    ],
)
def test_typed_options_without_effect_are_named(
    arguments: str, expected: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    result = CliRunner().invoke(step, arguments.split())
    assert result.exit_code == 0, result.output
    assert caplog.messages == expected


def test_options_of_a_pipeline_file_may_wait_for_another_method(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "p.toml").write_text('[prune]\nmethod = "ratio"\nmax_error_px = 2\n')
    arguments = ["--pipeline", str(tmp_path / "p.toml")]
    assert CliRunner().invoke(whole, arguments).exit_code == 0
    assert not caplog.messages
    assert CliRunner().invoke(whole, [*arguments, "--max-error-px", "3", "--max-ratio", "0.7"]).exit_code == 0
    assert caplog.messages == ["--max-error-px: no effect with --method ratio"]


def test_no_option_of_pruning_is_idle_where_methods_are_compared(caplog: pytest.LogCaptureFixture) -> None:
    def comparing(config: PipelineConfig) -> None:
        """A command that chooses methods by itself."""

    command = click.command()(pipeline_options(comparing, several_methods=True))
    result = CliRunner().invoke(command, ["--max-ratio", "0.7", "--num-spatial", "3"])
    assert result.exit_code == 0, result.output
    assert caplog.messages == ["--num-spatial: no effect with --pairing auto"]


@pytest.mark.parametrize(
    "words",
    [
        "check photos --no-forecast --keep mine.jpg",
        "localize scene photos/a.jpg --csv mine.jpg",
        "train prepare photos --output mine.jpg",
        "train export net.pt mine.jpg",
        "train plots --run runs --output mine.jpg",
        "bench --results mine.jpg",
        "compare photos out --results mine.jpg",
        "evaluate pose pairs.h5 --results mine.jpg",
    ],
)
def test_a_photo_in_the_place_of_a_result_is_not_replaced(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.jpg").write_bytes(b"\xff\xd8\xff mine")
    result = CliRunner().invoke(main, words.split())
    assert result.exit_code == 1, result.output
    assert "mine.jpg: " in result.output
    assert Path("mine.jpg").read_bytes() == b"\xff\xd8\xff mine"


def test_flags_that_a_command_takes_for_the_sake_of_scripts_are_said_to_do_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    CliRunner().invoke(main, ["reconstruct", str(tmp_path), "--verify", "--workers", "2", "--seed", "1"])
    assert "--verify, --workers: no effect with this command" in caplog.messages
