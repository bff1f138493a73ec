"""Synthetic pairs without limit: structured scenes, realistic motions, outliers like real ones, exact truth.

A whole batch is drawn at once on the training device. A pair starts from image 0: keypoints, a depth for each
from the scene's structure, a motion, the projections into image 1. Inliers get those, with keypoint noise in
both images; outliers get a place in image 1 that a matcher could mistake for theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from corrsfm.training.config import NO_AUGMENTATION, SyntheticConfig
from corrsfm.training.dataset import Batch, RealPairs, generator_for
from corrsfm.training.statistics import MEASURED, SideStatistics

__all__ = ["SyntheticPairs", "draw_both", "make_pairs"]

SCENES = ("plane", "boxes", "relief", "clutter")
MOTIONS = ("sideways", "forward", "orbit", "near-rotation", "wide")
_NUM_BOXES = 6
_NUM_WAVES = 4


@dataclass
class _Draw:
    """Random numbers for a batch of B pairs."""

    num_pairs: int
    device: torch.device
    generator: torch.Generator

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        values = torch.rand(self.num_pairs, *shape, device=self.device, generator=self.generator)
        return low + (high - low) * values

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(self.num_pairs, *shape, device=self.device, generator=self.generator)

    def choice(self, count: int, *shape: int) -> Tensor:
        shape = (self.num_pairs, *shape)
        return torch.randint(count, shape, device=self.device, generator=self.generator)


class SyntheticPairs:
    """A source of batches like `RealPairs`, without files.

    Parameters
    ----------
    config : SyntheticConfig
    device : torch.device
    statistics : SideStatistics
        Distribution of side information.
    """

    def __init__(
        self, config: SyntheticConfig, device: torch.device, statistics: SideStatistics = MEASURED
    ) -> None:
        self._config, self._device, self._statistics = config, device, statistics.to(device)

    def sample(self, num_pairs: int, num_matches: int, generator: torch.Generator) -> Batch:
        """Draw ``num_pairs`` pairs of ``num_matches`` correspondences."""
        return make_pairs(num_pairs, num_matches, self._config, self._statistics, self._device, generator)


def draw_both(
    paths: Sequence[Path], num_batches: int, *, num_pairs: int = 32, num_matches: int = 1000, seed: int = 0
) -> tuple[list[Batch], list[Batch]]:
    """Draw batches of real pairs, not augmented, and as many of synthetic ones, to compare them."""
    device = torch.device("cpu")
    real = RealPairs.from_files(paths, device)
    synthetic = SyntheticPairs(SyntheticConfig(), device)
    generators = [generator_for(seed, step, 0, device) for step in range(num_batches)]
    return (
        [real.sample(num_pairs, num_matches, NO_AUGMENTATION, generator) for generator in generators],
        [synthetic.sample(num_pairs, num_matches, generator) for generator in generators],
    )


def make_pairs(
    num_pairs: int,
    num_matches: int,
    config: SyntheticConfig,
    statistics: SideStatistics,
    device: torch.device,
    generator: torch.Generator,
) -> Batch:
    """Draw synthetic pairs; see the module.

    Returns
    -------
    Batch
        Without lens distortion: true and known correspondences are the same.
    """
    draw = _Draw(num_pairs, device, generator)
    # Half the image in units of the focal length: from a long lens (0.2) to a wide one (0.9), 4:3 to 16:9.
    half = torch.stack([draw.uniform(low=0.2, high=0.9), draw.uniform(low=0.56, high=0.75)], -1)
    half[:, 1] *= half[:, 0]
    upright = draw.uniform() < 0.3
    half = torch.where(upright[:, None], half.flip(1), half)
    x0 = _keypoints(draw, num_matches, half)
    depth, normal_slope = _depths(draw, x0)
    rotation, translation = _motions(draw, depth.median(1).values)
    points1 = (F.pad(x0, (0, 1), value=1.0) * depth[..., None]) @ rotation.transpose(1, 2)
    points1 = points1 + translation[:, None]
    x1 = points1[..., :2] / points1[..., 2:].clamp(min=1e-3)
    visible = (points1[..., 2] > 0.05) & (x1.abs() <= half[:, None]).all(-1)

    # Inlier ratios are spread evenly over their logarithm: most real pairs are hard.
    low, high = config.min_inlier_ratio, config.max_inlier_ratio
    wanted = low * (high / low) ** draw.uniform()
    order = draw.uniform(num_matches).masked_fill(~visible, 2.0).argsort(1).argsort(1)
    inlier = visible & (order < (wanted * num_matches).ceil()[:, None])

    noise = config.noise_px / 1000.0 * draw.uniform(1, 1, low=0.3, high=1.5)
    true_x1 = x1 + noise * draw.normal(num_matches, 2)
    noisy_x0 = x0 + noise * draw.normal(num_matches, 2)
    outlier_x1 = _outlier_places(draw, x1, half)
    noisy_x1 = torch.where(inlier[..., None], true_x1, outlier_x1)
    # A patch looks larger where the point is nearer, and turns with the camera's roll.
    log_scale = torch.log(depth / points1[..., 2].clamp(min=0.05)) + normal_slope * 0.1
    roll = torch.atan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1])
    side = statistics.draw(inlier, log_scale, roll[:, None].expand_as(log_scale), generator)
    correspondences = torch.cat([noisy_x0, noisy_x1], -1)
    return Batch(
        correspondences=correspondences,
        true_correspondences=correspondences,
        matrix=_cross(F.normalize(translation, dim=-1)) @ rotation,
        ratios=side[0],
        mutual=side[1],
        log_scale_ratios=side[2],
        rotations=side[3],
        mask=torch.ones(num_pairs, num_matches, dtype=torch.bool, device=device),
        related=torch.ones(num_pairs, dtype=torch.bool, device=device),
    )


def _keypoints(draw: _Draw, num: int, half: Tensor) -> Tensor:
    """Keypoints (B, N, 2) of image 0: some spread over the photo, most in clusters of texture."""
    spread = draw.uniform(num, 2, low=-1.0, high=1.0)
    centres = draw.uniform(12, 2, low=-0.9, high=0.9)
    member = draw.choice(12, num)[..., None].expand(-1, -1, 2)
    width = draw.uniform(12, 1, low=0.03, high=0.3).expand(-1, -1, 2)
    clustered = centres.gather(1, member) + width.gather(1, member) * draw.normal(num, 2)
    share = draw.uniform(1)  # of keypoints in clusters
    chosen = torch.where((draw.uniform(num) < share)[..., None], clustered, spread)
    return torch.where(chosen.abs() < 1, chosen, spread) * half[:, None]


def _depths(draw: _Draw, points: Tensor) -> tuple[Tensor, Tensor]:
    """Depths (B, N) of the keypoints in one of the scenes, and a smooth number that varies with them."""
    num = points.shape[1]
    kind = draw.choice(len(SCENES))[:, None]
    rays = F.pad(points, (0, 1), value=1.0)

    def plane_depth(tilt: Tensor, distance: Tensor) -> Tensor:
        # n · X = d with the normal towards the camera; grazing planes are cut off far away.
        normal = F.normalize(F.pad(tilt, (0, 1), value=1.0), dim=-1)
        return (distance / (rays * normal).sum(-1).clamp(min=0.08)).clamp(0.3, 30.0)

    plane = plane_depth(0.5 * draw.normal(1, 2), torch.ones(1, 1, device=points.device))
    # Boxes: the photo falls into cells, each seeing its own face.
    seeds = draw.uniform(_NUM_BOXES, 2, low=-0.8, high=0.8)
    cell = torch.cdist(points, seeds).argmin(-1)
    tilts = 0.6 * draw.normal(_NUM_BOXES, 2)
    distances = torch.exp(0.4 * draw.normal(_NUM_BOXES))
    boxes = plane_depth(tilts.gather(1, cell[..., None].expand(-1, -1, 2)), distances.gather(1, cell))
    # Relief: waves on the plane.
    frequencies = 6.0 * draw.normal(_NUM_WAVES, 2)
    phases = draw.uniform(_NUM_WAVES, high=6.28)
    waves = torch.sin(points @ frequencies.transpose(1, 2) + phases[:, None]).mean(-1)
    relief = plane * (1 + draw.uniform(1, low=0.05, high=0.5) * waves)
    clutter = torch.exp(draw.uniform(1, low=0.2, high=0.7) * draw.normal(num))
    depth = torch.where(
        kind == 0, plane, torch.where(kind == 1, boxes, torch.where(kind == 2, relief, clutter))
    )
    return depth.clamp(0.2, 40.0), waves


def _motions(draw: _Draw, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (B, 3, 3) and translations (B, 3) of cam1_from_cam0 for scenes at a distance (B,)."""
    kind = draw.choice(len(MOTIONS))[:, None]
    side = F.normalize(F.pad(draw.normal(2), (0, 1)), dim=-1)
    ahead = F.pad(torch.where(draw.uniform(1) < 0.5, -1.0, 1.0), (2, 0))
    small_turn = torch.deg2rad(2.0 * draw.normal(3))
    # Sideways and forward: the camera moves by a share of the distance and hardly turns.
    step = draw.uniform(1, low=0.05, high=0.5)
    sideways = step * (side + 0.1 * draw.normal(3))
    forward = step * (ahead + 0.15 * draw.normal(3))
    # Orbit: about a point at the scene's distance, so that the view stays on it; wide is a longer way.
    angle = torch.where(kind == 4, draw.uniform(1, low=25, high=70), draw.uniform(1, low=3, high=30))
    axis = F.normalize(torch.stack([side[:, 1], -side[:, 0], 0.1 * draw.normal()], -1), dim=-1)
    orbit_turn = torch.deg2rad(angle) * axis
    roll = F.pad(torch.deg2rad(torch.where(draw.uniform(1) < 0.1, 90.0, 5.0) * draw.normal(1)), (2, 0))
    about_point = (kind == 2) | (kind == 4)
    turn = torch.where(about_point, orbit_turn, small_turn * torch.where(kind == 3, 8.0, 1.0))
    rotation = torch.matrix_exp(_cross(turn)) @ torch.matrix_exp(_cross(roll))
    centre = F.pad(torch.ones_like(distance)[:, None], (2, 0)) * distance[:, None]
    orbit = centre - (rotation @ centre[..., None])[..., 0] + 0.05 * distance[:, None] * draw.normal(3)
    moved = torch.where(kind == 0, sideways, torch.where(kind == 1, forward, 0.02 * draw.normal(3)))
    translation = torch.where(about_point, orbit, moved * distance[:, None])
    return rotation, translation


