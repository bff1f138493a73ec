"""A bank of candidate models: the mappers, thresholds and cameras worth trying on one database.

No kind of candidate is best everywhere, and incremental mapping of a weak pair graph depends on its seed. So
candidates differ in as many ways as the mapper allows, and are tried in the order of what they brought on
training and validation scenes.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import Counter
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import pycolmap

from corrsfm.colmap.cameras import write_camera
from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.models import write_model
from corrsfm.colmap.sqlite import copy_database, database_errors
from corrsfm.errors import DatabaseError
from corrsfm.reconstruction.calibration import (
    DEFAULT_REFINEMENT,
    Refinement,
    has_possible_cameras,
    refine_intrinsics,
    restore_priors,
)

__all__ = [
    "Candidate",
    "MapperKind",
    "StartingCameras",
    "candidate_bank",
    "change_cameras",
    "find_cameras_on_trial",
    "has_unknown_focal_lengths",
    "incremental_options",
    "largest_possible",
    "map_candidate",
]

# What `relaxed` changes of COLMAP's defaults (100, 16°, 30, 0.25, 3): pairs of few matches and small
# baselines may start a model, and photos with few or doubtful matches may join.
_RELAXED = {
    "init_min_num_inliers": 30,
    "init_min_tri_angle": 8.0,
    "abs_pose_min_num_inliers": 15,
    "abs_pose_min_inlier_ratio": 0.1,
    "max_reg_trials": 5,
}


class MapperKind(StrEnum):
    """How a candidate is mapped."""

    INCREMENTAL = "incremental"
    RELAXED = "relaxed"
    """Incremental with thresholds that let more photos in."""
    HELD = "held"
    """Incremental with intrinsics held, and refined in the whole model."""
    GLOBAL = "global"


class StartingCameras(StrEnum):
    """Which cameras a candidate starts from."""

    AS_IS = "as-is"
    """Those of the database."""
    CALIBRATED = "calibrated"
    """Those of COLMAP's view graph calibration, which also computes the geometries of pairs again."""
    SEPARATE = "separate"
    """Those of the database, but a copy for each photo where several share one of unknown focal length."""
    SHARED = "shared"
    """Those of the database, but one for all photos of a size whose focal lengths are unknown."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One way of mapping a database.

    Attributes
    ----------
    mapper : MapperKind
    cameras : StartingCameras
    seed : int
        Equal candidates give equal models.
    """

    mapper: MapperKind
    cameras: StartingCameras = StartingCameras.AS_IS
    seed: int = 0

    @property
    def name(self) -> str:
        """Short and unique within a bank, fit for a folder: ``relaxed-separate-1``."""
        return f"{self.mapper}-{self.cameras}-{self.seed}"


def candidate_bank(
    *,
    seed: int,
    on_trial: StartingCameras | None,
    calibrate: bool,
    num_seeds: int = 3,
    refinement: Refinement = DEFAULT_REFINEMENT,
) -> list[Candidate]:
    """All candidates, in the order in which they are to be tried; the first model is not among them.

    Parameters
    ----------
    seed : int
        Of the first model; the others count up from it.
    on_trial : StartingCameras or None
        Other cameras to try as well, see `find_cameras_on_trial`.
    calibrate : bool
        Try calibrated cameras as well. Where focal lengths are known, by EXIF or the votes of pairs,
        calibration leaves them as they are, and its candidates would be the others once more.
    num_seeds : int
        How often each kind is tried.
    refinement : Refinement
        Where intrinsics are not to change, candidates that differ by them alone are left out.
    """
    sources = [StartingCameras.AS_IS]
    # By how near the best of its bank each kind came, on average; calibration is also slow.
    kinds = [MapperKind.GLOBAL, MapperKind.RELAXED, MapperKind.HELD, MapperKind.INCREMENTAL]
    if refinement.intrinsics:
        # Before the others confirm a model that only ever had a camera for each photo.
        if on_trial:
            sources.insert(0 if on_trial is StartingCameras.SHARED else 1, on_trial)
        if calibrate:
            sources.append(StartingCameras.CALIBRATED)
    else:
        kinds.remove(MapperKind.HELD)
    bank = [
        Candidate(mapper=kind, cameras=source, seed=seed + turn)
        for turn in range(num_seeds)
        for source in sources
        for kind in kinds
    ]
    first = Candidate(mapper=MapperKind.INCREMENTAL, seed=seed)
    return [candidate for candidate in bank if candidate != first]


