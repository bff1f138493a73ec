"""Pose evaluation on made-up labelled pairs: exact scores, result files, and repeated runs."""

import json
from pathlib import Path

import numpy as np
import pytest
from two_view_pairs import make_pair

from corrsfm.errors import ConfigError, InputError
from corrsfm.evaluation.metrics import pose_auc
from corrsfm.evaluation.two_view.methods import parse_method
from corrsfm.evaluation.two_view.pose import PairScores, evaluate_pose, score_pairs, summarise
from corrsfm.labelled.oanet import write_pairs


@pytest.fixture(scope="module")
def pairs_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pairs") / "made_up.h5"
    pairs = [
        make_pair(seed=i, num=120, inlier_ratio=0.5, noise_px=0.3, scene=f"scene_{i % 2}") for i in range(6)
    ]
    write_pairs(path, [*pairs, make_pair(seed=9, num=0, scene="scene_0")])
    return path


def _scores(errors: list[float], kept: float = 1.0) -> PairScores:
    values = np.array(errors)
    ones = np.full(len(values), kept)
    return PairScores(
        rotation_error_deg=values,
        translation_error_deg=values / 2,
        precision=ones,
        recall=ones,
        f_score=ones,
        pose_precision=ones,
        pose_recall=ones,
        pose_f_score=ones,
        num_kept=ones,
        filter_seconds=ones,
        estimator_seconds=ones,
    )


def test_scores_of_the_oracle_are_perfect_and_empty_pairs_fail():
    pairs = [make_pair(seed=i, num=200, inlier_ratio=0.4) for i in range(3)] + [make_pair(seed=7, num=0)]
    (scores,) = score_pairs([parse_method("oracle/poselib")], pairs)
    assert scores.precision.tolist() == [100, 100, 100, 0]
    assert scores.recall.tolist() == [100, 100, 100, 0]
    assert scores.pose_error_deg[:3].max() < 0.5
    assert scores.pose_error_deg[3] == np.inf
    assert scores.num_kept.tolist() == [float(pair.inliers().sum()) for pair in pairs]


def test_scores_do_not_depend_on_the_batch():
    pairs = [make_pair(seed=i, num=60 + i) for i in range(11)]
    (together,) = score_pairs([parse_method("ratio0.8/poselib")], pairs)
    (alone,) = score_pairs([parse_method("ratio0.8/poselib")], pairs[9:10])
    assert together.pose_error_deg[9] == alone.pose_error_deg[0]


def test_summary_is_exact_over_all_pairs_and_per_scene():
    errors = [3.0, 1.0, 7.0, np.inf]
    summary = summarise(_scores(errors), ["a", "b", "a", "b"])
    assert summary["auc"] == {"5": 37.5, "10": 56.25, "20": round(pose_auc(errors, [20.0])[0], 3)}
    assert summary["map"] == {"5": 50.0, "10": 62.5, "20": 68.75}
    assert summary["num_failed"] == 1
    assert summary["scenes"]["a"]["num_pairs"] == 2
    assert summary["scenes"]["b"]["auc"]["5"] == round(pose_auc([1.0, np.inf], [5.0])[0], 3)
    assert "auc_minus_baseline" not in summary


def test_difference_to_the_baseline_is_paired():
    better, worse = _scores([1.0] * 50 + [np.inf] * 50), _scores([2.0] * 50 + [np.inf] * 50)
    difference = summarise(better, [""] * 100, baseline=worse)["auc_minus_baseline"]["5"]
    assert difference[0] == 10.0
    # Half of the pairs differ by exactly 20, half by 0: sd 10, standard error 1.
    assert difference[1] == pytest.approx(8.0, abs=0.5) and difference[2] == pytest.approx(12.0, abs=0.5)


def test_result_file_holds_what_is_needed_to_repeat_it(pairs_file: Path, tmp_path: Path):
    results = tmp_path / "pose.json"
    values = evaluate_pose(
        pairs_file, ["nn/ransac", "oracle/poselib"], results=results, seed=5, command="corrsfm evaluate pose"
    )
    assert json.loads(results.read_text()) == {"format_version": 1, "kind": "pose", **values}
    assert values["subject"]["num_pairs"] == 7
    assert values["subject"]["pair_scenes"] == ["scene_0", "scene_1"] * 3 + ["scene_0"]
    assert values["baseline"] == "nn/ransac"
    measured = values["methods"]["oracle/poselib"]["measured"]
    assert measured["seed"] == 5 and measured["command"] == "corrsfm evaluate pose"
    assert {"corrsfm", "numpy", "poselib", "opencv-python-headless"} <= set(measured["versions"])
    oracle = values["methods"]["oracle/poselib"]
    assert oracle["pairs"]["rotation_error_deg"][6] is None
    assert oracle["summary"]["num_failed"] == 1
    assert oracle["summary"]["auc"]["20"] > values["methods"]["nn/ransac"]["summary"]["auc"]["20"]


