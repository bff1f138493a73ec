"""MGNet: local and global graph context for correspondence pruning (Dai et al., AAAI 2024)."""

from __future__ import annotations

from torch import Tensor, nn

from corrsfm.model.network import nearest_neighbors
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import (
    ClusterFilter,
    ResidualUnit,
    Stack,
    cbr,
    knn_edges,
    named,
    order_aware,
    pre,
)
from corrsfm.model.rivals.scaffolds import prune

__all__ = ["MGNet"]

NUM_NEIGHBORS = 24


class Block(nn.Module):
    """Inputs (B,N,.) to features (B,N,C) and one set of logits (B,N)."""

    def __init__(self, inputs: int, channels: int, clusters: int, *, last: bool) -> None:
        super().__init__()
        self.conv = Stack(*cbr(inputs, channels))
        self.down1 = named("conv", *pre(channels, clusters))
        self.oa = Stack(*(ClusterFilter(channels, clusters) for _ in range(2)))
        self.up1 = named("conv", *pre(channels, clusters))
        self.embed_00 = Stack(*(ResidualUnit(channels, channels) for _ in range(4)))
        self.elgraph = named("conv", *cbr(2 * channels, channels), *cbr(channels, channels))
        self.embed_10 = Stack(*(ResidualUnit(channels, channels) for _ in range(4)))
        # Its logits would set the weights of a graph whose row sums, all that the published code uses, are 2
        # whatever the weights: it never reaches the output.
        self.linear_0 = nn.Linear(channels, 1).requires_grad_(False)
        self.gsda = named("conv", *cbr(channels, channels))
        self.embed_1 = Stack(ResidualUnit(channels, channels))
        self.linear_1 = nn.Linear(channels, 1)
        if last:
            self.embed_2 = ResidualUnit(channels, channels)
            self.linear_2 = nn.Linear(channels, 2)

    def forward(self, inputs: Tensor, mask: Tensor | None) -> tuple[Tensor, list[Tensor]]:
        f = order_aware(self.conv(inputs, mask), self.down1, self.oa, self.up1, mask)
        f = self.embed_00(f, mask)
        edges = knn_edges(f, nearest_neighbors(f, NUM_NEIGHBORS, mask))
        f = self.embed_10(self.elgraph(edges, mask).amax(2), mask)
        f = self.embed_1(f + self.gsda(2 * f, mask), mask)
        return f, [self.linear_1(f).squeeze(-1)]


class MGNet(Rival):
    """Two blocks that sort but keep everything, and an estimate from all correspondences.

    Parameters
    ----------
    channels, clusters, side_channels : int
    """

    def __init__(self, *, channels: int = 128, clusters: int = 100, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.mg_0 = Block(4 + side_channels, channels, clusters, last=False)
        self.mg_1 = Block(5 + side_channels, channels, clusters, last=True)

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
        return prune(
            [self.mg_0, self.mg_1], self.mg_1, inputs, ratio=self.pruning_ratio, min_rows=NUM_NEIGHBORS
        )
