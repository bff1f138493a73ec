"""CorrAdaptor: adaptive local context learning for correspondence pruning (Zhu et al., ECAI 2024).

The file reads from the bottom of the network to its top, and each part names the section of the paper it
comes from:

    rows of a batch            means, maxima and normalisation that know about padding
    explicit branch (3.3)      KNN graph, graph attention, annular convolution
    implicit branch (3.4)      pooling to clusters, order-aware filters, unpooling
    motion injection (3.5)     flow attention among correspondences and onto their motion
    two-view geometry (3.1)    weighted eight-point algorithm, full-size verification
    network (3.2)              fusion rounds, pruning blocks, `NetworkConfig`, `CorrAdaptor`

Shapes: B pairs, N correspondences, C channels, k neighbours, M clusters, H heads of D = C / H channels.
Channels are always the last axis, so that every 1x1 convolution of the published code is one matrix product
without a copy.

Pairs of different sizes share a batch through ``mask (B,N) bool``, True on correspondences and False on
padding; ``None`` means that all rows are correspondences. Every operation that mixes rows takes the mask, so
a pair's result does not depend on what it is batched with, but for rounding: products of another shape, or on
another processor, add their terms in another order. Mostly that shows in the sixth digit of a logit. But
the network also chooses, and where two candidates almost tie, rounding decides: between the k-th neighbour
and the next, between two places in the rings of the annular convolution (`nearest_neighbors`), and between
two matches of almost equal logits at a pruning. A neighbour that flips moves the logit of its own match by up
to several percent of the scale, and the others a little through the normalisations. How much of this reaches
the kept matches, `corrsfm.prune.learned.Pruner` says.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.config import NetworkUsage
from corrsfm.errors import ConfigError

__all__ = [
    "CorrAdaptor",
    "NetworkConfig",
    "PruningOutput",
    "last_logits",
    "symmetric_epipolar_squared",
    "weighted_eight_point",
]

# A correspondence farther out than this (a viewing ray within 0.006 degrees of the image plane) is treated
# as padding.
LARGEST_COORDINATE = 1e4

FLOW_EPSILON = 1e-6


def full_precision(x: Tensor) -> torch.autocast:
    """Context without autocast, for coordinates, distances and rankings: they need more than 8 bits."""
    return torch.autocast(x.device.type, enabled=False)


# ----------------------------------------------------------------------------------------------------------
# Rows of a batch
# ----------------------------------------------------------------------------------------------------------


def row_sum(x: Tensor, mask: Tensor | None) -> Tensor:
    """Sum over the correspondences of each pair: (B,N,...) to (B,1,...)."""
    if mask is None:
        return x.sum(1, keepdim=True)
    summed = mask[:, None].to(x.dtype) @ x.flatten(2)  # (B,1,N) @ (B,N,rest)
    return summed.reshape(x.shape[0], 1, *x.shape[2:])


def row_count(x: Tensor, mask: Tensor | None) -> Tensor | int:
    """Number of correspondences of each pair: N, or (B,1,...) with as many dimensions as x."""
    return x.shape[1] if mask is None else mask.sum(1).view(-1, *[1] * (x.ndim - 1))


def row_mean(x: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the correspondences of each pair: (B,N,...) to (B,1,...)."""
    return row_sum(x, mask) / row_count(x, mask)


def row_max(x: Tensor, mask: Tensor | None) -> Tensor:
    """Maximum over the correspondences of each pair: (B,N,k,C) to (B,1,k,C)."""
    if mask is not None:
        x = x.masked_fill(~mask[:, :, None, None], -math.inf)
    return x.amax(1, keepdim=True)


def row_softmax(x: Tensor, mask: Tensor | None) -> Tensor:
    """Softmax over the correspondences of each pair, (B,N,channels); padding gets zero."""
    if mask is not None:
        x = x.masked_fill(~mask[:, :, None], -math.inf)
    return x.softmax(1)


def take_rows(x: Tensor, index: Tensor) -> Tensor:
    """Rows ``index (B,...)`` of each pair: (B,N,C) to (B,...,C)."""
    batch, num_rows, channels = x.shape
    offset = torch.arange(batch, device=x.device) * num_rows
    flat = index + offset.view(-1, *[1] * (index.ndim - 1))
    return x.flatten(0, 1).index_select(0, flat.flatten()).view(*index.shape, channels)


class BatchNorm(nn.BatchNorm1d):
    """Scale, shift and running statistics; `normalise` and `linear_norm` apply them to the last axis."""

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float


def normalise(x: Tensor, norm: BatchNorm, eps: float, mask: Tensor | None) -> Tensor:
    """Instance normalisation without affine, then batch normalisation, as one scale and one shift.

    Instance-normalised features have mean 0 and variance v / (v + eps) in every pair, so the batch statistics
    follow from the instance statistics without looking at the features again, in training too.

    Parameters
    ----------
    x : Tensor, shape (B,N,C) or (B,N,k,C)
    norm : BatchNorm
    eps : float
        Of the instance normalisation.
    mask : Tensor, shape (B,N) bool, optional
    """
    if not norm.training and mask is None and x.shape[0] == 1:
        # With one pair, instance normalisation is the batch normalisation of that pair: one native kernel.
        gain = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        shift = norm.bias - norm.running_mean * gain
        rows, *_ = torch.native_batch_norm(x.flatten(0, -2), gain, shift, None, None, True, 0.0, eps)
        return rows.view(x.shape)
    values, variance = centre(x, mask)
    if norm.training:
        batch_mean, batch_variance = _follow_batch(values, variance, norm, eps, mask)
    else:
        batch_mean, batch_variance = norm.running_mean, norm.running_var
    gain = norm.weight * torch.rsqrt(batch_variance + norm.eps)
    scale = gain * torch.rsqrt(variance + eps)  # (B,1,...,C)
    shift = norm.bias - batch_mean * gain  # (C,)
    return torch.addcmul(shift.to(values.dtype), values, scale.to(values.dtype))


