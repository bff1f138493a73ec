"""A model in three dimensions: an interactive view by plotly, or still views from above and the side."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.errors import DependencyError
from corrsfm.report.pictures import DROPPED_COLOUR

__all__ = ["ModelView", "make_view", "plotly_view"]

_MAX_POINTS = 20_000
# The frame reaches to the cameras within this times the 90th percentile of their distances from their middle,
# and to the bulk of the points within this times the median of theirs from the same place.
_REACH = 3.0
_BULK = (0.05, 0.95)
_MARGIN = 0.04
# Points farther from the middle of the frame than this times its diagonal are left out: at some distance,
# single precision no longer holds the rest apart.
_FARTHEST = 30.0
# Above this length of a mean direction, photos count as having it in common.
_COMMON_DIRECTION = 0.3
# From behind the cameras, a little to the right, and above them.
_TOWARDS_EYE = np.array([0.15, -0.89, 0.43])
# Half the vertical field of view of plotly's camera, as a tangent; the narrowest picture, width over height,
# that shows the whole frame; and the room around it.
_HALF_VIEW = np.tan(np.radians(22.5))
_NARROWEST = 1.2
_AROUND = 1.08


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
    low, high : (3,) float64
        Corners of the frame: the box of the cameras and of the bulk of the points, which the first look
        shows. Single points and cameras may lie outside.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    centres: NDArray[np.float64]
    frusta: NDArray[np.float64]
    names: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def make_view(model: pycolmap.Reconstruction) -> ModelView:
    """Choose at most 20 000 points, turn everything upright, and find the frame of the first look."""
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda image: image.name
    )
    poses = [image.cam_from_world() for image in images]
    rotations = np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3)
    centres = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    upright = _upright(rotations, centres)
    points, colours = _points(model)
    points, centres, rotations = points @ upright.T, centres @ upright.T, rotations @ upright.T
    low, high = _frame(points, centres)
    diagonal = float(np.linalg.norm(high - low))
    near = np.linalg.norm(points - (low + high) / 2, axis=1) <= _FARTHEST * diagonal
    size = _frustum_size(diagonal, centres)
    frusta = np.array(
        [
            _frustum(image.camera, rotation, centre, size)
            for image, rotation, centre in zip(images, rotations, centres, strict=True)
        ]
    ).reshape(-1, 5, 3)
    return ModelView(
        points=points[near],
        colours=colours[near],
        centres=centres,
        frusta=frusta,
        names=tuple(image.name for image in images),
        low=low,
        high=high,
    )


def _upright(rotations: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation that takes the photos' average up to z, and their common viewing direction to y."""
    if not len(rotations):
        return np.eye(3)
    # Cameras look along z with y down, and the rows of a rotation are the camera's axes in the world.
    up, forward = -rotations[:, 1].mean(axis=0), rotations[:, 2].mean(axis=0)
    if np.linalg.norm(up) < _COMMON_DIRECTION < np.linalg.norm(forward):
        # Photos that look down, turned any way about that.
        up = -forward
    if np.linalg.norm(up) < 1e-6:
        return np.eye(3)
    up /= np.linalg.norm(up)
    level = np.eye(3) - np.outer(up, up)
    forward = level @ forward
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
    if len(ids) > _MAX_POINTS:
        ids = np.sort(np.random.default_rng(0).choice(ids, _MAX_POINTS, replace=False))
    points = [model.points3D[int(number)] for number in ids]
    return (
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
    )


