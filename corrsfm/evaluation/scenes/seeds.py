"""One scene under several seeds: mapping is a draw, so a single model tells little about what made it.

Each further seed has a workspace of its own in ``WORKSPACE/.seeds/SEED``, an ordinary one that shares
everything up to the kept matches by hard links. There the matches are verified, cameras decided and models
mapped and chosen again. Finished seeds are kept; deleting ``.seeds`` costs only the time to map them again.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.colmap.models import find_model, is_model, poses_of, read_model
from corrsfm.errors import ConfigError, InputError, ReconstructionError
from corrsfm.evaluation.scenes.evidence import common_evidence, evidence_of
from corrsfm.evaluation.scenes.score import (
    SCENE_THRESHOLDS_DEG,
    evaluate_scene,
    read_truth,
    score_poses,
)
from corrsfm.evaluation.scenes.sharing import KEPT_MATCHES, PUTATIVE_MATCHES, share_stages
from corrsfm.geometry import Pose
from corrsfm.prune import depends_on_seed
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.views import views_of
from corrsfm.workspace import Workspace
from corrsfm.workspace.last_run import seed_of_last_run
from corrsfm.workspace.models import models_of

__all__ = [
    "SeedRun",
    "evaluate_seeds",
    "map_other_seeds",
    "measure_seed",
    "seconds_of",
    "summarise_seeds",
    "verify_and_map",
    "wanted_seeds",
    "why_one_model",
]

logger = logging.getLogger("corrsfm")

_HEADLINES = ("num_registered", "num_points", "explained_share", "num_predicted_matches")
"""More is better for all of them."""


@dataclass(frozen=True, kw_only=True)
class SeedRun:
    """A workspace that was mapped with a seed.

    Attributes
    ----------
    seed : int
    workspace : Workspace
    failure : str or None
        Why mapping gave no model.
    """

    seed: int
    workspace: Workspace
    failure: str | None = None


def wanted_seeds(first: int, num_seeds: int) -> list[int]:
    """The seeds counted up from a first one.

    Raises
    ------
    ConfigError
        If there would be none, or one too large.
    """
    most = cfg.LARGEST_INT - first + 1
    if not 1 <= num_seeds <= most:
        raise ConfigError(f"{num_seeds} seeds from {first} on: expected a number from 1 to {most}")
    return list(range(first, first + num_seeds))


def verify_and_map(
    workspace: Workspace, config: cfg.PipelineConfig, *, overwrite: bool = False
) -> str | None:
    """Verify kept matches and map them; returns the reason if mapping fails, else None."""
    pipeline.verify_matches(workspace, config.database, config.run, overwrite=overwrite)
    try:
        pipeline.reconstruct(workspace, config.reconstruction, config.run, overwrite=overwrite)
    except ReconstructionError as error:
        return str(error)
    return None


def map_other_seeds(
    workspace: Workspace,
    config: cfg.PipelineConfig,
    num_seeds: int,
    *,
    overwrite: bool = False,
    subject: str = "",
) -> list[SeedRun]:
    """Map a workspace with further seeds; itself it stays as it is.

    Parameters
    ----------
    workspace : Workspace
        With kept matches, and locked by the caller.
    config : PipelineConfig
        The options that it was made with, and its own seed.
    num_seeds : int
        The workspace's own seed included.
    overwrite : bool
        Redo finished seeds.
    subject : str
        What is mapped, to begin lines of progress with.

    Returns
    -------
    list of SeedRun
        Of the other seeds, in order.
    """
    prune_again = depends_on_seed(config.prune)
    runs = []
    for number, seed in enumerate(wanted_seeds(config.run.seed, num_seeds)[1:], start=2):
        logger.info("%sseed %d of %d", subject and f"{subject}, ", number, num_seeds)
        other = Workspace(workspace.seeds / str(seed), create=True)
        with_seed = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))
        with other.lock():
            share_stages(workspace, other, PUTATIVE_MATCHES if prune_again else KEPT_MATCHES)
            if prune_again:
                pipeline.prune_matches(other, config.prune, with_seed.run, overwrite=overwrite)
            failure = verify_and_map(other, with_seed, overwrite=overwrite)
        runs.append(SeedRun(seed=seed, workspace=other, failure=failure))
    return runs


def measure_seed(
    run: SeedRun, evidence: SceneEvidence, truth: Mapping[str, Pose] | None = None
) -> dict[str, Any]:
    """Numbers of the largest model of a seed, plain values for JSON.

    Parameters
    ----------
    run : SeedRun
    evidence : SceneEvidence
        The same for all models that are compared, see `common_evidence`.
    truth : mapping of str to Pose, optional
        Known cameras.

    Returns
    -------
    dict
        A seed without a model has registered and explained nothing, and its AUC is 0.
    """
    workspace = run.workspace
    model = None if run.failure else models_of(workspace)[0]
    views = {} if model is None else views_of(model)
    found = None if model is None else evidence_of(workspace, views)
    poses = {} if model is None else poses_of(model)
    return {
        "seed": run.seed,
        "failure": run.failure,
        "num_registered": len(views),
        "num_points": 0 if model is None else model.num_points3D(),
        "explained_share": 0.0 if found is None else found.explained_share,
        "num_predicted_matches": evidence.count_predicted(views),
        "num_contradicted_pairs": 0 if found is None else found.num_contradicted_pairs,
        "grade": None if found is None else found.grade,
        "ground_truth": None if truth is None else score_poses(poses, truth).to_dict(),
        "seconds": seconds_of(workspace),
    }


def seconds_of(workspace: Workspace) -> dict[str, float | None]:
    """Seconds of pruning, verification and mapping; None for a stage that never finished."""
    stages = {"prune": "pruned matches", "verify": "verified matches", "map": "models"}
    records = {name: workspace.record_of(stage) for name, stage in stages.items()}
    return {name: round(record.seconds, 3) if record else None for name, record in records.items()}


def summarise_seeds(seeds: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Median and worst of what `measure_seed` found.

    Returns
    -------
    dict
        ``median`` and ``worst``, each number by number: the worst of two numbers may come from two seeds.
    """
    summary = {}
    for name, reduce in (("median", statistics.median), ("worst", min)):
        summary[name] = {key: reduce([seed[key] for seed in seeds]) for key in _HEADLINES}
        if all(seed["ground_truth"] for seed in seeds):
            summary[name]["auc"] = {
                f"{threshold:g}": reduce([seed["ground_truth"]["auc"][f"{threshold:g}"] for seed in seeds])
                for threshold in SCENE_THRESHOLDS_DEG
            }
    return summary


