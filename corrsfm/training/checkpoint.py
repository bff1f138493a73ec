"""State of a run: all that a resumed run needs to continue as if it had never stopped."""

from __future__ import annotations

import dataclasses
import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from corrsfm.errors import CheckpointError
from corrsfm.files import atomic_path
from corrsfm.model import CorrAdaptor

__all__ = ["Average", "damaged_state", "load_state", "save_state", "without_side_channels"]

_FORMAT = "corrsfm-training-1"


class Average:
    """Exponential moving average of a network's weights and running statistics.

    Parameters
    ----------
    network : Module
    decay : float
        Share of the average that a step keeps; early steps keep less, so that it soon forgets the start.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self._decay = decay
        self._num_updates = 0
        self._values = {name: value.detach().clone() for name, value in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Add the weights after a step."""
        self._num_updates += 1
        decay = min(self._decay, (1 + self._num_updates) / (10 + self._num_updates))
        for name, value in network.state_dict().items():
            if value.is_floating_point():
                self._values[name].lerp_(value, 1 - decay)
            else:
                self._values[name].copy_(value)

    def copy_to(self, network: nn.Module) -> None:
        """Copy the averaged weights into a network."""
        network.load_state_dict(self._values)

    def state_dict(self) -> dict[str, Any]:
        """Averaged values and number of updates."""
        return {"num_updates": self._num_updates, "values": self._values}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        shapes = {name: value.shape for name, value in state["values"].items()}
        if shapes != {name: value.shape for name, value in self._values.items()}:
            raise ValueError("averages of another network")
        self._num_updates = state["num_updates"]
        for name, value in state["values"].items():
            self._values[name].copy_(value)


def save_state(path: Path, **state: dict[str, Any] | Tensor | int | float | str) -> None:
    """Write the state of a run, whole or not at all."""
    with atomic_path(Path(path)) as temporary:
        torch.save({"format": _FORMAT, **state}, temporary)


def load_state(path: Path, device: torch.device) -> dict[str, Any]:
    """Read what `save_state` wrote.

    Raises
    ------
    CheckpointError
        If the file is missing or holds something else.
    """
    try:
        with warnings.catch_warnings():
            # torch has its own to say of other files.
            warnings.simplefilter("ignore")
            state = torch.load(path, map_location=device, weights_only=True)
        if state["format"] != _FORMAT:
            raise ValueError("of another format")
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (MemoryError, torch.OutOfMemoryError):
        raise
    # Whatever torch stumbles over in damaged bytes.
    except Exception as error:
        raise damaged_state(path) from error
    return state


def damaged_state(path: Path) -> CheckpointError:
    """The error for a state that cannot be used."""
    return CheckpointError(
        f"{path}: damaged, or not the state of a training run; begin another run with another --output, from "
        f"the last weights of this one with: {shlex.join(['--initial', str(path.with_name('latest.pt'))])}"
    )


def without_side_channels(network: CorrAdaptor, num_left: int, neutral: Sequence[float]) -> CorrAdaptor:
    """The network without its last side channels, as if they always held their neutral values.

    Parameters
    ----------
    network : CorrAdaptor
    num_left : int
        Side channels to keep, counted from the first.
    neutral : sequence of float
        Value of each side channel, also of ones that the network lacks, where nothing is known.

    Returns
    -------
    CorrAdaptor
    """
    assert network.config is not None
    narrow = CorrAdaptor.from_config(dataclasses.replace(network.config, side_channels=num_left))
    narrow.usage = network.usage
    state = network.state_dict()
    dropped = torch.tensor(neutral[num_left : network.config.side_channels])
    for block in range(len(network.blocks)):
        # Side channels are the last columns of a block's input.
        weight, bias = f"blocks.{block}.stem.weight", f"blocks.{block}.stem.bias"
        state[bias] = state[bias] + state[weight][:, -len(dropped) :] @ dropped
        state[weight] = state[weight][:, : -len(dropped)]
    narrow.load_state_dict(state)
    return narrow
