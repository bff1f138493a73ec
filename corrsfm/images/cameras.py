"""Which photos are proposed to share a camera, and what is known about each camera.

Photos of one size without EXIF are proposed to share one, since one camera took most sets of photos. That is
a proposal only: before verification, focal lengths that the matches vote for confirm it, split it or undo it
(`corrsfm.database.focal_votes`).
"""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from corrsfm.camera import CAMERA_PARAMETERS, Camera
from corrsfm.colmap.cameras import create_camera, with_focal_length
from corrsfm.config import CameraMode
from corrsfm.errors import ConfigError, InputError, first_few

__all__ = ["DEFAULT_FOCAL_FACTOR", "PhotoInfo", "assign_cameras"]

# COLMAP's guess where nothing is known: a field of view of about 45° along the longest side.
DEFAULT_FOCAL_FACTOR = 1.2
# EXIF rounds focal lengths by a few per cent; photos of one camera that differ by more were zoomed.
SAME_FOCAL_RATIO = 1.05
_LARGEST_PARAMETER = 1e7

logger = logging.getLogger("corrsfm")


@dataclass(frozen=True, kw_only=True)
class PhotoInfo:
    """Size of a photo, and camera and position from its EXIF.

    Attributes
    ----------
    width, height : int
        Pixels as stored.
    camera_name : str or None
        Make, model and focal length setting from EXIF.
    focal_px : float or None
        Focal length in pixels from EXIF.
    orientation : int
        From EXIF, 1 to 8; 1 is upright as stored.
    gps : tuple of float or None
        Latitude and longitude in degrees, altitude in metres; 0 if the altitude is not known.
    """

    width: int
    height: int
    camera_name: str | None = None
    focal_px: float | None = None
    orientation: int = 1
    gps: tuple[float, float, float] | None = None


def assign_cameras(
    names: Sequence[str], infos: Sequence[PhotoInfo], *, mode: CameraMode, model: str, params: str = ""
) -> tuple[list[Camera], list[int]]:
    """Propose which photos share a camera, and say what is known about each camera.

    Parameters
    ----------
    names : sequence of str
    infos : sequence of PhotoInfo
        One per name.
    mode : CameraMode
        ``auto`` shares a camera among photos of equal size, EXIF camera and focal length; photos without
        EXIF count as equal in the latter two. COLMAP's cameras have one width and height, so portrait and
        landscape photos of one camera get two; a log line says so, and both vote together.
        A camera that photos share by any other mode starts from the median of their known focal lengths; a
        warning names its photos if these differ by more than a few per cent.
    model : str
        COLMAP camera model.
    params : str
        Known intrinsics, comma-separated in COLMAP's order; empty to take the focal length from EXIF or,
        failing that, to guess it.

    Returns
    -------
    cameras : list of Camera
        In the order of the first photo of each.
    camera_ids : list of int
        Index into the cameras, one per name.

    Raises
    ------
    ConfigError
        If the model is unknown or has another number of parameters.
    InputError
        If photos of one camera differ in size.
    """
    values = _parse_params(model, params)
    keys = [_camera_key(name, info, mode) for name, info in zip(names, infos, strict=True)]
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, key in enumerate(keys):
        groups[key].append(index)
        info, reference = infos[index], infos[groups[key][0]]
        if (info.width, info.height) != (reference.width, reference.height):
            raise InputError(
                f"{names[index]}: has {info.width}×{info.height} pixels, but '{names[groups[key][0]]}', which"
                f" is to share its camera, has {reference.width}×{reference.height}; try --camera-mode auto"
                " or remove one"
            )
    if values:
        _check_one_size(names, infos)
    else:
        for group in groups.values():
            _warn_of_zoom([(names[index], infos[index].focal_px) for index in group])
        if mode is CameraMode.AUTO:
            _tell_of_proposals([infos[group[0]] for group in groups.values()], list(groups.values()))
    cameras = [_make_camera([infos[index] for index in group], model, values) for group in groups.values()]
    position = {key: index for index, key in enumerate(groups)}
    return cameras, [position[key] for key in keys]


