"""Conversion of cameras to and from pycolmap, and normalisation of points."""

from __future__ import annotations

import copy
import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from corrsfm.camera import CAMERA_PARAMETERS, Camera
from corrsfm.errors import InputError

if TYPE_CHECKING:
    import pycolmap

__all__ = [
    "camera_from_pycolmap",
    "create_camera",
    "mean_focal_px",
    "normalise_by_pinhole",
    "normalise_points",
    "pinhole_parameters",
    "to_pycolmap",
    "with_focal_length",
    "write_camera",
]


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


def write_camera(database: pycolmap.Database, camera: pycolmap.Camera, *, keep_id: bool = False) -> int:
    """Write a camera and the rig that COLMAP wants around it; the id of both, a new one unless it is kept."""
    import pycolmap

    written = copy.copy(camera)
    written.camera_id = database.write_camera(written, use_camera_id=keep_id)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(written.sensor_id)
    rig.rig_id = written.camera_id
    database.write_rig(rig, use_rig_id=True)
    return written.camera_id


def camera_from_pycolmap(camera: pycolmap.Camera) -> Camera:
    """Convert from pycolmap's camera; the id is dropped."""
    return Camera(
        model=camera.model_name,
        width=int(camera.width),
        height=int(camera.height),
        params=tuple(float(value) for value in camera.params),
        has_prior_focal_length=bool(camera.has_prior_focal_length),
    )


def create_camera(model: str, focal_px: float, width: int, height: int) -> Camera:
    """A camera without distortion whose principal point is the centre of the photo.

    Its focal length counts as a guess; `with_focal_length` makes it a known one.
    """
    import pycolmap

    return camera_from_pycolmap(pycolmap.Camera.create_from_model_name(1, model, focal_px, width, height))


def with_focal_length(camera: Camera, focal_px: float) -> Camera:
    """The camera with another focal length, which counts as known; the rest stays."""
    params = list(camera.params)
    for index in to_pycolmap(camera).focal_length_idxs():
        params[index] = float(focal_px)
    return dataclasses.replace(camera, params=tuple(params), has_prior_focal_length=True)


def mean_focal_px(camera0: Camera, camera1: Camera) -> float:
    """Mean focal length of the two cameras of a pair in pixels, x and y alike."""
    return float(np.mean([to_pycolmap(camera).mean_focal_length() for camera in (camera0, camera1)]))


def pinhole_parameters(camera: Camera) -> tuple[float, float, float, float]:
    """Focal lengths and principal point ``fx fy cx cy`` in pixels: the camera without its distortion.

    Raises
    ------
    InputError
        If a camera of this model has no focal length.
    """
    named = dict(zip(CAMERA_PARAMETERS[camera.model].split(), camera.params, strict=True))
    if "cx" not in named:
        raise InputError(f"camera of model {camera.model}: has no focal length; expected a perspective model")
    fx, fy = (named.get(name, named.get("f", 0.0)) for name in ("fx", "fy"))
    return fx, fy, named["cx"], named["cy"]


def normalise_by_pinhole(camera: Camera, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Normalised coordinates (N, 2) of pixels (N, 2) by `pinhole_parameters`; distortion stays in them."""
    fx, fy, cx, cy = pinhole_parameters(camera)
    return (points - np.array([cx, cy])) / np.array([fx, fy])


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
