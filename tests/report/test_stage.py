"""The summary of a workspace: only what belongs together."""

import json
from pathlib import Path

import cv2  # noqa: F401  (before pycolmap)
import numpy as np
import pycolmap
import pytest
from photos import SIZE, write_photos

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.colmap.pairs import read_verified_matches
from corrsfm.errors import WorkspaceError
from corrsfm.evaluation.scenes.score import find_model
from corrsfm.report import MissingReason
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.lists import read_index

RUN = cfg.RunConfig(threads=1, device="cpu")


def prune(workspace: Workspace, max_ratio: float) -> None:
    config = cfg.PruneConfig(method=cfg.PruneMethod.RATIO, max_ratio=max_ratio)
    pipeline.prune_matches(workspace, config, RUN)
    pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN)


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """Of three photos, with a model that counts as made from the verified matches."""
    write_photos(tmp_path / "photos", 3)
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, tmp_path / "photos", cfg.ImagesConfig(), RUN)
    pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=60), RUN)
    pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN)
    prune(workspace, 0.8)
    (workspace.sparse / "0").mkdir(parents=True)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=3, num_points3D=20)
    height, width = SIZE
    options.camera_width, options.camera_height = width, height
    options.camera_params = [float(width), width / 2, height / 2, 0.0]
    model = pycolmap.synthesize_dataset(options)
    names = read_index(workspace).names
    for image, name in zip(model.images.values(), names, strict=True):
        image.name = name
    model.write_binary(str(workspace.sparse / "0"))
    verified = workspace.require("verified matches").fingerprint
    config = cfg.to_dict(cfg.ReconstructionConfig(min_model_size=2))
    workspace.finish(
        "models",
        StageRecord(fingerprint="f", inputs={"verified matches": verified}, config=config, seconds=7.5),
    )
    return workspace


def test_the_verdict_on_a_model_is_not_that_on_one_in_its_place(workspace: Workspace) -> None:
    verdict = {"grade": "good", "reasons": ["as it should be"], "next_steps": []}
    workspace.evidence.write_text(json.dumps({"verdict": verdict}))
    workspace.finish("models", workspace.require("models"))
    assert pipeline.report(workspace).evidence["verdict"]["grade"] == "good"
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    model.delete_point3D(next(iter(model.points3D)))
    model.write_binary(str(workspace.sparse / "0"))
    assert pipeline.report(workspace).evidence == {}


def test_current_models_are_reported(workspace: Workspace) -> None:
    summary = pipeline.report(workspace)
    assert [model.num_points for model in summary.models] == [20]
    assert summary.stage_seconds["models"] == 7.5
    assert find_model(workspace.root) == workspace.sparse / "0"


def test_models_of_earlier_matches_are_not_mixed_with_new_ones(
    workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    prune(workspace, 0.3)
    summary = pipeline.report(workspace)
    assert summary.models == ()
    assert {image.reason for image in summary.missing} == {MissingReason.NOT_MAPPED}
    assert "models" not in summary.stage_seconds and "models" not in summary.configuration
    command = f"run: corrsfm reconstruct {workspace.root} --min-model-size 2"
    assert f"models are older than the matches; {command}" in caplog.text
    with pytest.raises(WorkspaceError, match=f"models are older than verified matches; {command}"):
        find_model(workspace.root)


def test_counts_of_a_pair_are_those_of_its_matches(workspace: Workspace) -> None:
    from corrsfm.workspace.lists import read_pairs
    from corrsfm.workspace.stores import matches_of, pruned_of

    matches, pruned = matches_of(workspace), pruned_of(workspace)
    pairs = pipeline.report(workspace).pairs
    assert [(pair.name0, pair.name1) for pair in pairs] == sorted(read_pairs(workspace).pairs)
    for pair in pairs:
        key = (pair.name0, pair.name1)
        assert pair.num_putative == len(matches.read(key)) > pair.num_kept
        assert pair.num_kept == len(pruned.read(key).indices) > 0


def test_warnings_of_the_stages_and_of_the_report_are_in_the_json(workspace: Workspace) -> None:
    workspace.warnings_json.write_text(json.dumps({"models": ["late"], "images": ["early"], "gone": ["?"]}))
    workspace.evidence.write_text("{")
    pipeline.report(workspace)
    warnings = json.loads(workspace.report_json.read_text())["warnings"]
    assert [warning["stage"] for warning in warnings] == ["images", "models", "report"]
    assert [warning["message"] for warning in warnings[:2]] == ["early", "late"]
    assert "evidence.json: cannot be read" in warnings[2]["message"]
    workspace.warnings_json.write_text("{")
    workspace.evidence.unlink()
    assert pipeline.report(workspace).warnings == ()


def test_verified_matches_of_some_pairs_are_those_of_all(workspace: Workspace) -> None:
    everything = read_verified_matches(workspace.database)
    assert everything
    for pair, matches in everything.items():
        found = read_verified_matches(workspace.database, [pair, ("gone.png", pair[1])])
        assert list(found) == [pair]
        np.testing.assert_array_equal(found[pair], matches)
