"""Photos that come to a finished scene: found, read and checked before anything is changed."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from corrsfm.errors import ImageError, InputError
from corrsfm.files import sha256_of
from corrsfm.images.convert import readable_name
from corrsfm.images.listing import VIDEO_SUFFIXES, list_images
from corrsfm.images.photos import convert_photo, read_image
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import imported_from

__all__ = [
    "Incoming",
    "PhotoPaths",
    "find_photos",
    "make_readable",
    "name_in",
    "refuse_imported",
    "require_readable",
]

PhotoPaths = Path | str | Sequence[Path | str]
"""Photos, and folders of photos."""


@dataclass(frozen=True, kw_only=True)
class Incoming:
    """A photo that comes.

    Attributes
    ----------
    name : str
        What it is called in the scene.
    path : Path
        Where it lies now.
    file : Path
        What joins the scene: the photo itself, or a JPEG that was made of it.
    sha256 : str
        Of that file's bytes.
    """

    name: str
    path: Path
    file: Path
    sha256: str


def find_photos(
    paths: PhotoPaths, images_dir: Path | None, *, mask_dir: Path | None = None
) -> list[Incoming]:
    """The photos that paths name, sorted by name.

    A photo in the folder of the scene's photos keeps its name there. Any other is called by its path in the
    folder that was given, or by its file name.

    Parameters
    ----------
    paths : path or sequence of paths
    images_dir : Path or None
        Folder of the scene's photos; None if they do not join: then they are called by their paths.
    mask_dir : Path, optional
        A folder in which there are no photos.

    Raises
    ------
    InputError
        If a path does not exist or is a video, a folder holds no photo, or two different photos would have
        one name.
    """
    given = [Path(paths)] if isinstance(paths, Path | str) else [Path(path) for path in paths]
    found: dict[str, Incoming] = {}
    for path in given:
        if path.is_dir():
            files = [(name, path / name) for name in list_images(path, at_least=1, mask_dir=mask_dir)]
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            raise InputError(
                f"{path}: is a video; take its frames with: corrsfm extract {shlex.quote(str(path))} FILM, "
                "then give FILM/frames or some of its photos"
            )
        elif path.is_file():
            files = [(path.name, path)]
        else:
            raise InputError(f"{path}: no such photo or folder")
        for name, file in files:
            called = str(file) if images_dir is None else name_in(file, images_dir) or name
            photo = Incoming(name=called, path=file, file=file, sha256=sha256_of(file))
            other = found.setdefault(photo.name, photo)
            if other.sha256 != photo.sha256:
                raise InputError(
                    f"{file}: would be called {photo.name}, as {other.path} would, which is another photo; "
                    "rename one of them"
                )
    return [found[name] for name in sorted(found)]


def make_readable(photos: Sequence[Incoming], folder: Path) -> list[Incoming]:
    """The photos as they join a scene: of HEIC and AVIF photos, which other tools do not read, the JPEGs.

    As in a scene, such a photo beside a JPEG of the same name is left out.

    Parameters
    ----------
    photos : sequence of Incoming
    folder : Path
        For the JPEGs. The same photo gives the same bytes every time, so that an addition can go on.

    Raises
    ------
    ImageError, DependencyError
        If a photo cannot be converted.
    """
    names = {photo.name for photo in photos}
    readable = []
    for number, photo in enumerate(photos):
        name = readable_name(photo.name)
        if name == photo.name:
            readable.append(photo)
        elif name not in names:
            names.add(name)
            jpeg = folder / f"{number}.jpg"
            convert_photo(photo.path, jpeg)
            readable.append(dataclasses.replace(photo, name=name, file=jpeg, sha256=sha256_of(jpeg)))
    return readable


def name_in(file: Path, folder: Path) -> str:
    """Posix path of a file relative to a folder; empty if it lies elsewhere."""
    root = folder.resolve()
    # A link among the photos goes by its own name.
    for place in (file.parent.resolve() / file.name, file.resolve()):
        if place.is_relative_to(root):
            return place.relative_to(root).as_posix()
    return ""


def refuse_imported(workspace: Workspace) -> None:
    """Check that the features of the scene are ones that can be made of other photos.

    Raises
    ------
    InputError
        If they were imported.
    """
    if imported_from(workspace, "features") is not None:
        raise InputError(
            f"{workspace.root}: the features of this scene were imported, and corrsfm cannot make those of "
            "other photos; import a file that holds them too: "
            f"{workspace.command_for('features')}"
        )


def require_readable(photos: Sequence[Incoming]) -> None:
    """Read every photo once.

    Raises
    ------
    ImageError
        Naming all that cannot be read.
    """
    problems = []
    for photo in photos:
        try:
            read_image(photo.path)
        except ImageError as error:
            problems.append(str(error))
    if problems:
        raise ImageError("\n".join(problems) + "\nreplace or leave out these photos; nothing was changed")
