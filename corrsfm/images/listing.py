"""Which files of a folder are photos, and which are masks."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from corrsfm.disk import is_closed, opening
from corrsfm.errors import InputError, first_few
from corrsfm.files import read_lines, why_unusable
from corrsfm.images.photos import CONVERTED_SUFFIXES

__all__ = [
    "IMAGE_SUFFIXES",
    "VIDEO_SUFFIXES",
    "find_masks",
    "holds_pictures",
    "list_images",
    "photos_below",
    "require_list",
]

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp", *CONVERTED_SUFFIXES)
VIDEO_SUFFIXES = (".3gp", ".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".webm", ".wmv")
# Photos that are not read: cameras' own formats, whose brightness and colours a developer has to choose.
_FOREIGN_SUFFIXES = (
    ".arw", ".cr2", ".cr3", ".dng", ".gif", ".jp2", ".jxl", ".nef", ".orf", ".pef", ".raf", ".raw", ".rw2",
    ".srw",
)  # fmt: skip

# All at which lines may be split are among them.
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")

logger = logging.getLogger("corrsfm")


def list_images(
    folder: Path,
    *,
    image_list: Path | None = None,
    mask_dir: Path | None = None,
    chosen: Sequence[str] | None = None,
    at_least: int = 2,
) -> list[str]:
    """Names of the photos in a folder and its sub-folders, sorted.

    Parameters
    ----------
    folder : Path
        Hidden files and folders, and files without one of `IMAGE_SUFFIXES` (in any case), are ignored.
    image_list : Path, optional
        Text file with one name per line, relative to the folder; ``#`` starts a comment line. Only these
        photos are used, whatever their suffix.
    mask_dir : Path, optional
        Folder of masks. If it lies inside the folder, nothing in it is a photo; if it is the folder itself,
        ``NAME.png`` beside a photo ``NAME`` is not a photo. A list overrules this.
    chosen : sequence of str, optional
        Names to choose from, in place of everything in the folder.
    at_least : int
        Photos that there must be: two for a scene of their own.

    Returns
    -------
    list of str
        Posix paths relative to the folder.

    Raises
    ------
    InputError
        If the folder or the list cannot be read, the list names photos that do not exist, or too few photos
        remain.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected the folder with the photos")
    files = list(chosen) if chosen is not None else _visible_files(folder)
    if image_list is None:
        names = files if chosen is not None else [n for n in files if n.lower().endswith(IMAGE_SUFFIXES)]
        if mask_dir is not None:
            names = _without_masks(names, folder, mask_dir)
        names = _without_twins(names)
        _warn_of_foreign(files, names)
        where = str(folder)
    else:
        names = _read_image_list(image_list, folder)
        where = str(image_list)
    unprintable = [name for name in names if not _is_utf8(name)]
    if unprintable:
        why = why_unusable(unprintable[0])
        raise InputError(f"{folder}: {first_few(map(repr, unprintable))}: {why}")
    separating = [name for name in names if _CONTROL.search(name)]
    if separating:
        raise InputError(
            f"{folder}: names hold a tab or a line break, which lists of photos and pairs cannot, or another"
            f" control character: {first_few(map(ascii, separating))}; rename them"
        )
    special = [name for name in names if (folder / name).exists() and not (folder / name).is_file()]
    if special:
        raise InputError(
            f"{folder}: pipes, devices or folders are named like photos: {first_few(special)}; remove them"
        )
    if len(names) < at_least:
        found = f"the only photo is '{names[0]}'" if names else f"no photos, {_census(files)}"
        if videos := [name for name in files if name.lower().endswith(VIDEO_SUFFIXES)]:
            found += f"; to use a video give it in place of its folder: {folder / videos[0]}"
        if not names and "workspace.json" in files:
            found = "is a workspace; the folder of photos comes first: corrsfm run PHOTOS WORKSPACE"
        needed = "at least two overlapping photos are needed" if at_least > 1 else "expected photos"
        raise InputError(f"{where}: {found}; {needed} ({', '.join(IMAGE_SUFFIXES)})")
    return sorted(names)


def photos_below(folder: Path) -> list[str]:
    """Names of the files with one of `IMAGE_SUFFIXES` in a folder and its sub-folders, sorted."""
    return [name for name in _visible_files(folder) if name.lower().endswith(IMAGE_SUFFIXES)]


def _without_twins(names: Sequence[str]) -> list[str]:
    """The names without HEIC and AVIF files that are there in another format too, as phones export them."""
    others = {
        PurePosixPath(name).with_suffix("") for name in names if not name.lower().endswith(CONVERTED_SUFFIXES)
    }
    twins = {
        name
        for name in names
        if name.lower().endswith(CONVERTED_SUFFIXES) and PurePosixPath(name).with_suffix("") in others
    }
    if twins:
        logger.info("ignored %s: the same photos are there in another format", _count_suffixes(sorted(twins)))
    return [name for name in names if name not in twins]


