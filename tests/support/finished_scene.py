"""A finished workspace made without mapping: exact cameras and points, photos with a spot on a point."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap
from corrsfm.files import sha256_of
from corrsfm.types import Features, ImageRecord, PairList
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.items import PrunedMatches
from corrsfm.workspace.lists import Index, write_index, write_pairs
from corrsfm.workspace.stores import features_of, pruned_of

WIDTH, HEIGHT = 200, 150
CAMERAS = {
    "SIMPLE_PINHOLE": [160.0, 100.0, 75.0],
    "SIMPLE_RADIAL": [160.0, 100.0, 75.0, -0.08],
    "OPENCV": [160.0, 164.0, 98.0, 77.0, -0.08, 0.01, 0.002, -0.001],
    "OPENCV_FISHEYE": [90.0, 90.0, 100.0, 75.0, 0.01, 0.002, -0.001, 0.0005],
    "THIN_PRISM_FISHEYE": [120.0, 120.0, 100.0, 75.0, 0.01, 0.0, 0.001, 0.0, 0.0, 0.0, 0.001, 0.0],
    "WIDE_FISHEYE": [55.0, 55.0, 100.0, 75.0, 0.0, 0.0, 0.0, 0.0],
}
LEFT_OUT = "lost.png"


@dataclass(frozen=True, kw_only=True)
class FinishedScene:
    """A workspace, its photos, and the model that lies in ``sparse/0``."""

    workspace: Path
    photos: Path
    model: pycolmap.Reconstruction

    @property
    def names(self) -> list[str]:
        return sorted(image.name for image in self.model.images.values())


def draw_spot(centre: NDArray[np.float64], sigma: float = 2.5) -> NDArray[np.uint8]:
    """A photo that is grey but for a bright spot; the first pixel's centre is (0.5, 0.5)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    spot = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * sigma**2))
    return np.rint(40 + 200 * spot).astype(np.uint8)


def find_spot(photo: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Centre of the spot, by the centroid of what is brighter than the grey."""
    weights = np.clip(photo.astype(np.float64) - 45, 0, None)
    y, x = np.mgrid[: photo.shape[0], : photo.shape[1]] + 0.5
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


def centre_point(model: pycolmap.Reconstruction, image: pycolmap.Image) -> int:
    """Id of the point that a photo sees nearest to a quarter of its width and height."""
    seen = image.get_observation_points2D()
    wanted = np.array([WIDTH / 4, HEIGHT / 4])
    return min(seen, key=lambda point: float(np.linalg.norm(point.xy - wanted))).point3D_id


def make_finished_scene(
    root: Path, *, camera: str = "OPENCV", num_photos: int = 5, num_points: int = 60, folder: str = "left"
) -> FinishedScene:
    """Write a workspace; the first photo lies in a folder, and one photo is in no model."""
    root.mkdir(parents=True)
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=num_photos + 1, num_points3D=num_points,
        camera_width=WIDTH, camera_height=HEIGHT, camera_params=CAMERAS[camera],
        camera_model_id=pycolmap.CameraModelId.__members__[camera.replace("WIDE_FISHEYE", "OPENCV_FISHEYE")],
    )  # fmt: skip
    workspace = Workspace(root / "scene", create=True)
    with pycolmap.Database.open(workspace.database) as database:
        model = pycolmap.synthesize_dataset(options, database)
    for i, image in enumerate(sorted(model.images.values(), key=lambda image: image.image_id)):
        name = LEFT_OUT if i == num_photos else f"{i}.png"
        image.name = f"{folder}/{name}" if folder and i == 0 else name
    with contextlib.closing(sqlite3.connect(workspace.database)) as connection, connection:
        for image in model.images.values():
            connection.execute("UPDATE images SET name = ? WHERE image_id = ?", (image.name, image.image_id))
    rng = np.random.default_rng(0)
    for point in model.points3D.values():
        point.color = rng.integers(0, 256, 3).astype(np.uint8)
    _write_photos(model, root / "photos")
    _write_lists(workspace, model, root / "photos")
    lost = model.find_image_with_name(LEFT_OUT)
    model.deregister_frame(lost.frame_id)
    (workspace.sparse / "0").mkdir(parents=True)
    model.write_binary(workspace.sparse / "0")
    workspace.evidence.write_text(
        json.dumps({"verdict": {"grade": "good", "reasons": ["all is known"], "next_steps": []}})
    )
    workspace.finish("models", StageRecord(fingerprint="made up"))
    return FinishedScene(
        workspace=workspace.root,
        photos=root / "photos",
        model=pycolmap.Reconstruction(workspace.sparse / "0"),
    )


def _write_photos(model: pycolmap.Reconstruction, photos: Path) -> None:
    for image in model.images.values():
        path = photos / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        position = model.points3D[centre_point(model, image)].xyz
        spot = image.camera.img_from_cam(image.cam_from_world() * position[None])[0]
        assert cv2.imwrite(str(path), cv2.cvtColor(draw_spot(spot), cv2.COLOR_GRAY2BGR))


def _write_lists(workspace: Workspace, model: pycolmap.Reconstruction, photos: Path) -> None:
    """Index, pairs, features and kept matches; keypoint k of each photo is that of the model."""
    images = sorted(model.images.values(), key=lambda image: image.name)
    camera = camera_from_pycolmap(next(iter(model.cameras.values())))
    records = tuple(
        ImageRecord(name=image.name, camera_id=0, sha256=sha256_of(photos / image.name)) for image in images
    )
    write_index(workspace, Index(records=records, cameras=(camera,)))
    workspace.images_dir = photos
    names = [image.name for image in images]
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    write_pairs(workspace, PairList(pairs=tuple(pairs), origins=(("exhaustive",),) * len(pairs)))
    features = features_of(workspace)
    for image in images:
        features.add(image.name, "0", _features_of(image))
    features.commit(dict.fromkeys(names, "0"), "features")
    pruned = pruned_of(workspace)
    for pair in pairs:
        index0, index1 = (_keypoint_of_point(model.find_image_with_name(name)) for name in pair)
        common = index0.keys() & index1.keys()
        matches = np.array(sorted((index0[p], index1[p]) for p in common), np.int32).reshape(-1, 2)
        pruned.add(
            pair, "0", PrunedMatches(
                indices=matches, scores=np.full(len(matches), 0.75, np.float32), num_putative=len(matches)
            ),
        )  # fmt: skip
    pruned.commit(dict.fromkeys(pairs, "0"), "pruned matches")


def _keypoint_of_point(image: pycolmap.Image) -> dict[int, int]:
    return {point.point3D_id: k for k, point in enumerate(image.points2D) if point.has_point3D()}


def _features_of(image: pycolmap.Image) -> Features:
    num = len(image.points2D)
    ones = np.ones(num, np.float32)
    return Features(
        keypoints=np.array([point.xy for point in image.points2D], np.float32),
        scales=ones,
        orientations=0 * ones,
        scores=ones,
        descriptors=np.random.default_rng(image.image_id).integers(0, 200, (num, 128)).astype(np.uint8),
        image_size=(WIDTH, HEIGHT),
    )
