"""SuperPoint: keypoints and descriptors from one network (DeTone et al., CVPR Workshops 2018).

The weights are not ours to hand on; users bring the published state dict (``superpoint_v1.pth``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from corrsfm.errors import CheckpointError
from corrsfm.model.weights import fill_network

__all__ = ["SuperPoint", "load_superpoint"]

CELL = 8
DESCRIPTOR_SIZE = 256
# The published defaults.
NMS_RADIUS = 4
BORDER = 4
_ENCODER = {"1": (1, 64), "2": (64, 64), "3": (64, 128), "4": (128, 128)}


class SuperPoint(nn.Module):
    """The network; its parameters are named as in the published state dict."""

    def __init__(self) -> None:
        super().__init__()
        for level, (inputs, outputs) in _ENCODER.items():
            setattr(self, f"conv{level}a", nn.Conv2d(inputs, outputs, 3, padding=1))
            setattr(self, f"conv{level}b", nn.Conv2d(outputs, outputs, 3, padding=1))
        self.convPa = nn.Conv2d(128, 256, 3, padding=1)
        self.convPb = nn.Conv2d(256, CELL**2 + 1, 1)
        self.convDa = nn.Conv2d(128, 256, 3, padding=1)
        self.convDb = nn.Conv2d(256, DESCRIPTOR_SIZE, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Score every pixel and describe every cell of 8 × 8 pixels.

        Parameters
        ----------
        image : (1, 1, H, W)
            Grey values from 0 to 1; H and W are multiples of 8.

        Returns
        -------
        scores : (H, W)
            Probability that the pixel is a keypoint.
        descriptors : (1, 256, H/8, W/8)
            Of unit length, at the centres of the cells.
        """
        x = image
        for level in _ENCODER:
            x = functional.relu(getattr(self, f"conv{level}a")(x))
            x = functional.relu(getattr(self, f"conv{level}b")(x))
            if level != "4":
                x = functional.max_pool2d(x, 2)
        # The last of the 65 classes stands for "no keypoint in this cell".
        classes = self.convPb(functional.relu(self.convPa(x))).softmax(1)[:, :-1]
        scores = functional.pixel_shuffle(classes, CELL)[0, 0]  # (H, W)
        descriptors = self.convDb(functional.relu(self.convDa(x)))
        return scores, functional.normalize(descriptors, dim=1)

    def detect(self, image: Tensor, max_keypoints: int, min_score: float) -> tuple[Tensor, Tensor, Tensor]:
        """The strongest keypoints of a photo of any size.

        Parameters
        ----------
        image : (1, 1, H, W)
            Grey values from 0 to 1.
        max_keypoints : int
        min_score : float
            Weaker local maxima are no keypoints.

        Returns
        -------
        keypoints : (N, 2)
            x and y in pixels; the centre of the first pixel is (0, 0).
        scores : (N,)
        descriptors : (N, 256)
            Of unit length.
        """
        height, width = image.shape[2:]
        padding = (0, -width % CELL, 0, -height % CELL)
        scores, coarse = self(functional.pad(image, padding, mode="replicate"))
        scores = _local_maxima(scores[:height, :width])
        inside = torch.zeros_like(scores)
        inside[BORDER : height - BORDER, BORDER : width - BORDER] = 1
        flat = (scores * inside).ravel()
        found = torch.nonzero(flat > min_score)[:, 0]
        strongest = flat[found].sort(descending=True, stable=True).indices[:max_keypoints]
        found = found[strongest]
        keypoints = torch.stack([found % width, found // width], 1).to(image.dtype)
        return keypoints, flat[found], _sample(coarse, keypoints)


def _local_maxima(scores: Tensor) -> Tensor:
    """Scores (H, W) with zero wherever a neighbour within `NMS_RADIUS` is stronger.

    A pixel beside a maximum is no maximum, but a pixel beside that one may be: two more rounds find those.
    """

    def largest(values: Tensor) -> Tensor:
        return functional.max_pool2d(values[None], 2 * NMS_RADIUS + 1, 1, NMS_RADIUS)[0]

    maxima = scores == largest(scores)
    for _ in range(2):
        beside = largest(maxima.to(scores.dtype)) > 0
        left = scores.masked_fill(beside, 0)
        maxima = maxima | ((left == largest(left)) & ~beside)
    return torch.where(maxima, scores, 0)


def _sample(coarse: Tensor, keypoints: Tensor) -> Tensor:
    """Descriptors (N, 256) of keypoints, interpolated between the centres of cells."""
    height, width = coarse.shape[2:]
    # The centre of the first cell lies between its pixels 3 and 4.
    cells = (keypoints - (CELL - 1) / 2) / CELL
    grid = 2 * cells / torch.tensor([width - 1, height - 1]).clamp(min=1).to(cells) - 1
    sampled = functional.grid_sample(coarse, grid[None, None], align_corners=True)[0, :, 0].T
    return functional.normalize(sampled, dim=1)


def load_superpoint(path: Path) -> SuperPoint:
    """SuperPoint with the weights of a published state dict, in evaluation mode.

    Raises
    ------
    CheckpointError
        If the file is missing, cannot be read safely or is not that of this network.
    """
    advice = "expected the published state dict of SuperPoint, such as superpoint_v1.pth"
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; {advice}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch may raise anything on a file that is not a checkpoint
        raise CheckpointError(
            f"{path}: cannot be read as weights ({type(error).__name__}); {advice}"
        ) from error
    state = state.get("state_dict", state) if isinstance(state, Mapping) else state
    if not isinstance(state, Mapping):
        raise CheckpointError(f"{path}: holds a {type(state).__name__}; {advice}")
    network = SuperPoint()
    fill_network(network, state, f"{path}: not the weights of SuperPoint ({advice})")
    return network.eval()
