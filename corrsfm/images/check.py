"""A look at photos before a night of matching: what would stop a run, and what would weaken it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import DependencyError, ImageError, InputError
from corrsfm.files import sha256_of
from corrsfm.graph import connected_components
from corrsfm.images.cameras import PhotoInfo
from corrsfm.images.listing import find_masks, list_images
from corrsfm.images.photos import read_image, read_mask, read_photo_info
from corrsfm.images.quality import brightness_stops, hash_distances, perceptual_hash, sharp_detail
from corrsfm.images.sources import Given, find_source

__all__ = ["Finding", "PhotoCheck", "PhotosCheck", "check_photos"]

# Chosen on the validation scenes: their photos have 0.49 and more of the median, with a blur of 1.5 px on
# photos reduced to 1000 px 0.30 and less.
LEAST_SHARP_SHARE = 0.4
# Of 256 bits. The nearest photos of the validation scenes differ in 25, one saved smaller in up to 6.
MOST_DUPLICATE_BITS = 12
# SIFT bears two stops well; more leaves parts of a photo black or white.
MOST_STOPS = 2.0


@dataclass(frozen=True, kw_only=True)
class PhotoCheck:
    """One photo that can be read.

    Attributes
    ----------
    name : str
    width, height : int
        Pixels as stored.
    orientation : int
        From EXIF; 1 is upright as stored.
    camera_name : str or None
    focal_px : float or None
        From EXIF.
    sharpness : float
        Share of sharp detail over the median of the photos.
    stops : float
        Light over the median of the photos, in stops.
    """

    name: str
    width: int
    height: int
    orientation: int
    camera_name: str | None
    focal_px: float | None
    sharpness: float
    stops: float


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something to know before a run.

    Attributes
    ----------
    kind : str
        ``unreadable``, ``masks``, ``duplicate``, ``blurred``, ``exposure``, ``rotation`` or ``focal``.
    text : str
    photos : tuple of str
        Of duplicates those that could go: the sharpest of each group stays.
    next_step : str
        Options to add to ``corrsfm run PHOTOS WORKSPACE``; empty if there is nothing to do.
    """

    kind: str
    text: str
    photos: tuple[str, ...]
    next_step: str = ""


@dataclass(frozen=True, kw_only=True)
class PhotosCheck:
    """What was found in a folder of photos.

    Attributes
    ----------
    folder : Path
        Names of photos are relative to it.
    photos : tuple of PhotoCheck
        Those that can be read, sorted by name.
    findings : tuple of Finding
        The gravest first.
    """

    folder: Path
    photos: tuple[PhotoCheck, ...]
    findings: tuple[Finding, ...]

    @property
    def stops_a_run(self) -> bool:
        """Whether `corrsfm run` would end with an error."""
        stopping = ("unreadable", "masks")
        return len(self.photos) < 2 or any(finding.kind in stopping for finding in self.findings)

    @property
    def num_cameras(self) -> int:
        """Cameras that ``--camera-mode auto`` proposes."""
        return len({(p.width, p.height, p.camera_name, p.focal_px) for p in self.photos})

    @property
    def kept(self) -> list[str]:
        """The photos without those that cannot be read, are blurred, or are there twice."""
        dropped = {
            name
            for finding in self.findings
            if finding.kind in ("unreadable", "duplicate", "blurred")
            for name in finding.photos
        }
        return [photo.name for photo in self.photos if photo.name not in dropped]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            **asdict(self),
            "folder": str(self.folder),
            "num_cameras": self.num_cameras,
            "stops_a_run": self.stops_a_run,
            "kept": self.kept,
        }


@dataclass(frozen=True)
class _Look:
    """What one reading of a photo gives."""

    info: PhotoInfo
    sha256: str
    sharp: float
    stops: float
    bits: NDArray[np.bool_]


def check_photos(photos: Given, *, mask_dir: Path | str | None = None, threads: int = 1) -> PhotosCheck:
    """Look at every photo once.

    Parameters
    ----------
    photos : Given
        A folder, photos, a list or a pattern; see `corrsfm.images.sources.find_source`.
    mask_dir : path, optional
        Folder of their masks, to be looked at too.
    threads : int
        Photos read at a time.

    Returns
    -------
    PhotosCheck

    Raises
    ------
    InputError
        If there is no such folder or it holds fewer than two photos, or they are a video.
    """
    source = find_source(photos)
    if source.video is not None:
        raise InputError(
            f"{source.video}: is a video; its frames are chosen and looked at by: corrsfm extract VIDEO "
            "WORKSPACE, then corrsfm check WORKSPACE/frames"
        )
    folder, masks = source.folder, Path(mask_dir) if mask_dir is not None else None
    names = list_images(folder, mask_dir=masks, chosen=source.names)

    def look(name: str) -> _Look | str:
        try:
            grey = read_image(folder / name)
            info = read_photo_info(folder / name)
            sha256 = sha256_of(folder / name)
        except (ImageError, DependencyError) as error:
            return str(error)
        return _Look(info, sha256, sharp_detail(grey), brightness_stops(grey), perceptual_hash(grey))

    with ThreadPoolExecutor(threads) as pool:
        results = dict(zip(names, pool.map(look, names), strict=True))
    looks = {name: result for name, result in results.items() if isinstance(result, _Look)}
    median_sharp = float(np.median([value.sharp for value in looks.values()])) if looks else 0.0
    median_stops = float(np.median([value.stops for value in looks.values()])) if looks else 0.0
    checked = tuple(
        PhotoCheck(
            name=name,
            width=value.info.width,
            height=value.info.height,
            orientation=value.info.orientation,
            camera_name=value.info.camera_name,
            focal_px=value.info.focal_px,
            sharpness=value.sharp / median_sharp if median_sharp else 0.0,
            stops=value.stops - median_stops,
        )
        for name, value in looks.items()
    )
    findings = [
        _unreadable({name: result for name, result in results.items() if isinstance(result, str)}),
        _masks(masks, folder, checked),
        _duplicates(looks),
        _blurred(checked),
        _exposure(checked),
        _rotation(checked),
        _focal(checked),
    ]
    return PhotosCheck(
        folder=folder, photos=checked, findings=tuple(finding for finding in findings if finding)
    )