def centre(x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Features minus their mean over the positions of each pair, and their variance (B,1,...,C) there."""
    wide = torch.promote_types(x.dtype, torch.float32)
    positions = tuple(range(1, x.ndim - 1))
    if mask is None:
        # Sums rather than means: in bfloat16 a mean copies its input to float32 first.
        num_positions = math.prod(x.shape[1:-1])
        values = x - x.sum(positions, keepdim=True) / num_positions
        return values, values.square().sum(positions, keepdim=True).to(wide) / num_positions
    with full_precision(x):
        count = mask.sum(1).view(-1, *[1] * (x.ndim - 1)) * math.prod(x.shape[2:-1])
        mean = row_sum(x.to(wide), mask).sum(positions, keepdim=True) / count
        values = x - mean.to(x.dtype)
        return values, row_sum(values.to(wide).square(), mask).sum(positions, keepdim=True) / count


def _follow_batch(
    values: Tensor, variance: Tensor, norm: BatchNorm, eps: float, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Mean and variance of instance-normalised features over the batch; updates the running statistics."""
    normalised = (variance / (variance + eps)).reshape(-1, variance.shape[-1])  # (B,C)
    if mask is None:
        batch_variance = normalised.mean(0)
        num_positions: Tensor | float = values.numel() / values.shape[-1]
    else:
        counts = mask.sum(1).to(normalised)
        batch_variance = (counts / counts.sum()) @ normalised
        num_positions = counts.sum() * math.prod(values.shape[2:-1])
    batch_mean = torch.zeros_like(batch_variance)
    with torch.no_grad():
        unbiased = batch_variance * (num_positions / (num_positions - 1))
        norm.running_mean.lerp_(batch_mean.to(norm.running_mean), norm.momentum)
        norm.running_var.lerp_(unbiased.to(norm.running_var), norm.momentum)
        norm.num_batches_tracked.add_(1)
    return batch_mean, batch_variance


def linear_norm(x: Tensor, linear: nn.Linear, norm: BatchNorm, mask: Tensor | None = None) -> Tensor:
    """Linear layer, then batch normalisation over all rows; at inference folded into one linear layer."""
    if not norm.training:
        gain = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        return F.linear(
            x, linear.weight * gain[:, None], (linear.bias - norm.running_mean) * gain + norm.bias
        )
    x = linear(x)
    if mask is None:
        return norm(x.flatten(0, -2)).view(x.shape)
    rows = x[mask]  # (rows of all pairs, ..., C)
    return torch.zeros_like(x).masked_scatter(
        mask.view(*mask.shape, *[1] * (x.ndim - 2)), norm(rows.flatten(0, -2)).to(x.dtype)
    )


# ----------------------------------------------------------------------------------------------------------
# Explicit branch (section 3.3)
# ----------------------------------------------------------------------------------------------------------


def nearest_neighbors(features: Tensor, k: int, mask: Tensor | None) -> Tensor:
    """The k nearest correspondences of each in feature space, itself first: (B,N,C) to (B,N,k).

    A pair with fewer than k correspondences repeats each correspondence itself in the missing places. In
    float32 a ranking value is off by up to about 1e-6 of the largest squared feature, so neighbours whose
    distances differ by less may change places, with the batch or with the processor.
    """
    with full_precision(features), torch.no_grad():
        features = features.to(torch.promote_types(features.dtype, torch.float32))
        features = features - row_mean(features, mask)  # shorter vectors cancel less
        squared_norm = features.square().sum(-1)
        if mask is not None:
            squared_norm = squared_norm.masked_fill(~mask, math.inf)
        # |f_j|^2 - 2 f_i.f_j orders the neighbours of i as the distance does: |f_i|^2 is the same for all j.
        ones = torch.ones_like(squared_norm)[..., None]
        left, right = (
            torch.cat([features, ones], dim=-1),
            torch.cat([-2 * features, squared_norm[..., None]], -1),
        )
        if features.device.type == "cpu" and not torch.compiler.is_compiling():
            index = torch.empty(*left.shape[:2], k, dtype=torch.int64)
            for pair, pair_left, pair_right in zip(index, left, right, strict=True):
                pair[:] = _smallest_products(pair_left, pair_right, k)
        else:
            index = (left @ right.mT).topk(k, dim=-1, largest=False, sorted=True).indices  # of (B,N,N)
        if mask is not None:
            itself = torch.arange(features.shape[1], device=features.device)[None, :, None]
            place = torch.arange(k, device=features.device)
            index = torch.where(place < mask.sum(1)[:, None, None], index, itself)
    return index


def _smallest_products(left: Tensor, right: Tensor, k: int) -> Tensor:
    """Columns of the k smallest entries of each row of ``left (N,D) @ right (N,D)^T``, smallest first: (N,k).

    A block of rows stays in the cache while numpy's argmin, which compares many numbers at once, goes over it
    k times. That takes less than half the time of torch's topk.
    """
    num_rows = 128
    columns = right.mT.contiguous()
    block = left.new_empty(min(num_rows, len(left)), len(right))
    index = np.empty((len(left), k), dtype=np.int64)
    row = np.arange(num_rows)
    for start in range(0, len(left), num_rows):
        rows = left[start : start + num_rows]
        products = torch.mm(rows, columns, out=block[: len(rows)]).numpy()
        for place in range(k):
            found = products.argmin(axis=1)
            index[start : start + num_rows, place] = found
            products[row[: len(rows)], found] = np.inf
    return torch.from_numpy(index)


class AttentionMap(nn.Module):
    """Squeeze, GELU, expand, sigmoid: the MLP behind each of the three graph attentions, equation 5."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, hidden)
        self.squeeze_norm = BatchNorm(hidden)
        self.expand = nn.Linear(hidden, channels)
        self.expand_norm = BatchNorm(channels)

    def forward(self, pooled: Tensor, mask: Tensor | None = None) -> Tensor:
        x = F.gelu(linear_norm(pooled, self.squeeze, self.squeeze_norm, mask))
        return linear_norm(x, self.expand, self.expand_norm, mask).sigmoid()


class PointContext(nn.Module):
    """PointCN without its shortcut: twice normalisation, GELU, linear layer."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm1 = BatchNorm(channels)
        self.linear1 = nn.Linear(channels, channels)
        self.norm2 = BatchNorm(channels)
        self.linear2 = nn.Linear(channels, channels)

    def forward(self, graph: Tensor, mask: Tensor | None) -> Tensor:
        x = self.linear1(F.gelu(normalise(graph, self.norm1, 1e-3, mask)))
        return self.linear2(F.gelu(normalise(x, self.norm2, 1e-3, mask)))


class ExplicitBranch(nn.Module):
    """KNN graph, spatial, neighbourhood and channel attention, annular convolution: equations 4 to 6."""

    def __init__(self, channels: int, num_neighbors: int) -> None:
        super().__init__()
        self.num_neighbors = num_neighbors
        self.embed = nn.Linear(2 * channels, channels)
        self.embed_norm = BatchNorm(channels)
        self.spatial_attention = AttentionMap(num_neighbors, 3)
        self.neighbor_context = PointContext(channels)
        self.neighbor_attention = AttentionMap(channels, channels // 4)
        self.channel_context = PointContext(channels)
        self.channel_attention = AttentionMap(channels, channels // 4)
        self.ring = nn.Linear(3 * channels, channels)
        self.ring_norm = BatchNorm(channels)
        self.gather = nn.Linear(num_neighbors // 3 * channels, channels)
        self.gather_norm = BatchNorm(channels)

    def forward(self, features: Tensor, mask: Tensor | None) -> Tensor:
        batch, num_rows, channels = features.shape
        graph = self.edges(features, mask)  # (B,N,k,C)

        # One gate for each neighbour of each correspondence.
        pooled = graph.sum(3) / channels + graph.amax(3)  # (B,N,k)
        graph = graph * (1 + self.spatial_attention(pooled, mask))[..., None]

        # One gate for each channel of the j-th neighbour, common to all correspondences.
        context = self.neighbor_context(graph, mask)
        pooled = row_mean(context, mask) + row_max(context, mask)  # (B,1,k,C)
        graph = torch.addcmul(graph, context, self.neighbor_attention(pooled))

        # One gate for each channel of each correspondence.
        context = self.channel_context(graph, mask)
        pooled = context.sum(2) / self.num_neighbors + context.amax(2)  # (B,N,C)
        graph = torch.addcmul(graph, context, self.channel_attention(pooled, mask)[:, :, None])

        # Annular convolution: neighbours in rings of three, then all rings.
        rings = graph.view(batch, num_rows, -1, 3 * channels)  # (B,N,k/3,3C)
        rings = F.gelu(linear_norm(rings, self.ring, self.ring_norm, mask))
        return F.gelu(linear_norm(rings.flatten(2), self.gather, self.gather_norm, mask))  # (B,N,C)

    def edges(self, features: Tensor, mask: Tensor | None) -> Tensor:
        """Embedded edges e_ij = [f_i || f_i - f_j] of the KNN graph, equation 4: (B,N,C) to (B,N,k,C).

        W [f_i || f_i - f_j] = (W_a + W_b) f_i - W_b f_j, so that both products run on N rows instead of N k.
        """
        index = nearest_neighbors(features, self.num_neighbors, mask)
        centre_weight, offset_weight = self.embed.weight.chunk(2, dim=1)  # (C,C) each
        own = F.linear(features, centre_weight + offset_weight, self.embed.bias)
        other = F.linear(features, offset_weight)
        edges = own[:, :, None] - take_rows(other, index)
        return normalise(edges, self.embed_norm, 1e-5, mask)


# ----------------------------------------------------------------------------------------------------------
# Implicit branch (section 3.4)
# ----------------------------------------------------------------------------------------------------------


class OrderAwareFilter(nn.Module):
    """Mixing along channels, among clusters, along channels again, with a shortcut (OANet)."""

    def __init__(self, channels: int, num_clusters: int) -> None:
        super().__init__()
        self.norm1 = BatchNorm(channels)
        self.linear1 = nn.Linear(channels, channels)
        self.cluster_norm = BatchNorm(num_clusters)
        self.cluster_linear = nn.Linear(num_clusters, num_clusters)
        self.norm2 = BatchNorm(channels)
        self.linear2 = nn.Linear(channels, channels)

    def forward(self, clusters: Tensor) -> Tensor:
        x = self.linear1(F.relu(normalise(clusters, self.norm1, 1e-3, None)))  # (B,M,C)
        # The middle layer mixes clusters: its matrix multiplies from the left, which saves transpositions.
        x = x + self.cluster_linear.weight @ F.relu(self.cluster_norm(x)) + self.cluster_linear.bias[:, None]
        return self.linear2(F.relu(normalise(x, self.norm2, 1e-3, None))) + clusters


class ImplicitBranch(nn.Module):
    """Soft assignment to M clusters, filters among them, soft assignment back: equations 7 and 8."""

    def __init__(self, channels: int, num_clusters: int, num_filters: int) -> None:
        super().__init__()
        self.pool_norm = BatchNorm(channels)
        self.pool = nn.Linear(channels, num_clusters)
        self.filters = nn.ModuleList(OrderAwareFilter(channels, num_clusters) for _ in range(num_filters))
        self.unpool_norm = BatchNorm(channels)
        self.unpool = nn.Linear(channels, num_clusters)

    def forward(self, features: Tensor, mask: Tensor | None) -> Tensor:
        assignment = self.pool(F.relu(normalise(features, self.pool_norm, 1e-3, mask)))  # (B,N,M)
        clusters = row_softmax(assignment, mask).mT @ features  # (B,M,C)
        for order_aware_filter in self.filters:
            clusters = order_aware_filter(clusters)
        assignment = self.unpool(F.relu(normalise(features, self.unpool_norm, 1e-3, mask)))
        return assignment.softmax(2) @ clusters  # (B,N,C)


# ----------------------------------------------------------------------------------------------------------
# Motion injection (section 3.5)
# ----------------------------------------------------------------------------------------------------------


class MotionEmbedding(nn.Module):
    """Displacement of each correspondence to C channels, equation 9 and the first line of equation 10."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(2, channels // 4)
        self.norm1 = BatchNorm(channels // 4)
        self.linear2 = nn.Linear(channels // 4, channels // 2)
        self.norm2 = BatchNorm(channels // 2)
        self.linear3 = nn.Linear(channels // 2, channels)

    def forward(self, correspondences: Tensor, mask: Tensor | None) -> Tensor:
        x = correspondences[..., 2:] - correspondences[..., :2]
        x = F.relu(linear_norm(x, self.linear1, self.norm1, mask))
        x = F.relu(linear_norm(x, self.linear2, self.norm2, mask))
        return self.linear3(x)


def fold(norm: nn.LayerNorm, linear: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of ``linear(x * norm.weight + norm.bias)`` as one linear layer."""
    return linear.weight * norm.weight, F.linear(norm.bias, linear.weight, linear.bias)


class Attention(nn.Module):
    """Multi-head attention; flow attention (Flowformer) or the plain one with softmax."""

    def __init__(self, channels: int, num_heads: int, kind: str) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.kind = kind
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels)
        self.output = nn.Linear(channels, channels)

    def forward(
        self,
        tokens: Tensor,
        context: Tensor,
        query_norm: nn.LayerNorm | None,
        context_norm: nn.LayerNorm,
        mask: Tensor | None,
    ) -> Tensor:
        """Attend from tokens to context.

        Parameters
        ----------
        tokens : Tensor, shape (R B, N, C)
            R branches of B pairs, layer-normalised without affine if ``query_norm`` is given.
        context : Tensor, shape (R B, N, C) or (B, N, C)
            Layer-normalised without affine; with B items the branches share it and its keys.
        query_norm, context_norm : LayerNorm
            Their affine parts have not been applied yet; they are folded into the projections.
        mask : Tensor, shape (R B, N) bool, optional
        """
        query = (self.query.weight, self.query.bias) if query_norm is None else fold(query_norm, self.query)
        key, value = fold(context_norm, self.key), fold(context_norm, self.value)
        if tokens is context:  # one product for both
            weight, bias = torch.cat([query[0], key[0]]), torch.cat([query[1], key[1]])
            q, k = F.linear(tokens, weight, bias).chunk(2, dim=-1)
        else:
            q, k = F.linear(tokens, *query), F.linear(context, *key)
        num_branches = tokens.shape[0] // context.shape[0] if context.shape[0] else 1
        if num_branches > 1:
            k, context = k.repeat(num_branches, 1, 1), context.repeat(num_branches, 1, 1)
        if self.kind == "softmax":
            return self._softmax(q, k, F.linear(context, *value), mask)
        return self._flow(q.sigmoid(), k.sigmoid(), context, *value, mask)

    def _softmax(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
        q, k, v = (x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for x in (q, k, v))  # (B,H,N,D)
        allowed = None if mask is None else mask[:, None, None]
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=allowed)
        return self.output(out.transpose(1, 2).flatten(2))

    def _flow(
        self,
        q: Tensor,
        k: Tensor,
        context: Tensor,
        value_weight: Tensor,
        value_bias: Tensor,
        mask: Tensor | None,
    ) -> Tensor:
        """Flow attention: linear in N, with competition among sources and allocation to sinks.

        With S = K diag(competition), the paper's Q (S^T V) W_o is computed as Q ((S^T context) W_v W_o):
        values, which nothing else needs, are never formed on N rows, and the two products after the sum over
        tokens become one.
        """
        heads = self.num_heads
        if mask is not None:
            q, k = q * mask[..., None], k * mask[..., None]
        incoming = 1 / self._dot(q, k.sum(1))  # (B,H,N)
        outgoing = 1 / self._dot(k, q.sum(1))
        sink = self._dot(q, self._weighted_sum(k, outgoing))
        source = self._dot(k, self._weighted_sum(q, incoming)).clamp(-1, 1)
        # Sinks and sources are equally many here, so the published factor of their numbers is one.
        allocation = sink.sigmoid()
        if mask is not None:
            source = source.masked_fill(~mask[:, None], -math.inf)
        competition = source.softmax(2) * row_count(source.mT, mask)

        weighted = self._scale_heads(k, competition)  # (B,N,C)
        summed = (weighted.mT @ context).unflatten(1, (heads, -1))  # (B,H,D,C)
        mass = weighted.sum(1).unflatten(-1, (heads, -1))[..., None]  # (B,H,D,1)
        flow = summed @ value_weight.unflatten(0, (heads, -1)).mT + mass * value_bias.view(heads, 1, -1)
        flow = flow @ self.output.weight.mT.unflatten(0, (heads, -1))  # (B,H,D,D) to (B,H,D,C)
        gated = self._scale_heads(q, incoming * allocation)
        return gated @ flow.flatten(1, 2).to(gated.dtype) + self.output.bias.to(gated.dtype)

    def _dot(self, x: Tensor, y: Tensor) -> Tensor:
        """(x + eps) . (y + eps) + eps in each head: (B,N,C), (B,C) to (B,H,N)."""
        y = y.unflatten(-1, (self.num_heads, -1)) + FLOW_EPSILON  # (B,H,D)
        rows = torch.diag_embed(y.mT).permute(0, 2, 3, 1)  # (B,H,H,D): row h is zero outside head h
        constant = FLOW_EPSILON * y.sum(-1, keepdim=True) + FLOW_EPSILON
        return rows.flatten(2) @ x.mT + constant

    def _weighted_sum(self, x: Tensor, weight: Tensor) -> Tensor:
        """Sum over tokens of x times the weight of its head: (B,N,C), (B,H,N) to (B,C)."""
        every = (weight @ x).unflatten(-1, (self.num_heads, -1))  # (B,H,H,D)
        return every.diagonal(dim1=1, dim2=2).mT.flatten(1)

    def _scale_heads(self, x: Tensor, weight: Tensor) -> Tensor:
        """Each head of each token times its weight: (B,N,C), (B,H,N) to (B,N,C)."""
        return (x.unflatten(-1, (self.num_heads, -1)) * weight.mT[..., None].to(x.dtype)).flatten(2)


class MotionInjectionLayer(nn.Module):
    """Attention among the correspondences, attention onto their motion, MLP with layer scale: equation 10.

    The second and third layer norm replace the residual stream, as in the published code.
    """

    def __init__(self, channels: int, num_heads: int, mlp_ratio: int, attention: str, motion: bool) -> None:
        super().__init__()
        self.query_norm = nn.LayerNorm(channels)
        self.context_norm = nn.LayerNorm(channels)
        self.self_attention = Attention(channels, num_heads, attention)
        self.stream_norm = nn.LayerNorm(channels)
        if motion:
            self.motion_norm = nn.LayerNorm(channels)
            self.motion_attention = Attention(channels, num_heads, attention)
        self.mlp_norm = nn.LayerNorm(channels)
        self.expand = nn.Linear(channels, mlp_ratio * channels)
        self.contract = nn.Linear(mlp_ratio * channels, channels)
        self.layer_scale = nn.Parameter(torch.full((channels,), 1e-5))
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)

    def forward(self, x: Tensor, motion: Tensor | None, mask: Tensor | None) -> Tensor:
        """Inject into ``x (R B, N, C)`` the layer-normalised ``motion (B,N,C)``."""
        normed = F.layer_norm(x, x.shape[-1:])
        x = x + self.self_attention(normed, normed, self.query_norm, self.context_norm, mask)
        x = self.stream_norm(x)
        if motion is not None:
            x = x + self.motion_attention(x, motion, None, self.motion_norm, mask)
        x = self.mlp_norm(x)
        x_mlp = self.contract(F.gelu(self.expand(x)))
        return torch.addcmul(x, self.layer_scale.to(x.dtype), x_mlp.to(x.dtype))


# ----------------------------------------------------------------------------------------------------------
# Two-view geometry (section 3.1, equation 3)
# ----------------------------------------------------------------------------------------------------------


class SmallestEigenvector(torch.autograd.Function):
    """Unit eigenvector of the smallest eigenvalue of symmetric matrices, (...,n,n) to (...,n).

    The gradient divides by the gaps to the other eigenvalues. Where a gap vanishes the eigenvector is not
    defined, and that direction gets no gradient instead of an infinite one.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        values, vectors = torch.linalg.eigh(matrix)
        ctx.save_for_backward(values, vectors)
        return vectors[..., 0]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        values, vectors = ctx.saved_tensors
        gap = values[..., :1] - values  # (...,n), zero or negative
        usable = gap.abs() > 100 * torch.finfo(values.dtype).eps * values[..., -1:].abs()
        along = (gradient[..., None, :] @ vectors).squeeze(-2)  # gradient in the basis of eigenvectors
        along = torch.where(usable, along / torch.where(usable, gap, 1.0), 0.0)
        outer = (vectors @ along[..., None]) * vectors[..., None, :, 0]
        return (outer + outer.mT) / 2


def weighted_eight_point(correspondences: Tensor, weights: Tensor, *, fundamental: bool = False) -> Tensor:
    """The matrix E with x1^T E x0 = 0 in the weighted least-squares sense.

    Parameters
    ----------
    correspondences : Tensor, shape (B,N,4)
        x0 y0 x1 y1, normalised.
    weights : Tensor, shape (B,N)
        Non-negative.
    fundamental : bool
        Also make the result singular, the one constraint a fundamental matrix has.

    Returns
    -------
    Tensor, shape (B,3,3)
        Of unit norm, sign undetermined. Always finite: without usable correspondences it is an arbitrary
        unit matrix.
    """
    dtype = correspondences.dtype
    with full_precision(correspondences):
        if correspondences.device.type != "mps":  # which has no float64
            correspondences, weights = correspondences.double(), weights.double()
        x, y, u, v = correspondences.unbind(-1)
        rows = torch.stack([u * x, u * y, u, v * x, v * y, v, x, y, torch.ones_like(x)], dim=-1)  # (B,N,9)
        scatter = rows.mT @ (rows * weights[..., None])  # (B,9,9)
        trace = scatter.diagonal(dim1=-2, dim2=-1).sum(-1)
        scatter = scatter / trace.clamp(min=torch.finfo(scatter.dtype).tiny)[:, None, None]
        matrix = SmallestEigenvector.apply(scatter).unflatten(-1, (3, 3))
        if fundamental:
            null = SmallestEigenvector.apply(matrix.mT @ matrix)[..., None]  # (B,3,1)
            matrix = matrix - matrix @ null @ null.mT
            matrix = matrix / torch.linalg.matrix_norm(matrix, keepdim=True)
        return matrix.to(dtype)


def symmetric_epipolar_squared(correspondences: Tensor, matrix: Tensor) -> Tensor:
    """Squared symmetric epipolar distance in squared coordinate units: (B,N,4), (B,3,3) to (B,N)."""
    with full_precision(correspondences):
        ones = torch.ones_like(correspondences[..., :1])
        point0 = torch.cat([correspondences[..., :2], ones], dim=-1)
        point1 = torch.cat([correspondences[..., 2:], ones], dim=-1)
        line1 = point0 @ matrix.mT  # (B,N,3), epipolar lines in image 1
        line0 = point1 @ matrix
        algebraic = (point1 * line1).sum(-1)
        length1, length0 = line1[..., :2].square().sum(-1), line0[..., :2].square().sum(-1)
        return algebraic.square() * (1 / (length1 + 1e-15) + 1 / (length0 + 1e-15))


# ----------------------------------------------------------------------------------------------------------
# Network (section 3.2)
# ----------------------------------------------------------------------------------------------------------


class FusionRound(nn.Module):
    """Both branches, motion injected into each by the same layers, and their sum."""

    def __init__(
        self,
        *,
        channels: int,
        num_neighbors: int,
        clusters: int,
        oa_filters: int,
        heads: int,
        mlp_ratio: int,
        motion_stacking: int,
        attention: str,
        motion: bool,
        branches: str,
    ) -> None:
        super().__init__()
        self.explicit = ExplicitBranch(channels, num_neighbors) if branches != "implicit" else None
        self.implicit = ImplicitBranch(channels, clusters, oa_filters) if branches != "explicit" else None
        self.injection = nn.ModuleList(
            MotionInjectionLayer(channels, heads, mlp_ratio, attention, motion)
            for _ in range(2 * motion_stacking)
        )
        self.logit = nn.Linear(channels, 1)

    def forward(self, features: Tensor, motion: Tensor | None, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        """Features (B,N,C) and layer-normalised motion (B,N,C) to new features (B,N,C) and logits (B,N)."""
        branches = [branch(features, mask) for branch in (self.explicit, self.implicit) if branch is not None]
        x = torch.cat(branches)  # (R B, N, C)
        repeated_mask = None if mask is None else mask.repeat(len(branches), 1)
        for layer in self.injection:
            x = layer(x, motion, repeated_mask)
        features = x.unflatten(0, (len(branches), -1)).sum(0)
        with full_precision(features):
            logits = self.logit(features.to(self.logit.weight.dtype)).squeeze(-1)
        return features, logits


class PruningBlock(nn.Module):
    """Stem, motion embedding and fusion rounds on one set of correspondences."""

    def __init__(
        self, *, input_channels: int, fusion_rounds: int, channels: int, motion: bool, **fusion: Any
    ) -> None:
        super().__init__()
        self.stem = nn.Linear(input_channels, channels)
        self.stem_norm = BatchNorm(channels)
        self.motion = MotionEmbedding(channels) if motion else None
        self.rounds = nn.ModuleList(
            FusionRound(channels=channels, motion=motion, **fusion) for _ in range(fusion_rounds)
        )

    def forward(self, inputs: Tensor, mask: Tensor | None) -> tuple[Tensor, list[Tensor]]:
        """Inputs (B,N,4 + more), coordinates first, to features (B,N,C) and logits (B,N) of each round."""
        with full_precision(inputs):
            features = F.relu(normalise(self.stem(inputs), self.stem_norm, 1e-5, mask))
            motion = None
            if self.motion is not None:
                embedded = self.motion(inputs[..., :4], mask)
                motion = F.layer_norm(embedded, embedded.shape[-1:])
        logits = []
        for fusion_round in self.rounds:
            features, round_logits = fusion_round(features, motion, mask)
            logits.append(round_logits)
        return features, logits


class WeightHead(nn.Module):
    """Residual unit, then a logit and the logarithm of an eight-point weight for each correspondence."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(channels, channels)
        self.norm1 = BatchNorm(channels)
        self.linear2 = nn.Linear(channels, channels)
        self.norm2 = BatchNorm(channels)
        self.output = nn.Linear(channels, 2)
        # The published unit owns this projection and adds the unprojected input. It is here because the
        # published parameter counts include it, and frozen because no gradient ever reaches it.
        self.shortcut = nn.Linear(channels, channels).requires_grad_(False)

    def forward(self, features: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        """Features (B,N,C) to logits (B,N) and weights (B,N) that sum to almost one."""
        with full_precision(features):
            features = features.to(self.output.weight.dtype)
            x = F.gelu(normalise(self.linear1(features), self.norm1, 1e-5, mask))
            x = normalise(self.linear2(x), self.norm2, 1e-5, mask)
            logit, log_weight = self.output(F.gelu(x + features)).unbind(-1)
            weight = log_weight.clamp(max=60).exp() * logit.sigmoid()
            if mask is not None:
                weight = weight * mask
            return logit, weight / (weight.sum(1, keepdim=True) + 1e-5)


class PruningOutput(NamedTuple):
    """Output of the network for a batch of pairs.

    With R fusion rounds there are 2 R + 1 sets of logits: R on all correspondences, R on those kept by the
    first pruning block, one on those kept by the second; five in the published configuration. Padding has the
    logit minus infinity and an infinite residual. A pair of n correspondences keeps max(floor(n/2), 1) at a
    step.
    """

    logits: tuple[Tensor, ...]
    """(B,N), ..., (B,N'), ..., (B,N'')."""
    indices: tuple[Tensor, ...]
    """int64, like `logits`: which input each logit belongs to; best first after a pruning."""
    essential: Tensor
    """(B,3,3), unit norm, x1^T E x0 = 0; the fundamental matrix with ``estimate="fundamental"``."""
    residuals: Tensor
    """(B,N), squared symmetric epipolar distance of every input to `essential`."""

    def last_logits(self) -> Tensor:
        """Last logit of each input, (B,N) float32. Minus infinity on padding."""
        return last_logits(self.logits, self.indices, self.residuals.shape)


def last_logits(logits: Sequence[Tensor], indices: Sequence[Tensor], shape: torch.Size) -> Tensor:
    """Last logit of each of (B,N) inputs, float32: later sets judge fewer. Minus infinity on padding.

    Parameters
    ----------
    logits, indices : sequence of Tensor
        As in `PruningOutput`.
    shape : (int, int)
        B and N.
    """
    last = torch.full(shape, -math.inf, device=logits[0].device)
    for values, places in zip(logits, indices, strict=True):
        # Padding says minus infinity, and its index may be that of an input: it must not overwrite.
        last.scatter_(1, places, torch.where(values.isneginf(), last.gather(1, places), values.float()))
    return last


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Architecture of a `CorrAdaptor`; the defaults are the published network."""

    channels: int = 128
    """Width d of all features; a multiple of 4 and of `heads`."""
    clusters: int = 250
    """Clusters M of the implicit branch."""
    neighbors: tuple[int, int] = (9, 6)
    """Neighbours k of the explicit branch in each pruning block, multiples of 3."""
    pruning_ratio: float = 0.5
    """Share of the correspondences that a pruning block keeps (the paper's alpha)."""
    fusion_rounds: int = 2
    """Rounds of both branches in a block."""
    motion_stacking: int = 2
    """L_m: half the number of motion injection layers in a round; 0 only adds the branches."""
    motion: bool = True
    """Whether the injection layers attend to the motion; without, they only attend to each other."""
    attention: Literal["flow", "softmax"] = "flow"
    """Kind of attention."""
    heads: int = 4
    """Attention heads."""
    mlp_ratio: int = 4
    """Hidden width of the injection layers' MLP in units of `channels`."""
    oa_filters: int = 3
    """Order-aware filters among the clusters."""
    branches: Literal["both", "explicit", "implicit"] = "both"
    """Branches in use."""
    side_channels: int = 0
    """Columns of side information beside the coordinates."""
    estimate: Literal["essential", "fundamental"] = "essential"
    """What the eight-point algorithm estimates; fundamental makes it singular."""

    def __post_init__(self) -> None:
        problems = []
        if self.channels < 4 or self.channels % 4 or self.heads < 1 or self.channels % self.heads:
            problems.append(
                f"channels is {self.channels}, expected a multiple of 4 and of heads ({self.heads})"
            )
        if self.branches != "implicit" and (
            len(self.neighbors) != 2 or any(k < 3 or k % 3 for k in self.neighbors)
        ):
            problems.append(f"neighbors is {self.neighbors}, expected two multiples of 3")
        if not 0 < self.pruning_ratio <= 1:
            problems.append(f"pruning_ratio is {self.pruning_ratio}, expected more than 0 and at most 1")
        for name, smallest in [
            ("clusters", 1),
            ("mlp_ratio", 1),
            ("oa_filters", 0),
            ("fusion_rounds", 1),
            ("motion_stacking", 0),
            ("side_channels", 0),
        ]:
            if getattr(self, name) < smallest:
                problems.append(f"{name} is {getattr(self, name)}, expected at least {smallest}")
        for name, valid in [
            ("attention", ("flow", "softmax")),
            ("branches", ("both", "explicit", "implicit")),
            ("estimate", ("essential", "fundamental")),
        ]:
            if getattr(self, name) not in valid:
                problems.append(f"{name} is {getattr(self, name)!r}, expected one of {', '.join(valid)}")
        if problems:
            raise ConfigError("network configuration: " + "; ".join(problems))


class CorrAdaptor(nn.Module):
    """The network of the paper: two pruning blocks, weighted eight-point algorithm, full-size verification.

    `NetworkConfig` documents the arguments and holds their defaults; `from_config` builds a network from one.

    In inference its fastest form is ``network.eval()`` under `torch.inference_mode`, on one CPU pair by pair.
    Under `torch.autocast` to bfloat16 whatever must not be rounded (coordinates, neighbour search, logits,
    geometry) stays in float32.
    """

    config: NetworkConfig | None = None
    # Goes with the weights into a checkpoint; the layers do not read it.
    usage: NetworkUsage = NetworkUsage()

    def __init__(
        self,
        *,
        neighbors: tuple[int, int],
        pruning_ratio: float,
        fusion_rounds: int,
        channels: int,
        side_channels: int,
        estimate: str,
        **layers: Any,
    ) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.pruning_ratio = pruning_ratio
        self.fundamental = estimate == "fundamental"
        explicit = layers["branches"] != "implicit"
        self.min_rows = tuple(neighbors) if explicit else (1, 1)
        self.blocks = nn.ModuleList(
            PruningBlock(
                input_channels=4 + logit_channels + side_channels,
                fusion_rounds=fusion_rounds,
                channels=channels,
                num_neighbors=neighbors[block] if explicit else 0,
                **layers,
            )
            for block, logit_channels in enumerate((0, fusion_rounds))
        )
        self.head = WeightHead(channels)

    @classmethod
    def from_config(cls, config: NetworkConfig) -> Self:
        """Build the network that a configuration describes, with fresh weights."""
        network = cls(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})
        network.config = config
        return network

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> PruningOutput:
        """Score the correspondences of a batch of pairs and estimate their two-view geometry.

        Parameters
        ----------
        correspondences : Tensor, shape (B,N,4)
            x0 y0 x1 y1, normalised by the intrinsics. Rows that are not finite count as padding.
        side_information : Tensor, shape (B,N,S), optional
            Required exactly if the network was built with ``side_channels=S`` above zero.
        mask : Tensor, shape (B,N) bool, optional
            False on padding. Without it all rows are correspondences.

        Returns
        -------
        PruningOutput
        """
        coordinates, side, mask = self._clean(correspondences, side_information, mask)
        index = torch.arange(coordinates.shape[1], device=coordinates.device).expand(coordinates.shape[:2])
        first_block, second_block = self.blocks

        features, first = first_block(torch.cat([coordinates, side], dim=-1), mask)
        order, kept_mask = self._best(first[-1], mask, self.min_rows[1])
        kept, kept_side = take_rows(coordinates, order), take_rows(side, order)
        confidence = take_rows(torch.stack(first, dim=-1).detach().tanh().relu(), order)  # (B,N',R)

        features, second = second_block(torch.cat([kept, confidence, kept_side], dim=-1), kept_mask)
        last_order, last_mask = self._best(second[-1], kept_mask, 1)
        last, weights = self.head(take_rows(features, last_order), last_mask)

        matrix = weighted_eight_point(take_rows(kept, last_order), weights, fundamental=self.fundamental)
        residuals = symmetric_epipolar_squared(coordinates, matrix)
        if mask is not None:
            residuals = residuals.masked_fill(~mask, math.inf)

        kept_index = index.gather(1, order)
        num_inputs = correspondences.shape[1]
        sets = [_trim(x, index, mask, num_inputs) for x in first]
        sets += [_trim(x, kept_index, kept_mask, _most_rows(kept_mask, num_inputs)) for x in second]
        last_index, last_width = kept_index.gather(1, last_order), _most_rows(last_mask, num_inputs)
        sets += [_trim(last, last_index, last_mask, last_width)]
        return PruningOutput(
            logits=tuple(logits for logits, _ in sets),
            indices=tuple(indices for _, indices in sets),
            essential=matrix,
            residuals=residuals[:, :num_inputs],
        )

    def _clean(
        self, correspondences: Tensor, side_information: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Finite inputs with enough rows for the neighbour search, and the mask of what is real among them.

        A pair always has at least one row that counts, at worst a zero, so that no mean runs over nothing.
        """
        batch, num_rows, _ = correspondences.shape
        side = correspondences.new_zeros(batch, num_rows, 0) if side_information is None else side_information
        if side.shape != (batch, num_rows, self.side_channels):
            raise ValueError(
                f"side information has shape {tuple(side.shape)}, this network expects "
                f"{(batch, num_rows, self.side_channels)}"
            )
        usable = (correspondences.abs() <= LARGEST_COORDINATE).all(-1) & side.isfinite().all(-1)
        if mask is not None or not usable.all():
            mask = usable if mask is None else usable & mask
        missing = math.ceil(
            max(self.min_rows[0], self.min_rows[1] / self.pruning_ratio, 1 / self.pruning_ratio**2)
        )
        missing = max(missing - num_rows, 0)
        if missing:
            mask = F.pad(usable if mask is None else mask, (0, missing))
            correspondences, side = (
                F.pad(correspondences, (0, 0, 0, missing)),
                F.pad(side, (0, 0, 0, missing)),
            )
        if mask is not None:
            correspondences = torch.where(mask[..., None], correspondences, 0.0)
            side = torch.where(mask[..., None], side, 0.0)
            empty = ~mask.any(1)
            mask = mask | (empty[:, None] & (torch.arange(mask.shape[1], device=mask.device) == 0))
        return correspondences, side, mask

    def _best(self, logits: Tensor, mask: Tensor | None, min_rows: int) -> tuple[Tensor, Tensor | None]:
        """Indices (B,N') of the correspondences that a pruning keeps, best first, and the mask of them."""
        if mask is None:
            order = logits.argsort(dim=1, descending=True, stable=True)
            return order[:, : int(logits.shape[1] * self.pruning_ratio)], None
        order = logits.masked_fill(~mask, -math.inf).argsort(dim=1, descending=True, stable=True)
        num_kept = [max(int(count * self.pruning_ratio), 1) for count in mask.sum(1).tolist()]
        width = max([*num_kept, min_rows])
        row = torch.arange(width, device=order.device)
        return order[:, :width], row < torch.tensor(num_kept, device=order.device)[:, None]


def _most_rows(mask: Tensor | None, num_inputs: int) -> int:
    """Columns that hold a correspondence in at least one pair, no more than there were inputs."""
    return num_inputs if mask is None else min(int(mask.sum(1).max()), num_inputs)


def _trim(logits: Tensor, indices: Tensor, mask: Tensor | None, width: int) -> tuple[Tensor, Tensor]:
    """The first columns of logits and indices, with minus infinity as the logit of padding."""
    if mask is not None:
        logits = logits.masked_fill(~mask, -math.inf)
    return logits[:, :width], indices[:, :width]
