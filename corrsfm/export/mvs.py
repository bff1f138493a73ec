"""OpenMVS, Bundler and NVM: undistorted photos, and cameras, points and keypoints as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from corrsfm.colmap.models import poses_of, write_model
from corrsfm.errors import InputError
from corrsfm.export.photos import undistort

__all__ = ["write_bundler", "write_nvm", "write_openmvs"]

# Both formats hold one focal length, and a principal point in the middle.
_LARGEST_SHIFT_PX = 0.5
# From COLMAP's camera axes, y down and z forward, to Bundler's.
_FLIP = np.array([1.0, -1.0, -1.0])


def write_openmvs(model: pycolmap.Reconstruction, images_dir: Path, folder: Path) -> None:
    """``images`` and ``sparse`` as text with PINHOLE cameras, which InterfaceCOLMAP reads."""
    pinhole = undistort(model, images_dir, folder)
    write_model(pinhole, folder / "sparse", as_text=True)
    for name in ("rigs.txt", "frames.txt"):
        (folder / "sparse" / name).unlink()


def write_bundler(model: pycolmap.Reconstruction, images_dir: Path, folder: Path) -> None:
    """``bundle.out`` of version 0.3, ``list.txt`` and ``images``.

    Bundler's cameras look along −z with y up, and keypoints count from the middle of the photo.
    """
    pinhole = undistort(model, images_dir, folder)
    poses = poses_of(pinhole)
    positions = {name: i for i, name in enumerate(poses)}
    lines = ["# Bundle file v0.3", f"{len(poses)} {pinhole.num_points3D()}"]
    for name, (rotation, translation) in poses.items():
        camera = pinhole.cameras[pinhole.find_image_with_name(name).camera_id]
        lines.append(f"{_focal_px(camera)!r} 0 0")
        lines += [_numbers(row) for row in (*(_FLIP[:, None] * rotation), _FLIP * translation)]
    for point in pinhole.points3D.values():
        seen = _seen(pinhole, point, positions)
        lines += [
            _numbers(point.xyz),
            " ".join(str(int(value)) for value in point.color),
            " ".join([str(len(seen)), *(f"{i} {k} {x!r} {-y!r}" for i, k, x, y in seen)]),
        ]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "list.txt").write_text("".join(f"images/{name}\n" for name in poses), encoding="utf-8")


def write_nvm(model: pycolmap.Reconstruction, images_dir: Path, folder: Path) -> None:
    """``model.nvm`` of version 3 and ``images``; keypoints count from the middle of the photo, y down."""
    pinhole = undistort(model, images_dir, folder)
    poses = poses_of(pinhole)
    positions = {name: i for i, name in enumerate(poses)}
    lines = ["NVM_V3", "", str(len(poses))]
    for name in poses:
        image = pinhole.find_image_with_name(name)
        x, y, z, w = image.cam_from_world().rotation.quat
        numbers = [_focal_px(pinhole.cameras[image.camera_id]), w, x, y, z, *image.projection_center(), 0.0]
        lines.append(f"images/{name}\t{_numbers(numbers)} 0")
    lines += ["", str(pinhole.num_points3D())]
    for point in pinhole.points3D.values():
        seen = _seen(pinhole, point, positions)
        colour = " ".join(str(int(value)) for value in point.color)
        views = " ".join(f"{i} {k} {x!r} {y!r}" for i, k, x, y in seen)
        lines.append(f"{_numbers(point.xyz)} {colour} {len(seen)} {views}")
    (folder / "model.nvm").write_text("\n".join(lines) + "\n\n0\n", encoding="utf-8")


def _numbers(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def _focal_px(camera: pycolmap.Camera) -> float:
    """The one focal length of an undistorted camera.

    Raises
    ------
    InputError
        If the format cannot hold the camera to half a pixel.
    """
    fx, fy, cx, cy = camera.params
    half = max(camera.width, camera.height) / 2
    shift = max(abs(cx - camera.width / 2), abs(cy - camera.height / 2), abs(fx - fy) / fx * half)
    if shift > _LARGEST_SHIFT_PX:
        raise InputError(
            f"camera {camera.camera_id}: its two focal lengths ({fx:.1f} and {fy:.1f} px) or its principal "
            f"point ({cx:.1f}, {cy:.1f}) do not fit a format with one focal length and the middle of the "
            "photo; use --for openmvs or --for colmap"
        )
    return float((fx + fy) / 2)


def _seen(
    model: pycolmap.Reconstruction, point: pycolmap.Point3D, positions: dict[str, int]
) -> list[tuple[int, int, float, float]]:
    """Position of the photo in a list, index of the keypoint, and x, y from the middle of the photo."""
    found = []
    for element in point.track.elements:
        image = model.images[element.image_id]
        x, y = image.points2D[element.point2D_idx].xy - model.cameras[image.camera_id].params[2:]
        found.append((positions[image.name], int(element.point2D_idx), float(x), float(y)))
    return sorted(found)
