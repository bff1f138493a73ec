"""Self-calibration: how to notice implausible focal lengths, and how to get better ones.

A photo without EXIF starts from a guessed focal length, and mapping refines it from the first photos on. Few
photos determine it badly: a focal length that runs away bends the model around it, and every later photo is
registered to the bend. Registering with the guesses held and refining them all at the end, with many
photos to judge by, avoids that.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.sqlite import open_for_reading
from corrsfm.config import ReconstructionConfig

__all__ = [
    "DEFAULT_REFINEMENT",
    "Refinement",
    "adjust",
    "adjusted_cost",
    "adjustment_options",
    "describe_impossible",
    "focal_length_ratios",
    "has_possible_cameras",
    "has_prior_focal_lengths",
    "is_plausible",
    "refine",
    "refine_intrinsics",
    "restore_priors",
    "thinned",
]

# COLMAP drops a photo beyond these while it maps, but not after the last bundle adjustment.
_SMALLEST_RATIO, _LARGEST_RATIO = 0.1, 10.0
# Zoom lenses and crops differ by as much, but rarely in so large a share of one model.
_LARGEST_FACTOR, _LARGEST_SHARE = 2.0, 0.2

_REFINEMENTS = 3
# COLMAP's own limits for keeping a point.
_MAX_ERROR_PX, _MIN_ANGLE_DEG = 4.0, 1.5

# More points do not change the ratio of two costs, but take time.
_NUM_POINTS, _NUM_POINTS_PER_PHOTO = 1000, 40


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """Which intrinsics mapping may change.

    Attributes
    ----------
    intrinsics : bool
        Focal lengths and distortion.
    principal_point : bool
    """

    intrinsics: bool = True
    principal_point: bool = False

    @classmethod
    def of(cls, config: ReconstructionConfig) -> Refinement:
        """What the options of a stage say."""
        return cls(intrinsics=config.refine_intrinsics, principal_point=config.refine_principal_point)


DEFAULT_REFINEMENT = Refinement()


def focal_length_ratios(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """Focal length over the longest side, for every registered photo without one in EXIF.

    Returns
    -------
    (N,) float64
        Sorted.
    """
    cameras = [image.camera for image in model.images.values() if image.has_pose]
    return np.sort(
        [
            camera.mean_focal_length() / max(camera.width, camera.height)
            for camera in cameras
            if not camera.has_prior_focal_length
        ]
    ).astype(np.float64)


def is_plausible(model: pycolmap.Reconstruction) -> bool:
    """Whether the focal lengths that a model found for photos without EXIF are plausible.

    They are not if one is below a tenth or above ten times the longest side of the photo, or if more than a
    fifth of them differ from their median by more than a factor of two.
    """
    ratios = focal_length_ratios(model)
    if not len(ratios):
        return True
    if not (ratios[0] >= _SMALLEST_RATIO and ratios[-1] <= _LARGEST_RATIO):  # a NaN is not plausible
        return False
    factors = np.exp(np.abs(np.log(ratios / np.median(ratios))))
    return bool(np.mean(factors > _LARGEST_FACTOR) <= _LARGEST_SHARE)


def has_possible_cameras(model: pycolmap.Reconstruction) -> bool:
    """Whether all cameras of registered photos have finite parameters and focal lengths above zero.

    Bundle adjustment knows no bounds: on a few false matches a focal length can pass through zero.
    """
    cameras = [image.camera for image in model.images.values() if image.has_pose]
    return all(
        np.isfinite(camera.params).all() and (camera.params[list(camera.focal_length_idxs())] > 0).all()
        for camera in cameras
    )


def describe_impossible(model: pycolmap.Reconstruction) -> str:
    """Name focal lengths that no camera has; empty if there are none.

    Focal lengths that differ from photo to photo are not among them: photos of many cameras, or zoomed ones,
    do so rightly.
    """
    ratios = focal_length_ratios(model)
    if not len(ratios) or (ratios[0] >= _SMALLEST_RATIO and ratios[-1] <= _LARGEST_RATIO):
        return ""
    return f"focal lengths from {ratios[0]:.2g} to {ratios[-1]:.2g} times the longest side"


def has_prior_focal_lengths(model: pycolmap.Reconstruction) -> bool:
    """Whether EXIF, the user or the votes of pairs told the focal length of every registered photo."""
    return not len(focal_length_ratios(model))


def refine_intrinsics(
    model: pycolmap.Reconstruction, refinement: Refinement = DEFAULT_REFINEMENT, *, num_threads: int = 0
) -> None:
    """Refine a whole model and drop the points that no longer fit.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Changed in place.
    refinement : Refinement
    num_threads : int
        0 for all cores.
    """
    refine(model, adjustment_options(refinement, num_threads=num_threads))


def adjustment_options(
    refinement: Refinement = DEFAULT_REFINEMENT, *, num_threads: int = 1
) -> pycolmap.BundleAdjustmentOptions:
    """How a whole model is adjusted: what mapping left alone stays.

    Parameters
    ----------
    refinement : Refinement
    num_threads : int
        0 for all cores.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refinement.intrinsics
    options.refine_principal_point = refinement.principal_point
    options.ceres.solver_options.num_threads = num_threads or -1
    return options