def why_one_model(folder: Path) -> str:
    """Why a reconstruction cannot be mapped with further seeds; empty if it can."""
    if is_model(folder) or not (folder / "workspace.json").exists():
        return "it is not in a workspace"
    workspace = Workspace(folder)
    pruned = workspace.require("pruned matches")
    needed = [workspace.images_json, workspace.features, workspace.pair_origins, workspace.pruned]
    needed += [workspace.matches] if depends_on_seed(_prune_config(workspace, pruned.config)) else []
    missing = [path.name for path in (*needed, workspace.database) if not path.exists()]
    if missing:
        return f"{', '.join(missing)} of its workspace is gone"
    return "" if os.access(folder, os.W_OK) else "nothing can be written into its workspace"


def evaluate_seeds(folder: Path, ground_truth: Path, num_seeds: int, run: cfg.RunConfig) -> dict[str, Any]:
    """Measure a workspace against known cameras over several seeds.

    Parameters
    ----------
    folder : Path
        A workspace with models. Only ``.seeds`` in it is written.
    ground_truth : Path
        See `corrsfm.evaluation.scenes.score.read_poses`.
    num_seeds : int
    run : RunConfig
        Its seed is taken for that of the models if `run.json` does not say it.

    Returns
    -------
    dict
        The score of its own model as of `evaluate_scene`, with ``seeds`` (`measure_seed` of each, its own
        first), ``median`` and ``worst``, and ``known_cameras``: what those explain and predict, None where
        they have no intrinsics of these photos.

    Raises
    ------
    CorrsfmError
        If one of them cannot be read, or another process works in the workspace.
    """
    own = evaluate_scene(folder, ground_truth)
    truth = read_truth(ground_truth)
    workspace = Workspace(folder)
    with workspace.lock():
        config = _config_of(workspace, run)
        runs = [SeedRun(seed=config.run.seed, workspace=workspace)]
        runs += map_other_seeds(workspace, config, num_seeds)
        with common_evidence([one.workspace for one in runs], seed=config.run.seed) as evidence:
            seeds = [measure_seed(one, evidence, truth) for one in runs]
            known = _measure_known(ground_truth, evidence)
    return {**own.to_dict(), "seeds": seeds, "known_cameras": known, **summarise_seeds(seeds)}


def _measure_known(ground_truth: Path, evidence: SceneEvidence) -> dict[str, Any] | None:
    """What the known cameras explain and predict, as a model that was not made from these matches.

    None if they are poses alone, or cameras of photos of another size.
    """
    try:
        known = views_of(read_model(find_model(ground_truth)))
    except InputError:
        return None
    views = {name: view for name, view in known.items() if name in evidence.keypoints}
    for name, view in views.items():
        if (view.camera.width, view.camera.height) != evidence.features(name).image_size:
            return None
    return {
        "num_photos": len(views),
        "explained_share": evidence.explain(views).share,
        "num_predicted_matches": evidence.count_predicted(views),
    }


def _config_of(workspace: Workspace, run: cfg.RunConfig) -> cfg.PipelineConfig:
    """The options that a workspace's models were made with, and their seed."""
    where = str(workspace.manifest)
    seed = seed_of_last_run(workspace, workspace.require("models").fingerprint)
    if seed is not None:
        run = dataclasses.replace(run, seed=seed)
    return cfg.PipelineConfig(
        prune=_prune_config(workspace, workspace.require("pruned matches").config),
        database=cfg.from_dict(cfg.DatabaseConfig, workspace.require("verified matches").config, where),
        reconstruction=cfg.from_dict(cfg.ReconstructionConfig, workspace.require("models").config, where),
        run=run,
    )


def _prune_config(workspace: Workspace, values: dict[str, Any]) -> cfg.PruneConfig:
    return cfg.from_dict(cfg.PruneConfig, values, str(workspace.manifest))
