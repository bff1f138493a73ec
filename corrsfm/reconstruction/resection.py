"""The pose of a photo that a finished model does not hold, from the points of the model.

A match with a photo of the model leads to the point that the other photo's keypoint belongs to. From enough
such pairs of keypoint and point the pose follows, and where it is open the focal length.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap, to_pycolmap
from corrsfm.geometry import Pose
from corrsfm.types import Camera

__all__ = [
    "Landmarks",
    "Resection",
    "Sightings",
    "camera_in_model",
    "find_sightings",
    "focal_of_photos",
    "resect",
]

# Photos of other scenes reach 6: 85 photos of five training and validation scenes in a model of kermit.
FEWEST_INLIERS = 15
_FEWEST_TO_TRY = 4
# Of the longest side: COLMAP's 12 px suit photos of 3,000 px.
_MAX_ERROR_SHARE, _LEAST_ERROR_PX, _MOST_ERROR_PX = 0.004, 3.0, 12.0
_SMALLEST_FOCAL_RATIO, _LARGEST_FOCAL_RATIO = 0.2, 10.0


class Landmarks:
    """The points of a model by the keypoints that see them.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Not changed.
    """

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self._model = model
        self._of_keypoints: dict[str, NDArray[np.int64]] = {}

    @cached_property
    def photos(self) -> tuple[str, ...]:
        """Registered photos, sorted."""
        return tuple(sorted(image.name for image in self._model.images.values() if image.has_pose))

    def of_keypoints(self, photo: str) -> NDArray[np.int64]:
        """(N,) the point that each keypoint of a registered photo sees, -1 for none."""
        if photo not in self._of_keypoints:
            image = self._model.find_image_with_name(photo)
            self._of_keypoints[photo] = np.array(
                [point.point3D_id if point.has_point3D() else -1 for point in image.points2D], np.int64
            )
        return self._of_keypoints[photo]

    def positions(self, point_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """(P, 3) where points are, in the frame and units of the model."""
        return np.array([self._model.points3D[int(i)].xyz for i in point_ids]).reshape(-1, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sightings:
    """Keypoints of a photo and the points that they may see; a keypoint may have several.

    Attributes
    ----------
    keypoints : (C,) int32
    point_ids : (C,) int64
    num_matches : int
        Matches with photos of the model, whether or not they lead to a point.
    """

    keypoints: NDArray[np.int32]
    point_ids: NDArray[np.int64]
    num_matches: int

    def __len__(self) -> int:
        return len(self.keypoints)


def find_sightings(matches: Mapping[str, NDArray[np.integer]], landmarks: Landmarks) -> Sightings:
    """The points that matches with photos of a model lead to.

    Parameters
    ----------
    matches : mapping of str to (K, 2) int
        Photo → keypoint indices in the new photo and in that one; photos that are not registered are ignored.
    landmarks : Landmarks

    Returns
    -------
    Sightings
        Each pair of keypoint and point once.
    """
    found = [np.zeros((0, 2), np.int64)]
    num_matches = 0
    for name in sorted(matches.keys() & set(landmarks.photos)):
        pairs = np.asarray(matches[name], np.int64).reshape(-1, 2)
        num_matches += len(pairs)
        point_ids = landmarks.of_keypoints(name)[pairs[:, 1]]
        found.append(np.column_stack([pairs[:, 0], point_ids])[point_ids >= 0])
    unique = np.unique(np.concatenate(found), axis=0)
    return Sightings(keypoints=unique[:, 0].astype(np.int32), point_ids=unique[:, 1], num_matches=num_matches)


@dataclass(frozen=True, kw_only=True, eq=False)
class Resection:
    """What came of the search for a pose.

    Attributes
    ----------
    pose : Pose or None
        ``cam_from_world`` in the frame and units of the model; None if none is trustworthy.
    camera : Camera
        With the focal length that was found, if it was open.
    sightings : Sightings
        Those that agree with the pose, each keypoint once; if there is no pose those of the best attempt.
    num_candidates : int
        Pairs of keypoint and point that it was sought among.
    num_matches : int
    median_error_px : float
        Reprojection error of the sightings that agree; NaN without any.
    """

    pose: Pose | None
    camera: Camera
    sightings: Sightings
    num_candidates: int
    num_matches: int
    median_error_px: float

    @property
    def num_inliers(self) -> int:
        """Number of sightings that agree."""
        return len(self.sightings)

    @property
    def why_not(self) -> str:
        """Why there is no pose, a clause with its numbers; empty if there is one."""
        if self.pose is not None:
            return ""
        if not self.num_matches:
            return "no match with any photo of the model"
        if self.num_candidates < FEWEST_INLIERS:
            return (
                f"its {self.num_matches} matches lead to {self.num_candidates} points of the model, "
                f"{FEWEST_INLIERS} are needed"
            )
        if self.num_inliers >= FEWEST_INLIERS:
            return (
                f"{self.num_inliers} of {self.num_candidates} points of the model agree with one pose, but "
                "of a focal length that no camera has"
            )
        return (
            f"{self.num_inliers} of {self.num_candidates} points of the model agree with one pose, "
            f"{FEWEST_INLIERS} are needed"
        )


def resect(
    keypoints: NDArray[np.floating],
    sightings: Sightings,
    landmarks: Landmarks,
    camera: Camera,
    *,
    focal_is_open: bool,
    seed: int = 0,
) -> Resection:
    """Find the pose of a photo by RANSAC over its sightings, and refine it.

    Parameters
    ----------
    keypoints : (N, 2) float
        Pixels, COLMAP convention.
    sightings : Sightings
    landmarks : Landmarks
    camera : Camera
    focal_is_open : bool
        Estimate the focal length too; the camera's own is where the search starts.
    seed : int

    Returns
    -------
    Resection
    """
    longest = max(camera.width, camera.height)
    max_error_px = float(np.clip(_MAX_ERROR_SHARE * longest, _LEAST_ERROR_PX, _MOST_ERROR_PX))
    refined = to_pycolmap(camera)
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = focal_is_open
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = focal_is_open
    pixels = np.asarray(keypoints, np.float64)[sightings.keypoints]
    positions = landmarks.positions(sightings.point_ids)
    found = None
    if len(sightings) >= _FEWEST_TO_TRY:
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, positions, refined, estimation, refinement)
    agreeing, errors, pose = np.zeros(0, np.int64), np.zeros(0), None
    if found is not None:
        rigid = found["cam_from_world"]
        errors = _errors_px(refined, rigid * positions, pixels)
        agreeing = _one_to_one(sightings, errors, max_error_px)
        ratio = refined.mean_focal_length() / longest
        if len(agreeing) >= FEWEST_INLIERS and _SMALLEST_FOCAL_RATIO <= ratio <= _LARGEST_FOCAL_RATIO:
            pose = (
                np.asarray(rigid.rotation.matrix(), np.float64),
                np.asarray(rigid.translation, np.float64),
            )
    return Resection(
        pose=pose,
        camera=camera_from_pycolmap(refined) if pose is not None else camera,
        sightings=Sightings(
            keypoints=sightings.keypoints[agreeing],
            point_ids=sightings.point_ids[agreeing],
            num_matches=sightings.num_matches,
        ),
        num_candidates=len(np.unique(sightings.point_ids)),
        num_matches=sightings.num_matches,
        median_error_px=float(np.median(errors[agreeing])) if len(agreeing) else float("nan"),
    )


def _errors_px(
    camera: pycolmap.Camera, in_camera: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(C,) reprojection errors in pixels; infinite behind the camera."""
    errors = np.full(len(pixels), np.inf)
    front = in_camera[:, 2] > 0
    if front.any():
        projected = np.asarray(camera.img_from_cam(in_camera[front]), np.float64)
        errors[front] = np.linalg.norm(projected - pixels[front], axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)


