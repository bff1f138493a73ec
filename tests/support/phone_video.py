"""A phone-like video of a made-up place: a camera that stands, walks on an arc, and blurs some frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from photos import texture

SIZE = (640, 480)
FOCAL_PX = 520.0
RATE = 15.0
# Corner, and the two edges that span a rectangle, in metres; y is down.
_RECTANGLES = (
    ((-8, -4, 6), (16, 0, 0), (0, 5.5, 0)),  # back wall
    ((-8, 1.5, -2), (16, 0, 0), (0, 0, 8)),  # floor
    ((-5, -3, -2), (0, 0, 8), (0, 4.5, 0)),  # left wall
    ((5, -3, -2), (0, 0, 8), (0, 4.5, 0)),  # right wall
    ((-2.2, 0.0, 3.2), (1.4, 0, 0.5), (0, 1.5, 0)),  # boxes
    ((-2.2, 0.0, 3.2), (-0.5, 0, 1.2), (0, 1.5, 0)),
    ((0.8, -0.6, 3.8), (1.2, 0, -0.6), (0, 2.1, 0)),
    ((0.8, -0.6, 3.8), (0.6, 0, 1.0), (0, 2.1, 0)),
)


@dataclass(frozen=True)
class Film:
    """A video and what is true of it.

    Attributes
    ----------
    path : Path
    poses : list
        ``cam_from_world`` of each frame: rotation (3, 3) and translation (3,).
    blurred, standing : set of int
        Frames that are blurred, and those in which the camera does not walk.
    """

    path: Path
    poses: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
    blurred: set[int]
    standing: set[int]


def film(path: Path, num_standing: int = 12, num_walking: int = 48, *, size: tuple[int, int] = SIZE) -> Film:
    """Render a video: blurred are two of three frames while walking, none while standing."""
    rng = np.random.default_rng(5)
    fourcc = cv2.VideoWriter.fourcc(*("mp4v" if path.suffix == ".mp4" else "MJPG"))
    writer = cv2.VideoWriter(str(path), fourcc, RATE, size)
    assert writer.isOpened()
    surfaces = [texture(seed) for seed in range(len(_RECTANGLES))]
    poses, blurred = [], set()
    for number in range(num_standing + num_walking):
        walked = max(0, number - num_standing) / max(1, num_walking)
        tremble = rng.normal(0, 0.0005, 3)
        centre = np.array([3.2 * walked - 1.6, 0.15 * np.sin(9 * walked), -1.2 + 0.8 * walked]) + tremble
        poses.append(_look_at(centre, np.array([0.2, 0.2, 4.0])))
        picture = _render(*poses[-1], surfaces, size)
        if number >= num_standing and number % 3:
            blurred.add(number)
            picture = cv2.blur(picture, (9, 3))
        noisy = picture + rng.normal(0, 2.0, picture.shape)
        writer.write(cv2.cvtColor(np.clip(noisy, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    writer.release()
    return Film(path, poses, blurred, set(range(num_standing)))


def _look_at(
    centre: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ centre


def _render(
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    surfaces: Sequence[NDArray[np.uint8]],
    size: tuple[int, int],
) -> NDArray[np.float64]:
    """Grey values (H, W) of textured rectangles, the nearest at each pixel."""
    width, height = size
    focal = FOCAL_PX * width / SIZE[0]
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1) @ rotation
    centre = -rotation.T @ translation
    picture, nearest = np.full((height, width), 128.0), np.full((height, width), np.inf)
    for (corner, *edges), surface in zip(_RECTANGLES, surfaces, strict=True):
        u, v = (np.array(edge, float) for edge in edges)
        normal = np.cross(u, v)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = normal @ (np.array(corner, float) - centre) / (rays @ normal)
        hit = centre + np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays - np.array(corner, float)
        a, b = (hit @ u / (u @ u)).astype(np.float32), (hit @ v / (v @ v)).astype(np.float32)
        seen = (depth > 0.1) & (depth < nearest) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        shown = cv2.remap(surface, a * (surface.shape[1] - 1), b * (surface.shape[0] - 1), cv2.INTER_LINEAR)
        picture[seen], nearest[seen] = shown[seen], depth[seen]
    return picture
