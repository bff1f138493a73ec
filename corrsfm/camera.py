"""The camera of a photo: COLMAP's models, refused if they are not possible.

Conventions are those of `corrsfm.types`, which exports the record beside the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from corrsfm.errors import InputError

__all__ = ["CAMERA_PARAMETERS", "Camera"]

CAMERA_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "SIMPLE_DIVISION": "f cx cy k",
    "DIVISION": "fx fy cx cy k",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta",
    "EQUIRECTANGULAR": "w h",
}
"""COLMAP's camera models and the names of their parameters, in order."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera as COLMAP describes it.

    Attributes
    ----------
    model : str
        COLMAP camera model name, such as ``SIMPLE_RADIAL``.
    width, height : int
        Image size in pixels, as stored in the file (EXIF orientation not applied).
    params : tuple of float
        Model parameters in COLMAP's order; focal lengths and principal point in pixels.
    has_prior_focal_length : bool
        True if the focal length comes from EXIF or the user rather than from a guess.

    Raises
    ------
    InputError
        If the model is unknown, has another number of parameters, or a size, focal length or parameter is
        not possible.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    has_prior_focal_length: bool = False

    def __post_init__(self) -> None:
        if self.model not in CAMERA_PARAMETERS:
            raise InputError(
                f"camera model '{self.model}' is unknown; use one of {', '.join(CAMERA_PARAMETERS)}"
            )
        names = CAMERA_PARAMETERS[self.model].split()
        if len(self.params) != len(names):
            raise InputError(
                f"camera of model {self.model}: {len(self.params)} parameters, expected {len(names)}:"
                f" {', '.join(names)}"
            )
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera of {self.width}×{self.height} pixels: expected a positive size")
        for name, value in zip(names, self.params, strict=True):
            if not math.isfinite(value) or (name in ("f", "fx", "fy") and value <= 0):
                raise InputError(
                    f"camera of model {self.model}: {name} is {value}; expected a finite number, and focal"
                    " lengths above zero, in pixels"
                )

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, width: int, height: int) -> Camera:
        """A pinhole camera of known intrinsics.

        Parameters
        ----------
        matrix : (3, 3) array_like
            Intrinsic matrix K for pixels in COLMAP's convention, without skew. One for pixels whose first
            centre is (0, 0), as OpenCV counts, needs half a pixel added to its principal point.
        width, height : int
            Image size in pixels.

        Raises
        ------
        InputError
            If it is not an intrinsic matrix without skew.
        """
        k = np.asarray(matrix, np.float64)
        if k.shape != (3, 3) or k[0, 1] or k[1, 0] or not np.array_equal(k[2], [0.0, 0.0, 1.0]):
            raise InputError(
                f"intrinsic matrix {k.tolist()}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
            )
        params = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
        return cls(model="PINHOLE", width=width, height=height, params=params, has_prior_focal_length=True)
