"""OANet: residual blocks around order-aware clusters, twice (Zhang et al., ICCV 2019)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import ClusterFilter, PointContext, Stack, named, order_aware, pre
from corrsfm.model.rivals.scaffolds import refine

__all__ = ["Block", "OANet"]


class Block(nn.Module):
    """Inputs (B,N,.) to logits (B,N)."""

    def __init__(self, inputs: int, channels: int, clusters: int) -> None:
        super().__init__()
        self.conv1 = nn.Linear(inputs, channels)
        self.l1_1 = Stack(*(PointContext(channels, channels) for _ in range(3)))
        self.down1 = named("conv", *pre(channels, clusters))
        self.l2 = Stack(*(ClusterFilter(channels, clusters) for _ in range(3)))
        self.up1 = named("conv", *pre(channels, clusters))
        self.l1_2 = Stack(
            PointContext(2 * channels, channels), *(PointContext(channels, channels) for _ in range(2))
        )
        self.output = nn.Linear(channels, 1)

    def embed(self, inputs: Tensor, mask: Tensor | None) -> Tensor:
        """Features (B,N,C) before the clusters."""
        return self.l1_1(self.conv1(inputs), mask)

    def forward(self, inputs: Tensor, mask: Tensor | None) -> Tensor:
        f = self.embed(inputs, mask)
        clustered = order_aware(f, self.down1, self.l2, self.up1, mask)
        return self.output(self.l1_2(torch.cat([f, clustered], dim=-1), mask)).squeeze(-1)


class OANet(Rival):
    """Two blocks; the second sees the residuals and weights of the first.

    Parameters
    ----------
    channels, clusters, side_channels : int
        Side information, here and in the other rivals, is more channels of the first layer of each block.
    """

    def __init__(self, *, channels: int = 128, clusters: int = 500, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.weights_init = Block(4 + side_channels, channels, clusters)
        self.weights_iter = nn.ModuleList([Block(6 + side_channels, channels, clusters)])

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> RivalOutput:
        """Score correspondences (B,N,4); see `Rival`."""
        inputs = Inputs.of(correspondences, side_information, mask, side_channels=self.side_channels)
        return refine([self.weights_init, *self.weights_iter], inputs)
