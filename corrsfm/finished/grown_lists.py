"""A scene's list of photos with new ones in it, and the cameras that these get."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from corrsfm import config as cfg
from corrsfm.colmap.cameras import camera_from_pycolmap, with_focal_length
from corrsfm.colmap.sqlite import open_for_reading
from corrsfm.errors import InputError, first_few
from corrsfm.files import sha256_of
from corrsfm.images.cache import PhotoCache
from corrsfm.images.cameras import assign_cameras
from corrsfm.images.listing import find_masks
from corrsfm.reconstruction.resection import camera_in_model, focal_of_photos
from corrsfm.types import Camera, ImageRecord
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import Index
from corrsfm.workspace.models import models_of

__all__ = ["cameras_of_new", "grown_index"]

logger = logging.getLogger("corrsfm")


def grown_index(
    index: Index, fresh: Mapping[str, Path], folder: Path, config: cfg.ImagesConfig, cache: PhotoCache
) -> Index:
    """The index with more photos; a new photo gets the camera of the photos that it is grouped with.

    Parameters
    ----------
    index : Index
    fresh : mapping of str to Path
        New photo → where it lies now.
    folder : Path
        Of the photos that are there.
    config : ImagesConfig
    cache : PhotoCache

    Raises
    ------
    InputError
        If photos of the scene are gone or were changed, or a new one does not fit the camera options.
    """
    before = {record.name: record for record in index.records}
    gone = [name for name in before if not (folder / name).is_file()]
    changed = [
        name for name in before if name not in gone and cache.hash_of(folder / name) != before[name].sha256
    ]
    for names, what in ((gone, "are not there any more"), (changed, "were changed since")):
        if names:
            raise InputError(
                f"{folder}: photos of the scene {what}: {first_few(names)}; put them back, or do everything "
                "again with corrsfm run"
            )
    names = sorted([*before, *fresh])
    infos = [cache.info_of(fresh.get(name, folder / name)) for name in names]
    proposed, groups = assign_cameras(
        names, infos, mode=config.camera_mode, model=config.camera_model, params=config.camera_params
    )
    cameras = list(index.cameras)
    camera_of_group = {
        group: before[name].camera_id for name, group in zip(names, groups, strict=True) if name in before
    }
    for group, camera in enumerate(proposed):
        if group not in camera_of_group:
            camera_of_group[group] = len(cameras)
            cameras.append(camera)
    # Masks are named like the user's photos, not like the JPEGs that were made of them.
    known_masks = {name: record.mask.removesuffix(".png") for name, record in before.items() if record.mask}
    masks = find_masks(config.mask_dir, folder, [known_masks.get(name, name) for name in names])
    records = []
    for name, group, info, mask in zip(names, groups, infos, masks, strict=True):
        records.append(
            before[name]
            if name in before
            else ImageRecord(
                name=name,
                camera_id=camera_of_group[group],
                sha256=cache.hash_of(fresh[name]),
                mask=mask,
                mask_sha256=sha256_of(config.mask_dir / mask) if config.mask_dir and mask else None,
                gps=info.gps,
            )
        )
    # In the order of the first photo of each, as listing the folder would number them.
    order = list(dict.fromkeys(record.camera_id for record in records))
    position = {old: number for number, old in enumerate(order)}
    return Index(
        records=tuple(
            dataclasses.replace(record, camera_id=position[record.camera_id]) for record in records
        ),
        cameras=tuple(cameras[old] for old in order),
    )


def cameras_of_new(workspace: Workspace, index: Index, new: Sequence[str]) -> dict[str, tuple[int, Camera]]:
    """For each new photo the id of its camera in the database, and the camera to write under a new id.

    A photo shares the camera of the photos that it is grouped with if all of them have one and the same in
    the model. Otherwise it gets its own, for which their focal lengths are the guess if there is no other.
    """
    models = models_of(workspace)
    path = workspace.database
    with open_for_reading(path) as database:
        used = {number for (number,) in database.execute("SELECT camera_id FROM cameras")}
    free = max({*used, *(i for model in models for i in model.cameras)}, default=0) + 1
    records = {record.name: record for record in index.records}
    own: dict[int, int] = {}
    chosen = {}
    for name in new:
        group = records[name].camera_id
        companions = [one.name for one in index.records if one.camera_id == group and one.name not in new]
        shared = camera_in_model(models[0], companions)
        if shared is not None:
            chosen[name] = (shared, camera_from_pycolmap(models[0].cameras[shared]))
            continue
        camera, focal_px = index.cameras[group], focal_of_photos(models[0], companions)
        if focal_px is not None and not camera.has_prior_focal_length:
            camera = dataclasses.replace(with_focal_length(camera, focal_px), has_prior_focal_length=False)
        # Photos of which none is known yet share what they are grouped by; others proved to differ.
        number = own.get(group) if not companions else None
        if number is None:
            number, free = free, free + 1
            own[group] = number
        chosen[name] = (number, camera)
    return chosen
