"""The sixth stage: kept matches become a COLMAP database with verified pairs."""

from __future__ import annotations

import logging
import time

from corrsfm import config as cfg
from corrsfm.colmap.log import pycolmap_version
from corrsfm.colmap.sqlite import is_truncated
from corrsfm.config import config_hash
from corrsfm.database.write import write_database
from corrsfm.machine import count_threads
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, PRUNED
from corrsfm.workspace.lists import read_index, read_pairs
from corrsfm.workspace.resume import StageOutcome, explain, finish
from corrsfm.workspace.store import ItemStore

__all__ = ["verify_matches"]

logger = logging.getLogger("corrsfm")


def verify_matches(
    workspace: Workspace, config: cfg.DatabaseConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Write the COLMAP database and verify the kept matches geometrically."""
    started = time.monotonic()
    index = read_index(workspace)
    pruned = workspace.require("pruned matches")
    fingerprint = config_hash(
        "verified matches", pycolmap_version(), pruned.fingerprint, index.cameras, config, run.seed
    )
    pair_list = read_pairs(workspace)
    damaged = workspace.database.is_file() and is_truncated(workspace.database)
    if damaged:
        logger.warning("%s: damaged, its end is missing; it is written again", workspace.database)
    current = workspace.is_current("verified matches", fingerprint, workspace.database)
    if current and not overwrite and not damaged:
        return StageOutcome(
            stage="verified matches", num_items=len(pair_list), num_reused=len(pair_list), skipped=True
        )
    if not damaged:
        explain(workspace, "verified matches", config)
    workspace.forget("verified matches")
    with (
        ItemStore(workspace.features, FEATURES).reader() as read_features,
        ItemStore(workspace.pruned, PRUNED).reader() as read_pruned,
    ):
        write_database(
            workspace.database,
            images=index.records,
            cameras=index.cameras,
            features=read_features,
            kept=((*pair, read_pruned(pair).indices) for pair in pair_list.pairs),
            config=config,
            seed=run.seed,
            num_threads=count_threads(run.threads),
            log_file=workspace.log,
        )
    outcome = StageOutcome(
        stage="verified matches", num_items=len(pair_list), seconds=time.monotonic() - started
    )
    finish(workspace, outcome, fingerprint, config, inputs={"pruned matches": pruned.fingerprint})
    return outcome
