"""Comparison of prune methods by whole reconstructions, on rendered photos of a made-up scene."""

import json
import os
import re
import statistics
from pathlib import Path

import pytest
from click.testing import CliRunner
from photos import write_photos
from rendered_scene import CONFIG, render_scene

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.cli import main
from corrsfm.errors import ConfigError, InputError, ReconstructionError
from corrsfm.evaluation.records import load_results
from corrsfm.evaluation.scenes.compare import compare_methods, method_folder
from corrsfm.evaluation.scenes.page import _short, _table
from corrsfm.evaluation.scenes.sharing import share_stages
from corrsfm.evaluation.tables import render_table
from corrsfm.reconstruction import stage as reconstruction_stage
from corrsfm.workspace import Workspace

METHODS = ["ratio", "loransac"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("scene")
    images, truth = render_scene(folder)
    values = compare_methods(
        images, folder / "out", METHODS, CONFIG, num_seeds=3,
        ground_truth=truth, results=folder / "results" / "made_up.json", command="corrsfm compare",
    )  # fmt: skip
    return folder, values


def test_every_method_is_measured_on_the_same_matches(compared: tuple[Path, dict]):
    folder, values = compared
    assert values["subject"]["name"] == folder.name
    assert (values["subject"]["num_photos"], values["subject"]["num_pairs"]) == (4, 6)
    assert list(values["methods"]) == ["ratio", "loransac"]
    for method in values["methods"].values():
        assert method["failure"] is None
        assert method["num_registered"] >= 3
        assert method["num_points"] > 20
        assert 0.5 < method["inlier_ratio"] <= 1.0
        assert method["ground_truth"]["num_photos"] == 4
        assert method["ground_truth"]["auc"]["10"] > 10
        assert all(seconds >= 0 for seconds in method["seconds"].values())
    ratio, loransac = values["methods"].values()
    assert loransac["num_kept_matches"] < ratio["num_kept_matches"]
    assert loransac["inlier_ratio"] > ratio["inlier_ratio"]
    for name in ("features.db", "matches.db"):
        files = [folder / "out" / part / name for part in ("base", "ratio", "loransac")]
        assert len({os.stat(path).st_ino for path in files}) == 1


def test_pairs_that_differ_most_come_first(compared: tuple[Path, dict]):
    _, values = compared
    spreads = [
        abs(row["kept_and_verified"]["ratio"][1] - row["kept_and_verified"]["loransac"][1])
        for row in values["pairs"]
    ]
    assert len(spreads) == 6 and spreads == sorted(spreads, reverse=True)
    for method in ("ratio", "loransac"):
        verified = sum(row["kept_and_verified"][method][1] for row in values["pairs"])
        assert verified == values["methods"][method]["num_inlier_matches"]


def test_every_seed_of_a_method_is_measured(compared: tuple[Path, dict]):
    folder, values = compared
    for name, method in values["methods"].items():
        assert [seed["seed"] for seed in method["seeds"]] == [0, 1, 2]
        own = method["seeds"][0]
        for key in ("num_registered", "num_points", "ground_truth", "seconds", "failure"):
            assert own[key] == method[key]
        for seed in method["seeds"]:
            workspace = folder / "out" / name
            if seed["seed"]:
                workspace = workspace / ".seeds" / str(seed["seed"])
            evidence = json.loads((workspace / "evidence.json").read_text())
            assert seed["explained_share"] == evidence["explained_share"] > 0.5
            assert seed["grade"] == evidence["verdict"]["grade"]
            assert seed["num_contradicted_pairs"] == len(evidence["contradicted_pairs"])
            assert seed["num_predicted_matches"] > 100
            assert evidence["num_predicted_matches"] in (None, seed["num_predicted_matches"])
        for key in ("num_points", "explained_share", "num_predicted_matches"):
            found = [seed[key] for seed in method["seeds"]]
            assert method["median"][key] == statistics.median(found) and method["worst"][key] == min(found)
        found = [seed["ground_truth"]["auc"]["5"] for seed in method["seeds"]]
        assert method["median"]["auc"]["5"] == statistics.median(found)
        assert method["worst"]["auc"]["5"] == min(found)


def test_seeds_share_what_does_not_depend_on_them(compared: tuple[Path, dict]):
    folder, _ = compared
    for method, num_kept_files in (("ratio", 1), ("loransac", 3)):
        places = [folder / "out" / method / place for place in (".", ".seeds/1", ".seeds/2")]
        assert len({os.stat(place / "features.db").st_ino for place in places}) == 1
        assert len({os.stat(place / "pruned" / f"{method}.db").st_ino for place in places}) == num_kept_files
        assert len({(place / "database.db").read_bytes() for place in places}) == 3


def test_results_page_and_table_hold_the_same_numbers(compared: tuple[Path, dict]):
    folder, values = compared
    stored = load_results(folder / "results" / "made_up.json", "compare")
    assert stored["methods"] == json.loads(json.dumps(values["methods"]))
    assert (folder / "out" / "compare.json").read_text() == (folder / "results" / "made_up.json").read_text()
    page = (folder / "out" / "compare.html").read_text()
    assert page.count("<img src='data:image/jpeg;base64,") == 4 * 2
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page)
    assert "Median (worst) of 3 seeds" in page and "Seed 0 in detail" in page
    table = render_table(stored)
    header, _, *rows = table.splitlines()
    assert header == "| method | photos | points | explained % | predicted | AUC@5 | verdicts |"
    assert "Median (worst) of 3 seeds from 0 on, 4 photos." in table
    for method, row in zip(values["methods"].values(), rows, strict=False):
        median, worst = method["median"], method["worst"]
        assert f"| {median['num_points']} ({worst['num_points']}) |" in row
        assert f"| {median['auc']['5']:.1f} ({worst['auc']['5']:.1f}) |" in row
        assert f"{median['num_points']:,}\N{NO-BREAK SPACE}({worst['num_points']:,})</td>" in page
        assert all(f">{seed['num_predicted_matches']:,}</td>" in page for seed in method["seeds"])
        assert len(row) <= 100