def _unreadable(errors: dict[str, str]) -> Finding | None:
    if not errors:
        return None
    missing = next((error for error in errors.values() if "pip install" in error), "")
    text = f"{len(errors)} cannot be read and would stop a run" + (f" ({missing})" if missing else "")
    return Finding(kind="unreadable", text=text, photos=tuple(errors), next_step="--skip-unreadable")


def _masks(mask_dir: Path | None, folder: Path, photos: Sequence[PhotoCheck]) -> Finding | None:
    """Masks that cannot be used, or that there are none; `find_masks` warns of masks of no photo."""
    if mask_dir is None or not photos:
        return None
    wrong: dict[str, str] = {}
    try:
        masks = find_masks(mask_dir, folder, [photo.name for photo in photos])
    except InputError as error:
        return Finding(kind="masks", text=str(error), photos=())
    for photo, mask in zip(photos, masks, strict=True):
        try:
            if mask is not None and not read_mask(mask_dir / mask, (photo.height, photo.width)).any():
                wrong[photo.name] = f"{mask_dir / mask}: hides the whole photo"
        except ImageError as error:
            wrong[photo.name] = str(error)
    if not wrong:
        return None
    text = (
        f"{len(wrong)} of {len(photos)} photos have a mask that cannot be used ({next(iter(wrong.values()))})"
    )
    return Finding(kind="masks", text=text, photos=tuple(wrong))


def _rotation(photos: Sequence[PhotoCheck]) -> Finding | None:
    names = tuple(photo.name for photo in photos if photo.orientation != 1)
    if not names:
        return None
    text = (
        f"{len(names)} are turned by EXIF when shown; they are used as stored, as COLMAP does, so masks and "
        "known intrinsics must be of the stored pixels"
    )
    return Finding(kind="rotation", text=text, photos=names)


def _duplicates(looks: dict[str, _Look]) -> Finding | None:
    names = list(looks)
    if len(names) < 2:
        return None
    distances = hash_distances(np.array([look.bits for look in looks.values()]))
    near = np.argwhere(np.triu(distances <= MOST_DUPLICATE_BITS, 1))
    pairs = [(names[i], names[j]) for i, j in near if looks[names[i]].sharp and looks[names[j]].sharp]
    groups = [group for group in connected_components(names, pairs) if len(group) > 1]
    if not groups:
        return None
    best = {max(group, key=lambda name: looks[name].sharp) for group in groups}
    num_equal = sum(len(group) - len({looks[name].sha256 for name in group}) for group in groups)
    extra = tuple(sorted(name for group in groups for name in group if name not in best))
    text = f"{len(extra)} show what another photo shows from the same place ({num_equal} are the same file)"
    return Finding(kind="duplicate", text=text, photos=extra, next_step="--image-list keep.txt")


def _blurred(photos: Sequence[PhotoCheck]) -> Finding | None:
    names = tuple(photo.name for photo in photos if photo.sharpness < LEAST_SHARP_SHARE)
    if not names:
        return None
    text = f"{len(names)} have less than {LEAST_SHARP_SHARE:.0%} of the sharp detail of the others"
    return Finding(kind="blurred", text=text, photos=names, next_step="--image-list keep.txt")


def _exposure(photos: Sequence[PhotoCheck]) -> Finding | None:
    names = tuple(photo.name for photo in photos if abs(photo.stops) > MOST_STOPS)
    if not names:
        return None
    text = f"{len(names)} are more than {MOST_STOPS:g} stops darker or brighter than the others"
    return Finding(kind="exposure", text=text, photos=names)


def _focal(photos: Sequence[PhotoCheck]) -> Finding | None:
    names = tuple(photo.name for photo in photos if photo.focal_px is None)
    if not names:
        return None
    sizes = Counter((photo.width, photo.height) for photo in photos if photo.focal_px is None)
    shared = ", ".join(f"{num} of {width}×{height} pixels" for (width, height), num in sizes.most_common())
    text = (
        f"{len(names)} have no focal length in EXIF: {shared}; their matches tell it, one for each size "
        "(--camera-mode per-image if many cameras took them)"
    )
    return Finding(kind="focal", text=text, photos=names)
