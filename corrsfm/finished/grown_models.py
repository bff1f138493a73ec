"""The models of a scene with new photos in them, and what is known of each photo that came."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from corrsfm import config as cfg
from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.models import write_model
from corrsfm.colmap.pairs import read_verified_matches
from corrsfm.files import atomic_path, atomic_write_json, read_json
from corrsfm.machine import count_threads
from corrsfm.reconstruction.best_model import judge_as_it_is
from corrsfm.reconstruction.calibration import Refinement, adjustment_options, restore_priors
from corrsfm.reconstruction.growth import grow
from corrsfm.reconstruction.record import record_of
from corrsfm.reconstruction.resection import Resection
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.stage import fingerprint_of
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_added, read_index
from corrsfm.workspace.models import models_of
from corrsfm.workspace.resume import StageOutcome, finish
from corrsfm.workspace.stores import features_of

__all__ = ["ORIGIN", "grow_models"]

logger = logging.getLogger("corrsfm")

ORIGIN = "added"
"""Where pairs of photos that came later, and models that hold them, are from."""


def grow_models(
    workspace: Workspace,
    photos: Sequence[str],
    config: cfg.ReconstructionConfig,
    run: cfg.RunConfig,
    *,
    refine: bool,
) -> tuple[StageOutcome, int]:
    """Put new photos into the models of a workspace, the first one first, and judge the first again.

    Parameters
    ----------
    workspace : Workspace
        With the verified matches of the new photos.
    photos : sequence of str
        The new ones, sorted.
    config : ReconstructionConfig
        What the models were made with.
    run : RunConfig
    refine : bool
        Adjust models that grew as a whole.

    Returns
    -------
    outcome : StageOutcome
    num_new_points : int
    """
    started = time.monotonic()
    verified = workspace.require("verified matches")
    fingerprint = fingerprint_of(verified.fingerprint, config, run.seed)
    if workspace.is_current("models", fingerprint, workspace.sparse / "0", workspace.added):
        num = len(models_of(workspace))
        return StageOutcome(stage="models", num_items=num, num_reused=num, skipped=True), 0
    models = models_of(workspace)
    for model in models:
        restore_priors(model, workspace.database)
    matches = read_verified_matches(workspace.database)
    index = read_index(workspace)
    known_focal = {
        record.name: index.camera_of(record).has_prior_focal_length or not config.refine_intrinsics
        for record in index.records
    }
    num_threads = count_threads(run.threads)
    refinement = adjustment_options(Refinement.of(config), num_threads=num_threads)
    placed: dict[str, tuple[int, Resection]] = {}
    last: dict[str, Resection] = {}
    num_new_points = 0
    for number, model in enumerate(models):
        growth = grow(
            model,
            [name for name in photos if name not in placed],
            workspace.database,
            matches,
            known_focal=known_focal,
            refinement=refinement if refine else None,
            seed=run.seed,
            num_threads=num_threads,
        )
        placed |= {name: (number, found) for name, found in growth.registered.items()}
        # What the first model says is what most want to know.
        last = {**growth.failed, **last}
        if growth.registered:
            num_new_points += growth.num_new_points
            models[number] = growth.model
            _colour(growth.model, growth.registered, workspace.images_dir)
    _write(workspace, photos, models, placed, last, run.seed)
    outcome = StageOutcome(stage="models", num_items=len(models), seconds=time.monotonic() - started)
    finish(workspace, outcome, fingerprint, config, inputs={"verified matches": verified.fingerprint})
    return outcome, num_new_points


def _write(
    workspace: Workspace,
    photos: Sequence[str],
    models: Sequence[pycolmap.Reconstruction],
    placed: Mapping[str, tuple[int, Resection]],
    last: Mapping[str, Resection],
    seed: int,
) -> None:
    """Write the models, what became of each photo, and the verdict."""
    held = {
        image.name: number
        for number, model in reversed(list(enumerate(models)))
        for image in model.images.values()
        if image.has_pose
    }
    before = read_added(workspace)
    record = {}
    for name in photos:
        found = placed[name][1] if name in placed else last.get(name)
        # An interrupted addition may have placed it before.
        numbers = before.get(name, {}) if found is None else _numbers(found)
        record[name] = {**numbers, "model": held.get(name)}
    atomic_write_json(workspace.added, {"photos": {**before, **record}})
    with atomic_path(workspace.sparse) as temporary:
        for number, model in enumerate(models):
            write_model(model, temporary / str(number))
    if workspace.evidence.exists():
        _judge(workspace, models[0], seed)


def _judge(workspace: Workspace, model: pycolmap.Reconstruction, seed: int) -> None:
    """Write the verdict on the first model as it is now."""
    with features_of(workspace).reader() as load:
        names, verified = read_index(workspace).names, read_verified_matches(workspace.database)
        evidence = SceneEvidence(names, verified, load, seed=seed)
        reason = "photos were added to a finished model"
        selection = judge_as_it_is(model, evidence, name=ORIGIN, reason=reason)
        record = record_of(selection, evidence)
    try:
        before = read_json(workspace.evidence)
        record |= {"joinings": before["joinings"]}
    except (ValueError, KeyError, TypeError):
        logger.debug("%s: says nothing of models that were joined", workspace.evidence)
    atomic_write_json(workspace.evidence, record)
    logger.info("verdict: %s", selection.verdict)


def _colour(model: pycolmap.Reconstruction, names: Mapping[str, Resection], folder: Path) -> None:
    """Colour the points that have no colour yet by the new photos."""
    with colmap_log():
        for name in names:
            model.extract_colors_for_image(model.find_image_with_name(name).image_id, folder)


def _numbers(found: Resection) -> dict[str, Any]:
    """What is kept of a search for a pose."""
    return {
        "num_inliers": found.num_inliers,
        "num_candidates": found.num_candidates,
        "median_error_px": found.median_error_px if np.isfinite(found.median_error_px) else None,
        "why_not": found.why_not,
    }
