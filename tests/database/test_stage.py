"""The database takes the cameras that matches speak for, and says so."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from two_view_pairs import CAMERA

from corrsfm import config as cfg
from corrsfm.database import stage
from corrsfm.database.focal_votes import FocalVotes, VoteDecision
from corrsfm.types import Features, ImageRecord
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.items import PrunedMatches
from corrsfm.workspace.lists import Index

NAMES = ("0.jpg", "1.jpg", "2.jpg")
GUESSED = dataclasses.replace(CAMERA, has_prior_focal_length=False)
INDEX = Index(
    records=tuple(ImageRecord(name=name, camera_id=0, sha256=name) for name in NAMES), cameras=(GUESSED,)
)
PAIRS = (("0.jpg", "1.jpg"), ("0.jpg", "2.jpg"))


def features(name: str) -> Features:
    column = np.ones(9, np.float32)
    return Features(
        keypoints=np.arange(18, dtype=np.float32).reshape(9, 2) + int(name[0]),
        scales=column, orientations=column, scores=column,
        descriptors=np.zeros((9, 128), np.uint8), image_size=(640, 480),
    )  # fmt: skip


def kept(pair: tuple[str, str]) -> PrunedMatches:
    indices = np.column_stack([np.arange(4), np.arange(4, 8)]).astype(np.int32)
    return PrunedMatches(
        indices=indices, scores=np.ones(4, np.float32), num_putative=9, model=None, decided_by="x"
    )


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    monkeypatch.setattr(stage, "_strongest", lambda workspace, pairs: pairs)
    return Workspace(tmp_path / "scene", create=True)


def index_as(workspace: Workspace, mode: cfg.CameraMode) -> list[tuple[int, ...]]:
    config = cfg.to_dict(cfg.ImagesConfig(camera_mode=mode))
    workspace.finish("images", StageRecord(fingerprint="i", config=config))
    return stage._cameras_that_vote(workspace, INDEX)


def decide(workspace: Workspace, voting: list[tuple[int, ...]]) -> tuple:
    return stage._decide_cameras(
        workspace, INDEX, voting, features, kept, PAIRS, cfg.RunConfig(seed=0, threads=1)
    )


def test_photos_with_a_camera_each_by_request_do_not_vote(workspace: Workspace) -> None:
    assert index_as(workspace, cfg.CameraMode.PER_IMAGE) == []
    assert index_as(workspace, cfg.CameraMode.AUTO) == [(0,)]


def test_whether_cameras_may_be_parted_is_part_of_what_the_stage_is(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage, "read_index", lambda _: INDEX)
    found = {}
    for mode in (cfg.CameraMode.AUTO, cfg.CameraMode.SINGLE, cfg.CameraMode.PER_FOLDER):
        index_as(workspace, mode)
        workspace.finish("pruned matches", StageRecord(fingerprint="p"))
        found[stage.fingerprint_of(workspace, cfg.DatabaseConfig(), seed=0)] = mode
    assert len(found) == 3


def test_points_reach_the_votes_relative_to_the_principal_point(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list = []

    def count(points: list, longest_side_px: float, **options: object) -> FocalVotes:
        asked.extend([*points, longest_side_px, options])
        return FocalVotes(decision=VoteDecision.UNDECIDED)

    monkeypatch.setattr(stage, "count_votes", count)
    decide(workspace, index_as(workspace, cfg.CameraMode.AUTO))
    first, second, longest_side_px, options = asked
    assert (first.name0, first.name1, second.name1, longest_side_px) == ("0.jpg", "1.jpg", "2.jpg", 640)
    np.testing.assert_array_equal(first.points0_px, features("0.jpg").keypoints[:4] - [320.0, 240.0])
    np.testing.assert_array_equal(second.points1_px, features("2.jpg").keypoints[4:8] - [320.0, 240.0])
    assert options == {"seed": 0, "may_split": True, "num_threads": 1}


@pytest.mark.parametrize(("mode", "num_cameras"), [(cfg.CameraMode.AUTO, 3), (cfg.CameraMode.SINGLE, 1)])
def test_scattered_votes_undo_a_proposal_but_not_what_the_user_asked_for(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, mode: cfg.CameraMode, num_cameras: int
) -> None:
    monkeypatch.setattr(stage, "count_votes", lambda *_, **__: FocalVotes(decision=VoteDecision.SCATTERED))
    records, cameras, remarks = decide(workspace, index_as(workspace, mode))
    assert len(cameras) == num_cameras
    assert [record.camera_id for record in records] == ([0, 1, 2] if num_cameras == 3 else [0, 0, 0])
    assert len(remarks) == 1 and json.dumps(remarks)