def refine(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Adjust a whole model in place a few times, and drop the points that no longer fit in between."""
    for _ in range(_REFINEMENTS):
        adjust(model, options)
        pycolmap.ObservationManager(model).filter_all_points3D(_MAX_ERROR_PX, _MIN_ANGLE_DEG)
    model.update_point_3d_errors()


def adjust(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    problem: pycolmap.BundleAdjustmentConfig | None = None,
) -> pycolmap.BundleAdjustmentSummary:
    """Adjust a whole model in place, or what a problem says, without the summary in the terminal.

    `pycolmap.bundle_adjustment` does the same but logs to the terminal.
    """
    options.print_summary = False
    return pycolmap.create_default_bundle_adjuster(options, problem or _whole(model), model).solve()


def _whole(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    problem = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        problem.add_image(image_id)
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return problem


def thinned(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with a sample of the points, those of many photos first: enough to compare two costs by."""
    copy = pycolmap.Reconstruction(model)
    num_kept = max(_NUM_POINTS, _NUM_POINTS_PER_PHOTO * model.num_reg_images())
    lengths = {point_id: point.track.length() for point_id, point in model.points3D.items()}
    for point_id in sorted(lengths, key=lambda point_id: (-lengths[point_id], point_id))[num_kept:]:
        copy.delete_point3D(point_id)
    return copy


def adjusted_cost(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    *,
    constant_cameras: Iterable[int] = (),
) -> float | None:
    """Half the sum of the squared errors (px²) after adjusting a model in place, on one thread.

    None if there is nothing to adjust. The intrinsics of ``constant_cameras`` stay.
    """
    options.ceres.solver_options.num_threads = 1
    problem = _whole(model)
    for camera_id in constant_cameras:
        problem.set_constant_cam_intrinsics(camera_id)
    summary = adjust(model, options, problem)
    if not summary.is_solution_usable():
        return None
    # The type stubs know the base class of summaries only.
    return float(summary.ceres_summary.final_cost)  # type: ignore[attr-defined]


def restore_priors(model: pycolmap.Reconstruction, database: Path) -> None:
    """Tell cameras of a model which focal lengths were known before mapping; files of models do not say.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Changed in place. Cameras that the database does not hold are copies of ones of unknown focal length.
    database : Path
    """
    with open_for_reading(database) as tables:
        has_prior = dict(tables.execute("SELECT camera_id, prior_focal_length FROM cameras"))
    for camera_id, camera in model.cameras.items():
        camera.has_prior_focal_length = bool(has_prior.get(camera_id, False))
