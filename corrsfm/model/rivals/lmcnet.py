"""LMCNet: learnable motion coherence on a graph of correspondences (Liu et al., CVPR 2021)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.config import NetworkUsage
from corrsfm.model.network import BatchNorm, full_precision, nearest_neighbors, take_rows
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import (
    ClusterFilter,
    PointContext,
    Stack,
    cbr,
    eight_point,
    named,
    order_aware,
    pre,
)
from corrsfm.model.rivals.spectral import NUM_EIGENPAIRS, coherence_spectrum

__all__ = ["NUM_GEOMETRIC_FEATURES", "NUM_IMAGE_FEATURES", "LMCNet"]

NUM_NEIGHBORS = 8
NUM_BLOCKS = 4
LOCAL_CHANNELS = 8
INPUT_SMOOTHNESS = 10.0

# Side information of the network that was published with all features: what the images say about a match,
# then what its keypoints' angles and sizes say.
NUM_IMAGE_FEATURES = 134
NUM_GEOMETRIC_FEATURES = 2


def smooth(f: Tensor, eta: Tensor | float, eig_val: Tensor, eig_vec: Tensor) -> Tensor:
    """The part of features (B,N,C) that changes slowly over the graph: U diag(1 / (1 + eta lambda)) U^T f."""
    gain = 1 / (1 + eta * eig_val)  # (B,32)
    return eig_vec @ (gain[..., None] * (eig_vec.mT @ f))


class LocalCoherence(nn.Module):
    """What a correspondence's nearest neighbours in coordinates differ in: (B,N,C) to (B,N,C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        mlp = Stack(*cbr(LOCAL_CHANNELS, LOCAL_CHANNELS), nn.Linear(LOCAL_CHANNELS, LOCAL_CHANNELS))
        self.knn_feats = nn.ModuleDict({"ds_net": nn.Linear(channels, LOCAL_CHANNELS), "mlp": mlp})
        self.conv_out = nn.Linear(LOCAL_CHANNELS, channels)

    def forward(self, f: Tensor, index: Tensor, mask: Tensor | None) -> Tensor:
        h = self.knn_feats["ds_net"](f)  # (B,N,8)
        differences = h[:, :, None] - take_rows(h, index)  # (B,N,k,8)
        return self.conv_out(self.knn_feats["mlp"](differences, mask).amax(2))


class CoherenceResidual(nn.Module):
    """What features lose by smoothing over the graph, filtered: (B,N,C) to (B,N,C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.eta = nn.Parameter(torch.full((1,), INPUT_SMOOTHNESS))
        self.filter = Stack(*pre(channels, channels, 1e-5), *pre(channels, channels, 1e-5))

    def forward(self, f: Tensor, spectrum: tuple[Tensor, Tensor], mask: Tensor | None) -> Tensor:
        return self.filter(smooth(f, self.eta, *spectrum) - f, mask)


class Clusters(nn.Module):
    """OANet's clusters with one filter."""

    def __init__(self, channels: int, clusters: int) -> None:
        super().__init__()
        self.down = named("conv", *pre(channels, clusters))
        self.mlp_cluster = ClusterFilter(channels, clusters)
        self.up = named("conv", *pre(channels, clusters))

    def forward(self, f: Tensor, mask: Tensor | None) -> Tensor:
        return order_aware(f, self.down, self.mlp_cluster, self.up, mask)


class Block(nn.Module):
    """Local coherence, global coherence, clusters, and both coherences again: (B,N,C) to (B,N,C)."""

    def __init__(self, channels: int, clusters: int) -> None:
        super().__init__()
        self.lc0 = LocalCoherence(channels)
        self.cn0 = PointContext(channels, channels)
        self.cr0 = CoherenceResidual(channels)
        self.cluster = Clusters(channels, clusters)
        self.lc1 = LocalCoherence(channels)
        self.cn1 = PointContext(channels, channels)
        self.cr1 = CoherenceResidual(channels)

    def forward(
        self, f: Tensor, index: Tensor, spectrum: tuple[Tensor, Tensor], mask: Tensor | None
    ) -> Tensor:
        f = self.cn0(f + self.lc0(f, index, mask), mask)
        f = f + self.cr0(f, spectrum, mask)
        f = f + self.cluster(f, mask)
        f = self.cn1(f + self.lc1(f, index, mask), mask)
        return f + self.cr1(f, spectrum, mask)


