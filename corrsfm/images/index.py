"""The photos of a scene: names, hashes, cameras and positions."""

from __future__ import annotations

import logging
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from corrsfm.config import ImagesConfig
from corrsfm.errors import CorrsfmError, DependencyError, ImageError, InputError, first_few
from corrsfm.files import sha256_of
from corrsfm.images.cameras import PhotoInfo, assign_cameras
from corrsfm.images.convert import readable_name
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
    photos: Sequence[str] | None = None,
    copies: Path | None = None,
    failed: Mapping[str, CorrsfmError] | None = None,
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
    photos : sequence of str, optional
        Names of the photos, if they have been listed already.
    copies : Path, optional
        Folder of `readable_copies` of the photos. The records then name the copies; masks are named like the
        photos.
    failed : mapping, optional
        Photos that could not be copied, and why.

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
        If a package is missing that reads them, there are fewer than two photos, or the list, the masks or
        the cameras do not fit them.
    """
    hash_of = hash_of or sha256_of
    info_of = info_of or read_photo_info
    failed = failed or {}
    if photos is None:
        photos = list_images(folder, image_list=config.image_list, mask_dir=config.mask_dir)
    place = copies or folder
    named = {photo: readable_name(photo) if copies else photo for photo in photos}

    def read(photo: str) -> tuple[str, PhotoInfo] | CorrsfmError:
        if photo in failed:
            return failed[photo]
        try:
            info = info_of(place / named[photo])
            return hash_of(place / named[photo]), info
        except (ImageError, DependencyError) as error:
            return error

    with ThreadPoolExecutor(threads) as pool:
        results = dict(zip(photos, pool.map(read, photos), strict=True))
    unreadable = [result for result in results.values() if isinstance(result, CorrsfmError)]
    if unreadable and not config.skip_unreadable:
        raise _refusal(unreadable)
    for error in unreadable:
        logger.warning("left out: %s", error)
    # Sorted by the names of the copies, which are those of the photos but for the suffix.
    photos = sorted(
        (photo for photo in photos if not isinstance(results[photo], CorrsfmError)), key=named.__getitem__
    )
    names = [named[photo] for photo in photos]
    found = [result for photo in photos if not isinstance(result := results[photo], CorrsfmError)]
    if len(names) < 2:
        raise InputError(f"{folder}: only {len(names)} photos can be read; at least two are needed")
    cameras, camera_ids = assign_cameras(
        names,
        [info for _, info in found],
        mode=config.camera_mode,
        model=config.camera_model,
        params=config.camera_params,
    )
    masks = find_masks(config.mask_dir, folder, photos)
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


def _refusal(errors: Sequence[CorrsfmError]) -> CorrsfmError:
    """One error for all photos that cannot be read; the same package may be missing for all of them."""
    advice = "--skip-unreadable goes on without such photos"
    if all(isinstance(error, DependencyError) for error in errors):
        rest = f"; so {len(errors) - 1} more photos" if len(errors) > 1 else ""
        return InputError(f"{errors[0]}{rest}\n{advice}")
    return ImageError("\n".join([*map(str, errors), advice]))


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
