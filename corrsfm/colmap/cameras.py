"""Conversion of cameras to and from pycolmap, and normalisation of points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from corrsfm.types import Camera

if TYPE_CHECKING:
    import pycolmap

__all__ = ["camera_from_pycolmap", "normalise_points", "to_pycolmap"]


def to_pycolmap(camera: Camera, camera_id: int = 1) -> pycolmap.Camera:
    """Convert to pycolmap's camera; ids are COLMAP's and start at 1."""
    import pycolmap

    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
        has_prior_focal_length=camera.has_prior_focal_length,
    )


def camera_from_pycolmap(camera: pycolmap.Camera) -> Camera:
    """Convert from pycolmap's camera; the id is dropped."""
    return Camera(
        model=camera.model_name,
        width=int(camera.width),
        height=int(camera.height),
        params=tuple(float(value) for value in camera.params),
        has_prior_focal_length=bool(camera.has_prior_focal_length),
    )


def normalise_points(camera: Camera, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Normalise pixels by the full camera model, distortion included.

    Parameters
    ----------
    camera : Camera
    points : (N, 2) float
        Pixels, COLMAP convention.

    Returns
    -------
    (N, 2) float64
        Normalised coordinates; NaN where the model has no viewing ray for a pixel.
    """
    if len(points) == 0:
        return np.zeros((0, 2))
    pixels = np.ascontiguousarray(points, np.float64)
    return np.asarray(to_pycolmap(camera).cam_from_img(pixels), np.float64)
