"""ConvMatch: motions of correspondences as an image that convolutions filter (Zhang and Ma, AAAI 2023)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from corrsfm.model.network import BatchNorm
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import Attention, InstanceNorm, Stack, cbr, eight_point, named

__all__ = ["ConvMatch"]

GRID_SIZE = 16
NUM_LAYERS = 6


def point_embedding(name: str, channels: int) -> Stack:
    """Points (B,N,2) to features (B,N,C)."""
    small, medium = channels // 4, channels // 2
    return named(name, *cbr(2, small), *cbr(small, medium), nn.Linear(medium, channels))


def grid_centres(like: Tensor) -> Tensor:
    """Centres (1,G*G,2) of the cells of a grid on [-1,1]^2, row by row from y = 1 down."""
    ticks = (2 * torch.arange(GRID_SIZE, device=like.device, dtype=like.dtype) + 1) / GRID_SIZE - 1
    y, x = torch.meshgrid(-ticks, ticks, indexing="ij")
    return torch.stack([x, y], dim=-1).view(1, -1, 2)


class ConvolutionUnit(nn.Module):
    """Two 3x3 convolutions beside the identity, nothing behind the sum: (B,C,G,G) to (B,C,G,G)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for _ in range(2):
            layers += [nn.Conv2d(channels, channels, 3, padding=1), nn.BatchNorm2d(channels), nn.ReLU()]
        self.net = nn.Sequential(*layers)

    def forward(self, image: Tensor) -> Tensor:
        return image + self.net(image)


class GridFilter(nn.Module):
    """Convolutions over the cells (B,G*G,C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.resnet = nn.Sequential(*(ConvolutionUnit(channels) for _ in range(3)))
        self.scale = nn.Sequential(nn.Conv2d(channels, channels, 1))

    def forward(self, cells: Tensor, mask: None = None) -> Tensor:
        image = cells.mT.unflatten(2, (GRID_SIZE, GRID_SIZE))  # (B,C,G,G)
        return self.scale(self.resnet(image)).flatten(2).mT


def inlier_predictor(*widths: int) -> Stack:
    """Features (B,N,C) to logits (B,N,1), normalised between the layers."""
    layers: list[nn.Module] = []
    for inputs, outputs in zip(widths[:-1], widths[1:], strict=True):
        layers += [nn.Linear(inputs, outputs), InstanceNorm(1e-3), BatchNorm(outputs), nn.ReLU()]
    return named("inlier_pre", *layers, nn.Linear(widths[-1], 1))


class Layer(nn.Module):
    """Motions (B,N,C) onto the grid, filtered there and back, and logits (B,N) from what changed."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.align = Attention(channels)
        self.filter = nn.ModuleDict({"filter": GridFilter(channels)})
        self.dealign = Attention(channels)
        self.inlier_pre = inlier_predictor(channels, channels // 2, channels // 8, channels // 32)

    def forward(self, motions: Tensor, grid: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        cells = self.filter["filter"](self.align(grid, motions, None, mask))
        changed = self.dealign(motions, cells, mask, None)
        return changed, self.inlier_pre(changed - motions, mask).squeeze(-1)


class ConvMatch(Rival):
    """Six layers, each with an estimate of its own; every one starts from the same empty grid.

    Parameters
    ----------
    channels : int
        A multiple of 32.
    side_channels : int
        Side information, which the published network lacks, is projected and added to the motions.
    """

    def __init__(self, *, channels: int = 128, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.pos_embed = point_embedding("position_encoder", channels)
        self.grid_pos_embed = point_embedding("position_encoder", channels)
        self.init_project = point_embedding("init_project", channels)
        self.side_project = nn.Linear(side_channels, channels) if side_channels else None
        self.layer_blocks = nn.ModuleList(Layer(channels) for _ in range(NUM_LAYERS))

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> RivalOutput:
        """Score correspondences (B,N,4); see `Rival`."""
        inputs = Inputs.of(correspondences, side_information, mask, side_channels=self.side_channels)
        points, mask = inputs.coordinates, inputs.mask
        motions = self.init_project(points[..., 2:] - points[..., :2], mask)
        motions = motions + self.pos_embed(points[..., :2], mask)
        if self.side_project is not None:
            motions = motions + self.side_project(inputs.features[..., 4:])
        grid = self.grid_pos_embed(grid_centres(points)).expand(len(points), -1, -1)  # (B,G*G,C)
        all_logits, essentials = [], []
        for layer in self.layer_blocks:
            motions, logits = layer(motions, grid, mask)
            all_logits.append(logits)
            essentials.append(eight_point(points, logits, mask))
        return inputs.output(all_logits, essentials)
