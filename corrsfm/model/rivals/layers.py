"""Layers that the rival networks share.

Modules carry the names of the published checkpoints (``left.0``, ``shot_cut``, ``conv.3``), so that a
checkpoint loads without a table of names and an error lists names that its owner can look up. Channels are
the last axis and a 1x1 convolution is a linear layer, as in `corrsfm.model.network`.

Shapes: B pairs, N rows, C channels, k neighbours, M clusters. `mask` is (B,N) bool or None.
"""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.model.network import (
    BatchNorm,
    linear_norm,
    nearest_neighbors,
    normalise,
    row_softmax,
    take_rows,
    weighted_eight_point,
)

__all__ = [
    "AnnularConvolution",
    "Attention",
    "ClusterFilter",
    "InstanceNorm",
    "PointContext",
    "ResidualUnit",
    "Stack",
    "cbr",
    "eight_point",
    "graph_filter",
    "knn_edges",
    "log_weighted_eight_point",
    "named",
    "order_aware",
    "positive_part",
    "pre",
]


class InstanceNorm(nn.Module):
    """Marks the instance normalisation in front of a batch normalisation; `Stack` computes both as one."""

    def __init__(self, eps: float) -> None:
        super().__init__()
        self.eps = eps


class Stack(nn.Sequential):
    """Layers in sequence on features (B,N,C) or (B,N,k,C), with a mask for those that mix rows."""

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        layers = list(self)
        while layers:
            match layers:
                case [InstanceNorm() as instance, BatchNorm() as norm, *layers]:
                    x = instance_norm(x, norm, instance.eps, mask)
                case [nn.Linear() as linear, BatchNorm() as norm, *layers]:
                    x = linear_norm(x, linear, norm, mask)
                case [BatchNorm() as norm, *layers]:
                    x = batch_norm(x, norm, mask)
                case [nn.Linear() | nn.ReLU() as layer, *layers]:
                    x = layer(x)
                case [layer, *layers]:
                    x = layer(x, mask)
        return x


def instance_norm(x: Tensor, norm: BatchNorm, eps: float, mask: Tensor | None) -> Tensor:
    """Instance and batch normalisation; padding becomes zero.

    In a pair of few equal rows a variance of almost zero would otherwise scale padding up, layer by layer.
    """
    x = normalise(x, norm, eps, mask)
    return x if mask is None else x.masked_fill(~mask.view(*mask.shape, *[1] * (x.ndim - 2)), 0.0)


def batch_norm(x: Tensor, norm: BatchNorm, mask: Tensor | None) -> Tensor:
    """Batch normalisation over all rows that count."""
    if mask is None or not norm.training:
        return norm(x.flatten(0, -2)).view(x.shape)
    where = mask.view(*mask.shape, *[1] * (x.ndim - 2))
    return torch.zeros_like(x).masked_scatter(where, norm(x[mask].flatten(0, -2)))


def named(name: str, *layers: nn.Module) -> Stack:
    """A stack one level below a name, where the published code wraps it in a class."""
    return Stack(OrderedDict([(name, Stack(*layers))]))


def pre(inputs: int, outputs: int, eps: float = 1e-3) -> list[nn.Module]:
    """Instance and batch normalisation, ReLU, linear layer."""
    return [InstanceNorm(eps), BatchNorm(inputs), nn.ReLU(), nn.Linear(inputs, outputs)]


def cbr(inputs: int, outputs: int) -> list[nn.Module]:
    """Linear layer, batch normalisation, ReLU."""
    return [nn.Linear(inputs, outputs), BatchNorm(outputs), nn.ReLU()]


class PointContext(nn.Module):
    """The residual block that OANet calls PointCN: twice `pre`, beside a shortcut."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = Stack(*pre(inputs, outputs), *pre(outputs, outputs))
        self.shot_cut = nn.Linear(inputs, outputs) if inputs != outputs else None

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        return self.conv(x, mask) + (x if self.shot_cut is None else self.shot_cut(x))


class ResidualUnit(nn.Module):
    """Twice a normalised linear layer, beside a shortcut, ReLU behind the sum (CLNet).

    The published unit owns the projection `right` even where widths agree and the identity is used. It is
    kept for its place in the checkpoint, and frozen because no gradient ever reaches it.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.left = Stack(
            *(nn.Linear(inputs, outputs), InstanceNorm(1e-5), BatchNorm(outputs), nn.ReLU()),
            *(nn.Linear(outputs, outputs), InstanceNorm(1e-5), BatchNorm(outputs)),
        )
        self.right = Stack(nn.Linear(inputs, outputs)).requires_grad_(inputs != outputs)
        self.projects = inputs != outputs

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        return F.relu(self.left(x, mask) + (self.right(x) if self.projects else x))


# Order-aware clusters (OANet)


class ClusterFilter(nn.Module):
    """Mixing along channels, among clusters, along channels again, beside a shortcut: (B,M,C) to (B,M,C)."""

    def __init__(self, channels: int, num_clusters: int) -> None:
        super().__init__()
        self.conv1 = Stack(*pre(channels, channels))
        self.conv2 = Stack(BatchNorm(num_clusters), nn.ReLU(), nn.Linear(num_clusters, num_clusters))
        # The published stack begins with the transposition back to channels, which shifts its numbers by one.
        self.conv3 = Stack(Pass(), *pre(channels, channels))

    def forward(self, clusters: Tensor, mask: None = None) -> Tensor:
        x = self.conv1(clusters)
        x = x + self.conv2(x.mT).mT
        return self.conv3(x) + clusters


