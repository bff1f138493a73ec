"""Photos added to a finished model, which stays where it is.

Poses and cameras of the photos that the model holds are not touched, nor are its points; points gain
observations, and new ones appear where new photos see what no point stands for yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap
from corrsfm.colmap.log import colmap_log
from corrsfm.reconstruction.cache import load_cache
from corrsfm.reconstruction.calibration import adjust, refine
from corrsfm.reconstruction.resection import Landmarks, Resection, find_sightings, resect
from corrsfm.types import Pair

__all__ = ["Growth", "grow"]

# COLMAP's own limit for keeping an observation.
_MAX_ERROR_PX = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Growth:
    """A model with more photos.

    Attributes
    ----------
    model : pycolmap.Reconstruction
    registered : dict of str to Resection
        The photos that joined it, in the order of joining.
    failed : dict of str to Resection
        Those that did not, sorted by name; the last attempt.
    num_new_points : int
    """

    model: pycolmap.Reconstruction
    registered: dict[str, Resection]
    failed: dict[str, Resection] = field(default_factory=dict)
    num_new_points: int = 0


def grow(
    model: pycolmap.Reconstruction,
    photos: Sequence[str],
    database: Path,
    verified: Mapping[Pair, NDArray[np.int32]],
    *,
    known_focal: Mapping[str, bool],
    refinement: pycolmap.BundleAdjustmentOptions | None = None,
    seed: int = 0,
    num_threads: int = 1,
) -> Growth:
    """Register photos into a model, those with most sightings first, and triangulate what they see.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Its image ids are those of the database; a copy grows.
    photos : sequence of str
        Those that the model holds already are passed over.
    database : Path
        With the photos, their cameras and their verified pairs; not changed. A camera whose id the model has
        too is the model's.
    verified : mapping of Pair to (K, 2) int32
        Verified matches, as keypoint indices of the database.
    known_focal : mapping of str to bool
        Photo → whether its focal length is known and stays.
    refinement : pycolmap.BundleAdjustmentOptions, optional
        How to adjust the whole model at the end, so that everything may move.
    seed, num_threads : int

    Returns
    -------
    Growth
        With none of the photos registered, its model is as it was.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    grown = pycolmap.Reconstruction(model)
    wanted = sorted(set(photos) - set(Landmarks(grown).photos))
    matches = {name: _matches_of(name, verified) for name in wanted}
    num_points = grown.num_points3D()
    registered: dict[str, Resection] = {}
    failed: dict[str, Resection] = {}
    cache = load_cache(database, model)
    with colmap_log():
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(grown)
        try:
            while len(registered) < len(wanted):
                attempts = _attempts(grown, matches, registered, known_focal, seed)
                placed = {name: one for name, one in attempts.items() if one.pose is not None}
                if not placed:
                    failed = attempts
                    break
                name, best = max(placed.items(), key=lambda item: (item[1].num_inliers, item[0]))
                _place(grown, mapper, name, best, seed)
                registered[name] = best
            if registered:
                _settle(grown, mapper, registered, known_focal, num_threads)
                _complete(grown, mapper, registered, seed)
        finally:
            mapper.end_reconstruction(False)
    if refinement is not None and registered:
        refine(grown, refinement)
    grown.update_point_3d_errors()
    return Growth(
        model=grown,
        registered=registered,
        failed=dict(sorted(failed.items())),
        num_new_points=grown.num_points3D() - num_points,
    )


def _matches_of(photo: str, verified: Mapping[Pair, NDArray[np.int32]]) -> dict[str, NDArray[np.int32]]:
    """Other photo → (K, 2) matches, the keypoints of this photo first."""
    found = {}
    for (name0, name1), indices in verified.items():
        if photo == name0:
            found[name1] = indices
        elif photo == name1:
            found[name0] = indices[:, ::-1]
    return found


def _attempts(
    model: pycolmap.Reconstruction,
    matches: Mapping[str, Mapping[str, NDArray[np.int32]]],
    registered: Mapping[str, Resection],
    known_focal: Mapping[str, bool],
    seed: int,
) -> dict[str, Resection]:
    """The pose of every photo that is still to come, from the points there are now."""
    landmarks = Landmarks(model)
    attempts = {}
    for name in sorted(matches.keys() - registered.keys()):
        image = model.find_image_with_name(name)
        # COLMAP's cache leaves out photos without a single verified pair.
        keypoints = np.zeros((0, 2)) if image is None else np.array([point.xy for point in image.points2D])
        camera = next(iter(model.cameras.values())) if image is None else model.cameras[image.camera_id]
        attempts[name] = resect(
            keypoints.reshape(-1, 2),
            find_sightings({} if image is None else matches[name], landmarks),
            landmarks,
            camera_from_pycolmap(camera),
            focal_is_open=not known_focal[name] and not _is_in_use(model, camera.camera_id),
            seed=seed,
        )
    return attempts


def _is_in_use(model: pycolmap.Reconstruction, camera_id: int) -> bool:
    """Whether a registered photo has this camera."""
    return any(image.has_pose and image.camera_id == camera_id for image in model.images.values())


def _place(
    model: pycolmap.Reconstruction,
    mapper: pycolmap.IncrementalMapper,
    name: str,
    found: Resection,
    seed: int,
) -> None:
    """Register a photo with its pose and sightings, and triangulate what it sees with others."""
    assert found.pose is not None
    image = model.find_image_with_name(name)
    if not _is_in_use(model, image.camera_id):
        model.cameras[image.camera_id].params = found.camera.params
    rotation, translation = found.pose
    rigid = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, rigid)
    model.register_frame(image.frame_id)
    for keypoint, point_id in zip(found.sightings.keypoints, found.sightings.point_ids, strict=True):
        element = pycolmap.TrackElement(image.image_id, int(keypoint))
        mapper.observation_manager.add_observation(int(point_id), element)
    mapper.triangulate_image(_triangulation(seed), image.image_id)


def _triangulation(seed: int) -> pycolmap.IncrementalTriangulatorOptions:
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    return options


def _settle(
    model: pycolmap.Reconstruction,
    mapper: pycolmap.IncrementalMapper,
    registered: Mapping[str, Resection],
    known_focal: Mapping[str, bool],
    num_threads: int,
) -> None:
    """Refine the new photos against the model, and drop their observations that do not fit."""
    images = [model.find_image_with_name(name) for name in registered]
    new_ids = {image.image_id for image in images}
    problem = pycolmap.BundleAdjustmentConfig()
    for image in images:
        # A point that other photos see too is held by the adjuster, since they are not in the problem.
        problem.add_image(image.image_id)
        users = {i for i, one in model.images.items() if one.has_pose and one.camera_id == image.camera_id}
        if known_focal[image.name] or not users <= new_ids:
            problem.set_constant_cam_intrinsics(image.camera_id)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = False
    options.ceres.solver_options.num_threads = num_threads
    adjust(model, options, problem)
    for image in images:
        for index in image.get_observation_point2D_idxs():
            point = image.points2D[index]
            position = model.points3D[point.point3D_id].xyz
            projected = image.project_point(position)
            if projected is None or np.linalg.norm(projected - point.xy) > _MAX_ERROR_PX:
                mapper.observation_manager.delete_observation(image.image_id, index)


def _complete(
    model: pycolmap.Reconstruction,
    mapper: pycolmap.IncrementalMapper,
    registered: Mapping[str, Resection],
    seed: int,
) -> None:
    """Triangulate once more from the refined poses."""
    for name in registered:
        mapper.triangulate_image(_triangulation(seed), model.find_image_with_name(name).image_id)
