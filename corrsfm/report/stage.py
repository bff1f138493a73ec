"""The last stage: what a workspace holds, in `report.json` and on the page `report.html`."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.models import summarise_model
from corrsfm.colmap.pairs import read_verified_matches, read_verified_pairs
from corrsfm.files import atomic_write_json, read_json
from corrsfm.machine import versions
from corrsfm.report.page import write_html
from corrsfm.report.statistics import SceneReport, StageWarning, make_report
from corrsfm.types import Pair, PairStatistics, check_indices
from corrsfm.workspace import Workspace
from corrsfm.workspace.commands import STAGE_COMMANDS
from corrsfm.workspace.lists import read_added, read_index, read_pairs
from corrsfm.workspace.models import changed_models, models_of
from corrsfm.workspace.resume import photos_left_out, require_database
from corrsfm.workspace.stores import features_of, matches_of, pruned_of
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
    if not workspace.added.exists():
        workspace.forget_file("models", workspace.added)
    elif not workspace.evidence.exists():
        # Models that photos were added to cannot be mapped again to be judged.
        workspace.forget_file("models", workspace.evidence)
    kept = read_warnings(workspace.warnings_json)
    stages = (BEFORE_STAGES, *STAGE_COMMANDS)
    said = [*((stage, kept.get(stage, [])) for stage in stages), ("report", met)]
    summary = dataclasses.replace(
        summary,
        warnings=tuple(
            StageWarning(stage=stage, message=message) for stage, messages in said for message in messages
        ),
    )
    with workspace.writing(workspace.report_json, *([workspace.report_html] if html else [])):
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
    changed = {path for stage in records for path in workspace.changed_files(stage)}
    for path in sorted(changed):
        if not path.is_relative_to(workspace.sparse):
            logger.warning(
                "%s: not as it was written; corrsfm check %s says how it is made again", path, workspace.root
            )
    models = models_of(workspace, changed) if "models" in records else []
    is_judged = "models" in records and not changed_models(workspace, changed)
    names = read_index(workspace).names
    evidence = _read_record(workspace.evidence, changed) if is_judged else {}
    remarks = _read_record(workspace.cameras_json, changed).get("remarks", [])
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
        evidence=evidence,
        camera_remarks=[*remarks, *filter(None, [evidence.get("camera_remark")])],
        added=[name for name, found in read_added(workspace).items() if found["model"] is not None],
    )
    return summary, models


# What other code takes for granted of records.
_KINDS: dict[str, type] = {
    "remarks": list, "verdict": dict, "pairs": list, "joinings": list, "camera_remark": str,
}  # fmt: skip


def _read_record(path: Path, changed: Collection[Path]) -> dict[str, Any]:
    """A record that a stage left for the report; empty if an older version left none or it is damaged."""
    if path in changed:
        return {}
    try:
        values = dict(read_json(path))
        for key, kind in _KINDS.items():
            if not isinstance(values.get(key, kind()), kind):
                raise ValueError(f"{key} is no {kind.__name__}")
        return values
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError) as error:
        logger.warning("%s: cannot be read (%s); the report goes without it", path, error)
        return {}


def _pair_statistics(workspace: Workspace) -> list[PairStatistics]:
    verified = {
        (pair.name0, pair.name1): pair.num_inliers for pair in read_verified_pairs(workspace.database)
    }
    pruned = pruned_of(workspace)
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
    indices = matches_of(workspace).read(pair).indices
    check_indices(pair, indices, (len(keypoints0), len(keypoints1)))
    kept = pruned_of(workspace).read(pair).indices
    return keypoints0[indices[:, 0]], keypoints1[indices[:, 1]], np.isin(indices[:, 0], kept[:, 0])


def _points_of_verified(workspace: Workspace, pair: Pair) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Verified matches of a pair as points in both photos, in the order of the database."""
    keypoints0, keypoints1 = _keypoints(workspace, pair)
    none = np.zeros((0, 2), np.int32)
    indices = read_verified_matches(workspace.database, [pair]).get(pair, none)
    return keypoints0[indices[:, 0]], keypoints1[indices[:, 1]]


def _keypoints(workspace: Workspace, pair: Pair) -> list[NDArray[np.float32]]:
    with features_of(workspace).reader() as read_features:
        return [read_features(name).keypoints for name in pair]
