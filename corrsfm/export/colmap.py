"""COLMAP itself: today's, and 3.8 that came before rigs and frames."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from corrsfm.colmap.databases import convert_to_3_8, copy_photos_of
from corrsfm.colmap.models import write_model
from corrsfm.errors import InputError
from corrsfm.export.photos import copy_photos
from corrsfm.files import atomic_write_text

__all__ = ["write_colmap", "write_colmap3", "write_three_files"]

_NEWEST_MODEL_OF_3_8 = 10


def write_three_files(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin`` alone: what readers of every age know."""
    write_model(model, folder)
    for name in ("rigs.bin", "frames.bin"):
        (folder / name).unlink()


def write_colmap(model: pycolmap.Reconstruction, images_dir: Path, database: Path, folder: Path) -> None:
    """``images``, ``image_list.txt``, ``database.db``, ``sparse/0`` in binary and ``sparse_text/0``."""
    names = _write_photos(model, images_dir, folder)
    copy_photos_of(database, folder / "database.db", names)
    write_model(model, folder / "sparse" / "0")
    write_model(model, folder / "sparse_text" / "0", as_text=True)


def write_colmap3(model: pycolmap.Reconstruction, images_dir: Path, database: Path, folder: Path) -> None:
    """The same for COLMAP 3.8: its database schema, and models of three files.

    Raises
    ------
    InputError
        If it does not know a camera model.
    """
    for camera in model.cameras.values():
        if camera.model.value > _NEWEST_MODEL_OF_3_8:
            raise InputError(
                f"camera {camera.camera_id}: COLMAP 3.8 does not know the model {camera.model_name}; "
                "reconstruct with --camera-model OPENCV or OPENCV_FISHEYE"
            )
    names = _write_photos(model, images_dir, folder)
    current = folder / ".current.db"
    copy_photos_of(database, current, names)
    convert_to_3_8(current, folder / "database.db")
    current.unlink()
    write_three_files(model, folder / "sparse" / "0")


def _write_photos(model: pycolmap.Reconstruction, images_dir: Path, folder: Path) -> list[str]:
    names = sorted(image.name for image in model.images.values())
    copy_photos(names, images_dir, folder / "images")
    atomic_write_text(folder / "image_list.txt", "".join(f"{name}\n" for name in names))
    return names
