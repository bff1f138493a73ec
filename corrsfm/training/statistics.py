"""Distributions of side information: measured on real pairs, drawn from for synthetic ones.

Inliers and outliers differ in their ratio, their mutual flag, and how well their change of scale and of
orientation agrees with the rest of the pair. All of these differ less on a pair with few inliers. The tables
here hold quantiles for each level of difficulty, which give synthetic matches the same distribution.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from corrsfm.training.dataset import Batch

__all__ = ["LEVELS", "MEASURED", "SideStatistics", "measure"]

LEVELS = (0.06, 0.15, 0.35)
"""Inlier ratios that separate the levels of difficulty."""
NUM_QUANTILES = 9
# Quantiles of fewer values would be noise.
_MIN_VALUES = 30


@dataclass(frozen=True)
class SideStatistics:
    """Distributions of side information; Q quantiles from the smallest to the largest value.

    Attributes
    ----------
    mutual : (4, 2) tensor
        Share of mutual matches by level, and by outlier or inlier.
    ratio : (4, 2, 2, Q) tensor
        Quantiles of the ratio by level, outlier or inlier, and not mutual or mutual.
    log_scale : (2, Q) tensor
        Quantiles of the log scale ratio; of inliers less the pair's median, which the depths explain.
    rotation : (2, Q) tensor
        Quantiles of the rotation in radians; of inliers less the pair's median, which the cameras explain.
    """

    mutual: Tensor
    ratio: Tensor
    log_scale: Tensor
    rotation: Tensor

    def to(self, device: torch.device) -> SideStatistics:
        """Copy to a device."""
        return SideStatistics(
            *(table.to(device) for table in (self.mutual, self.ratio, self.log_scale, self.rotation))
        )

    def draw(
        self, inlier: Tensor, log_scale: Tensor, rotation: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw side information for synthetic matches.

        Parameters
        ----------
        inlier : (B, N) bool tensor
        log_scale, rotation : (B, N) tensor
            Expected from the geometry.
        generator : torch.Generator

        Returns
        -------
        ratios, mutual, log_scale_ratios, rotations : (B, N) tensor
        """

        def uniform() -> Tensor:
            return torch.rand(inlier.shape, device=inlier.device, generator=generator)

        share = inlier.float().mean(1, keepdim=True)
        level = torch.bucketize(share, torch.tensor(LEVELS, device=inlier.device)).expand_as(inlier)
        kind = inlier.long()
        mutual = uniform() < self.mutual[level, kind]
        ratios = _interpolate(self.ratio[level, kind, mutual.long()], uniform())
        log_scale_noise = _interpolate(self.log_scale[kind], uniform())
        rotation_noise = _interpolate(self.rotation[kind], uniform())
        return (
            ratios,
            mutual.float(),
            torch.where(inlier, log_scale + log_scale_noise, log_scale_noise),
            torch.where(inlier, rotation + rotation_noise, rotation_noise),
        )


def _interpolate(quantiles: Tensor, position: Tensor) -> Tensor:
    """Values (B, N) at positions in [0, 1) of the distributions (B, N, Q)."""
    scaled = position * (quantiles.shape[-1] - 1)
    low = scaled.long().clamp(max=quantiles.shape[-1] - 2)
    below = quantiles.gather(-1, low[..., None])[..., 0]
    above = quantiles.gather(-1, low[..., None] + 1)[..., 0]
    return below + (scaled - low) * (above - below)


def measure(batches: Iterable[Batch]) -> SideStatistics:
    """Measure the distributions on real pairs, without augmentation.

    Cells with few matches borrow from the same kind of match over all levels.
    """
    columns: dict[str, list[Tensor]] = {}
    for batch in batches:
        inlier = batch.inliers()
        share = inlier.sum(1, keepdim=True) / batch.mask.sum(1, keepdim=True).clamp(min=1)
        rotation = torch.remainder(batch.rotations + torch.pi, 2 * torch.pi) - torch.pi
        typical_scale = (
            batch.log_scale_ratios.masked_fill(~inlier, torch.nan).nanmedian(1, keepdim=True).values
        )
        typical_rotation = rotation.masked_fill(~inlier, torch.nan).nanmedian(1, keepdim=True).values
        values = {
            "level": torch.bucketize(share, torch.tensor(LEVELS, device=share.device)).expand_as(inlier),
            "inlier": inlier.long(),
            "mutual": (batch.mutual > 0).long(),
            "ratio": batch.ratios,
            "log_scale": batch.log_scale_ratios - torch.where(inlier, typical_scale, 0.0),
            "rotation": rotation - torch.where(inlier, typical_rotation, 0.0),
        }
        for name, value in values.items():
            columns.setdefault(name, []).append(value[batch.mask].cpu())
    table = {name: torch.cat(parts) for name, parts in columns.items()}
    num_levels = len(LEVELS) + 1
    mutual, ratio = torch.zeros(num_levels, 2), torch.zeros(num_levels, 2, 2, NUM_QUANTILES)
    for level in range(num_levels):
        for inlier_flag in (0, 1):
            cell = (table["inlier"] == inlier_flag) & (table["level"] == level)
            if int(cell.sum()) < _MIN_VALUES:
                cell = table["inlier"] == inlier_flag
            mutual[level, inlier_flag] = table["mutual"][cell].float().mean()
            for mutual_flag in (0, 1):
                inner = cell & (table["mutual"] == mutual_flag)
                if int(inner.sum()) < _MIN_VALUES:
                    inner = (table["inlier"] == inlier_flag) & (table["mutual"] == mutual_flag)
                ratio[level, inlier_flag, mutual_flag] = _quantiles(table["ratio"][inner])
    return SideStatistics(
        mutual=mutual,
        ratio=ratio,
        log_scale=torch.stack([_quantiles(table["log_scale"][table["inlier"] == kind]) for kind in (0, 1)]),
        rotation=torch.stack([_quantiles(table["rotation"][table["inlier"] == kind]) for kind in (0, 1)]),
    )


