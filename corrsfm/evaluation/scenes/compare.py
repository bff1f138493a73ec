"""Whole reconstructions side by side: the same features and matches under several prune methods.

::

    OUTPUT/
    ├── base/            workspace: photos, features, pairs, matches
    ├── METHOD/ …        one workspace each, sharing the base's files, from pruning to models
    ├── compare.json     what was measured
    └── compare.html     the same, with the pairs that differ most drawn

Shared files are hard links: a method takes space only for what it makes. Each workspace is an ordinary one
that every command accepts. Finished work is kept.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from corrsfm import pipeline
from corrsfm.config import PipelineConfig, PruneConfig, to_dict
from corrsfm.errors import ConfigError, ReconstructionError
from corrsfm.evaluation.records import finite_or_none, provenance, save_results
from corrsfm.evaluation.scenes.score import evaluate_scene, read_poses, score_poses
from corrsfm.evaluation.two_view.filters import parse_prune_method
from corrsfm.types import ModelSummary, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index, read_pairs

__all__ = ["compare_methods", "method_folder", "share_matches"]

logger = logging.getLogger("corrsfm")

_SHARED_STAGES = ("images", "features", "pairs", "matches")


def method_folder(method: str) -> str:
    """Folder name of a method, safe on every file system."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", method).strip("._") or "_"


def share_matches(base: Workspace, target: Workspace) -> None:
    """Give a workspace the photos, features, pairs and matches of another without copying them.

    What was made from a stage stays valid while the record of the stage is unchanged.
    """
    target.images_dir = base.images_dir
    files = ("images_txt", "images_json", "features", "pairs", "pair_origins", "matches")
    for name in files:
        source, link = getattr(base, name), getattr(target, name)
        if link.exists() and os.path.samefile(source, link):
            continue
        link.unlink(missing_ok=True)
        try:
            os.link(source, link)
        except OSError:
            # Some file systems have no hard links.
            shutil.copy2(source, link)
    for stage in _SHARED_STAGES:
        record = base.require(stage)
        known = target.record_of(stage)
        if known is None or known.fingerprint != record.fingerprint:
            target.finish(stage, record)


