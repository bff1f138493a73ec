"""The photos of a scene: names, hashes, cameras and positions."""

from __future__ import annotations

import logging
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from corrsfm.config import ImagesConfig
from corrsfm.errors import ImageError, InputError, first_few
from corrsfm.files import sha256_of
from corrsfm.images.cameras import PhotoInfo, assign_cameras
from corrsfm.images.listing import find_masks, list_images
from corrsfm.images.photos import read_photo_info
from corrsfm.types import Camera, ImageRecord

__all__ = ["duplicate_images", "index_images", "name_remarks"]

logger = logging.getLogger("corrsfm")


def index_images(
    folder: Path,
    config: ImagesConfig,
    *,
    threads: int = 1,
    hash_of: Callable[[Path], str] | None = None,
    info_of: Callable[[Path], PhotoInfo] | None = None,
) -> tuple[list[ImageRecord], list[Camera]]:
    """List the photos of a scene with their hashes, cameras and positions.

    Parameters
    ----------
    folder : Path
    config : ImagesConfig
    threads : int
        Photos whose headers are read at a time.
    hash_of, info_of : callable, optional
        Replacements for `corrsfm.files.sha256_of` and `read_photo_info`, such as a cache.

    Returns
    -------
    records : list of ImageRecord
        Sorted by name.
    cameras : list of Camera
        In the order of the first photo of each.

    Raises
    ------
    ImageError
        Naming every photo that cannot be read.
    InputError
        If there are fewer than two photos, or the list, the masks or the cameras do not fit them.
    """
    hash_of = hash_of or sha256_of
    info_of = info_of or read_photo_info
    names = list_images(folder, image_list=config.image_list, mask_dir=config.mask_dir)

    def read(name: str) -> tuple[str, PhotoInfo] | ImageError:
        try:
            info = info_of(folder / name)
            return hash_of(folder / name), info
        except ImageError as error:
            return error

    with ThreadPoolExecutor(threads) as pool:
        results = list(pool.map(read, names))
    unreadable = [str(result) for result in results if isinstance(result, ImageError)]
    if unreadable and not config.skip_unreadable:
        raise ImageError("\n".join(unreadable) + "\n--skip-unreadable goes on without such photos")
    for text in unreadable:
        logger.warning("left out: %s", text)
    names = [n for n, result in zip(names, results, strict=True) if not isinstance(result, ImageError)]
    found = [result for result in results if not isinstance(result, ImageError)]
    if len(names) < 2:
        raise InputError(f"{folder}: only {len(names)} photos can be read; at least two are needed")
    cameras, camera_ids = assign_cameras(
        names,
        [info for _, info in found],
        mode=config.camera_mode,
        model=config.camera_model,
        params=config.camera_params,
    )
    masks = find_masks(config.mask_dir, folder, names)
    records = [
        ImageRecord(
            name=name,
            camera_id=camera_id,
            sha256=sha256,
            mask=mask,
            mask_sha256=hash_of(config.mask_dir / mask) if config.mask_dir and mask else None,
            gps=info.gps,
        )
        for name, camera_id, (sha256, info), mask in zip(names, camera_ids, found, masks, strict=True)
    ]
    return records, cameras


def name_remarks(names: Sequence[str]) -> list[str]:
    """Warn of photo names that other programs cannot handle; corrsfm can."""
    remarks = []
    spaced = [name for name in names if any(character.isspace() for character in name)]
    if spaced:
        subject = "1 name contains" if len(spaced) == 1 else f"{len(spaced)} names contain"
        remarks.append(
            f"{subject} spaces, which text files of COLMAP and hloc cannot hold: {first_few(spaced)};"
            " rename them, or keep to corrsfm and pycolmap, which cope"
        )
    groups = defaultdict(list)
    for name in names:
        groups[unicodedata.normalize("NFC", name).casefold()].append(name)
    remarks.extend(
        f"file systems that ignore case or accents' encoding would mix up: {', '.join(group)}"
        for group in groups.values()
        if len(group) > 1
    )
    return remarks


def duplicate_images(records: Iterable[ImageRecord]) -> list[tuple[str, ...]]:
    """Names of photos whose bytes are the same, in groups of at least two, sorted."""
    groups = defaultdict(list)
    for record in records:
        groups[record.sha256].append(record.name)
    return sorted(tuple(sorted(group)) for group in groups.values() if len(group) > 1)
