"""CLNet: progressive correspondence pruning by consensus learning (Zhao et al., ICCV 2021)."""

from __future__ import annotations

from torch import Tensor, nn

from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import AnnularConvolution, ResidualUnit, Stack, cbr, graph_filter, named
from corrsfm.model.rivals.scaffolds import prune

__all__ = ["CLNet"]

NEIGHBORS = (9, 6)


class Block(nn.Module):
    """Inputs (B,N,.) to features (B,N,C) and two sets of logits (B,N), before and after the graph filter."""

    def __init__(self, inputs: int, channels: int, num_neighbors: int, *, last: bool) -> None:
        super().__init__()
        self.conv = Stack(*cbr(inputs, channels))
        self.embed_0 = Stack(
            *(ResidualUnit(channels, channels) for _ in range(4)),
            AnnularConvolution(channels, num_neighbors),
            *(ResidualUnit(channels, channels) for _ in range(4)),
        )
        self.linear_0 = nn.Linear(channels, 1)
        self.gcn = named("conv", *cbr(channels, channels))
        self.embed_1 = Stack(ResidualUnit(channels, channels))
        self.linear_1 = nn.Linear(channels, 1)
        if last:
            self.embed_2 = ResidualUnit(channels, channels)
            self.linear_2 = nn.Linear(channels, 2)

    def forward(self, inputs: Tensor, mask: Tensor | None) -> tuple[Tensor, list[Tensor]]:
        f = self.embed_0(self.conv(inputs, mask), mask)
        first = self.linear_0(f).squeeze(-1)
        f = f + self.gcn(graph_filter(f, first, mask), mask)
        f = self.embed_1(f, mask)
        return f, [first, self.linear_1(f).squeeze(-1)]


class CLNet(Rival):
    """Two pruning blocks that keep one half each, and an estimate from the last quarter.

    Parameters
    ----------
    channels, side_channels : int
    """

    pruning_ratio = 0.5

    def __init__(self, *, channels: int = 128, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.ds_0 = Block(4 + side_channels, channels, NEIGHBORS[0], last=False)
        self.ds_1 = Block(6 + side_channels, channels, NEIGHBORS[1], last=True)

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> RivalOutput:
        """Score correspondences (B,N,4); see `Rival`."""
        inputs = Inputs.of(
            correspondences,
            side_information,
            mask,
            side_channels=self.side_channels,
            min_rows=2 * max(NEIGHBORS),
        )
        return prune(
            [self.ds_0, self.ds_1], self.ds_1, inputs, ratio=self.pruning_ratio, min_rows=NEIGHBORS[1]
        )