def test_second_run_measures_only_what_is_new(pairs_file: Path, tmp_path: Path):
    results = tmp_path / "pose.json"
    first = evaluate_pose(pairs_file, ["mutual/poselib"], results=results)
    measured: list[str] = []

    def note(name: str, total: int):
        measured.append(name)
        return lambda count: None

    second = evaluate_pose(
        pairs_file,
        ["mutual/poselib", "ratio0.8/poselib"],
        results=results,
        baseline="ratio0.8/poselib",
        on_filter=note,
    )
    assert measured == ["ratio0.8"]
    assert second["methods"]["mutual/poselib"]["pairs"] == first["methods"]["mutual/poselib"]["pairs"]
    assert set(second["methods"]["mutual/poselib"]["summary"]["auc_minus_baseline"]) == {"5", "10", "20"}
    evaluate_pose(pairs_file, ["mutual/poselib"], results=results, overwrite=True, on_filter=note)
    assert measured == ["ratio0.8", "mutual"]


def test_estimators_share_one_run_of_their_filter(pairs_file: Path):
    names = ["mutual/poselib", "ratio0.8/poselib", "mutual/ransac"]
    measured: list[str] = []

    def note(name: str, total: int):
        measured.append(name)
        return lambda count: None

    together = evaluate_pose(pairs_file, names, on_filter=note)["methods"]
    assert measured == ["mutual", "ratio0.8"]
    for name in names:
        alone = evaluate_pose(pairs_file, [name])["methods"][name]
        for key in ("rotation_error_deg", "translation_error_deg", "num_kept"):
            assert together[name]["pairs"][key] == alone["pairs"][key]


def test_results_of_other_pairs_are_not_mixed(pairs_file: Path, tmp_path: Path):
    results = tmp_path / "pose.json"
    evaluate_pose(pairs_file, ["mutual/poselib"], results=results)
    with pytest.raises(InputError, match=r"measured on something else .*--overwrite"):
        evaluate_pose(pairs_file, ["mutual/poselib"], results=results, max_per_scene=1)


@pytest.mark.parametrize("damage", ["subject", "methods", "fingerprint", "pairs", "number", "length"])
def test_damaged_results_are_named(pairs_file: Path, tmp_path: Path, damage: str):
    results = tmp_path / "pose.json"
    evaluate_pose(pairs_file, ["mutual/poselib"], results=results)
    values = json.loads(results.read_text())
    entry = values["methods"]["mutual/poselib"]
    match damage:
        case "subject":
            values["subject"] = None
        case "methods":
            del values["methods"]
        case "fingerprint" | "pairs":
            del entry[damage]
        case "number":
            entry["pairs"]["precision"][0] = "x"
        case _:
            del entry["pairs"]["precision"][0]
    results.write_text(json.dumps(values))
    with pytest.raises(InputError, match=r"pose\.json: damaged .*--overwrite"):
        evaluate_pose(pairs_file, ["mutual/poselib"], results=results)
    evaluate_pose(pairs_file, ["mutual/poselib"], results=results, overwrite=True)


def test_files_that_are_no_results_are_not_overwritten(pairs_file: Path, tmp_path: Path):
    (tmp_path / "mine.json").write_text('{"precious": 1}')
    with pytest.raises(InputError, match="not a result file"):
        evaluate_pose(pairs_file, ["mutual/poselib"], results=tmp_path / "mine.json")
    assert (tmp_path / "mine.json").read_text() == '{"precious": 1}'


def test_baseline_has_to_be_measured(pairs_file: Path):
    with pytest.raises(ConfigError, match="baseline 'nn/ransac' is none of the methods to measure"):
        evaluate_pose(pairs_file, ["mutual/poselib"], baseline="nn/ransac")


def test_equal_runs_give_equal_errors(pairs_file: Path):
    methods = ["ratio0.8+mutual/magsac", "nn/poselib"]
    runs = [evaluate_pose(pairs_file, methods, seed=2, max_per_scene=2) for _ in range(2)]
    for name in methods:
        one, two = (run["methods"][name]["pairs"] for run in runs)
        assert one["rotation_error_deg"] == two["rotation_error_deg"]
        assert one["translation_error_deg"] == two["translation_error_deg"]
