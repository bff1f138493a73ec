"""A database in memory, for going on with models that were mapped from it."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pycolmap

from corrsfm.colmap.cameras import write_camera
from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.sqlite import copy_database, database_errors

__all__ = ["load_cache"]


def load_cache(database: Path, *models: pycolmap.Reconstruction) -> pycolmap.DatabaseCache:
    """What mapping needs of a database, with the cameras that models gave their photos.

    A chosen model may have other cameras than the database (`corrsfm.reconstruction.candidates`), and COLMAP
    refuses to go on with one whose photos have others there.

    Parameters
    ----------
    database : Path
        Not changed.
    models : pycolmap.Reconstruction
        Mapped from it; of a photo that several hold, the first decides.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    with colmap_log(), database_errors(database), tempfile.TemporaryDirectory(prefix="corrsfm-") as folder:
        copy = Path(folder) / "database.db"
        copy_database(database, copy)
        with pycolmap.Database.open(copy) as tables:
            done: set[str] = set()
            for model in models:
                done |= _take_over_cameras(tables, model, done)
            return pycolmap.DatabaseCache.create(tables, pycolmap.DatabaseCacheOptions())


def _take_over_cameras(tables: pycolmap.Database, model: pycolmap.Reconstruction, done: set[str]) -> set[str]:
    """Give photos of a database the cameras that they have in a model; the names of all its photos."""
    frame_of = {data.id: frame for frame in tables.read_all_frames() for data in frame.image_ids}
    # Also of photos that it could not place: a part of a model may be joined to another by them.
    of_model = {image.name: image for image in model.images.values() if image.camera_id in model.cameras}
    for image in tables.read_all_images():
        if image.name not in of_model or image.name in done:
            continue
        camera_id = of_model[image.name].camera_id
        if camera_id == image.camera_id:
            continue
        if not tables.exists_camera(camera_id):
            write_camera(tables, model.cameras[camera_id], keep_id=True)
        image.camera_id = camera_id
        # The rig around a camera has its id.
        frame = pycolmap.Frame(frame_id=frame_of[image.image_id].frame_id, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        tables.update_frame(frame)
        tables.update_image(image)
    return set(of_model)
