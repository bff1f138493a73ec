"""A verified database → models, by pycolmap's incremental, global or hierarchical mapping."""

from __future__ import annotations

import copy
import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pycolmap

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.models import summarise_model, write_model
from corrsfm.colmap.sqlite import LOG_BYTES, database_errors, find_strange_table
from corrsfm.config import Mapper, ReconstructionConfig
from corrsfm.disk import room_for
from corrsfm.errors import DatabaseError, ReconstructionError
from corrsfm.files import atomic_path
from corrsfm.reconstruction.calibration import (
    Refinement,
    has_possible_cameras,
    is_plausible,
    refine_intrinsics,
)
from corrsfm.reconstruction.failure import read_pair_graph, why_no_model
from corrsfm.types import ModelSummary

__all__ = ["reconstruct", "threads_for"]

_POLL_SECONDS = 0.2

# With several threads, COLMAP's search for the first pair and its adjustment depend on which thread is ahead:
# on the 20 photos of a validation scene the same seed gave models of 15 and of 20 photos. One thread is as
# quick for scenes of this size.
_MOST_PHOTOS_ON_ONE_THREAD = 200

logger = logging.getLogger("corrsfm")


def reconstruct(
    database: Path,
    images_dir: Path | None,
    output: Path,
    *,
    config: ReconstructionConfig,
    seed: int = 0,
    num_threads: int = 0,
    log_file: Path | None = None,
    on_progress: Callable[[int], None] | None = None,
    choose: Callable[[pycolmap.Reconstruction | None, float], pycolmap.Reconstruction | None] | None = None,
    join: Callable[[list[pycolmap.Reconstruction]], list[pycolmap.Reconstruction]] | None = None,
    before_replacing: Callable[[], None] = lambda: None,
) -> list[ModelSummary]:
    """Map a database into models; they appear at ``output`` all at once or not at all.

    Parameters
    ----------
    database : Path
        With verified two-view geometries; not changed.
    images_dir : Path or None
        Folder of the photos, for the colours of the points; without it, or where a photo is missing, points
        stay black.
    output : Path
        Folder of the models ``0``, ``1`` … in COLMAP's binary format, the one with most photos first. An
        existing folder is replaced.
    config : ReconstructionConfig
    seed : int
        Equal seeds give equal models up to 200 photos; of more, only with ``num_threads`` 1.
    num_threads : int
        Of scenes with more than 200 photos; smaller ones are mapped on one. 0 for all cores.
    log_file : Path, optional
        Where pycolmap's messages are appended.
    on_progress : callable, optional
        Called with the number of photos in the model under construction whenever it grows; incremental
        mapping only. An exception it raises cancels the mapping and is passed on.
    choose : callable, optional
        Given the largest model, None if there is none, and the seconds it took: the model to put in its
        place. Not asked if the time limit stopped mapping.
    join : callable, optional
        Given all models if there are several, the largest first: those to keep. Not asked if the time limit
        stopped mapping.
    before_replacing : callable, optional
        Called when the models are on the disk, before they take the place of what is there; what it raises
        leaves that as it is.

    Returns
    -------
    list of ModelSummary
        In the order of the folders.

    Raises
    ------
    ReconstructionError
        If no model came out, with the reason.
    DatabaseError
        If there is no such database or it is in use.
    """
    if not database.is_file():
        raise DatabaseError(f"{database}: no such database; try: corrsfm prune WORKSPACE")
    if strange := find_strange_table(database):
        raise DatabaseError(f"{database}: damaged, {strange}; delete the file and make it again")
    with (
        atomic_path(output, before_replacing=before_replacing) as temporary,
        # Where pycolmap cannot make a log beside the database, it leaves half of one.
        room_for(output.parent, LOG_BYTES),
        colmap_log(log_file),
        database_errors(database),
    ):
        graph = read_pair_graph(database)
        if not graph.num_inliers:
            raise ReconstructionError(f"{database}: {why_no_model(graph)}")
        scratch = temporary / "mapper"
        scratch.mkdir(parents=True)
        pycolmap.set_random_seed(seed)
        _warn_of_unused(config)
        started = time.monotonic()
        # pycolmap wants an existing folder even if it reads no photo.
        mapped = _run_mapper(
            database,
            images_dir or scratch,
            scratch,
            config=config,
            options=_incremental_options(config, output, seed, threads_for(len(graph.names), num_threads)),
            on_progress=on_progress or (lambda num_registered: None),
        )
        seconds = time.monotonic() - started
        cut_off = _cut_off(config, seconds)
        models = _ranked(mapped.values(), config.min_model_size)
        first = models[0] if models else None
        chosen = first if choose is None or cut_off else choose(first, seconds)
        if chosen is not None and chosen is not first:
            models = [chosen, *(model for model in models[1:] if not _names(model) <= _names(chosen))]
        if not models:
            raise ReconstructionError(f"{database}: {why_no_model(graph, cut_off)}")
        if join is not None and len(models) > 1 and not cut_off:
            models = join(models)
        if cut_off:
            logger.warning("%s; photos may be missing for that reason alone", cut_off)
        for number, model in enumerate(models):
            has_colours = config.mapper is Mapper.INCREMENTAL and (number or chosen is first)
            if images_dir is not None and not has_colours:
                model.extract_colors_for_all_images(images_dir)
            write_model(model, temporary / str(number))
        shutil.rmtree(scratch)
        return [summarise_model(model) for model in models]


