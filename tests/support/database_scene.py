"""Sixty points seen by three cameras, and a database of them."""

from pathlib import Path

import numpy as np
import pycolmap

from corrsfm.config import DatabaseConfig
from corrsfm.database.write import write_database
from corrsfm.types import Camera, Features, ImageRecord

CAMERA = Camera(
    model="SIMPLE_RADIAL",
    width=640,
    height=480,
    params=(600.0, 320.0, 240.0, 0.01),
    has_prior_focal_length=True,
)
NAMES = ("a b/größe.jpg", "a/1.jpg", "b.jpg")
NUM_POINTS = 60


def scene_features(seed: int = 0) -> dict[str, Features]:
    """The same 60 points in space seen by three cameras along a line; keypoint i is point i everywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (NUM_POINTS, 3))
    camera = pycolmap.Camera(model=CAMERA.model, width=640, height=480, params=list(CAMERA.params))
    features = {}
    for position, name in enumerate(NAMES):
        keypoints = camera.img_from_cam(points - [0.5 * position, 0, 0]).astype(np.float32)
        features[name] = Features(
            keypoints=keypoints,
            scales=np.full(NUM_POINTS, 2.0, np.float32),
            orientations=np.zeros(NUM_POINTS, np.float32),
            scores=np.ones(NUM_POINTS, np.float32),
            descriptors=rng.integers(0, 255, (NUM_POINTS, 128), dtype=np.uint8),
            image_size=(640, 480),
        )
    return features


def big_features() -> dict[str, Features]:
    """Features whose keypoints take half a megabyte an image."""
    return {
        name: Features(
            keypoints=np.tile(features.keypoints, (500, 1)),
            scales=np.ones(30_000, np.float32),
            orientations=np.zeros(30_000, np.float32),
            scores=np.ones(30_000, np.float32),
            descriptors=np.zeros((30_000, 128), np.uint8),
            image_size=(640, 480),
        )
        for name, features in scene_features().items()
    }


def images(names: tuple[str, ...] = NAMES) -> list[ImageRecord]:
    return [ImageRecord(name=name, camera_id=0, sha256="") for name in names]


def all_matches() -> np.ndarray:
    return np.column_stack([np.arange(NUM_POINTS)] * 2).astype(np.int32)


def kept_pairs() -> list[tuple[str, str, np.ndarray]]:
    return [
        (NAMES[0], NAMES[1], all_matches()),
        (NAMES[2], NAMES[1], all_matches()[:20]),
        (NAMES[0], NAMES[2], np.zeros((0, 2), np.int32)),
    ]


def write(path: Path, kept=None, **arguments) -> None:
    features = scene_features()
    arguments = {
        "images": images(),
        "cameras": [CAMERA],
        "features": features.__getitem__,
        "kept": kept_pairs() if kept is None else kept,
        "config": DatabaseConfig(),
    } | arguments
    write_database(path, **arguments)