class LMCNet(Rival):
    """Four blocks and one logit for each correspondence.

    Parameters
    ----------
    channels, clusters : int
    side_channels : int
        136 is the network that was published with all features, 134 image features before 2 geometric ones;
        any other number of channels joins the coordinates.
    """

    # The published threshold for YFCC100M; 0.9 for SUN3D.
    usage = NetworkUsage(pose_min_score=0.95)

    def __init__(self, *, channels: int = 128, clusters: int = 128, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.num_image_features = (
            NUM_IMAGE_FEATURES if side_channels == NUM_IMAGE_FEATURES + NUM_GEOMETRIC_FEATURES else 0
        )
        num_geometric = 6 + side_channels - self.num_image_features
        self.geom_feats_embed = Stack(nn.Linear(num_geometric, channels), PointContext(channels, channels))
        self.image_feats_embed = (
            Stack(nn.Linear(NUM_IMAGE_FEATURES, channels), PointContext(channels, channels))
            if self.num_image_features
            else None
        )
        self.lmcblock_list = nn.ModuleList(Block(channels, clusters) for _ in range(NUM_BLOCKS))
        self.prob_predictor = Stack(BatchNorm(channels), nn.ReLU(), nn.Linear(channels, 1))

    def forward(
        self,
        correspondences: Tensor,
        side_information: Tensor | None = None,
        mask: Tensor | None = None,
        *,
        eig_val: Tensor | None = None,
        eig_vec: Tensor | None = None,
    ) -> RivalOutput:
        """Score correspondences (B,N,4); `Inputs.of` documents the first three arguments.

        Parameters
        ----------
        eig_val : Tensor, shape (B,32), optional
            Smallest eigenvalues of the graph Laplacian, ascending; computed by `coherence_spectrum` where
            they are not given.
        eig_vec : Tensor, shape (B,N,32), optional
            Their eigenvectors, of any signs; required with `eig_val`.
        """
        inputs = Inputs.of(
            correspondences,
            side_information,
            mask,
            side_channels=self.side_channels,
            min_rows=NUM_NEIGHBORS,
        )
        spectrum = self._spectrum(inputs, eig_val, eig_vec)
        points, mask = inputs.coordinates, inputs.mask
        index = nearest_neighbors(points, NUM_NEIGHBORS, mask)
        motion = points[..., 2:] - points[..., :2]
        incoherence = smooth(motion, INPUT_SMOOTHNESS, *spectrum) - motion
        image, geometric = inputs.features[..., 4:].tensor_split([self.num_image_features], dim=-1)
        f = self.geom_feats_embed(torch.cat([points, incoherence, geometric], dim=-1), mask)
        if self.image_feats_embed is not None:
            f = f + self.image_feats_embed(image, mask)
        for block in self.lmcblock_list:
            f = block(f, index, spectrum, mask)
        logits = self.prob_predictor(f, mask).squeeze(-1)
        return inputs.output([logits], [eight_point(points, logits, mask)])

    @staticmethod
    def _spectrum(inputs: Inputs, eig_val: Tensor | None, eig_vec: Tensor | None) -> tuple[Tensor, Tensor]:
        points = inputs.coordinates
        if eig_val is None or eig_vec is None:
            with full_precision(points):
                return coherence_spectrum(points, inputs.mask)
        expected = (len(points), inputs.num_rows, NUM_EIGENPAIRS)
        if eig_vec.shape != expected or eig_val.shape != expected[::2]:
            raise ValueError(
                f"eigenpairs have shapes {tuple(eig_val.shape)} and {tuple(eig_vec.shape)}, expected "
                f"{expected[::2]} and {expected}"
            )
        padding = points.shape[1] - inputs.num_rows
        return eig_val.to(points), F.pad(eig_vec, (0, 0, 0, padding)).to(points)