def threads_for(num_photos: int, num_threads: int) -> int:
    """Threads to map a scene on: one where several would make it a draw; 0 for all cores stays 0."""
    return 1 if num_photos <= _MOST_PHOTOS_ON_ONE_THREAD else num_threads


def _warn_of_unused(config: ReconstructionConfig) -> None:
    """Name the options that the chosen mapper ignores."""
    if config.mapper is not Mapper.GLOBAL:
        return
    for flag, value in (
        ("--max-runtime-minutes", config.max_runtime_minutes),
        ("--snapshot-every", config.snapshot_every),
    ):
        if value:
            logger.warning("%s %g has no effect with --mapper global", flag, value)


def _cut_off(config: ReconstructionConfig, seconds: float) -> str:
    """Say that the time limit stopped mapping, if it did; pycolmap tells only its log."""
    limit = _max_runtime_seconds(config)
    if config.mapper is Mapper.GLOBAL or not limit or seconds < limit:
        return ""
    # Hierarchical mapping applies the limit to each of its parts.
    stopped = "was stopped" if config.mapper is Mapper.INCREMENTAL else "may have been stopped"
    return f"mapping {stopped} after --max-runtime-minutes {config.max_runtime_minutes:g}"


def _max_runtime_seconds(config: ReconstructionConfig) -> int:
    """0 for no limit."""
    return max(1, round(60 * config.max_runtime_minutes)) if config.max_runtime_minutes > 0 else 0


def _incremental_options(
    config: ReconstructionConfig, output: Path, seed: int, num_threads: int
) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    # Verification decides which pairs are good; a second threshold here could only contradict it.
    options.min_num_matches = 1
    options.min_model_size = config.min_model_size
    options.multiple_models = config.multiple_models
    options.ba_refine_focal_length = options.ba_refine_extra_params = config.refine_intrinsics
    options.ba_refine_principal_point = config.refine_principal_point
    options.num_threads = num_threads or -1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    if limit := _max_runtime_seconds(config):
        options.max_runtime_seconds = limit
    if config.snapshot_every:
        snapshots = output.with_name("snapshots")
        snapshots.mkdir(parents=True, exist_ok=True)
        options.snapshot_path = snapshots
        options.snapshot_frames_freq = config.snapshot_every
    return options


