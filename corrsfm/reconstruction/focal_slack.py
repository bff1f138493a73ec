"""How far the poses of a model hang on a focal length that its photos leave open.

Photos around an object, or from one height over flat ground, fit many focal lengths: a change of the focal
length is made good by moving the cameras and bending the points. Such a model explains every match, and its
covariance is small, for the errors that remain are of the lens and not of the points. So the focal length is
changed outright, everything else adjusted to it, and what that costs compared with what it moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from corrsfm.reconstruction.agreement import relative_pose_differences_deg
from corrsfm.reconstruction.calibration import (
    adjusted_cost,
    focal_length_ratios,
    has_prior_focal_lengths,
    thinned,
)
from corrsfm.reconstruction.views import views_of

__all__ = ["FocalSlack", "measure_focal_slack"]

# Right models of training, validation and sample scenes have 1.07 and 1.1° at most, but for two flights over
# flat ground, and for three objects seen through long lenses: 1.10 to 1.18, which moves their cameras by 0.4
# to 0.5° only.
_LARGEST_FACTOR, _LARGEST_POSE_CHANGE_DEG = 1.08, 1.2
_POSE_CHANGE_OF_OPEN_DEG = 0.6

_FACTOR = 1.18
# A rise of the squared reprojection errors that the lens model alone may account for; and the smallest one
# from which it is extrapolated.
_TOLERATED_RISE, _SMALLEST_RISE = 0.05, 0.01
_MAX_ITERATIONS = 20
_MIN_NUM_POINTS = 20


@dataclass(frozen=True, kw_only=True)
class FocalSlack:
    """What another focal length would change.

    Attributes
    ----------
    factor : float
        By how much the focal lengths may be multiplied or divided for the squared reprojection errors to rise
        by 5 %.
    pose_change_deg : float
        Median change of the relative poses by that, see
        `corrsfm.reconstruction.agreement.relative_pose_differences_deg`.
    are_others_known : bool
        Cameras of known focal length took other photos of the model, so an open one moves its photos only.
    """

    factor: float
    pose_change_deg: float
    are_others_known: bool = False

    @property
    def is_large(self) -> bool:
        """Whether more than one focal length fits, and poses should not be relied on."""
        is_open = self.factor > _LARGEST_FACTOR and not self.are_others_known
        most = _POSE_CHANGE_OF_OPEN_DEG if is_open else _LARGEST_POSE_CHANGE_DEG
        return self.pose_change_deg > most


def measure_focal_slack(model: pycolmap.Reconstruction) -> FocalSlack | None:
    """Change the open focal lengths of a model by 18 %, both ways; see what it costs and what it moves.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Not changed. Cameras of known focal length stay as they are.

    Returns
    -------
    FocalSlack or None
        The larger of both ways. None if no focal length is open, if the model has fewer than three photos
        or twenty points, or if nothing could be adjusted.
    """
    if has_prior_focal_lengths(model) or model.num_reg_images() < 3 or model.num_points3D() < _MIN_NUM_POINTS:
        return None
    base = thinned(model)
    cost = _cost_of(base, refine_focal_length=True)
    if cost is None or cost <= 0:
        return None
    views, num_open = views_of(base), len(focal_length_ratios(base))
    found = []
    for factor in (_FACTOR, 1 / _FACTOR):
        other = pycolmap.Reconstruction(base)
        for camera in other.cameras.values():
            if camera.has_prior_focal_length:
                continue
            params = camera.params.copy()
            params[list(camera.focal_length_idxs())] *= factor
            camera.params = params
        other_cost = _cost_of(other, refine_focal_length=False)
        if other_cost is None:
            continue
        # Near the best focal length, costs rise with the square of the change and poses change in proportion.
        share = np.sqrt(_TOLERATED_RISE / max(other_cost / cost - 1, _SMALLEST_RISE))
        change_deg = float(np.median(relative_pose_differences_deg(views, views_of(other))))
        found.append(
            FocalSlack(
                factor=float(_FACTOR**share),
                pose_change_deg=float(share * change_deg),
                are_others_known=num_open < base.num_reg_images(),
            )
        )
    return max(found, key=lambda slack: slack.pose_change_deg, default=None)


def _cost_of(model: pycolmap.Reconstruction, *, refine_focal_length: bool) -> float | None:
    """The cost of a model after adjusting it in place, None if there is nothing to adjust."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_focal_length
    options.ceres.solver_options.max_num_iterations = _MAX_ITERATIONS
    known = [camera.camera_id for camera in model.cameras.values() if camera.has_prior_focal_length]
    return adjusted_cost(model, options, constant_cameras=known)
