"""NCMNet: neighbours consistent in space, features and graph, mined together (Liu and Yang, CVPR 2023)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.model.network import nearest_neighbors
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import (
    AnnularConvolution,
    ClusterFilter,
    ResidualUnit,
    Stack,
    cbr,
    graph_filter,
    named,
    order_aware,
    pre,
)
from corrsfm.model.rivals.scaffolds import prune

__all__ = ["NCMNet"]

NEIGHBORS = (9, 6)


class CrossInteraction(nn.Module):
    """Add to c what its rows say, weighted by how queries of a attend to keys of b: three (B,N,C) to one."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attq = Stack(*cbr(channels, channels // 4))
        self.attk = Stack(*cbr(channels, channels // 4))
        self.attv = Stack(*cbr(channels, channels))
        self.conv = Stack(*cbr(channels, channels))
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(self, a: Tensor, b: Tensor, c: Tensor, mask: Tensor | None) -> Tensor:
        q, k, v = self.attq(a, mask), self.attk(b, mask), self.attv(c, mask)
        allowed = None if mask is None else mask[:, None]
        gathered = F.scaled_dot_product_attention(q, k, v, attn_mask=allowed, scale=1.0)
        return c + self.gamma * self.conv(gathered, mask)


class Block(nn.Module):
    """Inputs (B,N,.) to features (B,N,C) and two sets of logits (B,N).

    Two rounds, each with layers of its own; the names of the second round's repeat the digit.
    """

    def __init__(self, inputs: int, channels: int, clusters: int, num_neighbors: int, *, last: bool) -> None:
        super().__init__()
        self.num_neighbors = num_neighbors
        self.conv = Stack(*cbr(inputs, channels))
        self.embed_00 = Stack(*(ResidualUnit(channels, channels) for _ in range(3)))
        for r, digits in ((1, ("1", "2", "3")), (2, ("11", "22", "33"))):
            # These two only choose neighbours, and no gradient passes a choice.
            self.add_module(f"mlp{r}", nn.Linear(channels, 1).requires_grad_(False))
            self.add_module(f"gcn{r}", named("conv", *cbr(channels, channels)).requires_grad_(False))
            for digit in digits:
                self.add_module(f"sce{digit}", AnnularConvolution(channels, num_neighbors))
                self.add_module(f"cci{digit}", CrossInteraction(channels))
            self.add_module(f"down{r}", named("conv", *pre(channels, clusters)))
            self.add_module(f"l{r}", Stack(*(ClusterFilter(channels, clusters) for _ in range(2))))
            self.add_module(f"up{r}", named("conv", *pre(channels, clusters)))
            wide = ResidualUnit(4 * channels, channels)
            self.add_module(f"embed_0{r}", Stack(wide, *(ResidualUnit(channels, channels) for _ in range(2))))
        self.linear_0 = nn.Linear(channels, 1)
        self.gs = named("conv", *cbr(channels, channels))
        self.embed_1 = Stack(ResidualUnit(channels, channels))
        self.linear_1 = nn.Linear(channels, 1)
        if last:
            self.embed_2 = ResidualUnit(channels, channels)
            self.linear_2 = nn.Linear(channels, 2)

    def mine(self, f: Tensor, in_space: Tensor, r: int, mask: Tensor | None) -> Tensor:
        """Round r of mining on features (B,N,C), with the neighbours (B,N,k) of the inputs."""
        one, two, three = ("1", "2", "3") if r == 1 else ("11", "22", "33")
        layer = self.get_submodule
        with torch.no_grad():
            logits = layer(f"mlp{r}")(f).squeeze(-1)
            graph = layer(f"gcn{r}")(graph_filter(f, logits, mask), mask)
            in_features = nearest_neighbors(f, self.num_neighbors, mask)
            in_graph = nearest_neighbors(graph, self.num_neighbors, mask)
        s = layer(f"sce{one}")(f, mask, in_space)
        t = layer(f"sce{two}")(f, mask, in_features)
        g = layer(f"sce{three}")(f, mask, in_graph)
        parts = [
            layer(f"cci{one}")(t, g, s, mask),
            layer(f"cci{two}")(g, s, t, mask),
            layer(f"cci{three}")(s, t, g, mask),
            order_aware(f, layer(f"down{r}"), layer(f"l{r}"), layer(f"up{r}"), mask),
        ]
        return layer(f"embed_0{r}")(torch.cat(parts, dim=-1), mask)

    def forward(self, inputs: Tensor, mask: Tensor | None) -> tuple[Tensor, list[Tensor]]:
        in_space = nearest_neighbors(inputs, self.num_neighbors, mask)
        f = self.embed_00(self.conv(inputs, mask), mask)
        f = self.mine(f, in_space, 1, mask)
        f = self.mine(f, in_space, 2, mask)
        first = self.linear_0(f).squeeze(-1)
        f = f + self.gs(graph_filter(f, first, mask), mask)
        f = self.embed_1(f, mask)
        return f, [first, self.linear_1(f).squeeze(-1)]


class NCMNet(Rival):
    """Two pruning blocks that keep one half each, and an estimate from the last quarter.

    Parameters
    ----------
    channels : int
        A multiple of 4.
    clusters, side_channels : int
    """

    pruning_ratio = 0.5

    def __init__(self, *, channels: int = 128, clusters: int = 250, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.ds_0 = Block(4 + side_channels, channels, clusters, NEIGHBORS[0], last=False)
        self.ds_1 = Block(6 + side_channels, channels, clusters, NEIGHBORS[1], last=True)

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
