"""MS2DG-Net: attention over two graphs of neighbours, then OANet's clusters (Dai et al., CVPR 2022)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from corrsfm.model.network import nearest_neighbors
from corrsfm.model.rivals import oanet
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import PointContext, Stack, knn_edges, named, pre
from corrsfm.model.rivals.scaffolds import refine

__all__ = ["MS2DGNet"]

NUM_NEIGHBORS = 20


class GraphAttention(nn.Module):
    """Add to each feature a sum over its neighbours, weighted channel by channel: (B,N,C) to (B,N,C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.att1 = Stack(*pre(2 * channels, channels))
        self.attq1 = nn.Linear(channels, channels)
        self.attk1 = nn.Linear(channels, channels)
        self.attv1 = nn.Linear(channels, channels)
        self.gamma1 = nn.Parameter(torch.ones(1))

    def forward(self, f: Tensor, mask: Tensor | None) -> Tensor:
        h = self.att1(knn_edges(f, nearest_neighbors(f, NUM_NEIGHBORS, mask)), mask)  # (B,N,k,C)
        attention = (self.attq1(h) * self.attk1(h)).softmax(2)
        return f + self.gamma1 * (attention * self.attv1(h)).sum(2)


class Block(oanet.Block):
    """Inputs (B,N,.) to logits (B,N): OANet's block behind features of two graphs."""

    def __init__(self, inputs: int, channels: int, clusters: int) -> None:
        super().__init__(inputs, channels, clusters)
        half = channels // 2
        self.conv1 = nn.Linear(inputs, half)
        self.att1_1 = GraphAttention(half)
        self.s1_1 = named("conv", *pre(channels, channels))
        self.l1_1 = Stack(
            PointContext(half + channels, channels), *(PointContext(channels, channels) for _ in range(2))
        )

    def embed(self, inputs: Tensor, mask: Tensor | None) -> Tensor:
        f = self.att1_1(self.conv1(inputs), mask)
        edges = knn_edges(f, nearest_neighbors(f, NUM_NEIGHBORS, mask))
        strongest = self.s1_1(edges, mask).amax(2)  # (B,N,C)
        return self.l1_1(torch.cat([f, strongest], dim=-1), mask)


class MS2DGNet(Rival):
    """Two blocks; the second sees the residuals and weights of the first.

    Parameters
    ----------
    channels : int
        Even; the graphs live on half of them.
    clusters, side_channels : int
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
        inputs = Inputs.of(
            correspondences,
            side_information,
            mask,
            side_channels=self.side_channels,
            min_rows=NUM_NEIGHBORS,
        )
        return refine([self.weights_init, *self.weights_iter], inputs)