def compare_methods(
    images_dir: Path,
    output: Path,
    methods: Sequence[str],
    config: PipelineConfig,
    *,
    ground_truth: Path | None = None,
    results: Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> dict[str, Any]:
    """Reconstruct a scene once per prune method and measure each.

    Parameters
    ----------
    images_dir : Path
        Photos.
    output : Path
        Folder for workspaces and results.
    methods : sequence of str
        ``METHOD[@POINT][:CHECKPOINT]``, methods of `corrsfm prune`.
    config : PipelineConfig
        Options of all stages; a method's name overrides those of pruning.
    ground_truth : Path, optional
        See `corrsfm.evaluation.scenes.score.read_poses`.
    results : Path, optional
        Also write the result file here.
    overwrite : bool
        Redo finished work.
    command : str
        Recorded in the result file.

    Returns
    -------
    dict
        The content of the result file.

    Raises
    ------
    CorrsfmError
        Whatever the stages raise; but a method whose mapping fails is a result, not an error.
    """
    from corrsfm.evaluation.scenes.page import write_page

    prune_configs = {method: parse_prune_method(method, config.prune) for method in methods}
    folders = [method_folder(method) for method in prune_configs]
    if not folders or len(set(folders)) < len(folders) or "base" in folders:
        raise ConfigError(f"methods {', '.join(methods)}: give at least one, and each only once")
    base = Workspace(output / "base", create=True)
    _prepare(base, images_dir, config, overwrite)
    workspaces = {}
    measured = {}
    for method, prune_config in prune_configs.items():
        logger.info("method %s", method)
        workspace = Workspace(output / method_folder(method), create=True)
        failure = _reconstruct(base, workspace, prune_config, config, overwrite)
        workspaces[method] = workspace
        measured[method] = {
            "config": to_dict(prune_config),
            **_measure(workspace, failure, ground_truth),
        }
    index = read_index(base)
    values = {
        "provenance": provenance(seed=config.run.seed, command=command, device=config.run.device),
        "subject": {
            "name": _scene_name(images_dir),
            "num_photos": len(index.records),
            "num_pairs": len(read_pairs(base)),
            "photos_sha256": {record.name: record.sha256 for record in index.records},
            "config": to_dict(config),
        },
        "methods": measured,
        "pairs": _pair_counts(base, workspaces),
    }
    for path in (output / "compare.json", results):
        if path is not None:
            save_results(path, "compare", values)
    write_page(output / "compare.html", values, base, workspaces)
    return values


def _scene_name(images_dir: Path) -> str:
    """Name of the folder of photos, or of the scene for ``SCENE/images``."""
    folder = images_dir.resolve()
    return folder.parent.name if folder.name == "images" and folder.parent.name else folder.name


def _prepare(base: Workspace, images_dir: Path, config: PipelineConfig, overwrite: bool) -> None:
    run = config.run
    with base.lock():
        pipeline.index_photos(base, images_dir, config.images, run, overwrite=overwrite)
        pipeline.extract_features(base, config.features, run, overwrite=overwrite)
        pipeline.make_pairs(base, config.pairs, run, overwrite=overwrite)
        pipeline.match_pairs(base, config.matches, run, overwrite=overwrite)


def _reconstruct(
    base: Workspace, workspace: Workspace, prune: PruneConfig, config: PipelineConfig, overwrite: bool
) -> str | None:
    """Run everything from pruning on; returns the reason if mapping fails, else None."""
    with workspace.lock():
        share_matches(base, workspace)
        pipeline.prune_matches(workspace, prune, config.run, overwrite=overwrite)
        pipeline.verify_matches(workspace, config.database, config.run, overwrite=overwrite)
        try:
            pipeline.reconstruct(workspace, config.reconstruction, config.run, overwrite=overwrite)
        except ReconstructionError as error:
            return str(error)
    return None


def _measure(workspace: Workspace, failure: str | None, ground_truth: Path | None) -> dict[str, Any]:
    """Numbers of one method's reconstruction."""
    from corrsfm.colmap.pairs import read_verified_pairs

    pairs = read_verified_pairs(workspace.database)
    verified = [pair for pair in pairs if pair.num_inliers > 0]
    kept = sum(pair.num_matches for pair in pairs)
    inliers = sum(pair.num_inliers for pair in pairs)
    models = [] if failure else _models(workspace)
    largest = models[0] if models else None
    score = _score(workspace, ground_truth, failed=largest is None) if ground_truth else None
    seconds = {
        name: _seconds(workspace, stage)
        for name, stage in (("prune", "pruned matches"), ("verify", "verified matches"), ("map", "models"))
    }
    return {
        "failure": failure,
        "num_kept_matches": kept,
        "num_inlier_matches": inliers,
        "num_verified_pairs": len(verified),
        "inlier_ratio": inliers / kept if kept else None,
        "median_pair_inlier_ratio": (
            float(np.median([pair.num_inliers / pair.num_matches for pair in verified if pair.num_matches]))
            if verified
            else None
        ),
        "num_models": len(models),
        "num_registered": largest.num_images if largest else 0,
        "num_points": largest.num_points if largest else 0,
        "num_observations": largest.num_observations if largest else 0,
        "mean_track_length": finite_or_none(largest.mean_track_length) if largest else None,
        "mean_error_px": finite_or_none(largest.mean_error_px) if largest else None,
        "ground_truth": score,
        "seconds": seconds,
    }


def _score(workspace: Workspace, ground_truth: Path, *, failed: bool) -> dict[str, Any]:
    """Score against known cameras; without a model every photo is missing."""
    score = (
        score_poses({}, read_poses(ground_truth)) if failed else evaluate_scene(workspace.root, ground_truth)
    )
    return score.to_dict()


def _models(workspace: Workspace) -> list[ModelSummary]:
    """Summaries of the models, the largest first: mapping has ranked them."""
    from corrsfm.colmap.models import read_models, summarise_model

    return [summarise_model(model) for model in read_models(workspace.sparse)]


def _seconds(workspace: Workspace, stage: str) -> float | None:
    record = workspace.record_of(stage)
    return round(record.seconds, 3) if record else None


def _pair_counts(base: Workspace, workspaces: dict[str, Workspace]) -> list[dict[str, Any]]:
    """Kept and verified matches of every pair under every method, the pairs that differ most first."""
    from corrsfm.colmap.pairs import read_verified_pairs

    wanted = [_sorted_pair(pair) for pair in read_pairs(base).pairs]
    counts: dict[Pair, dict[str, list[int]]] = {pair: {} for pair in wanted}
    for method, workspace in workspaces.items():
        for pair in wanted:
            counts[pair][method] = [0, 0]
        for found in read_verified_pairs(workspace.database, wanted):
            counts[found.name0, found.name1][method] = [found.num_matches, found.num_inliers]
    rows = [
        {"name0": pair[0], "name1": pair[1], "kept_and_verified": per_method}
        for pair, per_method in counts.items()
    ]
    return sorted(rows, key=lambda row: (-_spread(row), row["name0"], row["name1"]))


def _sorted_pair(pair: Pair) -> Pair:
    return (pair[0], pair[1]) if pair[0] < pair[1] else (pair[1], pair[0])


def _spread(row: dict[str, Any]) -> int:
    verified = [counts[1] for counts in row["kept_and_verified"].values()]
    return max(verified) - min(verified)
