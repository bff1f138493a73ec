"""PGFNet: preference-guided filtering (Liu et al., IEEE TIP 2023)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from corrsfm.model.network import BatchNorm, row_max, row_mean, take_rows
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput, keep_best
from corrsfm.model.rivals.layers import ClusterFilter, Stack, cbr, eight_point, named, order_aware, pre
from corrsfm.model.rivals.scaffolds import with_estimate

__all__ = ["PGFNet"]

KEPT_RATIO = 0.5
NUM_GROUPS = 4


class GroupedAttention(nn.Module):
    """Four groups of channels, each building on the one before, with gates on rows and channels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        group = width // NUM_GROUPS
        self.spatial_att = Stack(nn.Linear(2, 1), BatchNorm(1))
        for j in range(1, NUM_GROUPS + 1):
            self.add_module(f"conv{j}", Stack(*pre(group, group), *pre(group, group)))
        self.channel_att = Stack(*cbr(width, group), nn.Linear(group, width), BatchNorm(width))

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        groups = x.chunk(NUM_GROUPS, dim=-1)  # four of (B,N,G)
        pooled = torch.cat([groups[0].amax(-1, keepdim=True), groups[0].mean(-1, keepdim=True)], dim=-1)
        gate = self.spatial_att(pooled, mask).sigmoid()  # (B,N,1)
        filtered: list[Tensor] = []
        for j, group in enumerate(groups, start=1):
            total = gate * group + (filtered[-1] if filtered else 0.0)
            filtered.append(self.get_submodule(f"conv{j}")(total, mask))
        y = torch.cat(filtered, dim=-1)
        pooled = row_mean(y, mask) + row_max(y[:, :, None], mask)[:, :, 0]  # (B,1,W)
        y = y * self.channel_att(pooled).sigmoid() + x
        return y.unflatten(-1, (NUM_GROUPS, -1)).transpose(-1, -2).flatten(-2)  # interleave the groups


class Block(nn.Module):
    """Inputs (B,N,.) to logits (B,N)."""

    def __init__(self, inputs: int, channels: int, clusters: int) -> None:
        super().__init__()
        width = 2 * channels
        self.conv1 = nn.Linear(inputs, width)
        self.l1_1 = Stack(*(GroupedAttention(width) for _ in range(3)))
        self.l1_down128 = named("conv", *pre(width, channels))
        self.down1 = named("conv", *pre(channels, clusters))
        self.l2 = Stack(*(ClusterFilter(channels, clusters) for _ in range(3)))
        self.up1 = named("conv", *pre(channels, clusters))
        self.l1_exchange = named("conv", *pre(width, width))
        self.l1_2 = Stack(*(GroupedAttention(width) for _ in range(3)))
        self.output = nn.Linear(width, 1)

    def forward(self, inputs: Tensor, mask: Tensor | None) -> Tensor:
        f = self.l1_down128(self.l1_1(self.conv1(inputs), mask), mask)
        clustered = order_aware(f, self.down1, self.l2, self.up1, mask)
        f = self.l1_exchange(torch.cat([f, clustered], dim=-1), mask)
        return self.output(self.l1_2(f, mask)).squeeze(-1)


class PGFNet(Rival):
    """A block on all correspondences, one on the better half, and the sum of their logits over all.

    Parameters
    ----------
    channels : int
        Half the width of the grouped features; even.
    clusters, side_channels : int
    """

    def __init__(self, *, channels: int = 128, clusters: int = 500, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.weights_init = Block(4 + side_channels, channels, clusters)
        self.weights_iter = nn.ModuleList([Block(6 + side_channels, channels, clusters)])
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> RivalOutput:
        """Score correspondences (B,N,4); see `Rival`."""
        inputs = Inputs.of(correspondences, side_information, mask, side_channels=self.side_channels)
        first = self.weights_init(inputs.features, inputs.mask)
        essential = eight_point(inputs.coordinates, first, inputs.mask)
        order, kept_mask = keep_best(first, inputs.mask, KEPT_RATIO)
        kept = take_rows(with_estimate(inputs, first, essential), order)
        kept_logits = self.weights_iter[0](kept, kept_mask)  # (B,N')
        if kept_mask is not None:
            kept_logits = kept_logits * kept_mask
        second = torch.zeros_like(first).scatter(1, order, kept_logits) + self.gamma * first
        essentials = [essential, eight_point(inputs.coordinates, second, inputs.mask)]
        return inputs.output([first, second], essentials)