class Pass(nn.Module):
    """Takes the number of a published layer that has nothing to do here."""

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        return x


def order_aware(
    f: Tensor, pool: nn.Module, filters: nn.Module, unpool: nn.Module, mask: Tensor | None
) -> Tensor:
    """Soft assignment to M clusters, filters among them, soft assignment back: (B,N,C) to (B,N,C)."""
    clusters = filters(row_softmax(pool(f, mask), mask).mT @ f)  # (B,M,C)
    return unpool(f, mask).softmax(2) @ clusters


# Graphs over correspondences


def knn_edges(f: Tensor, index: Tensor) -> Tensor:
    """Edges [f_i || f_i - f_j] to neighbours ``index (B,N,k)``: (B,N,C) to (B,N,k,2C)."""
    neighbors = take_rows(f, index)  # (B,N,k,C)
    own = f[:, :, None].expand_as(neighbors)
    return torch.cat([own, own - neighbors], dim=-1)


class AnnularConvolution(nn.Module):
    """Neighbours in rings of three, then all rings: edges (B,N,k,2C) to (B,N,C) (CLNet)."""

    def __init__(self, channels: int, num_neighbors: int) -> None:
        super().__init__()
        self.num_neighbors = num_neighbors
        self.conv = Stack(*cbr(6 * channels, channels), *cbr(num_neighbors // 3 * channels, channels))

    def forward(self, f: Tensor, mask: Tensor | None, index: Tensor | None = None) -> Tensor:
        """Gather over the given neighbours (B,N,k), by default the nearest in feature space."""
        if index is None:
            index = nearest_neighbors(f, self.num_neighbors, mask)
        rings = knn_edges(f, index).unflatten(2, (-1, 3)).flatten(3)  # (B,N,k/3,6C)
        return self.conv[3:](self.conv[:3](rings, mask).flatten(2), mask)


def graph_filter(f: Tensor, logits: Tensor, mask: Tensor | None) -> Tensor:
    """One step of graph convolution, D^-1/2 A D^-1/2 f with A = a a^T + I, a = ReLU(tanh(logits)) (CLNet).

    A is of rank one beside the identity, so its N x N entries are never formed. The logits (B,N) get no
    gradient.
    """
    a = positive_part(logits.detach(), mask)[..., None]  # (B,N,1)
    scale = torch.rsqrt(a * a.sum(1, keepdim=True) + 1)
    scaled = scale * f
    return scale * (a * (a.mT @ scaled) + scaled)


class Attention(nn.Module):
    """Four-headed attention of tokens (B,N,C) to others (B,L,C), beside a shortcut (ConvMatch)."""

    def __init__(self, channels: int, num_heads: int = 4) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query_filter = nn.Linear(channels, channels)
        self.key_filter = nn.Linear(channels, channels)
        self.value_filter = nn.Linear(channels, channels)
        self.mh_filter = nn.Linear(channels, channels)
        self.cat_filter = Stack(*cbr(2 * channels, 2 * channels), nn.Linear(2 * channels, channels))

    def forward(
        self, tokens: Tensor, others: Tensor, mask: Tensor | None = None, others_mask: Tensor | None = None
    ) -> Tensor:
        projected = (self.query_filter(tokens), self.key_filter(others), self.value_filter(others))
        q, k, v = (x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for x in projected)  # (B,H,.,C/H)
        allowed = None if others_mask is None else others_mask[:, None, None]
        gathered = F.scaled_dot_product_attention(q, k, v, attn_mask=allowed)
        gathered = self.mh_filter(gathered.transpose(1, 2).flatten(2))
        return tokens + self.cat_filter(torch.cat([tokens, gathered], dim=-1), mask)


# Estimates from logits


def positive_part(logits: Tensor, mask: Tensor | None) -> Tensor:
    """ReLU(tanh(logits)), the weight of a correspondence; zero on padding."""
    weight = logits.tanh().relu()
    return weight if mask is None else weight * mask


def eight_point(coordinates: Tensor, logits: Tensor, mask: Tensor | None) -> Tensor:
    """Essential matrices (B,3,3) of correspondences weighted by the positive part of their logits.

    Without a positive logit the matrix is an arbitrary one of unit norm.
    """
    return weighted_eight_point(coordinates, positive_part(logits, mask))


def log_weighted_eight_point(
    coordinates: Tensor, logits: Tensor, log_weights: Tensor, mask: Tensor | None
) -> Tensor:
    """Essential matrices (B,3,3) with the weights exp(log_weight) sigmoid(logit), over their sum (CLNet)."""
    weights = log_weights.clamp(max=60).exp() * logits.sigmoid()  # exp(60)^2 is still a float32
    if mask is not None:
        weights = weights * mask
    return weighted_eight_point(coordinates, weights / (weights.sum(1, keepdim=True) + 1e-5))