def _run_mapper(
    database: Path,
    images_dir: Path,
    scratch: Path,
    *,
    config: ReconstructionConfig,
    options: pycolmap.IncrementalPipelineOptions,
    on_progress: Callable[[int], None],
) -> dict[int, pycolmap.Reconstruction]:
    if config.mapper is Mapper.INCREMENTAL:
        mapped = _map_incrementally(database, images_dir, scratch, options, on_progress)
        largest = _largest(mapped.values())
        if largest is None or is_plausible(largest) or not config.refine_intrinsics:
            return mapped
        logger.info("implausible focal lengths: mapping once more, with intrinsics held until the end")
        again = _map_with_held_intrinsics(database, images_dir, scratch, options, on_progress)
        return again if _explains_more(_largest(again.values()), largest) else mapped
    if config.mapper is Mapper.GLOBAL:
        general = pycolmap.GlobalPipelineOptions()
        general.min_num_matches = options.min_num_matches
        general.min_model_size = options.min_model_size
        general.multiple_models = options.multiple_models
        general.num_threads = general.mapper.num_threads = options.num_threads
        general.random_seed = general.mapper.random_seed = options.random_seed
        general.mapper.rotation_averaging.random_seed = options.random_seed
        general.mapper.global_positioning.random_seed = options.random_seed
        general.mapper.retriangulation.random_seed = options.random_seed
        adjustment = general.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = config.refine_intrinsics
        adjustment.refine_principal_point = config.refine_principal_point
        return _interruptible(pycolmap.global_mapping, database, images_dir, scratch, general)
    clusters = pycolmap.HierarchicalPipelineOptions()
    clusters.num_threads = options.num_threads
    clusters.incremental_options = options
    return _interruptible(pycolmap.hierarchical_mapping, database, images_dir, scratch, clusters)


def _map_incrementally(
    database: Path,
    images_dir: Path,
    scratch: Path,
    options: pycolmap.IncrementalPipelineOptions,
    on_progress: Callable[[int], None],
) -> dict[int, pycolmap.Reconstruction]:
    num_registered = 0

    def start() -> None:
        nonlocal num_registered
        num_registered = 2
        on_progress(num_registered)

    def grow() -> None:
        nonlocal num_registered
        num_registered += 1
        on_progress(num_registered)

    return pycolmap.incremental_mapping(
        database,
        images_dir,
        scratch,
        options,
        initial_image_pair_callback=start,
        next_image_callback=grow,
    )


def _map_with_held_intrinsics(
    database: Path,
    images_dir: Path,
    scratch: Path,
    options: pycolmap.IncrementalPipelineOptions,
    on_progress: Callable[[int], None],
) -> dict[int, pycolmap.Reconstruction]:
    """Map with focal lengths and distortion held, then refine them in the finished models."""
    held = copy.deepcopy(options)
    held.ba_refine_focal_length = held.ba_refine_extra_params = held.ba_refine_principal_point = False
    (scratch / "held").mkdir()
    mapped = _map_incrementally(database, images_dir, scratch / "held", held, on_progress)
    for model in mapped.values():
        refine_intrinsics(
            model,
            Refinement(principal_point=options.ba_refine_principal_point),
            num_threads=max(options.num_threads, 0),
        )
    return mapped


def _largest(models: Iterable[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return next(iter(_ranked(models, 0)), None)


def _explains_more(model: pycolmap.Reconstruction | None, other: pycolmap.Reconstruction) -> bool:
    """Whether a model registers more photos than another, or as many with more observations."""

    def size(one: pycolmap.Reconstruction) -> tuple[int, int]:
        return one.num_reg_images(), one.compute_num_observations()

    return model is not None and size(model) > size(other)


def _interruptible(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function that ignores Ctrl-C, and obey Ctrl-C all the same.

    After an interruption the call runs on in its thread until it ends or the process does; its result is
    dropped.
    """
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["result"] = function(*arguments)
        except BaseException as error:  # raised again in the thread of the caller
            outcome["error"] = error

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_POLL_SECONDS)
    if "error" in outcome:
        raise outcome["error"]
    return outcome["result"]


def _ranked(models: Iterable[pycolmap.Reconstruction], min_model_size: int) -> list[pycolmap.Reconstruction]:
    """The models to keep, the largest first; the first one is kept whatever its size.

    A model whose photos all lie in one larger model is a failed start at the same place and is dropped.
    """

    def rank(model: pycolmap.Reconstruction) -> tuple[int, int, str]:
        return -model.num_reg_images(), -model.num_points3D(), _first_name(model)

    usable = (model for model in models if model.num_reg_images() > 1 and has_possible_cameras(model))
    ranked = sorted(usable, key=rank)
    kept = ranked[:1]
    for model in ranked[1:]:
        # The mappers sometimes ignore their option of this name.
        large_enough = model.num_reg_images() >= min_model_size
        if large_enough and not any(_names(model) <= _names(larger) for larger in kept):
            kept.append(model)
    return kept


def _names(model: pycolmap.Reconstruction) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _first_name(model: pycolmap.Reconstruction) -> str:
    return min(image.name for image in model.images.values())
