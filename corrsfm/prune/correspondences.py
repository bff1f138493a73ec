"""Putative matches as prune methods see them: points, normalised points and side information.

Training shares this part of the prune stage, so that a network learns from the very numbers it will see.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from corrsfm.colmap.cameras import normalise_points
from corrsfm.errors import InputError
from corrsfm.geometry import wrap_angles
from corrsfm.types import Camera, Correspondences, Features, Matches

__all__ = [
    "NEUTRAL_CHANNELS",
    "SIDE_CHANNELS",
    "SIDE_LAYOUTS",
    "confidence",
    "correspondences_from_points",
    "distinctiveness",
    "make_correspondences",
    "missing_channels",
    "side_channels",
    "side_information",
]

UNKNOWN_RATIO = 0.8
"""Descriptor distance ratio that stands in for one that is not known."""


def make_correspondences(
    features0: Features, features1: Features, matches: Matches, camera0: Camera, camera1: Camera, name: str
) -> Correspondences:
    """Gather what prune methods may know about the putative matches of one pair.

    Parameters
    ----------
    features0, features1 : Features
        Keypoints of the two images.
    matches : Matches
        Indices into them.
    camera0, camera1 : Camera
        Cameras as known before reconstruction; they normalise the points.
    name : str
        ``"name0 – name1"``, for messages.

    Returns
    -------
    Correspondences
        In the order of ``matches``.
    """
    index0, index1 = matches.indices[:, 0], matches.indices[:, 1]
    points0, points1 = features0.keypoints[index0], features1.keypoints[index1]
    log_scale_ratios = rotations = np.full(len(matches), np.nan, np.float32)
    shapes = (features0.scales, features0.orientations, features1.scales, features1.orientations)
    if shapes_known := all(values is not None for values in shapes):
        scales0, turns0, scales1, turns1 = (np.asarray(values) for values in shapes)
        rotations = turns1[index1] - turns0[index0]
        with np.errstate(divide="ignore", invalid="ignore"):
            log_scale_ratios = np.log(scales1[index1] / scales0[index0])
    return Correspondences(
        points0=points0,
        points1=points1,
        normalised=np.hstack(
            [normalise_points(camera0, points0), normalise_points(camera1, points1)], dtype=np.float32
        ),
        ratios=matches.ratios,
        mutual=matches.mutual,
        log_scale_ratios=log_scale_ratios.astype(np.float32),
        rotations=wrap_angles(rotations),
        camera0=camera0,
        camera1=camera1,
        name=name,
        scores=matches.scores,
        shapes_known=shapes_known,
    )


def correspondences_from_points(
    points0: ArrayLike,
    points1: ArrayLike,
    camera0: Camera | ArrayLike,
    camera1: Camera | ArrayLike,
    *,
    ratios: ArrayLike | None = None,
    mutual: ArrayLike | None = None,
    name: str = "your points",
) -> Correspondences:
    """Putative matches of your own, from any detector, for a prune method.

    What is unknown about a match takes a neutral value: `UNKNOWN_RATIO`, mutual, no change of scale and no
    rotation between the photos. Networks prune less well without it, and one that reads mutual matches only
    asks for ``mutual``.

    Parameters
    ----------
    points0, points1 : (M, 2) array_like
        Matched points in pixels, COLMAP's convention: the centre of the first pixel is (0.5, 0.5).
    camera0, camera1 : Camera or (3, 3) array_like
        Cameras, or intrinsic matrices of cameras without distortion.
    ratios : (M,) array_like, optional
        Distance to the nearest over distance to the second nearest descriptor, in [0, 1].
    mutual : (M,) array_like of bool, optional
        Whether a match is the nearest neighbour in both directions.
    name : str
        What to call the pair in messages.

    Raises
    ------
    InputError
        If a shape or value does not fit.
    """
    columns = [np.asarray(points, np.float32) for points in (points0, points1)]
    num = len(columns[0]) if columns[0].ndim else 0
    for label, points in zip(("points0", "points1"), columns, strict=True):
        if points.shape != (num, 2):
            raise InputError(f"{label} has shape {points.shape}, expected ({num}, 2): x and y in pixels")
    known_ratios = np.full(num, UNKNOWN_RATIO) if ratios is None else np.asarray(ratios)
    known_mutual = np.ones(num, bool) if mutual is None else np.asarray(mutual)
    for label, values in (("ratios", known_ratios), ("mutual", known_mutual)):
        if values.shape != (num,):
            raise InputError(f"{label} has shape {values.shape}, expected ({num},): one entry a match")
    # Also false for NaN.
    if not ((known_ratios >= 0) & (known_ratios <= 1)).all():
        raise InputError("ratios must be between 0 and 1: nearest over second nearest descriptor distance")
    cameras = [
        camera if isinstance(camera, Camera) else _pinhole(camera, points)
        for camera, points in zip((camera0, camera1), columns, strict=True)
    ]
    rays = [normalise_points(camera, points) for camera, points in zip(cameras, columns, strict=True)]
    return Correspondences(
        points0=columns[0],
        points1=columns[1],
        normalised=np.hstack(rays, dtype=np.float32),
        ratios=known_ratios.astype(np.float32),
        mutual=known_mutual.astype(bool),
        log_scale_ratios=np.zeros(num, np.float32),
        rotations=np.zeros(num, np.float32),
        camera0=cameras[0],
        camera1=cameras[1],
        name=name,
        mutual_known=mutual is not None,
    )


def _pinhole(matrix: ArrayLike, points: NDArray[np.float32]) -> Camera:
    """A camera of known intrinsics, just large enough for the points; only messages show its size."""
    finite = points[np.isfinite(points).all(axis=1)]
    width, height = np.ceil(finite.max(axis=0, initial=1.0)).astype(int)
    return Camera.from_matrix(matrix, int(width), int(height))


def confidence(pair: Correspondences) -> NDArray[np.float32]:
    """The score that a match brings along, in [0, 1]: of its matcher, else by its ratio; 0 for NaN."""
    if pair.scores is None:
        return distinctiveness(pair.ratios)
    return np.clip(np.nan_to_num(pair.scores, nan=0.0), 0.0, 1.0).astype(np.float32)


def distinctiveness(ratios: NDArray[np.floating]) -> NDArray[np.float32]:
    """One minus the ratio of the two nearest descriptor distances, in [0, 1]; 0 where the ratio is NaN."""
    return np.clip(1.0 - np.nan_to_num(ratios, nan=1.0), 0.0, 1.0).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class SideChannel:
    """One column of side information.

    Attributes
    ----------
    source : str
        Attribute of the matches that holds the values.
    function : {"", "cos", "sin"}
        Applied to the values, unless empty.
    bounds : tuple of float or None
        Values are clipped to them.
    unknown : float
        Replaces NaN, which says nothing about the match, and without bounds infinity.
    """

    source: str
    function: str = ""
    bounds: tuple[float, float] | None = None
    unknown: float = 0.0

    def compute(self, matches: Any, library: ModuleType) -> Any:
        """The column, from matches whose attributes are arrays of a library, numpy or torch."""
        low, high = self.bounds or (self.unknown, self.unknown)
        values = library.nan_to_num(getattr(matches, self.source), nan=self.unknown, posinf=high, neginf=low)
        if self.bounds:
            values = library.clip(values, low, high)
        return getattr(library, self.function)(values) if self.function else values


SIDE_CHANNELS = {
    "ratio": SideChannel(source="ratios", bounds=(0.0, 1.0), unknown=1.0),
    "mutual": SideChannel(source="mutual"),
    # The natural logarithm. Scales differ by e³ ≈ 20 between two photos at most; beyond is a broken keypoint.
    "log_scale_ratio": SideChannel(source="log_scale_ratios", bounds=(-3.0, 3.0)),
    "cos": SideChannel(source="rotations", function="cos"),
    "sin": SideChannel(source="rotations", function="sin"),
}
"""The side channels of a network's input by name, in order."""

