"""The published network written down plainly, to test and time `network` against.

Nothing is optimised: features lie channels-first, (B,C,N,1) or (B,C,N,k), every layer is a convolution, every
normalisation its own pass, and the branches go through the motion injection one after the other. Modules have
the names of the published checkpoint. The structure is the published one, at any width; there is no padding,
and pairs need enough correspondences for the neighbour search.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.model.network import PruningOutput

__all__ = ["PlainCorrAdaptor"]

FLOW_EPSILON = 1e-6


def conv(inputs: int, outputs: int, width: int = 1, stride: int = 1) -> nn.Conv2d:
    """Convolution along the neighbours; with the default width a 1x1 convolution."""
    return nn.Conv2d(inputs, outputs, (1, width), (1, stride))


class Transpose(nn.Module):
    """Swap channels and positions."""

    def forward(self, x: Tensor) -> Tensor:
        return x.transpose(1, 2)


class SoftAssignment(nn.Module):
    """Scores (B,M,N,1) of assigning N correspondences to M clusters."""

    def __init__(self, channels: int, clusters: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.InstanceNorm2d(channels, eps=1e-3),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            conv(channels, clusters),
        )

    def forward(self, features: Tensor) -> Tensor:
        return self.conv(features)


class OrderAwareFilter(nn.Module):
    """Filter of clusters (B,C,M,1)."""

    def __init__(self, channels: int, clusters: int) -> None:
        super().__init__()
        self.conv1 = nn.Sequential(
            nn.InstanceNorm2d(channels, eps=1e-3),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            conv(channels, channels),
            Transpose(),
        )
        self.conv2 = nn.Sequential(nn.BatchNorm2d(clusters), nn.ReLU(), conv(clusters, clusters))
        self.conv3 = nn.Sequential(
            Transpose(),
            nn.InstanceNorm2d(channels, eps=1e-3),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            conv(channels, channels),
        )

    def forward(self, clusters: Tensor) -> Tensor:
        x = self.conv1(clusters)
        x = x + self.conv2(x)
        return self.conv3(x) + clusters


class GraphAttention(nn.Module):
    """Embedding of the edges (B,2C,N,k), then spatial, neighbourhood and channel attention."""

    def __init__(self, channels: int, k: int) -> None:
        super().__init__()
        self.embed = nn.Sequential(
            conv(2 * channels, channels), nn.InstanceNorm2d(channels), nn.BatchNorm2d(channels)
        )
        self.pointcn1 = self.context(channels)
        self.pointcn2 = self.context(channels)
        self.spatial_att = self.gate(k, 3)
        self.neighbor_att = self.gate(channels, channels // 4)
        self.channel_att = self.gate(channels, channels // 4)

    @staticmethod
    def context(channels: int) -> nn.Sequential:
        return nn.Sequential(
            nn.InstanceNorm2d(channels, eps=1e-3),
            nn.BatchNorm2d(channels),
            nn.GELU(),
            conv(channels, channels),
            nn.InstanceNorm2d(channels, eps=1e-3),
            nn.BatchNorm2d(channels),
            nn.GELU(),
            conv(channels, channels),
        )

    @staticmethod
    def gate(channels: int, hidden: int) -> nn.Sequential:
        return nn.Sequential(
            conv(channels, hidden),
            nn.BatchNorm2d(hidden),
            nn.GELU(),
            conv(hidden, channels),
            nn.BatchNorm2d(channels),
        )

    def forward(self, edges: Tensor) -> Tensor:
        graph = self.embed(edges)
        pooled = graph.mean(1, keepdim=True) + graph.amax(1, keepdim=True)  # (B,1,N,k)
        gate = self.spatial_att(pooled.transpose(1, 3)).transpose(1, 3).sigmoid()
        graph = graph * gate + graph
        context = self.pointcn1(graph)
        pooled = context.mean(2, keepdim=True) + context.amax(2, keepdim=True)  # (B,C,1,k)
        graph = context * self.neighbor_att(pooled).sigmoid() + graph
        context = self.pointcn2(graph)
        pooled = context.mean(3, keepdim=True) + context.amax(3, keepdim=True)  # (B,C,N,1)
        return context * self.channel_att(pooled).sigmoid() + graph


class Aggregator(nn.Module):
    """Annular convolution (B,C,N,k) to (B,C,N,1)."""

    def __init__(self, channels: int, k: int) -> None:
        super().__init__()
        self.conv1 = nn.Sequential(conv(channels, channels, 3, 3), nn.BatchNorm2d(channels), nn.GELU())
        self.conv2 = nn.Sequential(conv(channels, channels, k // 3), nn.BatchNorm2d(channels), nn.GELU())

    def forward(self, graph: Tensor) -> Tensor:
        return self.conv2(self.conv1(graph))


class FlowAttention(nn.Module):
    """Flow attention between token sequences (B,N,C)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj = nn.Linear(channels, channels)
        self.k_proj = nn.Linear(channels, channels)
        self.v_proj = nn.Linear(channels, channels)
        self.proj = nn.Linear(channels, channels)

    def split(self, x: Tensor) -> Tensor:
        """(B,N,C) to (B,H,N,D)."""
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        eps = FLOW_EPSILON
        q, k = self.split(self.q_proj(x).sigmoid()), self.split(self.k_proj(y).sigmoid())
        v = self.split(self.v_proj(y))

        def dot(tokens: Tensor, total: Tensor) -> Tensor:
            return ((tokens + eps) * (total[:, :, None] + eps)).sum(-1) + eps  # (B,H,N)

        incoming, outgoing = 1 / dot(q, k.sum(2)), 1 / dot(k, q.sum(2))
        sink = dot(q, (k * outgoing[..., None]).sum(2))
        source = dot(k, (q * incoming[..., None]).sum(2)).clamp(-1, 1)
        allocation = (sink * (q.shape[2] / k.shape[2])).sigmoid()
        competition = source.softmax(-1) * k.shape[2]
        flow = q @ (k.mT @ (v * competition[..., None]))
        out = flow * incoming[..., None] * allocation[..., None]
        return self.proj(out.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two linear layers with a GELU between."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels, 4 * channels)
        self.fc2 = nn.Linear(4 * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class InjectionLayer(nn.Module):
    """One layer of the motion injection on tokens (B,N,C)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm1_1 = nn.LayerNorm(channels)
        self.norm1_2 = nn.LayerNorm(channels)
        self.norm1_3 = nn.LayerNorm(channels)
        self.self_attn = FlowAttention(channels, heads)
        self.cross_attn = FlowAttention(channels, heads)
        self.norm2 = nn.LayerNorm(channels)
        self.norm3 = nn.LayerNorm(channels)
        self.mlp = Mlp(channels)
        self.gamma = nn.Parameter(torch.full((channels,), 1e-5))

    def forward(self, q: Tensor, motion: Tensor) -> Tensor:
        motion = self.norm1_3(motion)
        q = q + self.self_attn(self.norm1_1(q), self.norm1_2(q))
        q = self.norm2(q)
        q = q + self.cross_attn(q, motion)
        q = self.norm3(q)
        return q + self.gamma * self.mlp(q)


class Injection(nn.Module):
    """The motion injection on maps (B,C,N,1)."""

    def __init__(self, channels: int, heads: int, depth: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(InjectionLayer(channels, heads) for _ in range(depth))

    def forward(self, features: Tensor, motion: Tensor) -> Tensor:
        q, m = features.squeeze(-1).mT, motion.squeeze(-1).mT
        for layer in self.layers:
            q = layer(q, m)
        return q.mT[..., None]


class ResidualUnit(nn.Module):
    """Two normalised convolutions beside the identity; `right` is in the checkpoint and not used."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.left = nn.Sequential(
            conv(channels, channels),
            nn.InstanceNorm2d(channels),
            nn.BatchNorm2d(channels),
            nn.GELU(),
            conv(channels, channels),
            nn.InstanceNorm2d(channels),
            nn.BatchNorm2d(channels),
        )
        self.right = nn.Sequential(conv(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        return F.gelu(self.left(x) + x)


def knn_edges(features: Tensor, k: int) -> Tensor:
    """Edges [f_i || f_i - f_j] to the k nearest neighbours: (B,C,N,1) to (B,2C,N,k)."""
    x = features.squeeze(-1)
    squared = x.square().sum(1)
    distance = squared[:, :, None] + squared[:, None] - 2 * x.mT @ x  # (B,N,N)
    index = distance.topk(k, largest=False).indices
    neighbors = torch.stack([one[:, i] for one, i in zip(x, index, strict=True)])  # (B,C,N,k)
    own = features.expand_as(neighbors)
    return torch.cat([own, own - neighbors], dim=1)


class Block(nn.Module):
    """One pruning block on inputs (B,4 or 6,N,1)."""

    def __init__(
        self, inputs: int, k: int, channels: int, clusters: int, heads: int, depth: int, last: bool
    ) -> None:
        super().__init__()
        self.k = k
        self.conv = nn.Sequential(
            conv(inputs, channels), nn.InstanceNorm2d(channels), nn.BatchNorm2d(channels), nn.ReLU()
        )
        self.motion_embed = nn.Sequential(
            conv(2, channels // 4),
            nn.BatchNorm2d(channels // 4),
            nn.ReLU(),
            conv(channels // 4, channels // 2),
            nn.BatchNorm2d(channels // 2),
            nn.ReLU(),
            conv(channels // 2, channels),
        )
        for r in (1, 2):
            self.add_module(f"gab{r}", GraphAttention(channels, k))
            self.add_module(f"aggregator{r}", Aggregator(channels, k))
            self.add_module(f"ltr{r}", Injection(channels, heads, depth))
            self.add_module(f"pool{r}", SoftAssignment(channels, clusters))
            self.add_module(f"unpool{r}", SoftAssignment(channels, clusters))
            filters = nn.Sequential(*(OrderAwareFilter(channels, clusters) for _ in range(3)))
            self.add_module(f"oafilter{r}", filters)
            self.add_module(f"linear_{r - 1}", conv(channels, 1))
        if last:
            self.embed_2 = ResidualUnit(channels)
            self.linear_2 = conv(channels, 2)

    def fuse(self, features: Tensor, motion: Tensor, r: int) -> tuple[Tensor, Tensor]:
        """Round r: features (B,C,N,1) and logits (B,N)."""
        part = {
            name: getattr(self, f"{name}{r}")
            for name in ("gab", "aggregator", "ltr", "pool", "unpool", "oafilter")
        }
        assignment = part["pool"](features).softmax(2).squeeze(-1)  # (B,M,N)
        clusters = features.squeeze(-1) @ assignment.mT
        clusters = part["oafilter"](clusters[..., None]).squeeze(-1)
        assignment = part["unpool"](features).softmax(1).squeeze(-1)
        implicit = (clusters @ assignment)[..., None]
        explicit = part["aggregator"](part["gab"](knn_edges(features, self.k)))
        fused = part["ltr"](explicit, motion) + part["ltr"](implicit, motion)
        return fused, getattr(self, f"linear_{r - 1}")(fused)[:, 0, :, 0]

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        motion = self.motion_embed(inputs[:, 2:4] - inputs[:, :2])
        features = self.conv(inputs)
        features, first = self.fuse(features, motion, 1)
        features, second = self.fuse(features, motion, 2)
        return features, first, second


class PlainCorrAdaptor(nn.Module):
    """The published network at a given width, with the published parameter names (the unused ones left out).

    Parameters
    ----------
    channels, clusters, heads : int
    neighbors : tuple of two int
    motion_stacking : int
        L_m; a round has twice as many injection layers.
    """

    def __init__(
        self,
        *,
        channels: int = 128,
        clusters: int = 250,
        heads: int = 4,
        neighbors: tuple[int, int] = (9, 6),
        motion_stacking: int = 2,
    ) -> None:
        super().__init__()
        depth = 2 * motion_stacking
        self.ds_0 = Block(4, neighbors[0], channels, clusters, heads, depth, last=False)
        self.ds_1 = Block(6, neighbors[1], channels, clusters, heads, depth, last=True)

    def forward(self, correspondences: Tensor) -> PruningOutput:
        """Correspondences (B,N,4) to the same output as `CorrAdaptor`."""
        batch, num_rows, _ = correspondences.shape
        inputs = correspondences.mT[..., None]  # (B,4,N,1)
        index = torch.arange(num_rows).to(inputs.device).expand(batch, -1)
        _, first, second = self.ds_0(inputs)
        order = second.argsort(dim=1, descending=True)[:, : num_rows // 2]
        confidence = torch.stack([first, second], dim=1).detach().tanh().relu()[..., None]
        kept = torch.cat([inputs, confidence], dim=1)
        kept = kept.gather(2, order[:, None, :, None].expand(-1, 6, -1, 1))
        kept_index = index.gather(1, order)
        features, third, fourth = self.ds_1(kept)
        last_order = fourth.argsort(dim=1, descending=True)[:, : order.shape[1] // 2]
        last_features = features.gather(2, last_order[:, None, :, None].expand(-1, features.shape[1], -1, 1))
        last = kept[:, :4].gather(2, last_order[:, None, :, None].expand(-1, 4, -1, 1))
        fifth, log_weight = self.ds_1.linear_2(self.ds_1.embed_2(last_features)).squeeze(-1).unbind(1)
        weight = log_weight.exp() * fifth.sigmoid()
        essential = self.eight_point(last.squeeze(-1).mT, weight / (weight.sum(1, keepdim=True) + 1e-5))
        return PruningOutput(
            logits=(first, second, third, fourth, fifth),
            indices=(index, index, kept_index, kept_index, kept_index.gather(1, last_order)),
            essential=essential,
            residuals=self.verify(correspondences, essential),
        )

    @staticmethod
    def eight_point(matches: Tensor, weight: Tensor) -> Tensor:
        """Essential matrices (B,3,3) of weighted correspondences."""
        x, y, u, v = matches.unbind(-1)
        rows = torch.stack([u * x, u * y, u, v * x, v * y, v, x, y, torch.ones_like(x)], dim=-1)
        scatter = rows.mT @ (weight[..., None] * rows)
        return torch.linalg.eigh(scatter).eigenvectors[:, :, 0].unflatten(-1, (3, 3))

    @staticmethod
    def verify(matches: Tensor, essential: Tensor) -> Tensor:
        """Squared symmetric epipolar distances (B,N)."""
        ones = torch.ones_like(matches[..., :1])
        point0 = torch.cat([matches[..., :2], ones], dim=-1)
        point1 = torch.cat([matches[..., 2:], ones], dim=-1)
        line1, line0 = point0 @ essential.mT, point1 @ essential
        product = (point1 * line1).sum(-1).square()
        norm1, norm0 = line1[..., :2].square().sum(-1), line0[..., :2].square().sum(-1)
        return product * (1 / (norm1 + 1e-15) + 1 / (norm0 + 1e-15))
