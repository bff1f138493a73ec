"""How far two models of one scene agree, whatever their frames and scales."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corrsfm.reconstruction.views import Views

__all__ = ["Agreement", "agreement", "relative_pose_differences_deg"]

MAX_DIFFERENCE_DEG = 5.0
# Two photos from nearly one place have no direction between them; shares of the largest distance.
_SMALLEST_BASELINE = 0.01


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """What two models have in common.

    Attributes
    ----------
    num_photos : int
        Photos that both register.
    share : float
        Of the pairs of these photos, the share whose relative poses agree, in [0, 1]; 0 without a pair.
    """

    num_photos: int
    share: float


def agreement(views_a: Views, views_b: Views, *, max_difference_deg: float = MAX_DIFFERENCE_DEG) -> Agreement:
    """Share of the relative poses that two models agree about.

    Parameters
    ----------
    views_a, views_b : mapping of str to View
        The registered photos of either.
    max_difference_deg : float
        Largest difference of poses that agree, in rotation and in the direction of the translation.

    Returns
    -------
    Agreement
    """
    num_photos = len(views_a.keys() & views_b.keys())
    differences = relative_pose_differences_deg(views_a, views_b)
    share = float(np.mean(differences < max_difference_deg)) if len(differences) else 0.0
    return Agreement(num_photos=num_photos, share=share)


def relative_pose_differences_deg(views_a: Views, views_b: Views) -> NDArray[np.float64]:
    """Difference of the relative poses of all pairs of common photos.

    Returns
    -------
    (n · (n − 1) / 2,) float64
        For each pair of the n common photos, in order of their names, the larger of the angle between the
        relative rotations and the angle between the directions of the baselines, in degrees. A baseline below
        1 % of the largest one in either model has no direction, and the rotation alone counts.
    """
    names = sorted(views_a.keys() & views_b.keys())
    if len(names) < 2:
        return np.zeros(0)
    first, second = np.triu_indices(len(names), k=1)
    rotations_a, directions_a, short_a = _poses(views_a, names)
    rotations_b, directions_b, short_b = _poses(views_b, names)
    # With D = Rbᵀ Ra per photo, the relative rotations differ by the angle of D1 D0ᵀ.
    turned = (rotations_b.transpose(0, 2, 1) @ rotations_a).reshape(len(names), 9)
    cosines = ((turned @ turned.T)[first, second] - 1.0) / 2.0
    along = np.einsum("ijk,ijk->ij", directions_a, directions_b)[first, second]
    along[(short_a | short_b)[first, second]] = 1.0
    return np.degrees(np.arccos(np.clip(np.minimum(cosines, along), -1.0, 1.0)))


def _poses(views: Views, names: list[str]) -> tuple[NDArray, NDArray, NDArray[np.bool_]]:
    """Rotations (n, 3, 3), unit baselines i → j in camera i (n, n, 3), and which of them are too short."""
    rotations = np.stack([views[name].rotation for name in names])
    centres = np.stack([views[name].centre for name in names])
    baselines = np.einsum("iab,ijb->ija", rotations, centres[None] - centres[:, None])
    lengths = np.linalg.norm(baselines, axis=2)
    short = lengths <= _SMALLEST_BASELINE * lengths.max()
    return rotations, baselines / np.where(lengths > 0, lengths, 1.0)[..., None], short