NEUTRAL_CHANNELS = (0.8, 1.0, 0.0, 1.0, 0.0)
"""Value of each side channel that says least."""

SIDE_LAYOUTS = (0, 2, 5)
"""How many of them, counted from the first, a network may be made for: all, those of descriptors, none."""


def missing_channels(num_channels: int, *, has_shapes: bool, has_ratios: bool) -> str:
    """What matches lack that a network reads, in words; empty if they have everything."""
    if num_channels and not has_ratios:
        return "the ratio of descriptor distances"
    return "scale and orientation of keypoints" if num_channels > 2 and not has_shapes else ""


def side_channels(matches: Any, num_channels: int, library: ModuleType) -> Any:
    """The first side channels, always finite.

    Parameters
    ----------
    matches : object
        With ``ratios``, ``mutual``, ``log_scale_ratios`` and ``rotations``, arrays of one shape: a
        `Correspondences`, or a batch of training.
    num_channels : int
        One of `SIDE_LAYOUTS` other than 0.
    library : module
        That the arrays are of: numpy, or torch.

    Returns
    -------
    (..., num_channels) array or tensor

    Raises
    ------
    ValueError
        If no layout has that many channels.
    """
    if num_channels not in SIDE_LAYOUTS[1:]:
        raise ValueError(f"no layout of {num_channels} side channels, there are {list(SIDE_LAYOUTS)}")
    channels = list(SIDE_CHANNELS.values())[:num_channels]
    return library.stack([channel.compute(matches, library) for channel in channels], -1)


def side_information(correspondences: Correspondences, num_channels: int) -> NDArray[np.float32]:
    """Side channels of a network's input, as numpy array.

    Parameters
    ----------
    correspondences : Correspondences
        M putative matches.
    num_channels : int
        One of `SIDE_LAYOUTS`.

    Returns
    -------
    (M, num_channels) float32

    Raises
    ------
    ValueError
        If no layout has that many channels.
    """
    if num_channels == 0:
        return np.zeros((len(correspondences), 0), np.float32)
    return np.ascontiguousarray(side_channels(correspondences, num_channels, np), np.float32)
