"""A bank of candidate models: the mappers, thresholds and focal lengths worth trying on one database.

No kind of candidate is best everywhere, and incremental mapping of a weak pair graph depends on its seed. So
candidates differ in as many ways as the mapper allows, and are tried in the order of what they brought on
training and validation scenes.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import pycolmap

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.sqlite import copy_database, database_errors
from corrsfm.errors import DatabaseError
from corrsfm.reconstruction.calibration import refine_intrinsics

__all__ = [
    "Candidate",
    "FocalLengths",
    "MapperKind",
    "candidate_bank",
    "incremental_options",
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


class FocalLengths(StrEnum):
    """Which focal lengths a candidate starts from."""

    AS_IS = "as-is"
    """Those of the database."""
    CALIBRATED = "calibrated"
    """Those of COLMAP's view graph calibration, which also computes the geometries of pairs again."""
    GIVEN = "given"
    """Those handed in, such as the plain guess where votes have set another."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One way of mapping a database.

    Attributes
    ----------
    mapper : MapperKind
    focal_lengths : FocalLengths
    seed : int
        Equal candidates give equal models.
    """

    mapper: MapperKind
    focal_lengths: FocalLengths = FocalLengths.AS_IS
    seed: int = 0

    @property
    def name(self) -> str:
        """Short and unique within a bank, fit for a folder: ``relaxed-given-1``."""
        return f"{self.mapper}-{self.focal_lengths}-{self.seed}"


def candidate_bank(*, seed: int, have_given: bool, num_seeds: int = 3) -> list[Candidate]:
    """All candidates, in the order in which they are to be tried; the first model is not among them.

    Parameters
    ----------
    seed : int
        Of the first model; the others count up from it.
    have_given : bool
        Whether focal lengths are handed in to try as well.
    num_seeds : int
        How often each incremental kind is tried.
    """
    sources = [FocalLengths.AS_IS, FocalLengths.CALIBRATED]
    sources += [FocalLengths.GIVEN] if have_given else []
    # By how near the best of its bank each kind came, on average; calibration is also slow.
    kinds = [MapperKind.GLOBAL, MapperKind.RELAXED, MapperKind.HELD, MapperKind.INCREMENTAL]
    bank = [
        Candidate(mapper=kind, focal_lengths=source, seed=seed + turn)
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
    focal_lengths_px: Mapping[int, float] | None = None,
    refine_principal_point: bool = False,
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
    focal_lengths_px : mapping of int to float, optional
        COLMAP's camera id → focal length, for `FocalLengths.GIVEN`; other cameras stay as they are.
    refine_principal_point : bool
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
        return pycolmap.Reconstruction(workdir / "model") if (workdir / "model").is_dir() else None
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
        prepared = _prepare_database(candidate, own, workdir, focal_lengths_px or {})
        models = {} if prepared is None else _map(
            candidate, prepared, scratch, refine_principal_point, num_threads, max_runtime_seconds
        )  # fmt: skip
        model = max(models.values(), key=lambda one: (one.num_reg_images(), one.num_points3D()), default=None)
        if model is not None and model.num_reg_images() > 1:
            _restore_priors(model, own)
            (workdir / "model").mkdir()
            model.write_binary(workdir / "model")
        else:
            model = None
    shutil.rmtree(scratch)
    for name in ("database.db", "original.db"):
        (workdir / name).unlink(missing_ok=True)
    # Last: its presence says that the candidate is finished.
    finished.write_text(json.dumps({"name": candidate.name, "seconds": time.monotonic() - started}))
    return model


def _prepare_database(
    candidate: Candidate, database: Path, workdir: Path, focal_lengths_px: Mapping[int, float]
) -> Path | None:
    """The database with the candidate's focal lengths; None if they could not be had."""
    if candidate.focal_lengths is FocalLengths.AS_IS:
        return database
    copy = workdir / "database.db"
    copy_database(database, copy)
    if candidate.focal_lengths is FocalLengths.CALIBRATED:
        options = pycolmap.ViewGraphCalibrationOptions()
        options.random_seed = candidate.seed
        return copy if pycolmap.calibrate_view_graph(copy, options) else None
    with pycolmap.Database.open(copy) as tables:
        for camera in tables.read_all_cameras():
            if camera.camera_id in focal_lengths_px:
                for index in camera.focal_length_idxs():
                    camera.params[index] = focal_lengths_px[camera.camera_id]
                # Otherwise the first photo of a camera is tried with other focal lengths, too.
                camera.has_prior_focal_length = True
                tables.update_camera(camera)
    return copy


def _restore_priors(model: pycolmap.Reconstruction, database: Path) -> None:
    """Give cameras back what is known about their focal length; what a candidate tried is not EXIF."""
    with pycolmap.Database.open(database) as tables:
        has_prior = {camera.camera_id: camera.has_prior_focal_length for camera in tables.read_all_cameras()}
    for camera_id, camera in model.cameras.items():
        camera.has_prior_focal_length = has_prior[camera_id]


def _map(
    candidate: Candidate,
    database: Path,
    scratch: Path,
    refine_principal_point: bool,
    num_threads: int,
    max_runtime_seconds: int,
) -> dict[int, pycolmap.Reconstruction]:
    # pycolmap insists on a folder of photos even if it reads none; colours come after the choice.
    if candidate.mapper is MapperKind.GLOBAL:
        return pycolmap.global_mapping(
            database, scratch, scratch, _global_options(candidate.seed, refine_principal_point, num_threads)
        )
    options = incremental_options(candidate, refine_principal_point, num_threads)
    if max_runtime_seconds:
        options.max_runtime_seconds = max_runtime_seconds
    models = pycolmap.incremental_mapping(database, scratch, scratch, options)
    if candidate.mapper is MapperKind.HELD:
        for model in models.values():
            refine_intrinsics(model, refine_principal_point=refine_principal_point, num_threads=num_threads)
    return models


def incremental_options(
    candidate: Candidate, refine_principal_point: bool, num_threads: int
) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's options for an incremental kind of candidate."""
    options = pycolmap.IncrementalPipelineOptions()
    # Verification has decided which pairs are good; a second threshold here could only contradict it.
    options.min_num_matches = 1
    options.min_model_size = 3
    options.extract_colors = False
    options.ba_refine_principal_point = refine_principal_point
    options.num_threads = options.mapper.num_threads = num_threads
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = candidate.seed
    if candidate.mapper is MapperKind.HELD:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.ba_refine_principal_point = False
    if candidate.mapper is MapperKind.RELAXED:
        for name, value in _RELAXED.items():
            setattr(options.mapper, name, value)
    return options


def _global_options(
    seed: int, refine_principal_point: bool, num_threads: int
) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions()
    options.min_num_matches = 1
    options.num_threads = options.mapper.num_threads = num_threads
    options.random_seed = options.mapper.random_seed = seed
    options.mapper.rotation_averaging.random_seed = seed
    options.mapper.global_positioning.random_seed = seed
    options.mapper.retriangulation.random_seed = seed
    options.mapper.bundle_adjustment.refine_principal_point = refine_principal_point
    return options