def _quantiles(values: Tensor) -> Tensor:
    """Evenly spaced quantiles (Q,); the extremes are at 1 and 99 %, so that a stray value does not count."""
    if len(values) == 0:
        return torch.zeros(NUM_QUANTILES)
    positions = torch.linspace(0.0, 1.0, NUM_QUANTILES).clamp(0.01, 0.99)
    return torch.quantile(values.float()[:: max(1, len(values) // 1_000_000)], positions)


# Measured on 12 batches of 32 pairs of real training scenes, 1,000 matches each; 2,000 SIFT a photo.
MEASURED = SideStatistics(
    mutual=torch.tensor(
        [
            [0.26, 0.503],
            [0.278, 0.635],
            [0.259, 0.797],
            [0.209, 0.881],
        ]
    ),
    ratio=torch.tensor(
        [
            [0.812, 0.914, 0.941, 0.957, 0.969, 0.98, 0.988, 0.996, 1.0],
            [0.686, 0.847, 0.89, 0.918, 0.937, 0.957, 0.973, 0.988, 1.0],
            [0.711, 0.898, 0.933, 0.953, 0.965, 0.976, 0.984, 0.992, 1.0],
            [0.23, 0.569, 0.722, 0.8, 0.859, 0.902, 0.937, 0.969, 0.996],
            [0.812, 0.914, 0.941, 0.957, 0.969, 0.98, 0.988, 0.992, 1.0],
            [0.682, 0.851, 0.89, 0.918, 0.941, 0.957, 0.973, 0.988, 1.0],
            [0.694, 0.878, 0.925, 0.945, 0.961, 0.973, 0.984, 0.992, 1.0],
            [0.259, 0.533, 0.655, 0.741, 0.808, 0.863, 0.914, 0.957, 0.996],
            [0.78, 0.906, 0.937, 0.957, 0.969, 0.976, 0.988, 0.992, 1.0],
            [0.529, 0.827, 0.878, 0.91, 0.933, 0.953, 0.969, 0.984, 1.0],
            [0.557, 0.831, 0.894, 0.925, 0.949, 0.965, 0.98, 0.992, 1.0],
            [0.204, 0.388, 0.498, 0.584, 0.667, 0.749, 0.827, 0.91, 0.992],
            [0.761, 0.898, 0.933, 0.953, 0.965, 0.976, 0.984, 0.992, 1.0],
            [0.545, 0.824, 0.875, 0.906, 0.929, 0.949, 0.969, 0.984, 1.0],
            [0.388, 0.784, 0.867, 0.91, 0.937, 0.957, 0.976, 0.988, 1.0],
            [0.082, 0.22, 0.314, 0.396, 0.478, 0.573, 0.682, 0.812, 0.98],
        ]
    ).view(4, 2, 2, NUM_QUANTILES),
    log_scale=torch.tensor(
        [
            [-2.189, -0.692, -0.31, -0.114, 0.014, 0.146, 0.338, 0.697, 1.979],
            [-0.937, -0.204, -0.093, -0.035, 0.0, 0.037, 0.098, 0.211, 0.972],
        ]
    ),
    rotation=torch.tensor(
        [
            [-3.1, -2.369, -1.447, -0.545, 0.006, 0.57, 1.471, 2.388, 3.101],
            [-3.009, -0.194, -0.082, -0.03, 0.0, 0.03, 0.079, 0.193, 3.13],
        ]
    ),
)
"""What `measure` found on real pairs."""
