"""How two views and a match agree: distances in pixels and signs of depths.

Points are normalised; one unit is ``focal_px`` pixels in each photo, which is exact for a pinhole and good
to the local change of scale under distortion. A distance that does not exist (no baseline, no viewing ray)
is NaN and fails every threshold.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from corrsfm.geometry import essential_from_pose, relative_pose
from corrsfm.reconstruction.views import Rays, View

__all__ = ["TwoViews"]


@dataclass(frozen=True, eq=False)
class TwoViews:
    """Two registered photos and the rays of their keypoints.

    Attributes
    ----------
    view0, view1 : View
    rays0, rays1 : Rays
    """

    view0: View
    view1: View
    rays0: Rays
    rays1: Rays

    def sampson_distance_px(self, matches: NDArray[np.integer]) -> NDArray[np.float64]:
        """First-order distance of matches to the epipolar geometry (Sampson, CGIP 1982).

        Parameters
        ----------
        matches : (K, 2) int
            Keypoint indices.

        Returns
        -------
        (K,) float64
            Pixels; the gradient is taken in pixels of either photo, so different focal lengths count right.
        """
        x0, x1 = self._homogeneous(matches)
        essential = self._essential()
        line_in_1, line_in_0 = x0 @ essential.T, x1 @ essential
        gradient_sq = _normal_sq(line_in_1) / self.rays1.focal_px**2
        gradient_sq += _normal_sq(line_in_0) / self.rays0.focal_px**2
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.abs(np.einsum("ki,ki->k", x1, line_in_1)) / np.sqrt(gradient_sq)

    def line_distance_px(self, matches: NDArray[np.integer]) -> NDArray[np.float64]:
        """Distance of the keypoint in photo 1 to the epipolar line of the one in photo 0.

        Parameters
        ----------
        matches : (K, 2) int
            Keypoint indices.

        Returns
        -------
        (K,) float64
            Pixels of photo 1.
        """
        # Lines of all keypoints first: the neighbours of a keypoint share its line.
        lines = _homogeneous(self.rays0.points) @ self._essential().T
        with np.errstate(divide="ignore", invalid="ignore"):
            lines *= (self.rays1.focal_px / np.sqrt(_normal_sq(lines)))[:, None]
        line = lines[matches[:, 0]]
        x1 = self.rays1.points[matches[:, 1]]
        return np.abs(line[:, 0] * x1[:, 0] + line[:, 1] * x1[:, 1] + line[:, 2])

    def in_front(self, matches: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Whether the point between the two rays of a match lies in front of both photos.

        Parameters
        ----------
        matches : (K, 2) int
            Keypoint indices.

        Returns
        -------
        (K,) bool
            The signs of both depths where the rays come closest; False for parallel rays.
        """
        translation = self._cam1_from_cam0[1]
        ray0, x1 = self._rays_in_cam1(matches)
        # Least squares of depth1 · x1 = depth0 · R x0 + t; both depths times the same positive determinant.
        ray00, ray11 = np.sum(ray0**2, axis=1), np.sum(x1**2, axis=1)
        ray01 = np.einsum("ki,ki->k", ray0, x1)
        along0, along1 = ray0 @ translation, x1 @ translation
        return (ray01 * along1 - ray11 * along0 > 0) & (ray00 * along1 - ray01 * along0 > 0)

    def far_distance_px(self, matches: NDArray[np.integer]) -> NDArray[np.float64]:
        """Distance of the keypoint in photo 1 to where a far point under the one in photo 0 would be.

        No translation is needed for it, so it says more than an epipolar line where the camera only turned.

        Parameters
        ----------
        matches : (K, 2) int
            Keypoint indices.

        Returns
        -------
        (K,) float64
            Pixels of photo 1; NaN where the ray of photo 0 leads behind photo 1.
        """
        ray0, x1 = self._rays_in_cam1(matches)
        depth = np.where(ray0[:, 2] > 0, ray0[:, 2], np.nan)
        return self.rays1.focal_px * np.linalg.norm(ray0[:, :2] / depth[:, None] - x1[:, :2], axis=1)

    def ray_angles_deg(self, matches: NDArray[np.integer]) -> NDArray[np.float64]:
        """Angle between the two rays of each match, in degrees; 0 where the camera only turned.

        Parameters
        ----------
        matches : (K, 2) int
            Keypoint indices.

        Returns
        -------
        (K,) float64
        """
        ray0, x1 = self._rays_in_cam1(matches)
        sine = np.linalg.norm(np.cross(ray0, x1), axis=1)
        return np.degrees(np.arctan2(sine, np.einsum("ki,ki->k", ray0, x1)))

    @cached_property
    def _cam1_from_cam0(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return relative_pose(
            self.view0.rotation, self.view0.translation, self.view1.rotation, self.view1.translation
        )

    def _rays_in_cam1(self, matches: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions (K, 3) of both keypoints of matches, turned into the frame of photo 1."""
        x0, x1 = self._homogeneous(matches)
        return x0 @ self._cam1_from_cam0[0].T, x1

    def _essential(self) -> NDArray[np.float64]:
        return essential_from_pose(*self._cam1_from_cam0)

    def _homogeneous(self, matches: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return (
            _homogeneous(self.rays0.points[matches[:, 0]]),
            _homogeneous(self.rays1.points[matches[:, 1]]),
        )


def _homogeneous(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([points, np.ones(len(points))])


def _normal_sq(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    return lines[:, 0] ** 2 + lines[:, 1] ** 2