def map_candidate(
    candidate: Candidate,
    database: Path,
    workdir: Path,
    *,
    refinement: Refinement = DEFAULT_REFINEMENT,
    num_threads: int = 1,
    max_runtime_seconds: int = 0,
) -> pycolmap.Reconstruction | None:
    """Map a candidate, or read it if an earlier run finished it; fit to be called in a process of its own.

    Parameters
    ----------
    candidate : Candidate
    database : Path
        With verified two-view geometries; not changed.
    workdir : Path
        Folder of this candidate alone. It keeps ``model/`` and ``candidate.json`` with the seconds it took;
        what an interrupted run left half finished is replaced.
    refinement : Refinement
    num_threads : int
        With 1 the model is a function of database and candidate; with more, only up to rounding.
    max_runtime_seconds : int
        Incremental mapping stops after so long; 0 for no limit.

    Returns
    -------
    pycolmap.Reconstruction or None
        The largest model; None if none came out.

    Raises
    ------
    DatabaseError
        If there is no such database or it cannot be read.
    """
    finished = workdir / "candidate.json"
    if finished.exists():
        if not (workdir / "model").is_dir():
            return None
        known = pycolmap.Reconstruction(workdir / "model")
        restore_priors(known, database)
        return known
    if not database.is_file():
        raise DatabaseError(f"{database}: no such database; try: corrsfm prune WORKSPACE")
    shutil.rmtree(workdir, ignore_errors=True)
    scratch = workdir / "mapper"
    scratch.mkdir(parents=True)
    started = time.monotonic()
    # A copy for this process: several that open one database at the same moment get in each other's way.
    own = workdir / "original.db"
    copy_database(database, own)
    with colmap_log(), database_errors(own, database):
        pycolmap.set_random_seed(candidate.seed)
        prepared = _prepare_database(candidate, own, workdir)
        models = {} if prepared is None else _map(
            candidate, prepared, scratch, refinement, num_threads, max_runtime_seconds
        )  # fmt: skip
        model = largest_possible(models.values())
        if model is not None and model.num_reg_images() > 1:
            restore_priors(model, own)
            write_model(model, workdir / "model")
        else:
            model = None
    shutil.rmtree(scratch)
    for name in ("database.db", "original.db"):
        (workdir / name).unlink(missing_ok=True)
    # Last: its presence says that the candidate is finished.
    finished.write_text(json.dumps({"name": candidate.name, "seconds": time.monotonic() - started}))
    return model


