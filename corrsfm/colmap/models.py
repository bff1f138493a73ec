"""Finding COLMAP models, reading and writing them, their poses, and summarising them in numbers."""

from __future__ import annotations

import errno
import os
import re
import shlex
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.log import colmap_log
from corrsfm.disk import room_for
from corrsfm.errors import InputError, WorkspaceError
from corrsfm.files import read_bytes
from corrsfm.geometry import Pose
from corrsfm.types import ModelSummary

__all__ = [
    "find_model",
    "is_model",
    "observation_errors",
    "poses_of",
    "read_model",
    "read_models",
    "summarise_model",
    "write_model",
]

# Where a folder may keep its model: a workspace's first one, COLMAP's own habits.
_PLACES = (".", "sparse/0", "sparse", "model", "0")


# What pycolmap raises on damaged bytes.
_UNREADABLE = (RuntimeError, ValueError, LookupError, MemoryError, TypeError, OSError)


def is_model(folder: Path) -> bool:
    """Whether a folder is a COLMAP model, binary or text."""
    # A workspace has an images.txt too, the list of its photos.
    return any(
        (folder / f"cameras{suffix}").exists() and (folder / f"images{suffix}").exists()
        for suffix in (".bin", ".txt")
    )


def find_model(folder: Path) -> Path:
    """The model in a folder: the folder itself, or in its ``sparse/0``, ``sparse``, ``model`` or ``0``.

    Raises
    ------
    InputError
        If there is none.
    """
    for place in _PLACES:
        if is_model(folder / place):
            return folder / place
    raise InputError(
        f"{folder}: holds no COLMAP model (cameras and images, .bin or .txt) and no sparse/0, sparse or "
        f"model with one; for a workspace run: corrsfm reconstruct {shlex.quote(str(folder))}"
    )


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model that the user handed in.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        return _read(folder)
    except _UNREADABLE as error:
        # pycolmap says first where in its source it was.
        what = re.sub(r"^\[[\w.]+:\d+\] ", "", str(error))
        raise InputError(
            f"{folder}: COLMAP model cannot be read ({what}); a file of it is damaged: give a whole one"
        ) from error


def _read(folder: Path) -> pycolmap.Reconstruction:
    for path in folder.glob("*.bin"):
        # pycolmap makes room for as many as the file promises, and makes up what is missing at its end.
        content = read_bytes(path)
        promised = int.from_bytes(content[:8], "little")
        if len(content) < 8 or promised > len(content):
            raise ValueError(f"{path.name} promises {promised} entries in {len(content)} bytes")
        if path.name in _SIZES:
            _check_end(path.name, content, promised)
    with colmap_log():
        model = pycolmap.Reconstruction(str(folder))
    for image_id, image in model.images.items():
        try:
            image.name  # noqa: B018
        except UnicodeDecodeError as error:
            raise ValueError(
                f"the name of photo {image_id} is not UTF-8: {ascii(error.object[:60])}"
            ) from None
    return model


def _size_of_image(content: bytes, start: int) -> int:
    name_end = content.index(b"\0", start + 64) + 1
    (num_points,) = struct.unpack_from("<Q", content, name_end)
    return int(name_end - start + 8 + 24 * num_points)


def _size_of_point(content: bytes, start: int) -> int:
    (track_length,) = struct.unpack_from("<Q", content, start + 43)
    return int(51 + 8 * track_length)


def _size_of_frame(content: bytes, start: int) -> int:
    (num_data,) = struct.unpack_from("<I", content, start + 64)
    return int(68 + 16 * num_data)


def _size_of_rig(content: bytes, start: int) -> int:
    (num_sensors,) = struct.unpack_from("<I", content, start + 4)
    place = start + (16 if num_sensors else 8)
    for _ in range(num_sensors - 1):
        (has_pose,) = struct.unpack_from("<B", content, place + 8)
        place += 65 if has_pose else 9
    return place - start


# Bytes of an entry that begins at a place of a file, as COLMAP writes it: photo id, pose, camera id, name,
# points; point id, position, colour, error, track; frame id, rig id, pose, photos; rig id, sensors, of which
# all but the first have poses or none.
_SIZES: dict[str, Callable[[bytes, int], int]] = {
    "frames.bin": _size_of_frame,
    "images.bin": _size_of_image,
    "points3D.bin": _size_of_point,
    "rigs.bin": _size_of_rig,
}


def _check_end(name: str, content: bytes, num_entries: int) -> None:
    """Raise `ValueError` unless a binary file ends where its last entry does."""
    place = 8
    try:
        for _ in range(num_entries):
            place += _SIZES[name](content, place)
    except (struct.error, ValueError, OverflowError) as error:
        raise ValueError(f"{name} ends within an entry") from error
    if place != len(content):
        raise ValueError(f"{name} has {len(content)} bytes, and its entries {place}")


# Bytes of an entry in binary: of a photo, an observation, a point, one of its views; at least those of a
# camera and of a frame. As text a number takes up to 24.
_PHOTO, _OBSERVATION, _POINT, _VIEW, _CAMERA, _FRAME = 73, 24, 51, 8, 48, 64
_TEXT_FACTOR = 4
_EXTRA_BYTES = 1 << 13


