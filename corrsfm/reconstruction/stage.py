"""The seventh stage: the verified pairs of the database become models."""

from __future__ import annotations

import functools
import logging
import time

from tqdm import tqdm

from corrsfm import config as cfg
from corrsfm.colmap.log import pycolmap_version
from corrsfm.colmap.pairs import names_of_verified_pairs
from corrsfm.config import config_hash
from corrsfm.errors import ReconstructionError, first_few
from corrsfm.graph import connected_components
from corrsfm.machine import count_threads
from corrsfm.reconstruction.mapper import reconstruct as map_database
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.resume import StageOutcome, explain, finish, require_database

__all__ = ["reconstruct"]

logger = logging.getLogger("corrsfm")


def reconstruct(
    workspace: Workspace, config: cfg.ReconstructionConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Map the verified database into models, the largest at `sparse/0`.

    Raises
    ------
    ReconstructionError
        If no model came out, with the reason; models of earlier matches are then in ``sparse.old``.
    """
    started = time.monotonic()
    verified = require_database(workspace)
    fingerprint = config_hash("models", pycolmap_version(), verified.fingerprint, config, run.seed)
    # Models without colours are remade once the photos are back.
    black = config_hash("black", fingerprint)
    images_dir = workspace.images_dir if workspace.images_dir.is_dir() else None
    current = [fingerprint] if images_dir else [fingerprint, black]
    if not overwrite and any(workspace.is_current("models", one, workspace.sparse / "0") for one in current):
        num = sum(1 for path in workspace.sparse.iterdir() if path.is_dir())
        return StageOutcome(stage="models", num_items=num, num_reused=num, skipped=True)
    explain(workspace, "models", config)
    workspace.forget("models")
    names = read_index(workspace).names
    if images_dir is None:
        fingerprint = black
        logger.warning(
            "photos are no longer at %s; the points stay black; if they moved, run: %s",
            workspace.images_dir,
            workspace.command_for("images", images_dir="NEWDIR"),
        )
    _warn_of_parts(workspace, names)
    with tqdm(total=len(names), desc="mapping", unit="photo", leave=False) as bar:
        try:
            models = map_database(
                workspace.database,
                images_dir,
                workspace.sparse,
                config=config,
                seed=run.seed,
                num_threads=count_threads(run.threads),
                log_file=workspace.log,
                on_progress=functools.partial(_show_progress, bar),
            )
        except ReconstructionError:
            workspace.put_models_aside()
            raise
    outcome = StageOutcome(stage="models", num_items=len(models), seconds=time.monotonic() - started)
    finish(workspace, outcome, fingerprint, config, inputs={"verified matches": verified.fingerprint})
    return outcome


def _show_progress(bar: tqdm, num_registered: int) -> None:
    # A new model, or a new attempt at the same one, begins.
    if num_registered < bar.n:
        bar.reset()
    bar.n = num_registered
    bar.refresh()


def _warn_of_parts(workspace: Workspace, names: list[str]) -> None:
    """Warn before mapping if the verified pairs do not connect the photos."""
    parts = [
        part
        for part in connected_components(names, names_of_verified_pairs(workspace.database))
        if len(part) > 1
    ]
    if len(parts) > 1:
        logger.warning(
            "verified pairs fall into %d components of %s photos: each becomes a separate model at best; "
            "add photos that bridge them, or try more features or more pairs\n"
            "not connected to the largest: %s",
            len(parts),
            first_few(str(len(part)) for part in parts),
            first_few(name for part in parts[1:] for name in part),
        )
