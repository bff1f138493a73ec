"""A model in three dimensions: an interactive view by plotly, or still views from above and the side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.errors import DependencyError
from corrsfm.report.pictures import DROPPED_COLOUR

__all__ = ["ModelView", "make_view", "plotly_view"]

_MAX_POINTS = 20_000
# Points farther from the middle than this times the 75th percentile of all distances are not shown: a few of
# them, far behind the scene, would shrink the rest to a dot.
_REACH = 2.5
# Above this length of the mean viewing direction, photos count as looking one way.
_COMMON_DIRECTION = 0.3


@dataclass(frozen=True, kw_only=True)
class ModelView:
    """The part of a model that is drawn, turned so that z is up.

    Attributes
    ----------
    points : (N, 3) float64
    colours : (N, 3) uint8
        Red first.
    centres : (C, 3) float64
        Camera centres.
    frusta : (C, 5, 3) float64
        Each camera's centre and the four corners of its picture.
    names : tuple of str
        Of the cameras' photos.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    centres: NDArray[np.float64]
    frusta: NDArray[np.float64]
    names: tuple[str, ...]


def make_view(model: pycolmap.Reconstruction) -> ModelView:
    """Choose at most 20 000 points, leave out the farthest ones, and turn everything upright."""
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda image: image.name
    )
    poses = [image.cam_from_world() for image in images]
    rotations = np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3)
    centres = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    upright = _upright(rotations, centres)
    points, colours = _points(model)
    size = _frustum_size(points, centres)
    frusta = np.array(
        [
            _frustum(image.camera, rotation, centre, size)
            for image, rotation, centre in zip(images, rotations, centres, strict=True)
        ]
    ).reshape(-1, 5, 3)
    return ModelView(
        points=points @ upright.T,
        colours=colours,
        centres=centres @ upright.T,
        frusta=frusta @ upright.T,
        names=tuple(image.name for image in images),
    )


def _upright(rotations: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation that takes the photos' average up to z, and their common viewing direction to y."""
    # Cameras look along z with y down, and the rows of a rotation are the camera's axes in the world.
    up = -rotations[:, 1].sum(axis=0)
    if np.linalg.norm(up) < 1e-6:
        return np.eye(3)
    up /= np.linalg.norm(up)
    level = np.eye(3) - np.outer(up, up)
    forward = level @ rotations[:, 2].mean(axis=0)
    if np.linalg.norm(forward) < _COMMON_DIRECTION:
        # The photos look all ways, around an object or a room: their widest spread goes from left to right.
        widest = np.linalg.svd((centres - centres.mean(axis=0)) @ level)[2][0]
        forward = np.cross(up, level @ widest)
    if np.linalg.norm(forward) < 1e-6:
        forward = level[np.argmin(np.abs(up))]
    forward /= np.linalg.norm(forward)
    return np.array([np.cross(forward, up), forward, up])


def _points(model: pycolmap.Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    ids = np.array(sorted(model.points3D), np.int64)
    if not len(ids):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if len(ids) > _MAX_POINTS:
        ids = np.sort(np.random.default_rng(0).choice(ids, _MAX_POINTS, replace=False))
    points = np.array([model.points3D[int(number)].xyz for number in ids])
    colours = np.array([model.points3D[int(number)].color for number in ids], np.uint8)
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    reach = _REACH * np.percentile(distances, 75)
    near = distances <= max(reach, 1e-9)
    return points[near], colours[near]


def _frustum_size(points: NDArray[np.float64], centres: NDArray[np.float64]) -> float:
    """Length of a drawn camera: a fraction of the scene, less where cameras stand close together."""
    everything = np.vstack([points, centres])
    extent = float(np.linalg.norm(np.ptp(everything, axis=0))) if len(everything) else 1.0
    size = 0.04 * extent
    if 1 < len(centres) <= 2000:
        squares = np.sum(centres**2, axis=1)
        distances = squares[:, None] + squares[None] - 2 * centres @ centres.T
        np.fill_diagonal(distances, np.inf)
        nearest = float(np.sqrt(np.median(np.maximum(distances.min(axis=1), 0))))
        size = min(size, max(0.7 * nearest, 0.01 * extent))
    return size


def _frustum(
    camera: pycolmap.Camera, rotation: NDArray[np.float64], centre: NDArray[np.float64], size: float
) -> NDArray[np.float64]:
    """Centre and picture corners of a camera whose longer picture side is ``size`` long; (5, 3)."""
    longest = max(camera.width, camera.height)
    half_width, half_height = 0.5 * camera.width / longest, 0.5 * camera.height / longest
    # Wide lenses would flatten the drawing, long ones make it a needle.
    depth = min(max(camera.mean_focal_length() / longest, 0.4), 1.0)
    corners = [[x * half_width, y * half_height, depth] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return np.vstack([centre, centre + size * np.array(corners) @ rotation])


def plotly_view(view: ModelView) -> str:
    """An interactive view as HTML with plotly's script included.

    Raises
    ------
    DependencyError
        If plotly is not installed.
    """
    try:
        import plotly.graph_objects as graph_objects
    except ImportError as error:
        raise DependencyError("plotly", "the interactive 3-D view", "report") from error
    points = view.points.astype(np.float32)
    cloud = graph_objects.Scatter3d(
        x=points[:, 0], y=points[:, 1], z=points[:, 2], mode="markers", name="points", hoverinfo="skip",
        marker={"size": 1.6, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in view.colours]},
    )  # fmt: skip
    lines = _frustum_lines(view.frusta).astype(np.float32)
    frusta = graph_objects.Scatter3d(
        x=lines[:, 0], y=lines[:, 1], z=lines[:, 2], mode="lines", name="cameras", hoverinfo="skip",
        line={"color": DROPPED_COLOUR, "width": 2},
    )  # fmt: skip
    centres = view.centres.astype(np.float32)
    photos = graph_objects.Scatter3d(
        x=centres[:, 0], y=centres[:, 1], z=centres[:, 2], mode="markers", name="photos",
        text=list(view.names), hovertemplate="%{text}<extra></extra>",
        marker={"size": 3, "color": DROPPED_COLOUR},
    )  # fmt: skip
    hidden = {"visible": False, "showspikes": False}
    figure = graph_objects.Figure(
        [cloud, frusta, photos],
        layout={
            "scene": {
                "aspectmode": "data",
                "xaxis": hidden,
                "yaxis": hidden,
                "zaxis": hidden,
                "camera": {"eye": {"x": 0.25, "y": -1.55, "z": 0.75}},
                "dragmode": "orbit",
            },
            "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
            "showlegend": False,
            "paper_bgcolor": "rgba(0,0,0,0)",
            "modebar": {"bgcolor": "rgba(0,0,0,0)"},
        },
    )
    return figure.to_html(
        full_html=False,
        include_plotlyjs=True,
        include_mathjax=False,
        default_height="min(70vh, 560px)",
        div_id="model",
        config={
            "displaylogo": False,
            "modeBarButtons": [["toImage", "resetCameraDefault3d"]],
            "responsive": True,
            "plotlyServerURL": "",
        },
    )


def _frustum_lines(frusta: NDArray[np.float64]) -> NDArray[np.float64]:
    """One line through the edges of all frusta, interrupted by NaN between cameras; (C * 13, 3)."""
    order = [0, 1, 2, 3, 4, 1, 0, 2, 0, 3, 0, 4]
    broken = np.full((len(frusta), 1, 3), np.nan)
    return np.concatenate([frusta[:, order], broken], axis=1).reshape(-1, 3)