def write_model(model: pycolmap.Reconstruction, folder: Path, *, as_text: bool = False) -> None:
    """Write a model into a folder; pycolmap alone cuts it short on a full disk and says nothing.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    folder : Path
        Is made where it is missing.
    as_text : bool
        COLMAP's text format instead of the binary one.

    Raises
    ------
    OSError
        If the disk is full, or nothing may be written there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with room_for(folder, *_sizes(model, as_text)):
        (model.write_text if as_text else model.write_binary)(folder)
    try:
        (_check_texts if as_text else _check_written)(model, folder)
    except (OSError, ValueError) as error:
        raise OSError(errno.ENOSPC, f"what was written is not whole: {error}", str(folder)) from error


def _sizes(model: pycolmap.Reconstruction, as_text: bool) -> list[int]:
    """Bytes of each file of a model, at most."""
    images, num_views = model.images.values(), model.compute_num_observations()
    names = sum(len(os.fsencode(image.name)) for image in images)
    num_keypoints = sum(image.num_points2D() for image in images)
    sizes = [
        names + len(images) * _PHOTO + num_keypoints * _OBSERVATION,
        model.num_points3D() * _POINT + num_views * _VIEW,
        model.num_cameras() * 4 * _CAMERA,
        model.num_frames() * 2 * _FRAME,
        model.num_rigs() * 2 * _FRAME,
    ]
    return [size * (_TEXT_FACTOR if as_text else 1) + _EXTRA_BYTES for size in sizes]


def _check_written(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Raise `ValueError` unless the binary files that matter hold all of a model."""
    for name, number in (("images.bin", model.num_reg_images()), ("points3D.bin", model.num_points3D())):
        content = read_bytes(folder / name)
        if int.from_bytes(content[:8], "little") != number:
            raise ValueError(f"{name} does not hold {number} entries")
        _check_end(name, content, number)
    for name, least in (
        ("cameras.bin", model.num_cameras() * _CAMERA),
        ("frames.bin", model.num_reg_frames() * _FRAME),
    ):
        if (folder / name).stat().st_size < 8 + least:
            raise ValueError(f"{name} is too short")


def _check_texts(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Raise `ValueError` unless the text files that matter hold all of a model."""
    for name, num_lines in (
        ("images.txt", 2 * model.num_reg_images()),
        ("points3D.txt", model.num_points3D()),
        ("cameras.txt", model.num_cameras()),
    ):
        content = read_bytes(folder / name)
        num = sum(not line.startswith(b"#") for line in content.splitlines())
        if num < num_lines or not content.endswith(b"\n"):
            raise ValueError(f"{name} ends too early")


def poses_of(model: pycolmap.Reconstruction) -> dict[str, Pose]:
    """Poses of the registered photos by name, sorted."""
    poses = {}
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name):
        pose = image.cam_from_world()
        poses[image.name] = (
            np.asarray(pose.rotation.matrix(), np.float64),
            np.asarray(pose.translation, np.float64),
        )
    return poses


def read_models(folder: Path) -> list[pycolmap.Reconstruction]:
    """Read the models ``folder/0``, ``folder/1`` … in this order.

    Raises
    ------
    WorkspaceError
        If there is none, or one cannot be read.
    """
    models: list[pycolmap.Reconstruction] = []
    while (path := folder / str(len(models))).is_dir():
        try:
            models.append(_read(path))
        except _UNREADABLE as error:
            raise WorkspaceError(
                f"{path}: no readable COLMAP model; try: corrsfm reconstruct "
                f"{shlex.quote(str(folder.parent))} --overwrite"
            ) from error
    if not models:
        raise WorkspaceError(
            f"{folder}: holds no model; try: corrsfm reconstruct {shlex.quote(str(folder.parent))}"
        )
    return models


def observation_errors(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """Reprojection error of every observation of a model.

    Returns
    -------
    (O,) float64
        Distances in pixels between keypoint and projected point, images in order of their names. Infinite
        for a point behind its camera.
    """
    errors = [np.zeros(0)]
    # One pass over the points: asking pycolmap for the point of each observation takes twice as long.
    point_ids = np.array(sorted(model.points3D), np.uint64)
    positions = np.array([model.points3D[int(point_id)].xyz for point_id in point_ids]).reshape(-1, 3)
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        observed = image.get_observation_points2D()
        if not observed:
            continue
        keypoints = np.array([point.xy for point in observed])
        observed_ids = np.array([point.point3D_id for point in observed], np.uint64)
        in_camera = image.cam_from_world() * positions[np.searchsorted(point_ids, observed_ids)]
        projected = np.full_like(keypoints, np.inf)
        front = in_camera[:, 2] > 0
        projected[front] = image.camera.img_from_cam(in_camera[front])
        errors.append(np.linalg.norm(projected - keypoints, axis=1))
    return np.concatenate(errors)


def summarise_model(model: pycolmap.Reconstruction) -> ModelSummary:
    """Summarise a model in numbers."""
    errors = observation_errors(model)
    num_images = model.num_reg_images()
    # Errors are undefined without points.
    mean, median, p95 = (
        (errors.mean(), *np.percentile(errors, [50, 95])) if len(errors) else (np.nan, np.nan, np.nan)
    )
    num_observations = model.compute_num_observations()
    return ModelSummary(
        image_names=tuple(sorted(image.name for image in model.images.values() if image.has_pose)),
        num_points=model.num_points3D(),
        num_observations=num_observations,
        mean_track_length=num_observations / max(model.num_points3D(), 1),
        mean_observations_per_image=num_observations / max(num_images, 1),
        mean_error_px=float(mean),
        median_error_px=float(median),
        p95_error_px=float(p95),
    )
