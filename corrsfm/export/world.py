"""The world of a model before it is exported: turned upright, brought to scale, freed of stray points."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

from corrsfm.colmap.models import poses_of
from corrsfm.errors import InputError, first_few
from corrsfm.geometry import Pose, camera_centre

__all__ = ["common_up", "crop_to_bulk", "held_upright", "scale_of", "similarity", "turn_to_z"]

# Mean length of the cameras' up axes; below it they point everywhere.
_LEAST_AGREEMENT = 0.5
# From a grain of dust to the way to the moon: coordinates stay numbers of single precision.
NEAREST_M, FARTHEST_M = 1e-6, 1e9
# Mean square of the horizontal axes along the second direction: about 8 degrees of turning.
_LEAST_TURNING = 0.02
# Outer share of the points on each side of an axis that does not count as bulk.
_OUTER_SHARE = 0.05


def similarity(rotation: ArrayLike, scale: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> pycolmap.Sim3d:
    """The similarity x ↦ scale · rotation · x + translation."""
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(np.asarray(rotation)), np.asarray(translation))


# EXIF orientation → axes right, down and forward of the photo as shown, in those of the photo as stored.
_SHOWN_FROM_STORED = {
    3: np.diag([-1.0, -1.0, 1.0]),
    6: np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    8: np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}


def held_upright(pose: Pose, orientation: int) -> Pose:
    """The pose of a camera turned as EXIF says the photo is to be shown; mirrored photos stay as they are."""
    turn = _SHOWN_FROM_STORED.get(orientation, np.eye(3))
    return turn @ pose[0], turn @ pose[1]


def common_up(poses: Iterable[Pose]) -> NDArray[np.float64]:
    """Direction that is up for most cameras.

    Photographers hold cameras level but tilt them: the horizontal axes of the cameras lie in the ground plane
    even where all of them look down. Where the cameras hardly turn, these axes leave a direction open, which
    the mean of the vertical axes settles.

    Parameters
    ----------
    poses : iterable of Pose
        ``cam_from_world``.

    Returns
    -------
    (3,) float64
        Of unit length, in the world.

    Raises
    ------
    InputError
        If the cameras have no common up, as when some photos are upright and some lie on their side.
    """
    rotations = np.array([rotation for rotation, _ in poses])
    mean_up = -rotations[:, 1].mean(axis=0)
    if np.linalg.norm(mean_up) < _LEAST_AGREEMENT:
        raise InputError(
            "--upright: the photos have no common up; some lie on their side or look straight up or down. "
            "Export without it and turn the scene in the next tool"
        )
    horizontal = rotations[:, 0]
    values, axes = np.linalg.eigh(horizontal.T @ horizontal / len(horizontal))
    num_spread = int((values >= _LEAST_TURNING).sum())
    level = axes[:, : max(1, 3 - num_spread)]
    up = level @ (level.T @ mean_up)
    return up / np.linalg.norm(up)


def turn_to_z(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest rotation (3, 3) that turns a unit vector to +z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis), up[2]
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    x, y, z = axis / sine
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def scale_of(model: pycolmap.Reconstruction, photo0: str, photo1: str, metres: float) -> float:
    """The factor that brings two photos to a known distance.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    photo0, photo1 : str
    metres : float
        The true distance of their centres.

    Raises
    ------
    InputError
        If a photo is not in the model, the two are one, or the distance is not possible.
    """
    poses = poses_of(model)
    missing = [name for name in (photo0, photo1) if name not in poses]
    if missing:
        raise InputError(f"--scale: not in the model: {first_few(missing)}; it has {first_few(poses)}")
    if not NEAREST_M <= metres <= FARTHEST_M:
        raise InputError(
            f"--scale: a distance of {metres:g} m; expected one from {NEAREST_M:g} to {FARTHEST_M:g} m"
        )
    distance = np.linalg.norm(camera_centre(poses[photo0]) - camera_centre(poses[photo1]))
    extent = np.ptp([camera_centre(pose) for pose in poses.values()], axis=0).max()
    if distance <= 1e-6 * extent or distance == 0:
        raise InputError(
            f"--scale: {photo0} and {photo1} were taken at one place; choose two photos far apart"
        )
    return float(metres / distance)


def crop_to_bulk(model: pycolmap.Reconstruction) -> int:
    """Drop points outside twice the box that holds the middle 90 % of the points along each axis.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Changed in place.

    Returns
    -------
    int
        Number of points dropped.
    """
    ids = list(model.points3D)
    if not ids:
        return 0
    positions = np.array([model.points3D[point_id].xyz for point_id in ids])
    low, high = np.quantile(positions, [_OUTER_SHARE, 1.0 - _OUTER_SHARE], axis=0)
    margin = (high - low) / 2
    outside = ((positions < low - margin) | (positions > high + margin)).any(axis=1)
    for i in np.flatnonzero(outside):
        model.delete_point3D(ids[i])
    return int(outside.sum())
