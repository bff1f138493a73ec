"""Photos: their index, pixels and masks, cameras and positions from EXIF.

Photos are read as stored: an EXIF orientation is not applied, because COLMAP does not either and camera,
mask and keypoints must speak of the same frame.
"""

from __future__ import annotations

import logging
import math
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from corrsfm.cameras import PhotoInfo, assign_cameras
from corrsfm.config import ImagesConfig
from corrsfm.errors import ImageError, InputError, first_few
from corrsfm.files import sha256_of
from corrsfm.listing import find_masks, list_images
from corrsfm.types import Camera, ImageRecord

__all__ = [
    "duplicate_images",
    "index_images",
    "name_remarks",
    "read_image",
    "read_mask",
    "read_photo_info",
]

logger = logging.getLogger("corrsfm")


def index_images(
    folder: Path,
    config: ImagesConfig,
    *,
    threads: int = 1,
    hash_of: Callable[[Path], str] | None = None,
    info_of: Callable[[Path], PhotoInfo] | None = None,
) -> tuple[list[ImageRecord], list[Camera]]:
    """List the photos of a scene and say what is known of each.

    Parameters
    ----------
    folder : Path
    config : ImagesConfig
    threads : int
        Photos whose headers are read at a time.
    hash_of, info_of : callable, optional
        Stand-ins for `corrsfm.files.sha256_of` and `read_photo_info`, for a caller that remembers their
        results.

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
    """What other programs may stumble over in the names of the photos; corrsfm copes with all of it."""
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


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a photo as grey values, in the orientation in which it is stored.

    Any depth, palette, colour or alpha is accepted; alpha is dropped. Depths above 8 bits are scaled by the
    smallest power of two that holds the photo's brightest pixel, since 10- to 14-bit sensor values are
    commonly stored in 16 bits.

    Returns
    -------
    (H, W) uint8

    Raises
    ------
    ImageError
        If the file cannot be read or decoded completely.
    """
    image = _decode(path, "re-export or remove the photo")
    if image.dtype == np.uint16:
        shift = max(0, int(image.max()).bit_length() - 8)
        image = (image >> shift).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ImageError(f"{path}: pixels of type {image.dtype}; convert the photo to 8 or 16 bits")
    return image


def read_mask(path: Path, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Read a mask.

    Parameters
    ----------
    path : Path
    shape : tuple of int
        Height and width of the photo.

    Returns
    -------
    (H, W) bool
        False where the photo is to be ignored (the mask is zero).

    Raises
    ------
    ImageError
        If the mask cannot be read or is not as large as the photo.
    """
    mask = _decode(path, "re-export or remove the mask")
    if mask.shape != tuple(shape[:2]):
        raise ImageError(
            f"{path}: the mask has {mask.shape[1]}×{mask.shape[0]} pixels, its photo {shape[1]}×{shape[0]} as"
            " stored (EXIF orientation not applied); re-export the mask in that size"
        )
    return mask > 0


def _decode(path: Path, advice: str) -> NDArray:
    """(H, W) grey values in the depth of the file; reads bytes first, for names of any alphabet."""
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror}); {advice}") from error
    if len(content) == 0:
        raise ImageError(f"{path}: the file is empty; {advice}")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(content, flags)
    except cv2.error as error:
        raise ImageError(f"{path}: cannot be decoded ({error.err}); {advice}") from error
    if image is None:
        raise ImageError(f"{path}: is damaged, cut off or no photo; {advice}")
    return np.asarray(image)


def read_photo_info(path: Path) -> PhotoInfo:
    """Size, camera and position of a photo.

    Raises
    ------
    ImageError
        If the photo cannot be read.
    """
    import pycolmap

    bitmap = pycolmap.Bitmap.read(path, False)
    if bitmap is None:
        # A format that pycolmap does not know (WebP) or a file that cannot be read at all.
        height, width = read_image(path).shape
        return PhotoInfo(width=width, height=height)
    return PhotoInfo(
        width=int(bitmap.width),
        height=int(bitmap.height),
        camera_name=bitmap.exif_camera_model() or None,
        focal_px=bitmap.exif_focal_length() or None,
        gps=_position(bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()),
    )


def _position(
    latitude: float | None, longitude: float | None, altitude: float | None
) -> tuple[float, float, float] | None:
    """The position in EXIF if it is one on earth; an altitude that is none becomes 0."""
    # Receivers without a fix write 0, or 0/0, which is read as NaN.
    if latitude is None or longitude is None or (latitude, longitude) == (0.0, 0.0):
        return None
    # Comparisons with NaN are false.
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return None
    metres = float(altitude or 0.0)
    return float(latitude), float(longitude), metres if math.isfinite(metres) else 0.0
