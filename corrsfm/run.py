"""A whole run: all stages over one workspace, and `run.json`, the record of what made it."""

from __future__ import annotations

import logging
import platform
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.errors import ReconstructionError
from corrsfm.index import read_index
from corrsfm.machine import versions
from corrsfm.workspace import STAGE_COMMANDS, Workspace, atomic_write_json

if TYPE_CHECKING:
    from corrsfm.report import SceneReport

__all__ = ["run_scene"]

logger = logging.getLogger("corrsfm")


def run_scene(
    images_dir: Path, workspace_dir: Path, config: cfg.PipelineConfig, *, overwrite: bool = False
) -> SceneReport:
    """Go from a folder of photos to models and a report, skipping what is finished.

    Parameters
    ----------
    images_dir, workspace_dir : Path
    config : PipelineConfig
    overwrite : bool
        Redo finished work.

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
    pipeline.check_options(run, config.prune)
    workspace = Workspace(workspace_dir, create=True, images_dir=images_dir)
    with workspace.lock():
        _say(pipeline.index_photos(workspace, images_dir, config.images, run, overwrite=overwrite))
        _say(pipeline.extract_features(workspace, config.features, run, overwrite=overwrite))
        _say(pipeline.make_pairs(workspace, config.pairs, run, overwrite=overwrite))
        _say(pipeline.match_pairs(workspace, config.matches, run, overwrite=overwrite))
        _say(pipeline.prune_matches(workspace, config.prune, run, overwrite=overwrite))
        _say(pipeline.verify_matches(workspace, config.database, run, overwrite=overwrite))
        try:
            _say(pipeline.reconstruct(workspace, config.reconstruction, run, overwrite=overwrite))
        except ReconstructionError as error:
            pipeline.report(workspace, html=True)
            raise ReconstructionError(f"{error}\nevery photo and pair: {workspace.report_html}") from error
        atomic_write_json(workspace.run_json, _run_record(workspace, config))
        return pipeline.report(workspace, html=True)


def _say(outcome: pipeline.StageOutcome) -> None:
    """One line about a finished stage, which also stays where no progress bar is drawn."""
    logger.info("%s", outcome)


def _run_record(workspace: Workspace, config: cfg.PipelineConfig) -> dict[str, Any]:
    from corrsfm.prune import checkpoint_sha256

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
