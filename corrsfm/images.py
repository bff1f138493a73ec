"""Photos: listing, reading, masks, cameras and positions from EXIF.

Photos are read as stored: an EXIF orientation is not applied, because COLMAP does not either and camera,
mask and keypoints must speak of the same frame.
"""

from __future__ import annotations

import logging
import math
import os
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray

from corrsfm.cameras import PhotoInfo, assign_cameras
from corrsfm.config import ImagesConfig
from corrsfm.errors import ImageError, InputError, first_few
from corrsfm.files import read_lines, sha256_of
from corrsfm.types import Camera, ImageRecord

__all__ = [
    "IMAGE_SUFFIXES",
    "duplicate_images",
    "index_images",
    "list_images",
    "name_remarks",
    "read_image",
    "read_mask",
    "read_photo_info",
]

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
# Photos that neither OpenCV nor pycolmap reads: phones' and cameras' own formats.
_FOREIGN_SUFFIXES = (
    ".arw", ".avif", ".cr2", ".cr3", ".dng", ".gif", ".heic", ".heif", ".jp2", ".jxl", ".nef", ".orf", ".pef",
    ".raf", ".raw", ".rw2", ".srw",
)  # fmt: skip

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
    masks = _find_masks(config.mask_dir, folder, names)
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


def list_images(folder: Path, *, image_list: Path | None = None, mask_dir: Path | None = None) -> list[str]:
    """Names of the photos in a folder and its sub-folders, sorted.

    Parameters
    ----------
    folder : Path
        Hidden files and folders, and files without one of `IMAGE_SUFFIXES` (in any case), are ignored.
    image_list : Path, optional
        Text file with one name per line, relative to the folder; ``#`` starts a comment line. Only these
        photos are used, whatever their suffix.
    mask_dir : Path, optional
        Folder of masks. If it lies inside the folder, what it holds is no photo; if it is the folder itself,
        ``NAME.png`` beside a photo ``NAME`` is none. A list overrules this.

    Returns
    -------
    list of str
        Posix paths relative to the folder, at least two.

    Raises
    ------
    InputError
        If the folder or the list cannot be read, the list names photos that do not exist, or fewer than two
        photos remain.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected the folder with the photos")
    files = _visible_files(folder)
    if image_list is None:
        names = [name for name in files if name.lower().endswith(IMAGE_SUFFIXES)]
        if mask_dir is not None:
            names = _without_masks(names, folder, mask_dir)
        _warn_of_foreign(files, names)
        where = str(folder)
    else:
        names = _read_image_list(image_list, folder)
        where = str(image_list)
    unprintable = [name for name in names if not _is_utf8(name)]
    if unprintable:
        raise InputError(
            f"{folder}: names are not valid UTF-8: {first_few(map(repr, unprintable))}; rename them"
        )
    separating = [name for name in names if "\t" in name or name.splitlines() != [name]]
    if separating:
        raise InputError(
            f"{folder}: names hold a tab or a line break, which lists of photos and pairs cannot:"
            f" {first_few(map(ascii, separating))}; rename them"
        )
    if len(names) < 2:
        found = f"the only photo is '{names[0]}'" if names else f"no photos, {_census(files)}"
        raise InputError(
            f"{where}: {found}; at least two overlapping photos are needed ({', '.join(IMAGE_SUFFIXES)})"
        )
    return sorted(names)


def _visible_files(folder: Path) -> list[str]:
    """Posix names of all files that are not hidden; links to folders are followed, but never twice."""
    names: list[str] = []
    visited = set()
    for root, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(root)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        relative = Path(root).relative_to(folder)
        names.extend((relative / name).as_posix() for name in files if not name.startswith("."))
    return sorted(names)


def _warn_of_foreign(files: Sequence[str], names: Sequence[str]) -> None:
    """Say which photos are not read; a raw photo beside the same one as JPEG is not missed."""
    read = {PurePosixPath(name).with_suffix("") for name in names}
    foreign = [
        file
        for file in files
        if file.lower().endswith(_FOREIGN_SUFFIXES) and PurePosixPath(file).with_suffix("") not in read
    ]
    if foreign:
        logger.warning("ignored %s: not readable here; convert them to JPEG first", _count_suffixes(foreign))


def _without_masks(names: Sequence[str], folder: Path, mask_dir: Path) -> list[str]:
    """The names that are no masks."""
    masks, photos = mask_dir.resolve(), folder.resolve()
    if masks == photos:
        listed = set(names)
        return [name for name in names if not (name.endswith(".png") and name[:-4] in listed)]
    if not masks.is_relative_to(photos):
        return list(names)
    # Folders, since a mask may itself be a link to elsewhere.
    inside = {
        parent: (folder / parent).resolve().is_relative_to(masks)
        for parent in {PurePosixPath(name).parent for name in names}
    }
    return [name for name in names if not inside[PurePosixPath(name).parent]]


def _read_image_list(image_list: Path, folder: Path) -> list[str]:
    lines = read_lines(image_list)
    entries = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    names = sorted({PurePosixPath(entry).as_posix() for entry in entries})
    outside = [name for name in names if name.startswith("/") or ".." in PurePosixPath(name).parts]
    if outside:
        raise InputError(f"{image_list}: names must be relative to {folder}: {first_few(outside)}")
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise InputError(f"{image_list}: {len(missing)} photos are not in {folder}: {first_few(missing)}")
    return names


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


def _find_masks(mask_dir: Path | None, folder: Path, names: Sequence[str]) -> list[str | None]:
    """For each photo ``NAME`` the mask ``NAME.png`` if it exists; photos without one are used whole."""
    if mask_dir is None:
        return [None] * len(names)
    if not mask_dir.is_dir():
        raise InputError(f"{mask_dir}: no such folder; expected the folder with the masks")
    masks = [f"{name}.png" if (mask_dir / f"{name}.png").is_file() else None for name in names]
    rule = f"the mask of '{names[0]}' must be '{names[0]}.png'"
    if not any(masks):
        raise InputError(f"{mask_dir}: no mask for any photo; {rule}")
    logger.info("masks: %d of %d photos", len(masks) - masks.count(None), len(names))
    if stray := _stray_masks(mask_dir, folder):
        subject = "1 mask belongs" if len(stray) == 1 else f"{len(stray)} masks belong"
        logger.warning("%s: %s to no photo: %s; %s", mask_dir, subject, first_few(stray), rule)
    return masks


def _stray_masks(mask_dir: Path, folder: Path) -> list[str]:
    """Pictures among the masks that are neither the mask of a file among the photos nor a photo."""
    if folder.resolve().is_relative_to(mask_dir.resolve()):
        return []  # the photos are among the masks: nothing tells one from the other
    return [
        name
        for name in _visible_files(mask_dir)
        if name.lower().endswith(IMAGE_SUFFIXES)
        and not (name.endswith(".png") and (folder / name[:-4]).is_file())
    ]


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


def _census(files: Sequence[str]) -> str:
    """What is in a folder instead of photos."""
    return f"only {_count_suffixes(files)}" if files else "no visible files at all"


def _count_suffixes(files: Sequence[str]) -> str:
    """How many files there are of each suffix, for those that most of them have."""
    suffixes = Counter(PurePosixPath(name).suffix.lower() or "no suffix" for name in files)
    return ", ".join(f"{count} × {suffix}" for suffix, count in suffixes.most_common(5))


def _is_utf8(name: str) -> bool:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