def largest_possible(models: Iterable[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    """The model of most photos, then points, among those whose cameras can be; None if there is none."""
    possible = [model for model in models if has_possible_cameras(model)]
    return max(possible, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _prepare_database(candidate: Candidate, database: Path, workdir: Path) -> Path | None:
    """The database with the candidate's cameras; None if they could not be had."""
    if candidate.cameras is StartingCameras.AS_IS:
        return database
    copy = workdir / "database.db"
    copy_database(database, copy)
    if candidate.cameras is StartingCameras.CALIBRATED:
        options = pycolmap.ViewGraphCalibrationOptions()
        options.random_seed = candidate.seed
        return copy if pycolmap.calibrate_view_graph(copy, options) else None
    change_cameras(copy, candidate.cameras)
    return copy


def find_cameras_on_trial(database: Path) -> StartingCameras | None:
    """The other way to give photos of unknown focal length their cameras, where nothing decided for one.

    Returns
    -------
    StartingCameras or None
        `SEPARATE` if some share a camera, else `SHARED` if some of one size have a camera each, else None.
    """
    with colmap_log(), database_errors(database), pycolmap.Database.open(database) as tables:
        cameras = {camera.camera_id: camera for camera in tables.read_all_cameras()}
        unknown = [
            cameras[image.camera_id]
            for image in tables.read_all_images()
            if not cameras[image.camera_id].has_prior_focal_length
        ]
    if _has_twice(camera.camera_id for camera in unknown):
        return StartingCameras.SEPARATE
    if _has_twice((camera.width, camera.height) for camera in unknown):
        return StartingCameras.SHARED
    return None


def has_unknown_focal_lengths(database: Path) -> bool:
    """Whether the focal length of any photo is but a guess."""
    with colmap_log(), database_errors(database), pycolmap.Database.open(database) as tables:
        known = {camera.camera_id: camera.has_prior_focal_length for camera in tables.read_all_cameras()}
        return any(not known[image.camera_id] for image in tables.read_all_images())


def _has_twice(values: Iterable[Hashable]) -> bool:
    return any(count > 1 for count in Counter(values).values())


def change_cameras(database: Path, to: StartingCameras) -> None:
    """Separate the cameras of photos in a database, or have photos share them; geometries of pairs stay.

    Parameters
    ----------
    database : Path
        Changed in place.
    to : StartingCameras
        `SEPARATE` or `SHARED`. Cameras of known focal length stay.
    """
    with pycolmap.Database.open(database) as tables:
        cameras = {camera.camera_id: camera for camera in tables.read_all_cameras()}
        frame_of = {data.id: frame for frame in tables.read_all_frames() for data in frame.image_ids}
        first_of_size: dict[tuple[int, int], int] = {}
        taken: set[int] = set()
        for image in sorted(tables.read_all_images(), key=lambda image: image.image_id):
            camera = cameras[image.camera_id]
            if camera.has_prior_focal_length:
                continue
            if to is StartingCameras.SHARED:
                camera_id = first_of_size.setdefault((camera.width, camera.height), camera.camera_id)
            else:
                camera_id = (
                    camera.camera_id if camera.camera_id not in taken else write_camera(tables, camera)
                )
                taken.add(camera_id)
            if camera_id == image.camera_id:
                continue
            image.camera_id = camera_id
            # The rig around a camera has its id, see `write_camera`.
            frame = pycolmap.Frame(frame_id=frame_of[image.image_id].frame_id, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            tables.update_frame(frame)
            tables.update_image(image)


def _map(
    candidate: Candidate,
    database: Path,
    scratch: Path,
    refinement: Refinement,
    num_threads: int,
    max_runtime_seconds: int,
) -> dict[int, pycolmap.Reconstruction]:
    # pycolmap insists on a folder of photos even if it reads none; colours come after the choice.
    if candidate.mapper is MapperKind.GLOBAL:
        return pycolmap.global_mapping(
            database, scratch, scratch, _global_options(candidate.seed, refinement, num_threads)
        )
    options = incremental_options(candidate, refinement, num_threads)
    if max_runtime_seconds:
        options.max_runtime_seconds = max_runtime_seconds
    models = pycolmap.incremental_mapping(database, scratch, scratch, options)
    if candidate.mapper is MapperKind.HELD:
        for model in models.values():
            refine_intrinsics(model, refinement, num_threads=num_threads)
    return models


def incremental_options(
    candidate: Candidate, refinement: Refinement, num_threads: int
) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's options for an incremental kind of candidate."""
    options = pycolmap.IncrementalPipelineOptions()
    # Verification has decided which pairs are good; a second threshold here could only contradict it.
    options.min_num_matches = 1
    options.min_model_size = 3
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = refinement.intrinsics
    options.ba_refine_principal_point = refinement.principal_point
    options.num_threads = options.mapper.num_threads = num_threads
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = candidate.seed
    if candidate.mapper is MapperKind.HELD:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.ba_refine_principal_point = False
    if candidate.mapper is MapperKind.RELAXED:
        for name, value in _RELAXED.items():
            setattr(options.mapper, name, value)
    return options


def _global_options(seed: int, refinement: Refinement, num_threads: int) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions()
    options.min_num_matches = 1
    options.num_threads = options.mapper.num_threads = num_threads
    options.random_seed = options.mapper.random_seed = seed
    options.mapper.rotation_averaging.random_seed = seed
    options.mapper.global_positioning.random_seed = seed
    options.mapper.retriangulation.random_seed = seed
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = refinement.intrinsics
    adjustment.refine_principal_point = refinement.principal_point
    return options
