"""The recipe that rebuilds the paper's tables runs, on made-up pairs with a classical method."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from two_view_pairs import make_pair

from corrsfm.evaluation.two_view.methods import parse_method
from corrsfm.labelled.oanet import write_pairs

RECIPE = "tools/paper_tables.sh"


def _run(repository: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    return subprocess.run(
        ["bash", str(repository / RECIPE), *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def test_recipe_explains_itself(repository: Path, tmp_path: Path):
    result = _run(repository, tmp_path, "yfcc")
    assert result.returncode == 2
    assert "paper_tables.sh hpatches hpatches-sequences-release CHECKPOINT" in result.stderr


def test_recipe_names_methods_that_exist(repository: Path):
    text = (repository / RECIPE).read_text()
    names = [line.split()[1] for line in text.splitlines() if line.strip().startswith("--method ratio")]
    assert len(names) == 2
    assert [parse_method(name).name for name in names] == names


def test_missing_checkpoint_is_reported(repository: Path, tmp_path: Path):
    write_pairs(tmp_path / "pairs.h5", [make_pair(seed=0, num=30)])
    result = _run(repository, tmp_path, "ablation", "pairs.h5", "missing.pt")
    assert result.returncode != 0
    assert "missing.pt" in result.stderr and "Traceback" not in result.stderr


@pytest.mark.parametrize("table", ["yfcc", "sun3d"])
def test_paper_says_what_the_paper_says(repository: Path, table: str):
    text = (repository / RECIPE).read_text()
    headline = {
        "yfcc": "| CorrAdaptor | 41.02 | 61.67 | 76.98 | 79.23 | 80.28 | 79.67 |",
        "sun3d": "| CorrAdaptor | 9.33 | 22.66 | 40.85 |",
    }
    assert headline[table] in text
