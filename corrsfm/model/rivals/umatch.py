"""U-Match: an attention U-Net over correspondences, coarse and fine (Li, Zhang and Ma, IJCAI 2023)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.model.network import BatchNorm, row_sum, take_rows
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput, keep_best
from corrsfm.model.rivals.layers import (
    Attention,
    InstanceNorm,
    PointContext,
    Stack,
    cbr,
    eight_point,
    named,
    positive_part,
)

__all__ = ["UMatch"]

POOL_RATIOS = (0.125, 0.5, 0.5)
NUM_BLOCKS = 6


class Pool(nn.Module):
    """The highest-scored share of the rows, each attending to all rows: (B,N,C) to (B,N',C)."""

    def __init__(self, channels: int, ratio: float) -> None:
        super().__init__()
        self.ratio = ratio
        self.init_filter = PointContext(channels, channels)
        self.proj = nn.Linear(channels, 1)
        self.pool = Attention(channels)

    def forward(self, d: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None, Tensor]:
        """Kept features (B,N',C), their mask (B,N') and their index (B,N') in the input."""
        scores = self.proj(d).sigmoid()  # (B,N,1)
        order, kept_mask = keep_best(scores.squeeze(-1), mask, self.ratio)
        kept = take_rows(scores * self.init_filter(d, mask), order)
        return self.pool(kept, d, kept_mask, mask), kept_mask, order


class Block(nn.Module):
    """Down three pools, attention among what is left, up again: (B,N,C) to (B,N,C) and logits (B,N)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.pools = nn.ModuleList(Pool(channels, ratio) for ratio in POOL_RATIOS)
        self.bottom_gat = nn.ModuleDict({"gat": Attention(channels)})
        self.unpools = nn.ModuleList(nn.ModuleDict({"unpool": Attention(channels)}) for _ in POOL_RATIOS)
        self.inlier_pre = named(
            "inlier_pre",
            *(nn.Linear(channels, channels), InstanceNorm(1e-3), BatchNorm(channels), nn.ReLU()),
            nn.Linear(channels, 1),
        )

    def forward(self, d: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        skips = []
        for pool in self.pools:
            skips.append((d, mask))
            d, mask, _ = pool(d, mask)
        d = self.bottom_gat["gat"](d, d, mask, mask)
        for unpool, (skip, skip_mask) in zip(self.unpools, reversed(skips), strict=True):
            d = unpool.get_submodule("unpool")(skip, d, skip_mask, mask)
            mask = skip_mask
        return d, self.inlier_pre(d, mask).squeeze(-1)


class GlobalContext(nn.Module):
    """Split features into their part along a weighted mean and the rest, and add what both say."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = Stack(*cbr(channels, channels // 4), nn.Linear(channels // 4, channels))
        self.conv1 = Stack(*cbr(2 * channels, channels), nn.Linear(channels, channels))

    def forward(self, d: Tensor, logits: Tensor, mask: Tensor | None) -> Tensor:
        weights = positive_part(logits, mask)
        weights = weights / weights.sum(1, keepdim=True).clamp(min=1e-12)
        mean = self.conv(row_sum(weights[..., None] * d, mask))  # (B,1,C)
        mean = F.normalize(mean, dim=-1)
        across = d - (d @ mean.mT) * mean
        return d + self.conv1(torch.cat([across, mean.expand_as(d)], dim=-1), mask)


class UMatch(Rival):
    """Six blocks, each with an estimate of its own, and a global context after the second and fourth.

    Parameters
    ----------
    channels : int
        A multiple of 4.
    side_channels : int
    """

    def __init__(self, *, channels: int = 128, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.init_project = nn.ModuleDict({"init_project": nn.Linear(4 + side_channels, channels)})
        self.layer_blocks = nn.ModuleList(Block(channels) for _ in range(NUM_BLOCKS))
        self.global_context1 = GlobalContext(channels)
        self.global_context2 = GlobalContext(channels)

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> RivalOutput:
        """Score correspondences (B,N,4); see `Rival`."""
        inputs = Inputs.of(correspondences, side_information, mask, side_channels=self.side_channels)
        mask = inputs.mask
        contexts = {1: self.global_context1, 3: self.global_context2}
        d = self.init_project["init_project"](inputs.features)
        all_logits, essentials = [], []
        for number, block in enumerate(self.layer_blocks):
            d, logits = block(d, mask)
            all_logits.append(logits)
            essentials.append(eight_point(inputs.coordinates, logits, mask))
            if number in contexts:
                d = contexts[number](d, logits, mask)
        return inputs.output(all_logits, essentials)
