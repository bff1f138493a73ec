"""Tables hold the numbers of their result files."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from two_view_pairs import make_pair

from corrsfm.cli import main
from corrsfm.evaluation.records import load_results
from corrsfm.evaluation.tables import render_table
from corrsfm.evaluation.two_view.pose import evaluate_pose
from corrsfm.labelled.oanet import write_pairs


@pytest.fixture(scope="module")
def results_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    write_pairs(folder / "pairs.h5", [make_pair(seed=i, num=80, scene="a") for i in range(4)])
    evaluate_pose(folder / "pairs.h5", ["mutual/poselib", "oracle/poselib"], results=folder / "two_view.json")
    return folder


def test_table_holds_the_numbers_of_its_file(results_dir: Path):
    values = load_results(results_dir / "two_view.json")
    table = render_table(values).splitlines()
    assert table[0].startswith("| filter / estimator | AUC@5 [95 %] | AUC@10 |")
    summary = values["methods"]["oracle/poselib"]["summary"]
    low, high = summary["auc_interval"]["5"][1:]
    assert table[2].startswith("| mutual / poselib (baseline) |")
    assert table[3].startswith(f"| oracle / poselib | {summary['auc']['5']:.1f} [{low:.1f}, {high:.1f}] |")
    assert "4 pairs of 1 scenes" in table[-1] and "seed 0" in table[-1]


def test_pose_command_prints_json_and_records_itself(results_dir: Path, tmp_path: Path):
    arguments = [
        "evaluate", "pose", str(results_dir / "pairs.h5"), "--method", "ratio0.8/poselib", "--json",
        "--device", "cpu", "--threads", "1", "--results", str(tmp_path / "r.json"),
    ]  # fmt: skip
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert list(values["methods"]) == ["ratio0.8/poselib"]
    assert load_results(tmp_path / "r.json")["provenance"]["command"].startswith("corrsfm ")


@pytest.mark.parametrize("name", ["against_pycolmap", "bench_published"])
def test_other_results_of_the_project_have_a_table(repository: Path, name: str):
    values = load_results(repository / "results" / f"{name}.json")
    table = render_table(values)
    # Those of all cores stand beside those of one.
    shown = [row for row in values["rows"] if name != "against_pycolmap" or row["cores"] == 1]
    assert len(shown) >= 4
    assert table.count("\n| ") >= len(shown)


def scene_row(
    scene: str, column: str, setting: str, scores: list[float], least: int = 10
) -> dict[str, object]:
    runs = [
        {"seed": seed, "auc5": score, "num_registered": 10 if score else least, "num_photos": 10}
        for seed, score in enumerate(scores)
    ]
    return {"scene": scene, "column": column, "setting": setting, "runs": runs}


def test_whole_scenes_show_median_and_worst_of_the_best_setting() -> None:
    values = {
        "kind": "whole_scenes",
        "provenance": {"versions": {"corrsfm": "0.1.0"}, "seed": 0},
        "rows": [
            scene_row("desk", "plain", "global", [80.0, 60.0, 90.0]),
            # A run without a model counts as 0, in the median too.
            scene_row("desk", "plain", "incremental", [95.0, 0.0, 0.0], least=0),
            scene_row("desk", "ours", "ours", [90.0, 0.0, 91.0], least=0),
            scene_row("door", "plain", "incremental", [70.0]),
        ],
    }
    text = render_table(values)
    assert "| scene | photos | plain | which | ours |" in text
    assert "| desk | 10 | 80.0 (60.0) | global (of 2) | 90.0 (0.0), 0/10 |" in text
    assert "| door | 10 | 70.0 (70.0), 1 of 3 seeds | incremental (of 1) | – |" in text
    assert "AUC@5 of 3 seeds: median (worst). corrsfm 0.1.0" in text


def test_many_ways_over_few_scenes_go_down_the_page() -> None:
    values = {
        "kind": "whole_scenes",
        "provenance": {"versions": {"corrsfm": "0.1.0"}, "seed": 0},
        "rows": [
            scene_row("desk", "clnet", "rival clnet", [80.0, 60.0, 90.0]),
            scene_row("desk", "oanet", "rival oanet", [95.0, 0.0, 0.0], least=0),
        ],
    }
    text = render_table(values)
    assert "| matches kept by | desk |" in text
    assert "| clnet | 80.0 (60.0) |" in text and "| oanet | 0.0 (0.0), 0/10 |" in text
