"""Hashes and headers of photos, kept between runs so that unchanged files are not read again."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from corrsfm.errors import InputError
from corrsfm.files import atomic_write_json, read_json, sha256_of
from corrsfm.images.cameras import PhotoInfo
from corrsfm.images.photos import read_photo_info
from corrsfm.types import ImageRecord

__all__ = ["PhotoCache", "photos_unlike"]


class PhotoCache:
    """Hashes and headers of photos, kept as long as the file does not change.

    A change shows in its size, its modification and change times or its inode: a copy over it or a swap may
    keep the first two.

    Reading them decodes every photo, which a resumed run of thousands of photos should not do again.

    Parameters
    ----------
    path : Path
        The file of the cache; a missing or damaged one counts as empty.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._kept: dict[str, dict[str, Any]] = {}
        self._known: dict[str, dict[str, Any]] = {}
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
            values = read_json(path)
            # One digit of a hash or of a focal length would otherwise change what is made from the photo.
            if values["checksum"] == _checksum(values["photos"]):
                self._known = values["photos"]

    def hash_of(self, path: Path) -> str:
        """As `corrsfm.files.sha256_of`."""
        return self._value(path, "sha256", sha256_of)

    def info_of(self, path: Path) -> PhotoInfo:
        """As `corrsfm.images.photos.read_photo_info`."""
        values = self._value(path, "info", lambda photo: dataclasses.asdict(read_photo_info(photo)))
        # JSON has no tuples.
        return PhotoInfo(**{**values, "gps": tuple(values["gps"]) if values["gps"] else None})

    def _value(self, path: Path, key: str, compute: Callable[[Path], Any]) -> Any:
        try:
            stat = path.stat()
        except OSError:  # a broken link; reading it will raise
            return compute(path)
        name = str(path.resolve())
        stamp = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
        entry = self._kept.get(name) or self._known.get(name)
        if entry is None or entry["stamp"] != stamp:
            entry = {"stamp": stamp}
        self._kept[name] = entry
        if key not in entry:
            entry[key] = compute(path)
        return entry[key]

    def save(self) -> None:
        """Write the cache with the photos asked for since construction, and no others."""
        atomic_write_json(self._path, {"photos": self._kept, "checksum": _checksum(self._kept)})


def photos_unlike(
    records: Iterable[ImageRecord], folder: Path, cache: PhotoCache
) -> tuple[list[str], list[str]]:
    """Photos that are not the files that were indexed.

    Parameters
    ----------
    records : iterable of ImageRecord
    folder : Path
        Of the photos.
    cache : PhotoCache
        Files that have not changed since it was written are not read.

    Returns
    -------
    missing, changed : list of str
        Names of photos that are not there, or cannot be read, and of those with another content.
    """
    missing, changed = [], []
    for record in records:
        try:
            if cache.hash_of(folder / record.name) != record.sha256:
                changed.append(record.name)
        except InputError:
            missing.append(record.name)
    return missing, changed


def _checksum(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