def test_second_run_maps_nothing(compared: tuple[Path, dict], monkeypatch: pytest.MonkeyPatch):
    folder, values = compared
    monkeypatch.setattr(reconstruction_stage, "map_database", lambda *_, **__: pytest.fail("mapped again"))
    again = compare_methods(
        folder / "images", folder / "out", METHODS, CONFIG, num_seeds=3, ground_truth=folder / "truth"
    )
    assert again["methods"] == values["methods"]


def test_one_seed_is_one_model(compared: tuple[Path, dict]):
    folder, values = compared
    single = compare_methods(
        folder / "images", folder / "out", ["ratio"], CONFIG, num_seeds=1, ground_truth=folder / "truth"
    )
    method = single["methods"]["ratio"]
    assert method["seeds"] == values["methods"]["ratio"]["seeds"][:1]
    assert method["median"] == method["worst"]
    header, _, row, *_ = render_table({"kind": "compare", **single}).splitlines()
    assert header.startswith("| method | verified pairs |") and header.endswith("| predicted | verdict |")
    assert f" {method['num_points']} |" in row
    page = (folder / "out" / "compare.html").read_text()
    assert "Median" not in page and ">explained %</th>" in page


def test_a_seed_without_a_model_counts_as_nothing_registered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    images, truth = render_scene(tmp_path)
    map_database = reconstruction_stage.map_database

    def fail_for_seed_2(*args: object, seed: int, **options: object) -> object:
        if seed == 2:
            raise ReconstructionError("no model today")
        return map_database(*args, seed=seed, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(reconstruction_stage, "map_database", fail_for_seed_2)
    with caplog.at_level("INFO", logger="corrsfm"):
        values = compare_methods(images, tmp_path / "out", ["ratio"], CONFIG, num_seeds=3, ground_truth=truth)
    assert [line for line in caplog.messages if line.startswith("method")] == [
        f"method ratio, seed {number} of 3" for number in (1, 2, 3)
    ]
    method = values["methods"]["ratio"]
    assert method["failure"] is None
    failed = method["seeds"][2]
    assert failed["failure"] == "no model today" and failed["grade"] is None
    assert failed["ground_truth"]["auc"] == {"1": 0.0, "5": 0.0, "10": 0.0}
    assert method["worst"] == {
        "num_registered": 0, "num_points": 0, "explained_share": 0.0, "num_predicted_matches": 0,
        "auc": {"1": 0.0, "5": 0.0, "10": 0.0},
    }  # fmt: skip
    assert method["median"]["num_registered"] >= 3
    assert ", 1 failed |" in render_table({"kind": "compare", **values})
    assert "no model today" in (tmp_path / "out" / "compare.html").read_text()


def test_photos_without_known_cameras_are_noticed_before_mapping(tmp_path: Path):
    images, truth = render_scene(tmp_path)
    for path in images.iterdir():
        path.rename(path.with_stem(f"other_{path.stem}"))
    with pytest.raises(InputError, match="share no photo name"):
        compare_methods(images, tmp_path / "out", ["ratio"], CONFIG, ground_truth=truth)
    assert not (tmp_path / "out" / "ratio").exists()


@pytest.mark.parametrize("num_seeds", [0, -1])
def test_no_seeds_are_refused(tmp_path: Path, num_seeds: int):
    with pytest.raises(ConfigError, match=f"{num_seeds} seeds from 0 on: expected a number from 1"):
        compare_methods(tmp_path, tmp_path / "out", ["ratio"], CONFIG, num_seeds=num_seeds)
    result = CliRunner().invoke(main, ["compare", str(tmp_path), "--seeds", str(num_seeds)])
    assert result.exit_code == 2 and f"'--seeds': {num_seeds} is not in the range x>=1" in result.output


def test_failed_mapping_is_a_result_with_its_reason(tmp_path: Path):
    write_photos(tmp_path / "wall", 2)
    values = compare_methods(
        tmp_path / "wall", tmp_path / "out", ["ratio"],
        cfg.PipelineConfig(features=cfg.FeaturesConfig(max_features=60), run=CONFIG.run), num_seeds=2,
    )  # fmt: skip
    method = values["methods"]["ratio"]
    assert "no model could be made" in method["failure"]
    assert (method["num_registered"], method["num_points"], method["ground_truth"]) == (0, 0, None)
    assert "no model could be made" in (tmp_path / "out" / "compare.html").read_text()
    assert "| ratio | 0 (0) | 0 (0) | 0 (0) | 0 (0) | 2 failed |" in render_table(
        {"kind": "compare", **values}
    )


def test_a_method_that_failed_is_the_best_at_nothing():
    def method(failure: str | None, value: float) -> dict:
        keys = ("num_kept_matches", "num_verified_pairs", "inlier_ratio", "num_registered", "num_models")
        keys += ("num_points", "mean_track_length", "mean_error_px")
        seconds = dict.fromkeys(("prune", "verify", "map"), 9 - value)
        numbers = {key: None if failure and key.startswith("mean") else value for key in keys}
        return {"failure": failure, "seconds": seconds, "seeds": [{}, {}], "ground_truth": None, **numbers}

    table = _table({"worst": method(None, 1), "better": method(None, 2), "failed": method("no model", 3)})
    rows = [row.count("class='best'") for row in table.split("<tr>")[2:]]
    assert rows == [0, 8, 0, 0]


def test_changed_features_reach_every_method(tmp_path: Path):
    write_photos(tmp_path / "photos", 2)
    base, target = Workspace(tmp_path / "base", create=True), Workspace(tmp_path / "target", create=True)
    for num in (40, 50):
        pipeline.index_photos(base, tmp_path / "photos", cfg.ImagesConfig(), CONFIG.run)
        pipeline.extract_features(base, cfg.FeaturesConfig(max_features=num), CONFIG.run)
        pipeline.make_pairs(base, cfg.PairsConfig(), CONFIG.run)
        pipeline.match_pairs(base, cfg.MatchesConfig(), CONFIG.run)
        share_stages(base, target)
        assert target.require("matches").fingerprint == base.require("matches").fingerprint
        assert os.path.samefile(base.matches, target.matches)
        outcome = pipeline.prune_matches(target, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), CONFIG.run)
        assert outcome.num_reused == 0


