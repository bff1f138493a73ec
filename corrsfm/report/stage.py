"""The last stage: what a workspace holds, in `report.json` and on the page `report.html`."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.models import read_models, summarise_model
from corrsfm.colmap.pairs import read_verified_matches, read_verified_pairs
from corrsfm.files import atomic_write_json
from corrsfm.machine import versions
from corrsfm.report.page import write_html
from corrsfm.report.statistics import SceneReport, StageWarning, make_report
from corrsfm.types import Pair, PairStatistics
from corrsfm.workspace import Workspace
from corrsfm.workspace.commands import STAGE_COMMANDS
from corrsfm.workspace.hloc import FEATURES, MATCHES, PRUNED
from corrsfm.workspace.lists import read_added, read_index, read_pairs
from corrsfm.workspace.resume import photos_left_out, require_database
from corrsfm.workspace.store import ItemStore
from corrsfm.workspace.warned import BEFORE_STAGES, collect_warnings, read_warnings

if TYPE_CHECKING:
    import pycolmap

__all__ = ["report", "summarise"]

logger = logging.getLogger("corrsfm")


def report(workspace: Workspace, *, html: bool = False) -> SceneReport:
    """Summarise a workspace; write `report.json` and, if asked for, `report.html`.

    Without models the report says why there are none. Models of earlier matches are left out.
    """
    with collect_warnings() as met:
        summary, models = summarise(workspace)
    kept = read_warnings(workspace.warnings_json)
    stages = (BEFORE_STAGES, *STAGE_COMMANDS)
    said = [*((stage, kept.get(stage, [])) for stage in stages), ("report", met)]
    summary = dataclasses.replace(
        summary,
        warnings=tuple(
            StageWarning(stage=stage, message=message) for stage, messages in said for message in messages
        ),
    )
    atomic_write_json(workspace.report_json, summary.to_dict())
    if html:
        write_html(
            summary,
            workspace.report_html,
            model=models[0] if models else None,
            images_dir=workspace.images_dir,
            load_matches=lambda name0, name1: _points_of_matches(workspace, (name0, name1)),
            load_verified=lambda name0, name1: _points_of_verified(workspace, (name0, name1)),
        )
    return summary


def summarise(workspace: Workspace) -> tuple[SceneReport, list[pycolmap.Reconstruction]]:
    """The statistics of a workspace, and its models if they are of its current matches."""
    require_database(workspace)
    records = {stage: record for stage in STAGE_COMMANDS if (record := workspace.record_of(stage))}
    if "models" in records and not workspace.current_record_of("models"):
        del records["models"]
        logger.warning("models are older than the matches; run: %s", workspace.command_for("models"))
    models = read_models(workspace.sparse) if "models" in records else []
    names = read_index(workspace).names
    summary = make_report(
        scene=workspace.root.resolve().name,
        image_names=names,
        left_out=photos_left_out(workspace, names),
        mapped="models" in records or workspace.mapping_failed,
        pairs=_pair_statistics(workspace),
        models=[summarise_model(model) for model in models],
        stage_seconds={stage: record.seconds for stage, record in records.items()},
        configuration={stage: record.config for stage, record in records.items()},
        versions=versions(),
        evidence=_read_record(workspace.evidence) if "models" in records else {},
        camera_remarks=_read_record(workspace.cameras_json).get("remarks", []),
        added=[name for name, found in read_added(workspace).items() if found["model"] is not None],
    )
    return summary, models


def _read_record(path: Path) -> dict[str, Any]:
    """A record that a stage left for the report; empty if an older version left none or it is damaged."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError) as error:
        logger.warning("%s: cannot be read (%s); the report goes without it", path, error)
        return {}


def _pair_statistics(workspace: Workspace) -> list[PairStatistics]:
    verified = {
        (pair.name0, pair.name1): pair.num_inliers for pair in read_verified_pairs(workspace.database)
    }
    pruned = ItemStore(workspace.pruned, PRUNED)
    return [
        PairStatistics(
            name0=name0,
            name1=name1,
            num_putative=int(counts["num_putative"]),
            num_kept=int(counts["num_kept"]),
            num_verified=verified.get((min(name0, name1), max(name0, name1)), 0),
        )
        for (name0, name1), counts in pruned.attributes(read_pairs(workspace).pairs)
    ]


def _points_of_matches(
    workspace: Workspace, pair: Pair
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Putative matches of a pair as points in both photos, and which of them pruning kept."""
    keypoints0, keypoints1 = _keypoints(workspace, pair)
    indices = ItemStore(workspace.matches, MATCHES).read(pair).indices
    kept = ItemStore(workspace.pruned, PRUNED).read(pair).indices
    return keypoints0[indices[:, 0]], keypoints1[indices[:, 1]], np.isin(indices[:, 0], kept[:, 0])


def _points_of_verified(workspace: Workspace, pair: Pair) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Verified matches of a pair as points in both photos, in the order of the database."""
    keypoints0, keypoints1 = _keypoints(workspace, pair)
    none = np.zeros((0, 2), np.int32)
    indices = read_verified_matches(workspace.database, [pair]).get(pair, none)
    return keypoints0[indices[:, 0]], keypoints1[indices[:, 1]]


def _keypoints(workspace: Workspace, pair: Pair) -> list[NDArray[np.float32]]:
    with ItemStore(workspace.features, FEATURES).reader() as read_features:
        return [read_features(name).keypoints for name in pair]