def _outlier_places(draw: _Draw, x1: Tensor, half: Tensor) -> Tensor:
    """Places (B, N, 2) in image 1 of outliers, mixed from four kinds of mistake."""
    num = x1.shape[1]
    uniform = draw.uniform(num, 2, low=-1.0, high=1.0) * half[:, None]
    centres = draw.uniform(8, 2, low=-0.9, high=0.9) * half[:, None]
    member = draw.choice(8, num)[..., None].expand(-1, -1, 2)
    clustered = centres.gather(1, member) + 0.08 * half[:, None] * draw.normal(num, 2)
    # Repeated structure: the right place, a few periods further.
    period = 0.25 * half[:, None] * draw.normal(1, 2)
    repeats = draw.choice(4, num)[..., None] + 1
    repeated = x1 + period * repeats + 0.003 * draw.normal(num, 2)
    # One to many: what another match has found already.
    few = draw.choice(max(num // 20, 1), num)[..., None].expand(-1, -1, 2)
    shared = uniform.gather(1, few)
    places = torch.stack([uniform, clustered, repeated, shared], 2)
    # On real pairs a third of all matches share their place with another.
    weights = draw.uniform(1, 4) ** 2 + torch.tensor([0.0, 0.0, 0.0, 0.7], device=x1.device)
    kind = torch.multinomial(weights[:, 0] + 1e-3, num, replacement=True, generator=draw.generator)  # (B, N)
    chosen = places.gather(2, kind[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
    inside = (chosen.abs() <= half[:, None]).all(-1, keepdim=True) & chosen.isfinite().all(-1, keepdim=True)
    return torch.where(inside, chosen, uniform)


def _cross(vectors: Tensor) -> Tensor:
    """Matrices (B, 3, 3) with ``[v]× w = v × w``."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
