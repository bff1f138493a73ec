"""Copies of photos for programs that do not read their format."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from corrsfm.errors import CorrsfmError, DependencyError, ImageError, InputError, WorkspaceError, first_few
from corrsfm.files import OWN_RECORD, atomic_path, atomic_write_json, read_json
from corrsfm.images.photos import CONVERTED_SUFFIXES, convert_photo

__all__ = ["is_converted", "possible_originals", "readable_copies", "readable_name"]


def is_converted(name: str) -> bool:
    """Whether a photo has to be converted before pycolmap and other tools can read it."""
    return name.lower().endswith(CONVERTED_SUFFIXES)


def readable_name(name: str) -> str:
    """The name under which a photo is reconstructed; a HEIC or AVIF photo becomes a JPEG."""
    return PurePosixPath(name).with_suffix(".jpg").as_posix() if is_converted(name) else name


def possible_originals(path: Path) -> list[Path]:
    """The photos of which a file may be the readable copy, itself included."""
    suffixes = [*CONVERTED_SUFFIXES, *(suffix.upper() for suffix in CONVERTED_SUFFIXES)]
    return [path, *(path.with_suffix(suffix) for suffix in suffixes)]


def readable_copies(
    source: Path, names: Sequence[str], folder: Path, hash_of: Callable[[Path], str]
) -> dict[str, CorrsfmError]:
    """Fill a folder with photos that every program reads: JPEGs of HEIC and AVIF photos, links to the others.

    Copies of earlier calls are kept as long as their photo does not change, and removed with it.

    Parameters
    ----------
    source : Path
        Folder of the photos.
    names : sequence of str
        Relative to it.
    folder : Path
        For the copies, named by `readable_name`.
    hash_of : callable
        As `corrsfm.files.sha256_of`.

    Returns
    -------
    dict
        Name → why a photo cannot be read.

    Raises
    ------
    InputError
        If two photos would have one name.
    WorkspaceError
        If the folder holds files of others, or cannot be written.
    """
    copies = Counter(readable_name(name) for name in names)
    if twice := [name for name in names if copies[readable_name(name)] > 1]:
        raise InputError(f"{source}: as JPEG these photos have one name: {first_few(twice)}; rename one")
    record = _record_of(folder)
    try:
        return _copy(source, names, folder, record, hash_of)
    except OSError as error:
        raise WorkspaceError(f"{folder}: copies of photos cannot be written ({error.strerror})") from error


def _copy(
    source: Path, names: Sequence[str], folder: Path, record: dict[str, str], hash_of: Callable[[Path], str]
) -> dict[str, CorrsfmError]:
    """Bring a folder to exactly the copies of these photos; ``record`` says what is there."""
    copies = {readable_name(name) for name in names}
    failed: dict[str, CorrsfmError] = {}
    folder.mkdir(parents=True, exist_ok=True)
    for copy in record.keys() - copies:
        (folder / copy).unlink(missing_ok=True)
        del record[copy]
    # Written before the copies: what is there is ours, even if this call is killed.
    atomic_write_json(folder / OWN_RECORD, record | {copy: record.get(copy, "") for copy in copies})
    for name in names:
        copy = readable_name(name)
        if not is_converted(name):
            _link(source / name, folder / copy)
            continue
        try:
            sha256 = hash_of(source / name)
            if record.get(copy) != sha256 or not (folder / copy).is_file():
                with atomic_path(folder / copy) as temporary:
                    convert_photo(source / name, temporary)
                record[copy] = sha256
                atomic_write_json(folder / OWN_RECORD, record | dict.fromkeys(copies - record.keys(), ""))
        except (ImageError, DependencyError) as error:
            failed[name] = error
    return failed


def _record_of(folder: Path) -> dict[str, str]:
    """Copies in a folder, with the hash of the photo that each was made from.

    Names that lead out of the folder are left out: a workspace may come from anybody, and copies are removed.
    """
    try:
        record = dict(read_json(folder / OWN_RECORD))
        return {name: sha256 for name, sha256 in record.items() if _is_inside(name)}
    except FileNotFoundError:
        if folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir()):
            raise WorkspaceError(
                f"{folder}: holds files of others, and copies of HEIC photos would go there; choose another "
                "workspace"
            ) from None
    except (OSError, ValueError, TypeError):
        pass
    return {}


def _is_inside(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts


def _link(photo: Path, link: Path) -> None:
    """Link to a photo; copy it where the file system has no links."""
    target = os.path.abspath(photo)
    if link.is_symlink() and os.readlink(link) == target:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    try:
        link.symlink_to(target)
    except OSError:
        shutil.copy2(photo, link)
