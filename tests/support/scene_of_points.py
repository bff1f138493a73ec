"""A scene made of points, seen from an arc of photos, with everything about it known exactly."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corrsfm.reconstruction.views import View
from corrsfm.types import Camera, Pair

FOCAL_PX = 500.0
CAMERA = Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=(FOCAL_PX, 320.0, 240.0))


def turn(axis: str, degrees: float) -> NDArray[np.float64]:
    """Rotation matrix about a coordinate axis."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation[i, i] = rotation[j, j] = cosine
    rotation[i, j], rotation[j, i] = -sine, sine
    return rotation


def project(view: View, points: NDArray[np.float64]) -> NDArray[np.float64]:
    in_camera = points @ view.rotation.T + view.translation
    return in_camera[:, :2] / in_camera[:, 2:] * FOCAL_PX + [320.0, 240.0]


def bend(view: View, degrees: float) -> View:
    """The photo turned up or down where it stands; about its baselines, so that all its lines move."""
    rotation = turn("x", degrees) @ view.rotation
    return dataclasses.replace(view, rotation=rotation, translation=-rotation @ view.centre)


def moved(views: dict[str, View], scale: float = 3.0) -> dict[str, View]:
    """The same model in another frame and scale."""
    rotation, shift = turn("x", 40.0) @ turn("z", 70.0), np.array([4.0, -2.0, 1.0])
    return {
        name: dataclasses.replace(
            view,
            rotation=view.rotation @ rotation.T,
            translation=scale * view.translation - view.rotation @ rotation.T @ shift,
        )
        for name, view in views.items()
    }


@dataclass(frozen=True, kw_only=True)
class SceneOfPoints:
    """P points in a cube of side 2, seen from N photos at distance 5 on an arc of 10 degrees a step.

    Every photo sees every point; keypoint k of photo i is point ``order[i][k]``.
    """

    points: NDArray[np.float64]
    views: dict[str, View]
    keypoints: dict[str, NDArray[np.float64]]
    descriptors: dict[str, NDArray[np.uint8]]
    order: dict[str, NDArray[np.intp]]

    def matches(self, pair: Pair, num: int | None = None) -> NDArray[np.int32]:
        """The true matches of the first points."""
        index0, index1 = (np.argsort(self.order[name])[:num] for name in pair)
        return np.column_stack([index0, index1]).astype(np.int32)

    def all_pairs(self) -> list[Pair]:
        names = sorted(self.views)
        return [(name0, name1) for i, name0 in enumerate(names) for name1 in names[i + 1 :]]

    def verified(self, num: int | None = None) -> dict[Pair, NDArray[np.int32]]:
        return {pair: self.matches(pair, num) for pair in self.all_pairs()}


def make_scene(num_photos: int = 5, num_points: int = 60, *, flat: bool = False) -> SceneOfPoints:
    generator = np.random.default_rng(7)
    points = generator.uniform(-1.0, 1.0, (num_points, 3))
    if flat:
        points[:, 2] = 0.0
    prints = generator.integers(20, 236, (num_points, 128))
    views, keypoints, descriptors, orders = {}, {}, {}, {}
    for i in range(num_photos):
        name = f"{i}.jpg"
        views[name] = View(
            camera=CAMERA, rotation=turn("y", 10.0 * i), translation=np.array([0.0, 0.1 * i, 5.0])
        )
        orders[name] = generator.permutation(num_points)
        keypoints[name] = project(views[name], points[orders[name]])
        noise = generator.integers(-9, 10, (num_points, 128))
        descriptors[name] = (prints[orders[name]] + noise).astype(np.uint8)
    return SceneOfPoints(
        points=points, views=views, keypoints=keypoints, descriptors=descriptors, order=orders
    )
