"""Photos in the wrong place: taken out of a model and registered again.

A mapper that once put a photo in the wrong place keeps it there, and bends its neighbours. Without it the
rest settles, and the photo mostly finds its place, or stays out.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path

import pycolmap

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.models import write_model
from corrsfm.colmap.sqlite import copy_database, database_errors
from corrsfm.reconstruction.calibration import DEFAULT_REFINEMENT, Refinement, restore_priors
from corrsfm.reconstruction.candidates import (
    Candidate,
    MapperKind,
    StartingCameras,
    change_cameras,
    incremental_options,
    largest_possible,
)

__all__ = ["register_again", "without_photos"]


def without_photos(model: pycolmap.Reconstruction, names: Collection[str]) -> pycolmap.Reconstruction:
    """A copy of a model without the poses of some photos, and without what only they see."""
    rest = pycolmap.Reconstruction(model)
    for image in list(rest.images.values()):
        if image.has_pose and image.name in names:
            rest.deregister_frame(image.frame_id)
    return rest


def register_again(
    model: pycolmap.Reconstruction,
    names: Collection[str],
    database: Path,
    workdir: Path,
    *,
    cameras: StartingCameras = StartingCameras.AS_IS,
    seed: int = 0,
    refinement: Refinement = DEFAULT_REFINEMENT,
    num_threads: int = 1,
    max_runtime_seconds: int = 0,
) -> pycolmap.Reconstruction | None:
    """Take photos out of a model, and go on mapping from there with lenient thresholds.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Not changed.
    names : collection of str
        Photos to take out, such as `Explained.misplaced`.
    database : Path
        The verified matches that the model was made from; not changed.
    workdir : Path
        Made, and removed at the end.
    cameras : StartingCameras
        What the model was mapped with in place of the cameras of the database.
    seed : int
    refinement : Refinement
    num_threads : int
        With 1 equal arguments give equal models.
    max_runtime_seconds : int
        Mapping stops after so long, once the photo at hand is done with; 0 for no limit. A photo that no
        points hold yet, only pairs, can take a minute.

    Returns
    -------
    pycolmap.Reconstruction or None
        With all photos that could be registered; None if fewer than two would be left to start from, or
        mapping lost photos that were not to be taken out or gave a camera that cannot be.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    rest = without_photos(model, names)
    if rest.num_reg_images() < 2:
        return None
    original = database
    # What a kill has left of an earlier attempt.
    shutil.rmtree(workdir, ignore_errors=True)
    given, found = workdir / "given", workdir / "found"
    for folder in (given, found):
        folder.mkdir(parents=True)
    write_model(rest, given)
    if cameras in (StartingCameras.SHARED, StartingCameras.SEPARATE):
        # Those of the model, else pycolmap refuses it.
        copy = workdir / "database.db"
        copy_database(database, copy)
        change_cameras(copy, cameras)
        database = copy
    candidate = Candidate(mapper=MapperKind.RELAXED, seed=seed)
    options = incremental_options(candidate, refinement, num_threads)
    if max_runtime_seconds:
        options.max_runtime_seconds = max_runtime_seconds
    with colmap_log(), database_errors(database):
        pycolmap.set_random_seed(seed)
        models = pycolmap.incremental_mapping(database, workdir, found, options, input_path=given)
    shutil.rmtree(workdir)
    again = largest_possible(models.values())
    kept = {image.name for image in rest.images.values() if image.has_pose}
    if again is None or not kept <= {image.name for image in again.images.values() if image.has_pose}:
        return None
    restore_priors(again, original)
    return again
