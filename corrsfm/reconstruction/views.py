"""Where a model puts the photos: one camera and one pose each, as plain records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap, normalise_points, to_pycolmap
from corrsfm.types import Camera

if TYPE_CHECKING:
    import pycolmap

__all__ = ["Rays", "View", "Views", "rays_of", "views_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A registered photo: its intrinsics and its pose.

    Attributes
    ----------
    camera : Camera
        As the model refined it.
    rotation : (3, 3) float64
        ``cam_from_world``.
    translation : (3,) float64
        ``cam_from_world``, in units of the model.
    """

    camera: Camera
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Camera centre in the world, (3,) float64, in units of the model."""
        return -self.rotation.T @ self.translation


Views = Mapping[str, View]
"""Registered photos by name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """The keypoints of a photo as its model camera sees them.

    Attributes
    ----------
    points : (N, 2) float64
        Normalised coordinates, distortion undone; NaN where the camera has no viewing ray for a pixel.
    focal_px : float
        Mean focal length: what one unit of normalised coordinates is in pixels near the image centre.
    """

    points: NDArray[np.float64]
    focal_px: float


def views_of(model: pycolmap.Reconstruction) -> dict[str, View]:
    """The registered photos of a model, sorted by name."""
    views = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            pose = image.cam_from_world()
            views[image.name] = View(
                camera=camera_from_pycolmap(image.camera),
                rotation=np.asarray(pose.rotation.matrix(), np.float64),
                translation=np.asarray(pose.translation, np.float64),
            )
    return views


def rays_of(views: Views, keypoints: Mapping[str, NDArray[np.floating]]) -> dict[str, Rays]:
    """Normalise the keypoints of every registered photo, once for all pairs it is in.

    Parameters
    ----------
    views : mapping of str to View
    keypoints : mapping of str to (N, 2) float
        Pixels, COLMAP convention; has every registered photo.

    Returns
    -------
    dict of str to Rays
    """
    return {
        name: Rays(
            points=normalise_points(view.camera, keypoints[name]),
            focal_px=float(to_pycolmap(view.camera).mean_focal_length()),
        )
        for name, view in views.items()
    }
