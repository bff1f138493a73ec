"""A workspace that corrsfm 0.1.0 made (commit 5fafada) is resumed: no stage is done again.

It was made from three photos of sample_scenes/courtyard with::

    corrsfm run photos WORKSPACE --image-list list.txt --max-features 200 --method ratio --min-num-inliers 8
"""

import shutil
from pathlib import Path

import cv2
import pycolmap
import pytest

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.workspace import Workspace

NAMES = ["courtyard_01.jpg", "courtyard_02.jpg", "courtyard_03.jpg"]
RUN = cfg.RunConfig(threads=1, device="cpu")


@pytest.fixture
def photos(repository: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in NAMES:
        shutil.copy(repository / "sample_scenes" / "courtyard" / "images" / name, folder)
    return folder


@pytest.fixture
def workspace(repository: Path, tmp_path: Path) -> Workspace:
    return Workspace(shutil.copytree(repository / "tests" / "data" / "workspace_0_1_0", tmp_path / "scene"))


def test_a_workspace_of_0_1_0_is_resumed_without_doing_a_stage_again(
    workspace: Workspace, photos: Path
) -> None:
    versions = [".".join(module.__version__.split(".")[:2]) for module in (cv2, pycolmap)]
    if versions != ["5.0", "4.2"]:
        pytest.skip(f"made with OpenCV 5.0 and pycolmap 4.2; these are {versions}, whose results may differ")
    database = workspace.database.read_bytes()
    recorded = {stage: workspace.require(stage) for stage in ("features", "matches", "verified matches")}
    with workspace.lock():
        pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    outcomes = [
        pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=200), RUN),
        pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN),
        pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN),
        pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), RUN),
        pipeline.verify_matches(workspace, cfg.DatabaseConfig(min_num_inliers=8), RUN),
    ]
    assert [outcome.stage for outcome in outcomes if not outcome.skipped] == []
    assert workspace.database.read_bytes() == database
    assert not list(workspace.root.rglob("*.h5*"))
    assert recorded == {stage: workspace.require(stage) for stage in recorded}


def test_a_changed_option_of_a_workspace_of_0_1_0_redoes_what_depends_on_it_only(
    workspace: Workspace, photos: Path
) -> None:
    with workspace.lock():
        pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=200), RUN)
    pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN)
    changed = cfg.PruneConfig(method=cfg.PruneMethod.RATIO, max_ratio=0.7)
    assert not pipeline.prune_matches(workspace, changed, RUN).skipped
    assert not pipeline.verify_matches(workspace, cfg.DatabaseConfig(min_num_inliers=8), RUN).skipped