@pytest.mark.parametrize("methods", [[], ["ratio", "ratio@sfm:"], ["no-such"], ["loransac@loose"]])
def test_methods_that_cannot_be_compared_are_refused(tmp_path: Path, methods: list[str]):
    with pytest.raises(ConfigError):
        compare_methods(tmp_path, tmp_path / "out", methods, CONFIG)
    assert not (tmp_path / "out").exists()


def test_a_network_without_weights_is_refused_before_any_work(tmp_path: Path):
    with pytest.raises(ConfigError, match="clnet:FILE in a list of methods"):
        compare_methods(tmp_path, tmp_path / "out", ["ratio", "clnet"], CONFIG, num_seeds=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["compare.json", "compare.html"])
def test_files_of_others_are_not_replaced(tmp_path: Path, name: str):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("<!DOCTYPE html>\n<p>mine")
    with pytest.raises(InputError, match=f"{name}: exists and is not a"):
        compare_methods(tmp_path, tmp_path / "out", ["ratio"], CONFIG, num_seeds=1)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]


def test_results_do_not_go_among_the_photos(tmp_path: Path):
    with pytest.raises(InputError, match="is the folder of the photos; choose another one with --output"):
        compare_methods(tmp_path, tmp_path, ["ratio"], CONFIG, num_seeds=1)
    assert not list(tmp_path.iterdir())


def test_folder_names_are_safe():
    assert method_folder("corradaptor@pose:/models/a b.pt") == "corradaptor_pose_models_a_b.pt"
    assert method_folder("../") == "_"


def test_command_refuses_the_flag_for_a_single_method(tmp_path: Path):
    result = CliRunner().invoke(main, ["compare", str(tmp_path), "--method", "ratio"])
    assert result.exit_code == 2 and "--methods" in result.output


@pytest.mark.parametrize(
    ("method", "shown"),
    [
        ("ratio", "ratio"),
        ("clnet@pose:/work/runs/clnet/latest.pt", "clnet@pose:clnet/latest.pt"),
        ("corradaptor:mine.pt", "corradaptor:mine.pt"),
    ],
)
def test_methods_are_shown_without_the_folders_of_their_checkpoints(method: str, shown: str) -> None:
    assert _short(method) == shown
