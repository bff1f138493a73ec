"""The first stage: photos, or the frames of a video, become the index of a workspace."""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import time
from pathlib import Path

from tqdm import tqdm

from corrsfm import config as cfg
from corrsfm.colmap.log import colmap_log
from corrsfm.config import config_hash
from corrsfm.errors import ConfigError, InputError, WorkspaceError, first_few
from corrsfm.files import OWN_RECORD
from corrsfm.images.cache import PhotoCache
from corrsfm.images.convert import is_converted, possible_originals, readable_copies
from corrsfm.images.frames import are_frames_of, extract_frames
from corrsfm.images.index import duplicate_images, index_images, name_remarks
from corrsfm.images.listing import list_images
from corrsfm.images.sources import Given, PhotoSource, find_source
from corrsfm.machine import count_threads
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import Index, read_index, write_index
from corrsfm.workspace.resume import StageOutcome, finish
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["fingerprint_of", "index_photos"]

logger = logging.getLogger("corrsfm")


@keeps_warnings("images")
def index_photos(
    workspace: Workspace,
    photos: Given,
    config: cfg.ImagesConfig,
    run: cfg.RunConfig,
    *,
    overwrite: bool = False,
) -> StageOutcome:
    """List the photos, read their cameras and write the index.

    Frames of a video are written to ``frames`` of the workspace and share a camera unless the mode says
    otherwise. If some photos are HEIC or AVIF, ``converted`` gets JPEGs of them and links to the others.

    Parameters
    ----------
    workspace : Workspace
    photos : Given
        A folder, a video, photos, a list or a pattern; see `find_source`.

    Raises
    ------
    InputError
        If there are fewer than two photos, or the folder, list, masks or camera options cannot be used, or,
        without ``overwrite``, if most of the photos that the workspace knows are not in the folder.
    """
    started = time.monotonic()
    source = find_source(photos)
    if source.folder.is_dir() and not overwrite:
        _refuse_vanished_photos(workspace, source)
    cache = PhotoCache(workspace.photo_cache)
    folder, chosen = source.folder, source.names
    if source.video is not None:
        if overwrite:
            _remove_own(workspace.frames)
        folder, chosen = workspace.frames, _frames_of(source.video, workspace.frames, config, cache)
        if config.camera_mode is cfg.CameraMode.AUTO:
            config = dataclasses.replace(config, camera_mode=cfg.CameraMode.SINGLE)
    elif config.frames or config.every:
        logger.warning("--frames and --every choose frames of a video; they have no effect on photos")
    listed = list_images(folder, image_list=config.image_list, mask_dir=config.mask_dir, chosen=chosen)
    listed = _without_own(listed, folder, workspace)
    copies, failed = None, {}
    if any(is_converted(name) for name in listed):
        copies = workspace.converted
        if overwrite:
            _remove_own(copies)
        failed = readable_copies(folder, listed, copies, cache.hash_of)
    with colmap_log(workspace.log):
        records, cameras = index_images(
            folder,
            config,
            threads=count_threads(run.threads),
            hash_of=cache.hash_of,
            info_of=cache.info_of,
            photos=listed,
            copies=copies,
            failed=failed,
        )
    cache.save()
    for remark in name_remarks([record.name for record in records]):
        logger.warning("%s", remark)
    for names in duplicate_images(records):
        logger.warning("photos with the same content: %s", ", ".join(names))
    index = Index(records=tuple(records), cameras=tuple(cameras))
    fingerprint = fingerprint_of(index)
    _explain_photos(workspace, index)
    if not workspace.is_current("images", fingerprint, workspace.images_json, workspace.images_txt):
        workspace.forget("images")
        write_index(workspace, index)
    workspace.remember_photos(source.given, copies or folder)
    outcome = StageOutcome(stage="images", num_items=len(records), seconds=time.monotonic() - started)
    finish(workspace, outcome, fingerprint, config)
    return outcome


def fingerprint_of(index: Index) -> str:
    """What the record of the stage must carry to be current."""
    return config_hash("images", index.records, index.cameras)


def _explain_photos(workspace: Workspace, index: Index) -> None:
    """Log which photos are new, gone or changed since the last run."""
    if workspace.record_of("images") is None:
        return
    try:
        before = {record.name: record.sha256 for record in read_index(workspace).records}
    except WorkspaceError:
        return
    now = {record.name: record.sha256 for record in index.records}
    for text, names in (
        ("new", now.keys() - before.keys()),
        ("gone", before.keys() - now.keys()),
        ("changed", {name for name in now.keys() & before.keys() if now[name] != before[name]}),
    ):
        if names:
            shown = first_few(sorted(names))
            logger.info("photos %s since the last run: %d (%s)", text, len(names), shown)


def _frames_of(video: Path, folder: Path, config: cfg.ImagesConfig, cache: PhotoCache) -> tuple[str, ...]:
    """Names of the frames of a video, written to a folder."""
    if config.frames and config.every:
        raise ConfigError("--frames and --every exclude each other; choose one")
    frames = extract_frames(
        video,
        folder,
        num_frames=config.frames,
        every=config.every,
        hash_of=cache.hash_of,
        track=lambda items, total, text: tqdm(items, desc=text, total=total, unit="frame", leave=False),
    )
    return tuple(frame.name for frame in frames)


def _remove_own(folder: Path) -> None:
    """Remove photos that corrsfm made, so that they are made again; those of others stay."""
    if (folder / OWN_RECORD).is_file():
        shutil.rmtree(folder)


def _without_own(names: list[str], folder: Path, workspace: Workspace) -> list[str]:
    """The photos without those that corrsfm made, where the workspace lies among the photos."""
    own = []
    for place in (workspace.frames.resolve(), workspace.converted.resolve()):
        if folder.resolve() in place.parents and (place / OWN_RECORD).is_file():
            own.append(f"{place.relative_to(folder.resolve()).as_posix()}/")
    return [name for name in names if not name.startswith(tuple(own))]


def _refuse_vanished_photos(workspace: Workspace, source: PhotoSource) -> None:
    """Stop if the folder lacks most known photos: it may be the wrong one, or not mounted.

    Raises
    ------
    InputError
        If more than half of the photos that the workspace knows are not in the folder.
    """
    try:
        known = read_index(workspace).names
    except WorkspaceError:
        return
    # A workspace that lost its record knows no video; its frames say which they are from.
    if source.video is not None:
        if workspace.given_photos in ((), source.given) or are_frames_of(source.video, workspace.frames):
            return
        if workspace.is_sequence:
            raise InputError(
                f"{source.video}: another video than {first_few(workspace.given_photos)}, which "
                f"{workspace.root} was made of; choose another workspace, or add --overwrite to do all of it "
                "again with this one"
            )
    gone = [name for name in known if not any(map(os.path.exists, possible_originals(source.folder / name)))]
    if 2 * len(gone) > len(known):
        raise InputError(
            f"{source.video or source.folder}: {len(gone)} of the {len(known)} photos of {workspace.root} "
            f"are not there ({first_few(gone)}); mount or correct the folder; if they are really gone, add "
            "--overwrite to do everything again without them"
        )
