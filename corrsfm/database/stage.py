"""The sixth stage: kept matches become a COLMAP database with verified pairs."""

from __future__ import annotations

import dataclasses
import functools
import heapq
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm import config as cfg
from corrsfm.colmap.cameras import pinhole_parameters
from corrsfm.colmap.log import pycolmap_version
from corrsfm.colmap.sqlite import find_damage, find_strange_table, is_truncated
from corrsfm.config import config_hash
from corrsfm.database.cameras_by_votes import assign_by_votes, cameras_that_vote
from corrsfm.database.focal_evidence import PairPoints
from corrsfm.database.focal_votes import VoteDecision, count_votes
from corrsfm.database.write import update_database, write_database
from corrsfm.files import atomic_write_json
from corrsfm.machine import count_threads
from corrsfm.types import Camera, Features, ImageRecord, Pair, check_indices
from corrsfm.workspace import Workspace
from corrsfm.workspace.items import PrunedMatches
from corrsfm.workspace.lists import Index, read_added, read_index, read_pairs
from corrsfm.workspace.resume import StageOutcome, explain, finish
from corrsfm.workspace.stores import features_of, pruned_of
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["fingerprint_of", "verify_matches"]

logger = logging.getLogger("corrsfm")

VOTES_VERSION = "votes-1"
# Voting picks 45 of these, spread over the photos.
MAX_PAIRS_ASKED = 400


