"""The commands that train say what they lack."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from corrsfm.cli import main
from corrsfm.config import MatchInput, NetworkUsage
from corrsfm.errors import ConfigError, InputError
from corrsfm.model import CorrAdaptor, NetworkConfig, load_network, read_provenance, save_network
from corrsfm.training.config import load_recipe
from corrsfm.training.plots import plot_learning_curves


def test_a_run_without_training_files_names_the_options_for_them() -> None:
    result = CliRunner().invoke(main, ["train", "run"])
    assert result.exit_code == 2
    assert "no pairs to train on; give --train-files, or --config" in result.stderr


def test_a_missing_recipe_is_named(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["train", "run", "--config", str(tmp_path / "none.toml")])
    assert result.exit_code == 1
    assert f"{tmp_path / 'none.toml'}: no such file; expected a training recipe" in result.stderr


def test_a_network_that_comes_with_corrsfm_can_be_exported_again(tmp_path: Path) -> None:
    command = ["train", "export", "small-mutual", str(tmp_path / "x.pt")]
    assert [CliRunner().invoke(main, command).exit_code for _ in range(2)] == [0, 0]


def test_export_keeps_what_a_checkpoint_says_but_for_the_flags_given(tmp_path: Path) -> None:
    config = NetworkConfig(channels=8, clusters=4, heads=2, mlp_ratio=1, side_channels=5)
    save_network(CorrAdaptor.from_config(config), tmp_path / "silent.pt", provenance={"steps": 3})
    for source, target, flags in [
        ("silent.pt", "mutual.pt", ["--input", "mutual", "--sfm-min-score", "0.2"]),
        ("mutual.pt", "loose.pt", ["--pose-min-score", "0.4"]),
    ]:
        command = ["train", "export", str(tmp_path / source), str(tmp_path / target), *flags]
        assert CliRunner().invoke(main, command).exit_code == 0
    usage = NetworkUsage(input=MatchInput.MUTUAL, sfm_min_score=0.2)
    assert load_network(tmp_path / "mutual.pt").usage == usage
    usage = NetworkUsage(input=MatchInput.MUTUAL, sfm_min_score=0.2, pose_min_score=0.4)
    assert load_network(tmp_path / "loose.pt").usage == usage
    assert read_provenance(tmp_path / "loose.pt") == {"steps": 3}
    command = ["train", "export", str(tmp_path / "silent.pt"), str(tmp_path / "x.pt"), "--sfm-min-score", "3"]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 1 and "sfm_min_score is 3.0, expected at most 1" in result.stderr


@pytest.mark.parametrize("text", ["train = 1", "[[train]]", "network = 1", "[[network]]"])
def test_a_recipe_whose_tables_are_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "r.toml").write_text(text + "\n")
    with pytest.raises(ConfigError, match="must be one table"):
        load_recipe(tmp_path / "r.toml")


def test_the_log_of_another_program_has_no_curves(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"log\.csv: is damaged \(no column step, "):
        plot_learning_curves(tmp_path, tmp_path / "c.png")
