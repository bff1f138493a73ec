"""The commands that train say what they lack."""

from pathlib import Path

from click.testing import CliRunner

from corrsfm.cli import main


def test_a_run_without_training_files_names_the_options_for_them() -> None:
    result = CliRunner().invoke(main, ["train", "run"])
    assert result.exit_code == 2
    assert "no pairs to train on; give --train-files, or --config" in result.stderr


def test_a_missing_recipe_is_named(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["train", "run", "--config", str(tmp_path / "none.toml")])
    assert result.exit_code == 1
    assert f"{tmp_path / 'none.toml'}: no such file; expected a training recipe" in result.stderr
