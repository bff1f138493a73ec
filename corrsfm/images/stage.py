"""The first stage: a folder of photos becomes the index of a workspace."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from corrsfm import config as cfg
from corrsfm.colmap.log import colmap_log
from corrsfm.config import config_hash
from corrsfm.errors import InputError, WorkspaceError, first_few
from corrsfm.images.cache import PhotoCache
from corrsfm.images.index import duplicate_images, index_images, name_remarks
from corrsfm.machine import count_threads
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import check_hloc_keys
from corrsfm.workspace.lists import Index, read_index, write_index
from corrsfm.workspace.resume import StageOutcome, finish
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["fingerprint_of", "index_photos"]

logger = logging.getLogger("corrsfm")


@keeps_warnings("images")
def index_photos(
    workspace: Workspace,
    images_dir: Path,
    config: cfg.ImagesConfig,
    run: cfg.RunConfig,
    *,
    overwrite: bool = False,
) -> StageOutcome:
    """List the photos, read their cameras and write the index.

    Raises
    ------
    InputError
        If there are fewer than two photos, or the folder, list, masks or camera options cannot be used, or,
        without ``overwrite``, if most of the photos that the workspace knows are not in the folder.
    """
    started = time.monotonic()
    if images_dir.is_dir() and not overwrite:
        _refuse_vanished_photos(workspace, images_dir)
    cache = PhotoCache(workspace.photo_cache)
    with colmap_log(workspace.log):
        records, cameras = index_images(
            images_dir,
            config,
            threads=count_threads(run.threads),
            hash_of=cache.hash_of,
            info_of=cache.info_of,
        )
    cache.save()
    check_hloc_keys(record.name for record in records)
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
    workspace.images_dir = images_dir
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


def _refuse_vanished_photos(workspace: Workspace, images_dir: Path) -> None:
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
    gone = [name for name in known if not os.path.exists(images_dir / name)]
    if 2 * len(gone) > len(known):
        raise InputError(
            f"{images_dir}: {len(gone)} of the {len(known)} photos of {workspace.root} are not there "
            f"({first_few(gone)}); mount or correct the folder; if they are really gone, add --overwrite "
            "to do everything again without them"
        )
