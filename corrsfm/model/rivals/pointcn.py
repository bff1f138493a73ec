"""PointCN: learning to find good correspondences (Yi et al., CVPR 2018)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from corrsfm.model.network import BatchNorm
from corrsfm.model.rivals.inputs import Inputs, Rival, RivalOutput
from corrsfm.model.rivals.layers import InstanceNorm, Stack, eight_point

__all__ = ["PointCN", "from_tensorflow", "is_tensorflow"]


class PlainBatchNorm(BatchNorm):
    """Batch normalisation with eps 1e-3, without scale and shift, as TensorFlow had it here."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=1e-3, affine=False)
        del self.weight, self.bias
        # `normalise` wants them; they are constants and no part of a checkpoint.
        self.register_buffer("weight", torch.ones(channels), persistent=False)
        self.register_buffer("bias", torch.zeros(channels), persistent=False)


def unit(channels: int) -> Stack:
    """Linear layer, context normalisation, ReLU."""
    return Stack(nn.Linear(channels, channels), InstanceNorm(1e-3), PlainBatchNorm(channels), nn.ReLU())


class PointCN(Rival):
    """Twelve residual blocks of two units each; nothing follows their sums.

    Parameters
    ----------
    channels, side_channels : int
    """

    def __init__(self, *, channels: int = 128, side_channels: int = 0) -> None:
        super().__init__()
        self.side_channels = side_channels
        self.input = nn.Linear(4 + side_channels, channels)
        self.hidden = nn.ModuleList(Stack(unit(channels), unit(channels)) for _ in range(12))
        self.output = nn.Linear(channels, 1)

    def forward(
        self, correspondences: Tensor, side_information: Tensor | None = None, mask: Tensor | None = None
    ) -> RivalOutput:
        """Score correspondences (B,N,4); see `Rival`."""
        inputs = Inputs.of(correspondences, side_information, mask, side_channels=self.side_channels)
        x = self.input(inputs.features)
        for block in self.hidden:
            x = x + block(x, inputs.mask)
        logits = self.output(x).squeeze(-1)
        return inputs.output([logits], [eight_point(inputs.coordinates, logits, inputs.mask)])


# TensorFlow's names to ours, in this order.
RENAMING = [
    (r":0$", ""),
    (r"^Matchnet/hidden-input/self-conv/", "input."),
    (r"^Matchnet/output/self-conv/", "output."),
    (r"^Matchnet/hidden-(\d+)/conv-branch/conv1/", r"hidden.\1.0."),
    (r"^Matchnet/hidden-(\d+)/conv-branch/conv2/", r"hidden.\1.1."),
    (r"\.self-conv/", ".0."),
    (r"\.bn/batch_normalization/moving_mean$", ".2.running_mean"),
    (r"\.bn/batch_normalization/moving_variance$", ".2.running_var"),
    (r"\.weights$", ".weight"),
    (r"\.biases$", ".bias"),
]

# Frozen scales and shifts (one and zero), and what the optimiser remembers.
UNUSED = re.compile(
    r"/batch_normalization/(gamma|beta)(:0)?$|/Adam(_1)?(:0)?$|(^|/)(beta[12]_power|global_step)(:0)?$"
)


def is_tensorflow(state: Mapping[str, Any]) -> bool:
    """Whether names are those of the published TensorFlow checkpoint."""
    return any(str(name).startswith("Matchnet/") for name in state)


def from_tensorflow(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """State dict from the published checkpoint's arrays, whose kernels are (1,1,in,out).

    Names that are not recognised are kept, so that loading can list them as unexpected.
    """
    state: dict[str, Any] = {}
    for published, value in arrays.items():
        if UNUSED.search(published):
            continue
        name = published
        for pattern, replacement in RENAMING:
            name = re.sub(pattern, replacement, name)
        if name.endswith(".weight") and isinstance(value, Tensor) and value.ndim == 4:
            value = value.flatten(0, 2).mT if value.shape[:2] == (1, 1) else value
        state[name] = value
        if name.endswith(".running_mean"):  # which TensorFlow's layer does not count
            state[name.replace("running_mean", "num_batches_tracked")] = torch.zeros((), dtype=torch.int64)
    return state