def _camera_key(name: str, info: PhotoInfo, mode: CameraMode) -> tuple:
    """Equal for photos that share a camera."""
    match mode:
        case CameraMode.SINGLE:
            return ()
        case CameraMode.PER_FOLDER:
            return (PurePosixPath(name).parent.as_posix(),)
        case CameraMode.AUTO:
            return (info.width, info.height, info.camera_name, info.focal_px)
    return (name,)


def _tell_of_proposals(infos: Sequence[PhotoInfo], groups: Sequence[Sequence[int]]) -> None:
    """Announce photos without a focal length that share a camera; ``infos`` holds one photo of each group."""
    sizes: dict[tuple, int] = {}
    for info, group in zip(infos, groups, strict=True):
        if info.focal_px is None and len(group) > 1:
            logger.info(
                "%d photos of %d×%d pixels have no focal length in EXIF and are taken to be of one camera "
                "until their matches say otherwise; --camera-mode per-image gives each its own",
                len(group),
                info.width,
                info.height,
            )
        # COLMAP's names end in the size of the photo.
        name = (info.camera_name or "").removesuffix(f"-{info.width}x{info.height}")
        sizes[(info.width, info.height, name, info.focal_px)] = len(group)
    for (width, height, name, focal_px), num in sizes.items():
        num_turned = sizes.get((height, width, name, focal_px), 0)
        if width > height and num_turned:
            logger.info(
                "photos of %d×%d pixels (%d) and of %d×%d (%d) look like one camera, turned and upright; "
                "each kind gets a camera, of one focal length where it is known or the matches tell it",
                *(width, height, num, height, width, num_turned),
            )


def _warn_of_zoom(focals: Sequence[tuple[str, float | None]]) -> None:
    """Warn if photos that share a camera, given as names and focal lengths, were zoomed."""
    known = sorted((focal, name) for name, focal in focals if focal is not None)
    if known and known[-1][0] > SAME_FOCAL_RATIO * known[0][0]:
        logger.warning(
            "%d photos share a camera (%s), but their focal lengths in EXIF run from %.0f px ('%s') to"
            " %.0f px ('%s'), as if zoomed; --camera-mode auto gives each focal length a camera",
            len(focals),
            first_few(name for name, _ in focals),
            *known[0],
            *known[-1],
        )


def _make_camera(infos: Sequence[PhotoInfo], model: str, values: list[float]) -> Camera:
    """The camera of some photos of one size."""
    width, height = infos[0].width, infos[0].height
    camera = create_camera(model, DEFAULT_FOCAL_FACTOR * max(width, height), width, height)
    if values:
        return dataclasses.replace(camera, params=tuple(values), has_prior_focal_length=True)
    known = [info.focal_px for info in infos if info.focal_px is not None]
    return with_focal_length(camera, float(np.median(known))) if known else camera


def _parse_params(model: str, params: str) -> list[float]:
    """The known intrinsics as numbers; checks the model on the way."""
    if model not in CAMERA_PARAMETERS:
        known = ", ".join(sorted(CAMERA_PARAMETERS))
        raise ConfigError(f"camera_model is '{model}', expected one of {known}")
    if not params.strip():
        return []
    expected = CAMERA_PARAMETERS[model].split()
    try:
        values = [float(value) for value in params.split(",")]
    except ValueError:
        values = []
    # Not finite, or so large that mapping would never end.
    if len(values) != len(expected) or not (np.abs(values) < _LARGEST_PARAMETER).all():
        raise ConfigError(
            f"camera_params is '{params}', expected the numbers {', '.join(expected)} for {model}, each "
            f"below {_LARGEST_PARAMETER:g}"
        )
    return values


def _check_one_size(names: Sequence[str], infos: Sequence[PhotoInfo]) -> None:
    sizes = Counter((info.width, info.height) for info in infos)
    (width, height), _ = sizes.most_common(1)[0]
    others = [n for n, i in zip(names, infos, strict=True) if (i.width, i.height) != (width, height)]
    if others:
        raise InputError(
            f"known camera_params fit photos of one size, but beside {width}×{height} pixels there are"
            f" {len(others)} of other sizes, such as '{others[0]}'; leave these out or drop camera_params"
        )
