"""From the world of a model to metres east, north and up, by the GPS positions in EXIF."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.errors import InputError
from corrsfm.geometry import Pose, camera_centre, earth_fixed

__all__ = ["GpsFit", "fit_to_gps"]

_MAX_SAMPLES = 1000
# Residuals up to this many times the median count as the noise of good receivers.
_OUTER_RESIDUAL = 3.0
# Digits of a position in EXIF.
_RESOLUTION_M = 0.01
# Second extent over the first, below which photos lie on a line.
_LEAST_WIDTH = 0.02
_ADVICE = "give two photos and their distance instead: --scale A B METRES"
_NARROW = (
    "--scale gps: the photos were taken on a line, as far as their positions can tell, about which the model "
    f"could turn; add --upright, which takes up from the cameras, or {_ADVICE}"
)

Fit = Callable[[NDArray[np.float64], NDArray[np.float64]], "tuple[float, NDArray, NDArray] | None"]


@dataclass(frozen=True, kw_only=True)
class GpsFit:
    """How a model lies on the ground: ``enu = scale · rotation · world + translation``.

    Attributes
    ----------
    scale : float
        Metres per unit of the model.
    rotation : tuple of tuple of float
        Rows (3, 3).
    translation : tuple of float
        Metres.
    origin : tuple of float
        Latitude and longitude in degrees and altitude in metres of the point 0, 0, 0.
    num_photos, num_agreeing : int
        Photos with a position, and those that the fit rests on.
    residual_m : float
        Median distance between the positions of all of them and the model.
    """

    scale: float
    rotation: tuple[tuple[float, ...], ...]
    translation: tuple[float, ...]
    origin: tuple[float, float, float]
    num_photos: int
    num_agreeing: int
    residual_m: float


def fit_to_gps(
    poses: Mapping[str, Pose],
    positions: Mapping[str, tuple[float, float, float]],
    *,
    is_upright: bool = False,
) -> GpsFit:
    """Fit a model to GPS positions: the least median of residuals over samples, then least squares.

    Parameters
    ----------
    poses : mapping of str to Pose
        ``cam_from_world`` of the photos of the model.
    positions : mapping
        Photo → latitude and longitude in degrees, altitude in metres; photos may lack one.
    is_upright : bool
        +z is up in the model already: it is turned about it only, and the positions may lie on a line.

    Raises
    ------
    InputError
        If fewer than three photos have a position, or the photos lie in one place or on a line as far as the
        positions can tell.
    """
    names = [name for name in poses if name in positions]
    if len(names) < 3:
        raise InputError(
            f"--scale gps: {len(names)} of {len(poses)} photos of the model have a GPS position in EXIF, at "
            f"least three are needed; {_ADVICE}"
        )
    centres = np.array([camera_centre(poses[name]) for name in names])
    geodetic = np.array([positions[name] for name in names], float)
    # On both sides of the 180th meridian longitudes are numbers far apart.
    geodetic[:, 1] = geodetic[0, 1] + np.remainder(geodetic[:, 1] - geodetic[0, 1] + 180.0, 360.0) - 180.0
    origin = np.median(geodetic, axis=0)
    targets = _east_north_up(geodetic, origin)
    if _extents(targets)[0] < _RESOLUTION_M:
        raise InputError(f"--scale gps: all photos have the same GPS position; {_ADVICE}")
    fit = _fit_turned if is_upright else _fit_any
    found = _least_median(centres, targets, fit, size=2 if is_upright else 3)
    if found is None:
        raise InputError(_NARROW)
    for _ in range(5):
        residuals = _residuals(found, centres, targets)
        agreeing = residuals <= max(_OUTER_RESIDUAL * float(np.median(residuals)), _RESOLUTION_M)
        found = fit(centres[agreeing], targets[agreeing]) or found
    scale, rotation, translation = found
    residual_m = float(np.median(_residuals(found, centres, targets)))
    extents = _extents(scale * centres[agreeing])
    if extents[0] < residual_m:
        raise InputError(
            f"--scale gps: the positions differ from the model by {residual_m:.1f} m in the median, too much "
            f"for photos that lie within about {4 * extents[0]:.0f} m; {_ADVICE}"
        )
    # The model, not the positions: their noise gives width to a line.
    if not is_upright and extents[1] < max(_LEAST_WIDTH * extents[0], residual_m):
        raise InputError(_NARROW)
    return GpsFit(
        scale=scale,
        rotation=tuple(tuple(float(value) for value in row) for row in rotation),
        translation=tuple(float(value) for value in translation),
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
        num_photos=len(names),
        num_agreeing=int(agreeing.sum()),
        residual_m=residual_m,
    )


def _east_north_up(geodetic: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) latitude, longitude, altitude → metres east, north and up of an origin."""
    latitude, longitude = np.radians(origin[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = (
        np.sin(latitude),
        np.cos(latitude),
        np.sin(longitude),
        np.cos(longitude),
    )
    axes = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return (earth_fixed(geodetic) - earth_fixed(origin[None])) @ axes.T


def _extents(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations (3,) along the principal axes of points (N, 3), the largest first."""
    return np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))


def _fit_any(
    centres: NDArray[np.float64], targets: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]] | None:
    """Similarity by least squares (Umeyama, PAMI 1991); None if the points do not tell it."""
    found = pycolmap.estimate_sim3d(centres, targets)
    if found is None:
        return None
    return float(found.scale), np.array(found.rotation.matrix()), np.array(found.translation)


def _fit_turned(
    centres: NDArray[np.float64], targets: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]] | None:
    """The same for a rotation about z: in the plane, a complex factor and an offset."""
    plane, wanted = (points[:, 0] + 1j * points[:, 1] for points in (centres, targets))
    offsets = plane - plane.mean()
    spread = float(np.vdot(offsets, offsets).real)
    if spread < 1e-12:
        return None
    factor = np.vdot(offsets, wanted - wanted.mean()) / spread
    scale = float(abs(factor))
    if scale == 0:
        return None
    cosine, sine = factor.real / scale, factor.imag / scale
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return scale, rotation, targets.mean(axis=0) - scale * rotation @ centres.mean(axis=0)


def _residuals(
    found: tuple[float, NDArray, NDArray], centres: NDArray[np.float64], targets: NDArray[np.float64]
) -> NDArray[np.float64]:
    scale, rotation, translation = found
    return np.linalg.norm(scale * centres @ rotation.T + translation - targets, axis=1)


def _least_median(
    centres: NDArray[np.float64], targets: NDArray[np.float64], fit: Fit, *, size: int
) -> tuple[float, NDArray, NDArray] | None:
    """The similarity of a smallest sample whose residuals have the least median (Rousseeuw 1984)."""
    num = len(centres)
    samples = itertools.islice(itertools.combinations(range(num), size), _MAX_SAMPLES + 1)
    chosen = [list(sample) for sample in samples]
    if len(chosen) > _MAX_SAMPLES:
        rng = np.random.default_rng(0)
        chosen = [list(rng.choice(num, size, replace=False)) for _ in range(_MAX_SAMPLES)]
    best, least = fit(centres, targets), np.inf
    if best is not None:
        least = float(np.median(_residuals(best, centres, targets)))
    for sample in chosen:
        found = fit(centres[sample], targets[sample])
        if found is None:
            continue
        median = float(np.median(_residuals(found, centres, targets)))
        if median < least:
            best, least = found, median
    return best
