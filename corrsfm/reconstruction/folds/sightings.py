"""What the photos of a model see of its points, and how much of a verified pair a model explains."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap
from corrsfm.reconstruction.explained import MAX_DISTANCE_PX, explain
from corrsfm.reconstruction.views import View
from corrsfm.types import Pair

__all__ = ["PhotoSightings", "Sightings", "explained_shares", "read_sightings"]


@dataclass(frozen=True, kw_only=True)
class PhotoSightings:
    """One registered photo and the points it observes.

    Attributes
    ----------
    name : str
    camera : pycolmap.Camera
    cam_from_world : (3, 4) float64
    centre : (3,) float64
        In the world frame.
    keypoints_px : (N, 2) float64
        All keypoints of the photo, COLMAP's pixel convention.
    point_rows : (M,) int64
        Rows of `Sightings.positions` that the photo observes, ascending, each once.
    keypoint_rows : (M,) int64
        The keypoint that observes each of them.
    """

    name: str
    camera: pycolmap.Camera
    cam_from_world: NDArray[np.float64]
    centre: NDArray[np.float64]
    keypoints_px: NDArray[np.float64]
    point_rows: NDArray[np.int64]
    keypoint_rows: NDArray[np.int64]

    @property
    def placed(self) -> View:
        """The photo's camera and pose alone."""
        return View(
            camera=camera_from_pycolmap(self.camera),
            rotation=self.cam_from_world[:, :3],
            translation=self.cam_from_world[:, 3],
        )

    def project(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where (M, 3) points of the world frame appear, (M, 2) float64 px; NaN behind the camera."""
        in_camera = positions @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3]
        projected = np.full((len(positions), 2), np.nan)
        front = in_camera[:, 2] > 0
        if front.any():
            projected[front] = self.camera.img_from_cam(in_camera[front])
        return projected


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """The registered photos of a model, sorted by name, and its well-held points.

    Attributes
    ----------
    views : tuple of PhotoSightings
    positions : (P, 3) float64
        Points of the world frame with tracks of the asked length or longer.
    """

    views: tuple[PhotoSightings, ...]
    positions: NDArray[np.float64]


def read_sightings(
    model: pycolmap.Reconstruction, *, min_track_length: int = 3, max_points_per_photo: int = 3000
) -> Sightings:
    """Take from a model what fold evidence needs.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    min_track_length : int
        Points seen by fewer photos are left out: a point of two photos cannot be missed by a third.
    max_points_per_photo : int
        Of photos with more points, an even sample is taken; bounds time and memory.
    """
    long_ids = np.array(
        sorted(one for one, point in model.points3D.items() if point.track.length() >= min_track_length),
        np.uint64,
    )
    positions = np.array([model.points3D[int(one)].xyz for one in long_ids]).reshape(-1, 3)
    registered = sorted((image for image in model.images.values() if image.has_pose), key=lambda i: i.name)
    return Sightings(
        views=tuple(_view(image, long_ids, max_points_per_photo) for image in registered),
        positions=positions,
    )


def _view(image: pycolmap.Image, long_ids: NDArray[np.uint64], max_points: int) -> PhotoSightings:
    keypoint_rows = np.array(image.get_observation_point2D_idxs(), np.int64)
    seen = np.array([point.point3D_id for point in image.get_observation_points2D()], np.uint64)
    is_long = np.isin(seen, long_ids)
    # A track may hold two keypoints of one photo; the first one stands for it.
    point_rows, first = np.unique(np.searchsorted(long_ids, seen[is_long]), return_index=True)
    if len(point_rows) > max_points:
        sample = np.linspace(0, len(point_rows) - 1, max_points).round().astype(np.int64)
        point_rows, first = point_rows[sample], first[sample]
    cam_from_world = image.cam_from_world()
    return PhotoSightings(
        name=image.name,
        camera=_camera(image),
        cam_from_world=cam_from_world.matrix(),
        centre=cam_from_world.inverse().translation,
        keypoints_px=np.array([point.xy for point in image.points2D]).reshape(-1, 2),
        point_rows=point_rows.astype(np.int64),
        keypoint_rows=keypoint_rows[is_long][first],
    )


def _camera(image: pycolmap.Image) -> pycolmap.Camera:
    if image.camera is None:
        raise ValueError(f"{image.name}: its camera is not part of the model")
    # The model's own camera is gone when the model is.
    return copy.deepcopy(image.camera)


def explained_shares(
    sightings: Sightings,
    verified: Mapping[Pair, NDArray[np.int32]],
    *,
    max_error_px: float = MAX_DISTANCE_PX,
) -> dict[Pair, float]:
    """Share of each verified pair's matches that the poses of a model agree with.

    A match is explained if its Sampson distance is below the bound and the point it makes lies in front of
    both cameras. Pairs of which a photo is not registered are left out.

    Returns
    -------
    dict of Pair to float
        In the order of ``verified``; 0 for a pair whose cameras stand in exactly one place, where no match
        has a depth.
    """
    views = {view.name: view.placed for view in sightings.views}
    keypoints = {view.name: view.keypoints_px for view in sightings.views}
    registered = {
        pair: matches
        for pair, matches in verified.items()
        if len(matches) and pair[0] in views and pair[1] in views
    }
    explained = explain(views, keypoints, registered, max_distance_px=max_error_px)
    shares = {(pair.name0, pair.name1): pair.share for pair in explained.pairs}
    return {pair: shares[pair] for pair in registered}
