"""Comparison of prune methods by whole reconstructions, on rendered photos of a made-up scene."""

import json
import os
import re
from pathlib import Path

import pycolmap
import pytest
from click.testing import CliRunner
from photos import write_photos

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.cli import main
from corrsfm.errors import ConfigError
from corrsfm.evaluation.records import load_results
from corrsfm.evaluation.scenes.compare import compare_methods, method_folder, share_matches
from corrsfm.evaluation.tables import render_table
from corrsfm.workspace import Workspace

CONFIG = cfg.PipelineConfig(
    images=cfg.ImagesConfig(camera_model="SIMPLE_PINHOLE", camera_params="1280,512,384"),
    features=cfg.FeaturesConfig(max_features=700),
    run=cfg.RunConfig(threads=1, device="cpu"),
)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("scene")
    (folder / "images").mkdir()
    (folder / "truth").mkdir()
    pycolmap.set_random_seed(3)
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_frames_per_rig=4, num_points3D=300, camera_width=1024, camera_height=768,
            camera_model_id=pycolmap.CameraModelId.SIMPLE_PINHOLE, camera_params=[1280, 512, 384],
        )
    )  # fmt: skip
    pycolmap.synthesize_images(
        pycolmap.SyntheticImageOptions(feature_patch_radius=15), model, str(folder / "images")
    )
    model.write_text(str(folder / "truth"))
    values = compare_methods(
        folder / "images", folder / "out", ["ratio", "loransac"], CONFIG,
        ground_truth=folder / "truth", results=folder / "results" / "made_up.json", command="corrsfm compare",
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
    for name in ("features.h5", "matches.h5"):
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


def test_results_page_and_table_hold_the_same_numbers(compared: tuple[Path, dict]):
    folder, values = compared
    stored = load_results(folder / "results" / "made_up.json", "compare")
    assert stored["methods"] == json.loads(json.dumps(values["methods"]))
    assert (folder / "out" / "compare.json").read_text() == (folder / "results" / "made_up.json").read_text()
    page = (folder / "out" / "compare.html").read_text()
    assert page.count("<img src='data:image/jpeg;base64,") == 4 * 2
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page)
    points = values["methods"]["loransac"]["num_points"]
    assert f">{points:,}</td>" in page
    assert f" {points} |" in render_table(stored) and "AUC@5" in render_table(stored)


def test_second_run_keeps_finished_work(compared: tuple[Path, dict]):
    folder, values = compared
    model = folder / "out" / "ratio" / "sparse" / "0" / "images.bin"
    before = model.stat().st_mtime_ns
    again = compare_methods(
        folder / "images", folder / "out", ["ratio"], CONFIG, ground_truth=folder / "truth"
    )
    assert model.stat().st_mtime_ns == before
    assert again["methods"]["ratio"] == values["methods"]["ratio"]


def test_failed_mapping_is_a_result_with_its_reason(tmp_path: Path):
    write_photos(tmp_path / "wall", 2)
    values = compare_methods(
        tmp_path / "wall", tmp_path / "out", ["ratio"],
        cfg.PipelineConfig(features=cfg.FeaturesConfig(max_features=60), run=CONFIG.run),
    )  # fmt: skip
    method = values["methods"]["ratio"]
    assert "no model could be made" in method["failure"]
    assert (method["num_registered"], method["num_points"], method["ground_truth"]) == (0, 0, None)
    assert "no model could be made" in (tmp_path / "out" / "compare.html").read_text()
    assert "0/2" in render_table({"kind": "compare", **values})


def test_changed_features_reach_every_method(tmp_path: Path):
    write_photos(tmp_path / "photos", 2)
    base, target = Workspace(tmp_path / "base", create=True), Workspace(tmp_path / "target", create=True)
    for num in (40, 50):
        pipeline.index_photos(base, tmp_path / "photos", cfg.ImagesConfig(), CONFIG.run)
        pipeline.extract_features(base, cfg.FeaturesConfig(max_features=num), CONFIG.run)
        pipeline.make_pairs(base, cfg.PairsConfig(), CONFIG.run)
        pipeline.match_pairs(base, cfg.MatchesConfig(), CONFIG.run)
        share_matches(base, target)
        assert target.require("matches").fingerprint == base.require("matches").fingerprint
        assert os.path.samefile(base.matches, target.matches)
        outcome = pipeline.prune_matches(target, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), CONFIG.run)
        assert outcome.num_reused == 0


@pytest.mark.parametrize("methods", [[], ["ratio", "ratio@sfm:"], ["no-such"], ["loransac@loose"]])
def test_methods_that_cannot_be_compared_are_refused(tmp_path: Path, methods: list[str]):
    with pytest.raises(ConfigError):
        compare_methods(tmp_path, tmp_path / "out", methods, CONFIG)
    assert not (tmp_path / "out").exists()


def test_folder_names_are_safe():
    assert method_folder("corradaptor@pose:/models/a b.pt") == "corradaptor_pose_models_a_b.pt"
    assert method_folder("../") == "_"


def test_command_refuses_the_flag_for_a_single_method(tmp_path: Path):
    result = CliRunner().invoke(main, ["compare", str(tmp_path), "--method", "ratio"])
    assert result.exit_code == 2 and "--methods" in result.output
