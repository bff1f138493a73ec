"""Whole reconstructions side by side: the same features and matches under several prune methods.

::

    OUTPUT/
    ├── base/            workspace: photos, features, pairs, matches
    ├── METHOD/ …        one workspace each, sharing the base's files, from pruning to models
    │   └── .seeds/SEED/ …      the same again for each further seed, see `corrsfm.evaluation.scenes.seeds`
    ├── compare.json     what was measured
    └── compare.html     the same, with the pairs that differ most drawn

Shared files are hard links: a method takes space only for what it makes. Each workspace is an ordinary one
that every command accepts. Finished work is kept.
"""

from __future__ import annotations

import dataclasses
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from corrsfm import pipeline
from corrsfm.config import PipelineConfig, to_dict
from corrsfm.errors import ConfigError, InputError
from corrsfm.evaluation.records import finite_or_none, provenance, save_results
from corrsfm.evaluation.scenes import DEFAULT_NUM_SEEDS
from corrsfm.evaluation.scenes.evidence import common_evidence
from corrsfm.evaluation.scenes.score import read_truth, require_common_names
from corrsfm.evaluation.scenes.seeds import (
    SeedRun,
    map_other_seeds,
    measure_seed,
    seconds_of,
    summarise_seeds,
    verify_and_map,
    wanted_seeds,
)
from corrsfm.evaluation.scenes.sharing import share_stages
from corrsfm.evaluation.two_view.filters import parse_prune_method
from corrsfm.files import PAGE_BEGINNING, RESULT_BEGINNING, require_replaceable
from corrsfm.types import ModelSummary, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index, read_pairs

__all__ = ["compare_methods", "method_folder"]

logger = logging.getLogger("corrsfm")


def method_folder(method: str) -> str:
    """Folder name of a method, safe on every file system."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", method).strip("._") or "_"


def compare_methods(
    images_dir: Path,
    output: Path,
    methods: Sequence[str],
    config: PipelineConfig,
    *,
    num_seeds: int = DEFAULT_NUM_SEEDS,
    ground_truth: Path | None = None,
    results: Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> dict[str, Any]:
    """Reconstruct a scene with each prune method, over several seeds, and measure.

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
    num_seeds : int
        Seeds that each method is mapped with, counted up from that of the config. What a result holds beside
        ``seeds``, ``median`` and ``worst`` is of the first.
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
    wanted_seeds(config.run.seed, num_seeds)
    for prune_config in prune_configs.values():
        pipeline.check_options(
            config.run, prune_config, features=config.features, pairs=config.pairs, matches=config.matches
        )
    if output.resolve() == images_dir.resolve():
        raise InputError(f"{output}: is the folder of the photos; choose another one with --output")
    require_replaceable(output / "compare.json", "a result file", RESULT_BEGINNING)
    require_replaceable(output / "compare.html", "a page of corrsfm", PAGE_BEGINNING)
    truth = read_truth(ground_truth) if ground_truth else None
    base = Workspace(output / "base", create=True)
    _prepare(base, images_dir, config, overwrite)
    index = read_index(base)
    if truth is not None and ground_truth is not None:
        require_common_names(index.names, images_dir, truth, ground_truth)
    runs = {
        method: _reconstruct(
            base, output, method, dataclasses.replace(config, prune=prune_config), num_seeds, overwrite
        )
        for method, prune_config in prune_configs.items()
    }
    workspaces = {method: seeds[0].workspace for method, seeds in runs.items()}
    logger.info("counting what the models predict")
    everything = [run.workspace for seeds in runs.values() for run in seeds]
    with common_evidence(everything, seed=config.run.seed) as evidence:
        measured = {
            method: {
                "config": to_dict(prune_configs[method]),
                **_measure(seeds[0], [measure_seed(run, evidence, truth) for run in seeds]),
            }
            for method, seeds in runs.items()
        }
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
    base: Workspace,
    output: Path,
    method: str,
    config: PipelineConfig,
    num_seeds: int,
    overwrite: bool,
) -> list[SeedRun]:
    """Run everything from pruning on, for every seed."""
    workspace = Workspace(output / method_folder(method), create=True)
    subject = f"method {method}"
    with workspace.lock():
        logger.info("%s", subject if num_seeds == 1 else f"{subject}, seed 1 of {num_seeds}")
        share_stages(base, workspace)
        pipeline.prune_matches(workspace, config.prune, config.run, overwrite=overwrite)
        failure = verify_and_map(workspace, config, overwrite=overwrite)
        return [
            SeedRun(seed=config.run.seed, workspace=workspace, failure=failure),
            *map_other_seeds(workspace, config, num_seeds, overwrite=overwrite, subject=subject),
        ]


def _measure(run: SeedRun, seeds: list[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of one method: of its first seed, and of all of them."""
    from corrsfm.colmap.pairs import read_verified_pairs

    workspace = run.workspace
    pairs = read_verified_pairs(workspace.database)
    verified = [pair for pair in pairs if pair.num_inliers > 0]
    kept = sum(pair.num_matches for pair in pairs)
    inliers = sum(pair.num_inliers for pair in pairs)
    models = [] if run.failure else _models(workspace)
    largest = models[0] if models else None
    return {
        "failure": run.failure,
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
        "ground_truth": seeds[0]["ground_truth"],
        "seconds": seconds_of(workspace),
        "seeds": seeds,
        **summarise_seeds(seeds),
    }


def _models(workspace: Workspace) -> list[ModelSummary]:
    """Summaries of the models, the largest first: mapping has ranked them."""
    from corrsfm.colmap.models import summarise_model
    from corrsfm.workspace.models import models_of

    return [summarise_model(model) for model in models_of(workspace)]


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
