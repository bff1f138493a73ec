"""A whole run: the stages in order over one workspace, and `run.json`, the record of what made it.

Each stage is a function of a workspace and its options that skips what is finished and returns a
`StageOutcome`; `report` alone summarises what all of them did.
"""

from __future__ import annotations

import contextlib
import logging
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from corrsfm import config as cfg
from corrsfm.cluster import connected
from corrsfm.database.stage import verify_matches
from corrsfm.errors import ReconstructionError
from corrsfm.features import create_extractor
from corrsfm.features.stage import extract_features
from corrsfm.files import atomic_write_json
from corrsfm.images.sources import Given, whole_folder
from corrsfm.images.stage import index_photos
from corrsfm.machine import count_threads, find_device, versions
from corrsfm.matches.stage import match_pairs
from corrsfm.model.lightglue import load_package
from corrsfm.pairs.stage import make_pairs
from corrsfm.pairs.strategies import check_files
from corrsfm.prune import build_pruner, checkpoint_sha256
from corrsfm.prune.stage import prune_matches
from corrsfm.reconstruction.stage import reconstruct
from corrsfm.report.stage import report
from corrsfm.report.statistics import SceneReport
from corrsfm.workspace import Workspace
from corrsfm.workspace.commands import STAGE_COMMANDS
from corrsfm.workspace.imported import traits_to_come
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.resume import StageOutcome
from corrsfm.workspace.warned import BEFORE_STAGES, collect_warnings, keep_warnings

__all__ = [
    "StageOutcome",
    "check_options",
    "extract_features",
    "index_photos",
    "make_pairs",
    "match_pairs",
    "prune_matches",
    "reconstruct",
    "report",
    "run_scene",
    "verify_matches",
]

logger = logging.getLogger("corrsfm")


def run_scene(
    photos: Given,
    workspace_dir: Path,
    config: cfg.PipelineConfig,
    *,
    overwrite: bool = False,
    wait: bool = False,
    warned: Sequence[str] = (),
) -> SceneReport:
    """Go from photos or a video to models and a report, skipping what is finished.

    Parameters
    ----------
    photos : Given
        A folder of photos, a video, photos, a list or a pattern; see `corrsfm.images.sources.find_source`.
    workspace_dir : Path
    config : PipelineConfig
    overwrite : bool
        Redo finished work.
    wait : bool
        Wait for another process that works in the workspace instead of failing.
    warned : sequence of str
        What the caller warned of already, such as options without effect; for the report.

    Returns
    -------
    SceneReport
        As in `report.json`.

    Raises
    ------
    CorrsfmError
        What the stages raise. If mapping fails, the report is written all the same, because it tells why.
    """
    run = config.run
    with contextlib.ExitStack() as stack:
        with collect_warnings() as met:
            check_options(
                run, config.prune, features=config.features, pairs=config.pairs, matches=config.matches,
                workspace_dir=workspace_dir,
            )  # fmt: skip
            stack.enter_context(connected(run.cluster, run.workers))
            workspace = Workspace(workspace_dir, create=True, images_dir=whole_folder(photos))
            stack.enter_context(workspace.lock(wait=wait))
        keep_warnings(workspace.warnings_json, BEFORE_STAGES, [*warned, *met])
        _say(index_photos(workspace, photos, config.images, run, overwrite=overwrite))
        _say(extract_features(workspace, config.features, run, overwrite=overwrite))
        _say(make_pairs(workspace, config.pairs, run, overwrite=overwrite))
        _say(match_pairs(workspace, config.matches, run, overwrite=overwrite))
        _say(prune_matches(workspace, config.prune, run, overwrite=overwrite))
        _say(verify_matches(workspace, config.database, run, overwrite=overwrite))
        try:
            _say(reconstruct(workspace, config.reconstruction, run, overwrite=overwrite))
        except ReconstructionError as error:
            report(workspace, html=True)
            raise ReconstructionError(f"{error}\nevery photo and pair: {workspace.report_html}") from error
        with workspace.writing(workspace.run_json):
            atomic_write_json(workspace.run_json, _run_record(workspace, config))
        return report(workspace, html=True)


def _say(outcome: StageOutcome) -> None:
    """Log one line about a finished stage; logs without progress bars show it too."""
    logger.info("%s", outcome)


def _run_record(workspace: Workspace, config: cfg.PipelineConfig) -> dict[str, Any]:
    records = {stage: workspace.record_of(stage) for stage in STAGE_COMMANDS}
    return {
        "finished_at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "versions": versions(),
        "platform": platform.platform(),
        "seed": config.run.seed,
        "config": cfg.to_dict(config),
        "checkpoint_sha256": checkpoint_sha256(config.prune),
        "images_dir": str(workspace.images_dir),
        "images_sha256": {record.name: record.sha256 for record in read_index(workspace).records},
        "seconds": {stage: record.seconds for stage, record in records.items() if record is not None},
        "fingerprints": {
            stage: record.fingerprint for stage, record in records.items() if record is not None
        },
    }


def check_options(
    run: cfg.RunConfig,
    prune: cfg.PruneConfig | None = None,
    *,
    features: cfg.FeaturesConfig | None = None,
    pairs: cfg.PairsConfig | None = None,
    matches: cfg.MatchesConfig | None = None,
    workspace_dir: Path | None = None,
) -> None:
    """Check the device, networks and files, and whether the stages fit each other, before any work is done.

    Parameters
    ----------
    run : RunConfig
    prune : PruneConfig, optional
        The method that comes later; none if matching is the last stage.
    features : FeaturesConfig, optional
    pairs : PairsConfig, optional
    matches : MatchesConfig, optional
    workspace_dir : Path, optional
        Imported features and matches in it are kept; it need not exist.

    Raises
    ------
    ConfigError
        If there is no such device, or an option does not fit the features.
    DependencyError
        If a network is not installed.
    InputError
        If a file that pairs are to come from is missing.
    CheckpointError
        If the method needs a checkpoint and it is missing, cannot be read or does not fit the features.
    WorkspaceError
        If the folder holds features or matches of another tool.
    """
    device = find_device(run.device)
    if pairs is not None:
        check_files(pairs)
    features, matches = features or cfg.FeaturesConfig(), matches or cfg.MatchesConfig()
    known = None
    if workspace_dir is not None:
        known = Workspace(workspace_dir) if (workspace_dir / "workspace.json").exists() else None
    traits = traits_to_come(known, features, matches)
    if features.extractor.kind != cfg.FeatureKind.SIFT:
        create_extractor(features, device)
    if matches.matcher == cfg.Matcher.LIGHTGLUE:
        load_package("--matcher lightglue")
    if prune is not None:
        build_pruner(prune, traits=traits, device=device, seed=run.seed, threads=count_threads(run.threads))
