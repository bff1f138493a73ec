"""What a user may name in place of a folder of photos: files, lists, patterns, several folders, a video."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from corrsfm.errors import InputError, first_few
from corrsfm.files import read_lines
from corrsfm.images.listing import IMAGE_SUFFIXES, VIDEO_SUFFIXES, photos_below

__all__ = ["Given", "PhotoSource", "find_source", "whole_folder"]

Given = Path | str | Sequence[Path | str]
"""A folder, photo, list of photos (.txt), pattern or video, or several of these but videos."""

_LIST_SUFFIXES = (".txt", ".lst")


@dataclass(frozen=True, kw_only=True)
class PhotoSource:
    """Where the photos of a scene are.

    Attributes
    ----------
    folder : Path
        Names of photos are relative to it; of a video the folder that holds it.
    names : tuple of str or None
        The photos chosen, sorted; None for all in the folder.
    video : Path or None
        The video to take frames from.
    given : tuple of str
        What the user named, as absolute paths.
    """

    folder: Path
    names: tuple[str, ...] | None = None
    video: Path | None = None
    given: tuple[str, ...] = ()


def find_source(given: Given) -> PhotoSource:
    """Find the photos or the video that a user means.

    One folder is taken whole. Of anything else the names of photos are relative to the nearest folder that
    holds all of them, so that two photos never have one name. Paths in a list are relative to the list.

    Raises
    ------
    InputError
        If something is not there, is of no known kind, or a video is not alone.
    """
    items = [Path(given)] if isinstance(given, Path | str) else [Path(item) for item in given]
    if not items:
        raise InputError("no photos named; expected a folder, photos, a list, a pattern or a video")
    absolute = tuple(os.path.abspath(item) for item in items)
    videos = [item for item in items if _is_video(item)]
    if videos and len(items) > 1:
        raise InputError(
            f"{videos[0]}: a video must be given alone; for several videos extract the frames of each into a "
            "workspace of its own, then give the folders WORKSPACE/frames together"
        )
    if videos:
        return PhotoSource(folder=videos[0].parent, video=videos[0], given=absolute)
    if len(items) == 1 and items[0].is_dir():
        return PhotoSource(folder=items[0], given=absolute)
    photos = sorted({os.path.abspath(photo) for item in items for photo in _photos_of(item)})
    if not photos:
        raise InputError(f"{first_few(map(str, items))}: no photos there ({', '.join(IMAGE_SUFFIXES)})")
    folder = Path(os.path.commonpath([os.path.dirname(photo) for photo in photos]))
    names = sorted(PurePosixPath(os.path.relpath(photo, folder)).as_posix() for photo in photos)
    return PhotoSource(folder=folder, names=tuple(names), given=absolute)


def whole_folder(given: Given) -> Path | None:
    """The folder of which all photos are taken, if that is what a user names."""
    items = [given] if isinstance(given, Path | str) else list(given)
    return Path(items[0]) if len(items) == 1 and Path(items[0]).is_dir() else None


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def _photos_of(item: Path) -> Iterable[Path]:
    """The photos that one folder, list, pattern or photo stands for."""
    if item.is_dir():
        return [item / name for name in photos_below(item)]
    if item.is_file():
        if item.suffix.lower() in _LIST_SUFFIXES:
            return _listed_in(item)
        if item.suffix.lower() in IMAGE_SUFFIXES:
            return [item]
        raise InputError(
            f"{item}: is neither a photo ({', '.join(IMAGE_SUFFIXES)}), nor a list of photos (.txt), nor a "
            f"video ({', '.join(VIDEO_SUFFIXES)})"
        )
    if not glob.has_magic(str(item)):
        raise InputError(f"{item}: no such folder or file; expected photos")
    found = [Path(name) for name in sorted(glob.glob(str(item), recursive=True))]
    if not found:
        raise InputError(f"{item}: nothing fits this pattern")
    return [
        photo
        for path in found
        if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES
        for photo in _photos_of(path)
    ]


def _listed_in(path: Path) -> list[Path]:
    lines = [line.strip() for line in read_lines(path)]
    photos = [path.parent / line for line in dict.fromkeys(lines) if line and not line.startswith("#")]
    missing = [str(photo) for photo in photos if not os.path.isfile(photo)]
    if missing:
        raise InputError(
            f"{path}: {len(missing)} of its photos are not there: {first_few(missing)}; expected a path a "
            f"line, absolute or relative to {path.parent}"
        )
    if not photos:
        raise InputError(f"{path}: lists no photos; expected a path a line")
    return photos