def _frame(
    points: NDArray[np.float64], centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the box of the cameras and of most points near them; outliers have no say."""
    if not len(centres) + len(points):
        return -np.ones(3), np.ones(3)
    middle = np.median(centres if len(centres) else points, axis=0)
    corners = []
    if len(centres):
        distances = np.linalg.norm(centres - middle, axis=1)
        together = centres[distances <= _REACH * np.percentile(distances, 90)]
        corners += [together.min(axis=0), together.max(axis=0)]
    if len(points):
        distances = np.linalg.norm(points - middle, axis=1)
        near = points[distances <= _REACH * np.median(distances)]
        corners += list(np.quantile(near, _BULK, axis=0))
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = max(_MARGIN * float(np.linalg.norm(high - low)), 1e-9)
    return low - margin, high + margin


def _frustum_size(diagonal: float, centres: NDArray[np.float64]) -> float:
    """Length of a drawn camera: a fraction of the frame, less where cameras stand close together."""
    size = 0.04 * diagonal
    if 1 < len(centres) <= 2000:
        squares = np.sum(centres**2, axis=1)
        distances = squares[:, None] + squares[None] - 2 * centres @ centres.T
        np.fill_diagonal(distances, np.inf)
        nearest = float(np.sqrt(np.median(np.maximum(distances.min(axis=1), 0))))
        size = min(size, max(0.7 * nearest, 0.01 * diagonal))
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
        import plotly.io
    except ImportError as error:
        raise DependencyError("plotly", "the interactive 3-D view", "report") from error
    cloud = {
        "type": "scatter3d", **_places(view.points), "mode": "markers",
        "name": "points", "hoverinfo": "skip",
        "marker": {"size": 1.6, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in view.colours]},
    }  # fmt: skip
    frusta = {
        "type": "scatter3d", **_places(_frustum_lines(view.frusta)), "mode": "lines",
        "name": "cameras", "hoverinfo": "skip", "line": {"color": DROPPED_COLOUR, "width": 2},
    }  # fmt: skip
    photos = {
        "type": "scatter3d", **_places(view.centres), "mode": "markers",
        "name": "photos", "text": list(view.names), "hovertemplate": "%{text}<extra></extra>",
        "marker": {"size": 3, "color": DROPPED_COLOUR},
    }  # fmt: skip
    layout = {
        "scene": _first_look(view),
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "modebar": {"bgcolor": "rgba(0,0,0,0)"},
    }
    # Plotly's own objects would check each value, for a third of the page's time.
    page: str = plotly.io.to_html(
        {"data": [cloud, frusta, photos], "layout": layout},
        validate=False,
        full_html=False,
        include_plotlyjs=True,
        include_mathjax=False,
        # Never so narrow that the frame does not fit, see `_NARROWEST`.
        default_height="min(70vh, 560px, 70vw)",
        div_id="model",
        config={
            "displaylogo": False,
            "modeBarButtons": [["toImage", "resetCameraDefault3d"]],
            "responsive": True,
            "plotlyServerURL": "",
        },
    )
    return page


def _places(points: NDArray[np.float64]) -> dict[str, dict[str, str]]:
    """The coordinates of points (N, 3) as plotly reads them in fewest bytes."""
    columns = np.ascontiguousarray(points.T, dtype="<f4")
    return {
        axis: {"dtype": "f4", "bdata": base64.b64encode(column).decode("ascii")}
        for axis, column in zip("xyz", columns, strict=True)
    }


def _first_look(view: ModelView) -> dict[str, object]:
    """Plotly's scene with everything in it, and its camera so that the frame fills the picture.

    Ranges that end at the frame would cut off what lies outside; so the axes reach to the last point, at the
    same scale, and the camera is near the frame.
    """
    everything = np.vstack([view.points, view.centres, view.frusta.reshape(-1, 3)])
    framed = everything[np.all((everything >= view.low) & (everything <= view.high), axis=1)]
    corners = np.vstack([everything, [view.low, view.high]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    # In plotly's camera the whole box has its middle at 0 and the size of the aspect ratio.
    unit = float(np.linalg.norm(view.high - view.low))
    centre = ((view.low + view.high) / 2 - (low + high) / 2) / unit
    look_at, distance = _fit((framed - (view.low + view.high) / 2) / unit)
    centre = centre + look_at
    eye = centre + distance * _TOWARDS_EYE / np.linalg.norm(_TOWARDS_EYE)
    axes = {
        f"{axis}axis": {"visible": False, "showspikes": False, "range": [float(low[i]), float(high[i])]}
        for i, axis in enumerate("xyz")
    }

    def named(values: NDArray[np.float64]) -> dict[str, float]:
        return dict(zip("xyz", values.round(4).tolist(), strict=True))

    return {
        **axes,
        "aspectmode": "manual",
        "aspectratio": named((high - low) / unit),
        "camera": {"eye": named(eye), "center": named(centre)},
        "dragmode": "orbit",
    }


def _fit(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Where to look, and from how far in the direction of the eye, so that (N, 3) points fill the picture."""
    towards = _TOWARDS_EYE / np.linalg.norm(_TOWARDS_EYE)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(towards, right)])
    half = np.array([[_NARROWEST], [1.0]]) * _HALF_VIEW
    look_at, distance = np.zeros(3), 1.0
    if not len(points):
        return look_at, distance
    # Near points are larger, so the middle of the picture depends on the distance and the other way round.
    for _ in range(4):
        across, depth = axes @ (points - look_at).T, (points - look_at) @ towards
        distance = float(np.max(np.abs(across) / half + depth))
        seen = across / np.maximum(distance - depth, 1e-9)
        look_at = look_at + distance * (seen.min(axis=1) + seen.max(axis=1)) / 2 @ axes
    across, depth = axes @ (points - look_at).T, (points - look_at) @ towards
    return look_at, _AROUND * float(np.max(np.abs(across) / half + depth))


def _frustum_lines(frusta: NDArray[np.float64]) -> NDArray[np.float64]:
    """One line through the edges of all frusta, interrupted by NaN between cameras; (C * 13, 3)."""
    order = [0, 1, 2, 3, 4, 1, 0, 2, 0, 3, 0, 4]
    broken = np.full((len(frusta), 1, 3), np.nan)
    return np.concatenate([frusta[:, order], broken], axis=1).reshape(-1, 3)
