"""Two-view geometry in plain numpy.

Conventions are those of `corrsfm.types`: normalised coordinates, ``x1ᵀ E x0 = 0``,
``x_in_cam1 = R · x_in_cam0 + t``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "INLIER_THRESHOLD",
    "Pose",
    "angle_between_deg",
    "camera_centre",
    "cross_matrix",
    "earth_fixed",
    "essential_from_pose",
    "pose_error_deg",
    "relative_pose",
    "rotation_angle_deg",
    "symmetric_epipolar_distance_sq",
    "wrap_angles",
]

INLIER_THRESHOLD = 1e-4
"""Squared symmetric epipolar distance below which a match is an inlier, in normalised coordinates.

The pruning literature labels matches with it and scores methods by it, from Yi et al., "Learning to Find Good
Correspondences" (CVPR 2018) on. At a focal length of 1000 px such a match is about 7 px off each line.
"""

# Semi-axes of the WGS84 ellipsoid.
_EQUATOR_M, _POLE_M = 6378137.0, 6356752.314245

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rotation (3, 3) and translation (3,) of ``cam_from_world``."""


def camera_centre(pose: Pose) -> NDArray[np.float64]:
    """Centre (3,) of a camera in the world, from its ``cam_from_world``."""
    rotation, translation = pose
    return -rotation.T @ translation


def cross_matrix(vector: ArrayLike) -> NDArray[np.float64]:
    """Matrix ``[v]×`` with ``[v]× w = v × w``."""
    x, y, z = np.asarray(vector, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def relative_pose(
    rotation0: ArrayLike, translation0: ArrayLike, rotation1: ArrayLike, translation1: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pose ``cam1_from_cam0`` from two ``cam_from_world`` poses.

    Parameters
    ----------
    rotation0, rotation1 : (3, 3) array_like
    translation0, translation1 : (3,) array_like

    Returns
    -------
    rotation : (3, 3) float64
    translation : (3,) float64
        In the units of the world, not normalised.
    """
    rotation = np.asarray(rotation1, np.float64) @ np.asarray(rotation0, np.float64).T
    return rotation, np.asarray(translation1, np.float64) - rotation @ np.asarray(translation0, np.float64)


def essential_from_pose(rotation: ArrayLike, translation: ArrayLike) -> NDArray[np.float64]:
    """Essential matrix ``[t]× R`` of ``cam1_from_cam0``, with t scaled to unit length (zero stays zero)."""
    translation = np.asarray(translation, np.float64)
    length = float(np.linalg.norm(translation))
    return cross_matrix(translation / length if length > 0 else translation) @ np.asarray(
        rotation, np.float64
    )


def symmetric_epipolar_distance_sq(essential: ArrayLike, correspondences: ArrayLike) -> NDArray[np.float64]:
    """Squared symmetric epipolar distance, the residual of the pruning literature (OANet's ``get_episym``).

    Parameters
    ----------
    essential : (3, 3) array_like
        E for normalised coordinates, or F for pixels; any scale.
    correspondences : (M, 4) array_like
        ``x0 y0 x1 y1``.

    Returns
    -------
    (M,) float64
        ``(x1ᵀ E x0)² · (1/‖(E x0)₁₂‖² + 1/‖(Eᵀ x1)₁₂‖²)`` in squared units of the coordinates.
    """
    points = np.asarray(correspondences, np.float64)
    matrix = np.asarray(essential, np.float64)
    ones = np.ones((len(points), 1))
    x0 = np.hstack([points[:, :2], ones])
    x1 = np.hstack([points[:, 2:], ones])
    line_in_1 = x0 @ matrix.T
    line_in_0 = x1 @ matrix
    numerator = np.einsum("ni,ni->n", x1, line_in_1) ** 2
    # The floor keeps points on an epipole finite; it is the published implementation's value.
    return numerator * (
        1.0 / (np.sum(line_in_1[:, :2] ** 2, axis=1) + 1e-15)
        + 1.0 / (np.sum(line_in_0[:, :2] ** 2, axis=1) + 1e-15)
    )


def rotation_angle_deg(rotation: ArrayLike) -> float:
    """Angle of a rotation matrix in degrees, exact down to tiny angles."""
    rotation = np.asarray(rotation, np.float64)
    # atan2 keeps precision where arccos of the trace loses it (angles near 0 and 180 degrees).
    sine = 0.5 * np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    cosine = 0.5 * (np.trace(rotation) - 1.0)
    return float(np.degrees(np.arctan2(sine, cosine)))


def angle_between_deg(vector0: ArrayLike, vector1: ArrayLike) -> float:
    """Angle between two vectors in degrees; 180 if either has no length."""
    vector0, vector1 = np.asarray(vector0, np.float64), np.asarray(vector1, np.float64)
    if not (np.linalg.norm(vector0) > 0 and np.linalg.norm(vector1) > 0):
        return 180.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(vector0, vector1)), np.dot(vector0, vector1))))


def pose_error_deg(
    rotation: ArrayLike, translation: ArrayLike, true_rotation: ArrayLike, true_translation: ArrayLike
) -> tuple[float, float]:
    """Rotation error and direction error of the translation, in degrees.

    The translation's sign is not judged, as in the literature: its error is ``min(e, 180 − e)``. A
    translation of zero length or with non-finite entries gets the largest error, 90.
    """
    rotation_error = rotation_angle_deg(
        np.asarray(rotation, np.float64) @ np.asarray(true_rotation, np.float64).T
    )
    direction_error = angle_between_deg(translation, true_translation)
    if not np.linalg.norm(np.asarray(translation, np.float64)) > 0:
        return rotation_error, 90.0
    return rotation_error, min(direction_error, 180.0 - direction_error)


def earth_fixed(geodetic: ArrayLike) -> NDArray[np.float64]:
    """Points on and above the earth (WGS84), from its centre.

    Parameters
    ----------
    geodetic : (N, 3)
        Latitude and longitude in degrees, height over the ellipsoid in metres.

    Returns
    -------
    (N, 3) float64
        Metres; z towards the north pole, x towards latitude and longitude zero.
    """
    latitude, longitude, height = np.asarray(geodetic, np.float64).T
    latitude, longitude = np.radians(latitude), np.radians(longitude)
    flattened = (_POLE_M / _EQUATOR_M) ** 2
    radius = _EQUATOR_M / np.sqrt(1 - (1 - flattened) * np.sin(latitude) ** 2)
    return np.stack(
        [
            (radius + height) * np.cos(latitude) * np.cos(longitude),
            (radius + height) * np.cos(latitude) * np.sin(longitude),
            (flattened * radius + height) * np.sin(latitude),
        ],
        axis=1,
    )


def wrap_angles(angles: NDArray[np.floating]) -> NDArray[np.float32]:
    """Angles in radians as float32 in [-π, π)."""
    wrapped = (np.mod(angles + np.pi, 2 * np.pi) - np.pi).astype(np.float32)
    # float32(π) exceeds π: the largest values round up to it.
    return np.where(wrapped >= np.float32(np.pi), -np.float32(np.pi), wrapped).astype(np.float32)
