"""Gaussian splatting and nerfstudio: photos and cameras as trainers read them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.models import poses_of
from corrsfm.export.colmap import write_three_files
from corrsfm.export.photos import copy_photos, crop_to_principal_point, flat_names, undistort
from corrsfm.export.tables import write_ply
from corrsfm.export.world import similarity
from corrsfm.files import atomic_write_json

__all__ = ["write_nerfstudio", "write_splat"]

# COLMAP's names → how nerfstudio calls the same parameters; what is missing is zero.
_FOCAL_AND_CENTRE = {"f": ("fl_x", "fl_y"), "fx": ("fl_x",), "fy": ("fl_y",), "cx": ("cx",), "cy": ("cy",)}
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")

# COLMAP's world has y down, nerfstudio's z up: x, y, z become x, z, −y.
_Z_UP_FROM_Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def write_splat(model: pycolmap.Reconstruction, images_dir: Path, folder: Path) -> None:
    """Undistorted photos in ``images``, a PINHOLE model in ``sparse/0`` with centred principal points.

    The reader of gaussian-splatting looks photos up by the last part of their name, so folders in names
    become underscores.
    """
    pinhole = undistort(model, images_dir, folder)
    crop_to_principal_point(pinhole, folder / "images")
    names = flat_names(image.name for image in pinhole.images.values())
    for image in pinhole.images.values():
        (folder / "images" / image.name).rename(folder / "images" / names[image.name])
        image.name = names[image.name]
    for path in sorted((folder / "images").rglob("*"), reverse=True):
        if path.is_dir():
            path.rmdir()
    write_three_files(pinhole, folder / "sparse" / "0")


def write_nerfstudio(
    model: pycolmap.Reconstruction, images_dir: Path, folder: Path, *, z_is_up: bool = False
) -> None:
    """``transforms.json``, ``images`` and ``sparse_pc.ply``.

    Cameras that nerfstudio can express keep their distortion and the photos are copied; others, and mixtures
    of perspective and fisheye cameras, are undistorted. Poses are camera-to-world with OpenGL's axes. Poses
    and points are written in the frame that ``applied_transform`` turns the model's world into.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    images_dir, folder : Path
    z_is_up : bool
        The model's world is upright already: it is not turned.
    """
    kinds = {camera.model_name for camera in model.cameras.values()}
    if kinds <= set(_PERSPECTIVE) or kinds <= set(_FISHEYE):
        copy_photos((image.name for image in model.images.values()), images_dir, folder / "images")
    else:
        model = undistort(model, images_dir, folder)
        kinds = {"PINHOLE"}
    turn = np.eye(3) if z_is_up else _Z_UP_FROM_Y_DOWN
    turned = pycolmap.Reconstruction(model)
    turned.transform(similarity(turn, 1.0))
    values: dict[str, Any] = {
        "camera_model": _camera_model(kinds),
        "frames": _frames(turned),
        "applied_transform": np.column_stack([turn, np.zeros(3)]).tolist(),
    }
    if turned.num_points3D():
        write_ply(turned, folder / "sparse_pc.ply")
        values["ply_file_path"] = "sparse_pc.ply"
    atomic_write_json(folder / "transforms.json", values)


def _camera_model(kinds: set[str]) -> str:
    if kinds <= set(_FISHEYE):
        return "OPENCV_FISHEYE"
    return "PINHOLE" if kinds <= {"SIMPLE_PINHOLE", "PINHOLE"} else "OPENCV"


def _frames(model: pycolmap.Reconstruction) -> list[dict[str, Any]]:
    frames = []
    for name, (rotation, translation) in poses_of(model).items():
        image = model.find_image_with_name(name)
        frames.append(
            {
                "file_path": f"images/{name}",
                "transform_matrix": _opengl_matrix(rotation, translation).tolist(),
                "colmap_im_id": image.image_id,
                **_intrinsics(model.cameras[image.camera_id]),
            }
        )
    return frames


def _opengl_matrix(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world (4, 4) with y up and z backwards, from ``cam_from_world``."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T * [1.0, -1.0, -1.0]
    matrix[:3, 3] = -rotation.T @ translation
    return matrix


def _intrinsics(camera: pycolmap.Camera) -> dict[str, float]:
    """nerfstudio's intrinsics of one frame, in pixels whose first centre is at 0.5 as COLMAP's."""
    fisheye = camera.model_name in _FISHEYE
    values: dict[str, float] = {"w": int(camera.width), "h": int(camera.height)}
    distortion = dict.fromkeys(("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2"), 0.0)
    for name, value in zip(camera.params_info.split(", "), camera.params, strict=True):
        if name in _FOCAL_AND_CENTRE:
            values |= dict.fromkeys(_FOCAL_AND_CENTRE[name], float(value))
        else:
            distortion["k1" if name == "k" else name] = float(value)
    return values | distortion
