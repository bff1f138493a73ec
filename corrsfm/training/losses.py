"""Terms of losses: classification of matches, and how far an estimated matrix is from the true one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.model.network import symmetric_epipolar_squared

__all__ = [
    "balanced_classification_loss",
    "classification_loss",
    "essential_loss",
    "matrix_loss",
    "virtual_points",
]

MARGIN = 0.1
"""Largest distance at which a virtual point counts."""


def classification_loss(
    logits: Sequence[Tensor],
    distances: Sequence[Tensor],
    mask: Sequence[Tensor] | None = None,
    threshold: float = INLIER_THRESHOLD,
) -> Tensor:
    """Binary cross entropy with adaptive temperature, summed over the pruning steps (CLNet, CorrAdaptor).

    Parameters
    ----------
    logits : sequence of (B, N_s) tensors
        One for each step, N_s correspondences left.
    distances : sequence of (B, N_s) tensors
        Squared symmetric epipolar distances to the true geometry, in the order of the logits.
    mask : sequence of (B, N_s) bool tensors, optional
        False for padding, which counts nowhere.
    threshold : float
        τ of the paper: largest distance of an inlier.

    Returns
    -------
    () tensor
    """
    total = logits[0].new_zeros(())
    for step, (logit, distance) in enumerate(zip(logits, distances, strict=True)):
        # Labels are decided in the precision of the distances; the rest is computed in that of the logits.
        positive = (distance < threshold).to(logit.dtype)
        valid = torch.ones_like(positive) if mask is None else mask[step].to(logit.dtype)
        num_positive = (positive * valid).sum(1, keepdim=True).clamp(min=1)
        num_negative = ((1 - positive) * valid).sum(1, keepdim=True).clamp(min=1)
        positive_weight = (num_negative / num_positive).clamp(min=1)
        # An inlier at the threshold counts fully, one on its line 1/e: the temperature of the paper.
        certainty = torch.exp(-(distance - threshold).abs() / threshold).to(logit.dtype)
        scaled = torch.where(positive > 0, certainty, 1.0) * logit.masked_fill(valid == 0, 0.0)
        losses = F.binary_cross_entropy_with_logits(
            scaled, positive, pos_weight=positive_weight, reduction="none"
        )
        total = total + (losses * valid).sum() / valid.sum().clamp(min=1)
    return total


def balanced_classification_loss(
    logits: Sequence[Tensor],
    distances: Sequence[Tensor],
    mask: Sequence[Tensor] | None = None,
    threshold: float = INLIER_THRESHOLD,
) -> Tensor:
    """Binary cross entropy in which inliers and outliers of a pair weigh the same (PointCN, OANet).

    The mean over the pairs of half the mean over inliers and half the mean over outliers, summed over the
    sets of logits. The parameters are those of `classification_loss`.
    """
    total = logits[0].new_zeros(())
    for step, (logit, distance) in enumerate(zip(logits, distances, strict=True)):
        positive = (distance < threshold).to(logit.dtype)
        valid = torch.ones_like(positive) if mask is None else mask[step].to(logit.dtype)
        losses = F.binary_cross_entropy_with_logits(
            logit.masked_fill(valid == 0, 0.0), positive, reduction="none"
        )
        for chosen in (positive * valid, (1 - positive) * valid):
            means = (losses * chosen).sum(1) / chosen.sum(1).clamp(min=1)
            total = total + 0.5 * means.mean()
    return total


def matrix_loss(essential: Tensor, matrix: Tensor) -> Tensor:
    """Mean squared distance of matrices of unit norm, whichever sign is nearer (PointCN).

    Parameters
    ----------
    essential, matrix : (B, 3, 3) tensor
        Estimated and true, of any scale.
    """
    estimated, true = (F.normalize(one.flatten(1), dim=1) for one in (essential, matrix))
    return torch.minimum((estimated - true).square().sum(1), (estimated + true).square().sum(1)).mean()


def essential_loss(essential: Tensor, points: Tensor) -> Tensor:
    """Mean clamped squared symmetric epipolar distance of virtual points to the predicted matrix.

    Parameters
    ----------
    essential : (B, 3, 3) tensor
        ``x1ᵀ E x0 = 0``, any scale.
    points : (B, V, 4) tensor
        True correspondences, see `virtual_points`.
    """
    return symmetric_epipolar_squared(points, essential).clamp(max=MARGIN).mean()


def virtual_points(matrix: Tensor, *, num_iterations: int = 10) -> Tensor:
    """Make noise-free correspondences: a 20 × 20 grid in both images, moved onto the geometry.

    Each grid point paired with itself is moved by the smallest total squared distance that fulfils the
    epipolar constraint. The optimum is found by iterating first-order corrections, after P. Lindstrom,
    "Triangulation made easy" (2010); OpenCV's ``correctMatches`` solves the same problem by the roots of a
    polynomial.

    Parameters
    ----------
    matrix : (B, 3, 3) tensor
        Essential or fundamental matrix, ``x1ᵀ E x0 = 0``.
    num_iterations : int

    Returns
    -------
    (B, 400, 4) tensor
    """
    steps = torch.arange(20, dtype=matrix.dtype, device=matrix.device) * 0.1 - 1.0
    grid = torch.cartesian_prod(steps, steps).flip(1)  # (400, 2), x fastest
    x0 = grid.expand(len(matrix), -1, -1)
    x1 = x0
    shift0, shift1 = torch.zeros_like(x0), torch.zeros_like(x1)
    upper = matrix[:, :2, :2]
    for _ in range(num_iterations):
        # Normals of the epipolar lines at the current estimate.
        current0 = F.pad(x0 - shift0, (0, 1), value=1.0)
        current1 = F.pad(x1 - shift1, (0, 1), value=1.0)
        normal0 = current1 @ matrix[:, :, :2]  # (B, 400, 2) = (Eᵀ x1)₁₂
        normal1 = current0 @ matrix[:, :2, :].transpose(1, 2)
        # Along these normals the constraint at the grid point is a λ² − 2 b λ + c = 0; take the smaller root.
        a = (normal1 * (normal0 @ upper.transpose(1, 2))).sum(-1)
        b = 0.5 * (
            (normal0 * (F.pad(x1, (0, 1), value=1.0) @ matrix[:, :, :2])).sum(-1)
            + (normal1 * (F.pad(x0, (0, 1), value=1.0) @ matrix[:, :2, :].transpose(1, 2))).sum(-1)
        )
        c = (F.pad(x1, (0, 1), value=1.0) * (F.pad(x0, (0, 1), value=1.0) @ matrix.transpose(1, 2))).sum(-1)
        root = (b * b - a * c).clamp(min=0).sqrt()
        denominator = b + torch.where(b >= 0, root, -root)
        step = torch.where(denominator.abs() > 1e-30, c / denominator, 0.0)[..., None]
        shift0, shift1 = step * normal0, step * normal1
    return torch.cat([x0 - shift0, x1 - shift1], dim=-1)
