"""The similarity between the frames of two models, from points that both may have.

Models of one scene have frames and scales of their own. A point of one and a point of the other that are
thought to be the same give a correspondence. It agrees with a similarity if each point, brought into the
other model, is seen where that model's photo sees its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Observed", "Similarity", "find_similarity", "fit_similarity"]

_NUM_TRIALS = 2000
_NUM_REFITS = 5
_SMALLEST_SCALE, _LARGEST_SCALE = 1e-3, 1e3


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """Points of a model, each with one photo that sees it.

    Attributes
    ----------
    points : (M, 3) float64
        In the world of the model.
    rotations : (M, 3, 3) float64
    translations : (M, 3) float64
        ``cam_from_world`` of the photo.
    rays : (M, 2) float64
        Where the photo sees the point, in normalised coordinates.
    focal_px : (M,) float64
        What one unit of these is in pixels.
    """

    points: NDArray[np.float64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    rays: NDArray[np.float64]
    focal_px: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points)

    def errors_px(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M,) distance in pixels between rays and other points (M, 3); infinite behind the photo."""
        in_camera = np.einsum("mij,mj->mi", self.rotations, points) + self.translations
        depth = in_camera[:, 2]
        front = depth > 0
        seen = in_camera[:, :2] / np.where(front, depth, 1.0)[:, None]
        errors = np.linalg.norm(seen - self.rays, axis=1) * self.focal_px
        return np.where(front & np.isfinite(errors), errors, np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Similarity:
    """``a_from_b``: ``x_in_a = scale · rotation · x_in_b + translation``.

    Attributes
    ----------
    scale : float
    rotation : (3, 3) float64
    translation : (3,) float64
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (M, 3) of b in a."""
        return self.scale * points @ self.rotation.T + self.translation

    def invert(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (M, 3) of a in b."""
        return (points - self.translation) @ self.rotation / self.scale


def fit_similarity(a: NDArray[np.float64], b: NDArray[np.float64]) -> Similarity | None:
    """The similarity that brings points b nearest to points a, by least squares.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.

    Parameters
    ----------
    a, b : (M, 3) float64
        M ≥ 3.

    Returns
    -------
    Similarity or None
        None if the points lie on one line.
    """
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    left, singular, right = np.linalg.svd((a - centre_a).T @ (b - centre_b) / len(a))
    variance = np.mean(np.sum((b - centre_b) ** 2, axis=1))
    if not singular[1] > 1e-9 * singular[0] or not variance > 0:
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(singular @ signs / variance)
    if not _SMALLEST_SCALE <= scale <= _LARGEST_SCALE:
        return None
    return Similarity(scale=scale, rotation=rotation, translation=centre_a - scale * rotation @ centre_b)


def find_similarity(
    a: Observed, b: Observed, *, max_error_px: float, seed: int = 0
) -> tuple[Similarity, NDArray[np.bool_]] | None:
    """The similarity that most correspondences agree with, by RANSAC.

    Parameters
    ----------
    a, b : Observed
        Row i of both is one correspondence.
    max_error_px : float
        Largest error of an agreeing correspondence, in either direction.
    seed : int

    Returns
    -------
    Similarity and (M,) bool
        The latter says which correspondences agree. None if there is no similarity.
    """
    if len(a) < 3:
        return None
    generator = np.random.default_rng(seed)
    best: tuple[Similarity, NDArray[np.bool_]] | None = None
    for _ in range(_NUM_TRIALS):
        sample = generator.choice(len(a), 3, replace=False)
        found = _improved(a, b, sample, max_error_px, best)
        best = found or best
    return best


def _improved(
    a: Observed,
    b: Observed,
    sample: NDArray[np.int64],
    max_error_px: float,
    best: tuple[Similarity, NDArray[np.bool_]] | None,
) -> tuple[Similarity, NDArray[np.bool_]] | None:
    """A similarity from a sample that more agree with than with the best so far, fitted to all of them."""
    found = None
    most = 3 if best is None else int(best[1].sum())
    rows: NDArray[np.int64] = sample
    for _ in range(_NUM_REFITS):
        similarity = fit_similarity(a.points[rows], b.points[rows])
        if similarity is None:
            break
        agreeing = _agreeing(similarity, a, b, max_error_px)
        if agreeing.sum() <= most:
            break
        found, most = (similarity, agreeing), int(agreeing.sum())
        rows = np.flatnonzero(agreeing)
    return found


def _agreeing(similarity: Similarity, a: Observed, b: Observed, max_error_px: float) -> NDArray[np.bool_]:
    forward = a.errors_px(similarity.apply(b.points)) <= max_error_px
    return forward & (b.errors_px(similarity.invert(a.points)) <= max_error_px)