@keeps_warnings("verified matches")
def verify_matches(
    workspace: Workspace, config: cfg.DatabaseConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Write the COLMAP database and verify the kept matches geometrically."""
    started = time.monotonic()
    index = read_index(workspace)
    pruned = workspace.require("pruned matches")
    voting = _cameras_that_vote(workspace, index)
    fingerprint = fingerprint_of(workspace, config, run.seed)
    pair_list = read_pairs(workspace)
    damaged = _damage(workspace.database, thorough=run.verify)
    current = workspace.is_current("verified matches", fingerprint, workspace.database)
    # What it remembers of its pairs says nothing of what was lost of photos and keypoints.
    if not (damaged or current) and workspace.database in workspace.changed_files("verified matches"):
        damaged = "not as it was written" if workspace.database.exists() else ""
    if damaged:
        logger.warning("%s: damaged (%s); it is written again", workspace.database, damaged)
    if current and not overwrite and not damaged:
        return StageOutcome(
            stage="verified matches", num_items=len(pair_list), num_reused=len(pair_list), skipped=True
        )
    if not damaged:
        explain(workspace, "verified matches", config)
    with (
        features_of(workspace).reader() as read_features,
        pruned_of(workspace).reader() as read_pruned,
    ):
        records, cameras, remarks = _decide_cameras(
            workspace, index, voting, read_features, read_pruned, pair_list.pairs, run
        )
        for remark in remarks:
            logger.info("%s", remark)
        features = workspace.require("features").fingerprint
        base = config_hash("database", pycolmap_version(), features, records, cameras, config, run.seed)
        settings: dict[str, Any] = {
            "base": base,
            "fingerprints": pruned_of(workspace).fingerprints(pair_list.pairs),
            "cameras": cameras,
            "config": config,
            "seed": run.seed,
            "num_threads": count_threads(run.threads),
            "log_file": workspace.log,
            "before_changing": functools.partial(_forget, workspace),
        }
        num_changed = None
        if not (overwrite or damaged):
            num_changed = update_database(
                workspace.database, kept=lambda pair: read_pruned(pair).indices, **settings
            )
        if num_changed is None:
            num_changed = len(pair_list)
            write_database(
                workspace.database,
                images=records,
                features=read_features,
                kept=((*pair, read_pruned(pair).indices) for pair in pair_list.pairs),
                **settings,
            )
    atomic_write_json(workspace.cameras_json, {"remarks": remarks})
    outcome = StageOutcome(
        stage="verified matches",
        num_items=len(pair_list),
        num_reused=len(pair_list) - num_changed,
        seconds=time.monotonic() - started,
    )
    finish(workspace, outcome, fingerprint, config, inputs={"pruned matches": pruned.fingerprint})
    return outcome


def _forget(workspace: Workspace) -> None:
    """From here on the database is another."""
    workspace.forget("verified matches")
    # Models that photos were added to name photos and cameras as their own database did.
    if read_added(workspace):
        workspace.forget("models")


def _damage(path: Path, *, thorough: bool) -> str:
    """What is wrong with a database; empty if nothing is or there is none."""
    if not path.is_file():
        return ""
    if is_truncated(path):
        return "its end is missing"
    return find_damage(path) if thorough else find_strange_table(path)


def fingerprint_of(workspace: Workspace, config: cfg.DatabaseConfig, seed: int) -> str:
    """What the record of the stage must carry to be current."""
    index = read_index(workspace)
    mode = workspace.require("images").config["camera_mode"]
    votes: list[Any] = [VOTES_VERSION] if _cameras_that_vote(workspace, index) else []
    return config_hash(
        "verified matches",
        pycolmap_version(),
        workspace.require("pruned matches").fingerprint,
        index.cameras,
        config,
        seed,
        # Where no camera votes, finished work of version 0.1.0 stays valid.
        *votes,
        # Whether votes may part what shares a camera; of photos without EXIF the index says it not.
        *([mode] if votes and mode != cfg.CameraMode.AUTO else []),
    )


def _cameras_that_vote(workspace: Workspace, index: Index) -> list[tuple[int, ...]]:
    """Groups of cameras, as indices, whose focal length the matches are asked for."""
    if workspace.require("images").config["camera_mode"] == cfg.CameraMode.PER_IMAGE:
        return []
    return cameras_that_vote(index.cameras, index.records)


def _decide_cameras(
    workspace: Workspace,
    index: Index,
    voting: list[tuple[int, ...]],
    read_features: Callable[[str], Features],
    read_kept: Callable[[Pair], PrunedMatches],
    pairs: Sequence[Pair],
    run: cfg.RunConfig,
) -> tuple[list[ImageRecord], list[Camera], list[str]]:
    """Assign cameras by the votes of the kept matches, with a remark on each decision."""
    # Sharing that the user asked for is not undone.
    asked_for = workspace.require("images").config["camera_mode"] != cfg.CameraMode.AUTO
    camera_of = {record.name: index.camera_of(record) for record in index.records}
    votes = {}
    for ids in voting:
        camera = index.cameras[ids[0]]
        names = {record.name for record in index.records if record.camera_id in ids}
        points = [
            _centred_points(camera_of, pair, read_features, read_kept(pair).indices)
            for pair in _strongest(workspace, [pair for pair in pairs if names.issuperset(pair)])
        ]
        counted = count_votes(
            points,
            max(camera.width, camera.height),
            seed=run.seed,
            may_split=not asked_for,
            num_threads=count_threads(run.threads),
        )
        if asked_for and counted.decision is VoteDecision.SCATTERED:
            counted = dataclasses.replace(counted, decision=VoteDecision.UNDECIDED)
        votes[ids] = counted
    cameras, camera_ids, remarks = assign_by_votes(index.cameras, index.records, votes)
    records = [
        dataclasses.replace(record, camera_id=camera_id)
        for record, camera_id in zip(index.records, camera_ids, strict=True)
    ]
    return records, cameras, remarks


def _strongest(workspace: Workspace, pairs: list[Pair]) -> list[Pair]:
    """The pairs with most kept matches, as many as voting can use."""
    store = pruned_of(workspace)
    # What is chosen is read with its checksum.
    counts = store.counts("num_kept")
    num_kept = {pair: counts.get(store.kind.key(pair), 0) for pair in pairs}
    return sorted(heapq.nsmallest(MAX_PAIRS_ASKED, pairs, key=lambda pair: (-num_kept[pair], pair)))


def _centred_points(
    camera_of: Mapping[str, Camera],
    pair: Pair,
    read_features: Callable[[str], Features],
    matches: NDArray[np.int32],
) -> PairPoints:
    """Matched points of a pair in pixels from the principal points."""
    keypoints = [read_features(name).keypoints for name in pair]
    check_indices(pair, matches, (len(keypoints[0]), len(keypoints[1])))
    sides = []
    for side, name in enumerate(pair):
        _, _, *centre = pinhole_parameters(camera_of[name])
        sides.append(keypoints[side][matches[:, side]].astype(np.float64) - np.array(centre))
    return PairPoints(name0=pair[0], name1=pair[1], points0_px=sides[0], points1_px=sides[1])