def _one_to_one(sightings: Sightings, errors: NDArray[np.float64], max_error_px: float) -> NDArray[np.int64]:
    """Indices of the sightings within an error: of each keypoint and of each point the best one."""
    taken_keypoints: set[int] = set()
    taken_points: set[int] = set()
    chosen = []
    for index in np.argsort(errors, kind="stable"):
        keypoint, point = int(sightings.keypoints[index]), int(sightings.point_ids[index])
        if errors[index] > max_error_px:
            break
        if keypoint not in taken_keypoints and point not in taken_points:
            taken_keypoints.add(keypoint)
            taken_points.add(point)
            chosen.append(index)
    return np.sort(np.array(chosen, np.int64))


def camera_in_model(model: pycolmap.Reconstruction, photos: list[str]) -> int | None:
    """The id of the one camera that all these photos have in a model; None if they have several or none.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    photos : list of str
        Those that are not registered are passed over.
    """
    wanted = set(photos)
    ids = {image.camera_id for image in model.images.values() if image.has_pose and image.name in wanted}
    return ids.pop() if len(ids) == 1 else None


def focal_of_photos(model: pycolmap.Reconstruction, photos: list[str]) -> float | None:
    """Median focal length in pixels of these photos in a model; None if it holds none of them."""
    wanted = set(photos)
    focals = [
        image.camera.mean_focal_length()
        for image in model.images.values()
        if image.has_pose and image.name in wanted
    ]
    return float(np.median(focals)) if focals else None
