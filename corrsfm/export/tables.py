"""Points as a PLY file, poses as a table."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pycolmap

from corrsfm.colmap.models import poses_of

__all__ = ["CSV_COLUMNS", "write_csv", "write_ply"]

CSV_COLUMNS = (
    "name", "qw", "qx", "qy", "qz", "tx", "ty", "tz", "x", "y", "z", "focal_px", "camera", "num_points",
)  # fmt: skip

_PLY_POINT = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def write_ply(model: pycolmap.Reconstruction, path: Path) -> None:
    """The points with their colours, in binary; unlike pycolmap's own, it fails where the disk is full."""
    points = [model.points3D[number] for number in sorted(model.points3D)]
    values = np.zeros(len(points), _PLY_POINT)
    if points:
        values["xyz"] = [point.xyz for point in points]
        values["rgb"] = [point.color for point in points]
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties]
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        file.write(values.tobytes())


def write_csv(model: pycolmap.Reconstruction, path: Path) -> None:
    """A line a photo: rotation and translation of ``cam_from_world``, centre, camera, points seen."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        for name in poses_of(model):
            image = model.find_image_with_name(name)
            pose, camera = image.cam_from_world(), model.cameras[image.camera_id]
            x, y, z, w = pose.rotation.quat
            numbers = (w, x, y, z, *pose.translation, *image.projection_center(), camera.mean_focal_length())
            writer.writerow(
                [name, *(repr(float(value)) for value in numbers), image.camera_id, image.num_points3D]
            )