def holds_pictures(folder: Path) -> bool:
    """Whether a folder or its sub-folders hold any photo or video, readable here or not."""
    suffixes = (*IMAGE_SUFFIXES, *_FOREIGN_SUFFIXES, *VIDEO_SUFFIXES)
    try:
        files = _visible_files(folder)
    except InputError:
        return True
    return any(name.lower().endswith(suffixes) for name in files)


def _refuse(error: OSError) -> None:
    """A folder that cannot be looked into may hold photos; one that is gone by now holds none."""
    path = Path(error.filename)
    if isinstance(error, FileNotFoundError) and not os.path.lexists(path):
        return
    if is_closed(path):
        raise InputError(opening(path)) from error
    raise InputError(f"{path}: cannot be looked into ({error.strerror}); open it, or move it away") from error


def _visible_files(folder: Path) -> list[str]:
    """Posix names of all files that are not hidden; links to folders are followed, but never twice.

    Raises
    ------
    InputError
        If a folder may not be read.
    """
    names: list[str] = []
    visited = set()
    for root, folders, files in os.walk(folder, followlinks=True, onerror=_refuse):
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
    """Name photos in formats that are not read, unless the same photo is there as JPEG."""
    read = {PurePosixPath(name).with_suffix("") for name in names}
    foreign = [
        file
        for file in files
        if file.lower().endswith(_FOREIGN_SUFFIXES) and PurePosixPath(file).with_suffix("") not in read
    ]
    if foreign:
        logger.warning(
            "ignored %s: not readable here; convert them to JPEG or TIFF first", _count_suffixes(foreign)
        )


def _without_masks(names: Sequence[str], folder: Path, mask_dir: Path) -> list[str]:
    """The names that are not masks."""
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
    missing = [name for name in names if not os.path.isfile(folder / name)]
    if missing:
        raise InputError(f"{image_list}: {len(missing)} photos are not in {folder}: {first_few(missing)}")
    return names


def find_masks(mask_dir: Path | None, folder: Path, names: Sequence[str]) -> list[str | None]:
    """For each photo ``NAME`` of a folder the mask ``NAME.png`` if it exists; without one it is used whole.

    Raises
    ------
    InputError
        If there is a folder of masks, but no mask in it for any photo.
    """
    if mask_dir is None:
        return [None] * len(names)
    if not mask_dir.is_dir():
        raise InputError(f"{mask_dir}: no such folder; expected the folder with the masks")
    places = [mask_dir / f"{name}.png" for name in names]
    masks = [f"{name}.png" if place.is_file() else None for name, place in zip(names, places, strict=True)]
    if broken := [path.name for path in places if path.is_symlink() and not path.exists()]:
        raise InputError(f"{mask_dir}: links that lead nowhere: {first_few(broken)}; mend or remove them")
    rule = f"the mask of '{names[0]}' must be '{names[0]}.png'"
    if not any(masks):
        raise InputError(f"{mask_dir}: no mask for any photo; {rule}")
    logger.info("masks: %d of %d photos", len(masks) - masks.count(None), len(names))
    if stray := _stray_masks(mask_dir, folder):
        subject = "1 mask belongs" if len(stray) == 1 else f"{len(stray)} masks belong"
        logger.warning("%s: %s to no photo: %s; %s", mask_dir, subject, first_few(stray), rule)
    return masks


def require_list(path: Path) -> None:
    """Refuse to write a list of photos in place of a file that is none.

    Raises
    ------
    InputError
        If there is such a file.
    """
    if path.is_file() and not all(line.lower().endswith(IMAGE_SUFFIXES) for line in read_lines(path)):
        raise InputError(f"{path}: exists and is not a list of photos; choose another name, or remove it")


def _stray_masks(mask_dir: Path, folder: Path) -> list[str]:
    """Pictures among the masks that are neither the mask of a file among the photos nor a photo."""
    if folder.resolve().is_relative_to(mask_dir.resolve()):
        return []  # photos and masks share a folder and look alike
    return [
        name
        for name in _visible_files(mask_dir)
        if name.lower().endswith(IMAGE_SUFFIXES)
        and not (name.endswith(".png") and (folder / name[:-4]).is_file())
    ]


def _census(files: Sequence[str]) -> str:
    """Describe what a folder holds instead of photos."""
    return f"only {_count_suffixes(files)}" if files else "no visible files at all"


def _count_suffixes(files: Sequence[str]) -> str:
    """Count files by suffix, for the most frequent suffixes."""
    suffixes = Counter(PurePosixPath(name).suffix.lower() or "no suffix" for name in files)
    return ", ".join(f"{count} × {suffix}" for suffix, count in suffixes.most_common(5))


def _is_utf8(name: str) -> bool:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
