"""Published checkpoints of the rivals: which network a file holds, and its tensors in our layers' shapes."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from corrsfm.errors import CheckpointError
from corrsfm.model.rivals.build import ARCHITECTURES, RivalConfig, build_rival
from corrsfm.model.rivals.inputs import Rival
from corrsfm.model.rivals.lmcnet import NUM_GEOMETRIC_FEATURES, NUM_IMAGE_FEATURES
from corrsfm.model.rivals.pointcn import from_tensorflow, is_tensorflow

__all__ = ["from_published_rival", "numbers_allowed", "overlap", "read_arrays", "recognise", "tensors_of"]

# Where published checkpoints keep their tensors: most, some, LMCNet.
STATE_KEYS = ("state_dict", "model", "network_state_dict")

# Tensors that the copies beside CorrAdaptor's code add and that nothing uses.
UNUSED = {"pgfnet": re.compile(r"\.pretrain_conv[12]\."), "ms2dgnet": re.compile(r"\.conv11\.")}


def numbers_allowed() -> AbstractContextManager[object]:
    """Let ``torch.load(weights_only=True)`` read NumPy's numbers: training codes store their best score.

    What rebuilds a number takes its type and its bytes; other types, objects first of all, stay refused.
    Before PyTorch 2.6 nothing can be allowed by the name that files use.
    """
    if torch.torch_version.TorchVersion(torch.__version__) < "2.6":
        return nullcontext()
    rebuild: Any = np.float64(0).__reduce__()[0]
    allowed: list[Any] = [
        (rebuild, "numpy.core.multiarray.scalar"),  # as NumPy 1 wrote it
        (rebuild, "numpy._core.multiarray.scalar"),
        np.dtype,
        *(type(np.dtype(kind)) for kind in ("f8", "f4", "i8", "i4", "?")),
    ]
    return torch.serialization.safe_globals(allowed)


def read_arrays(file: Path) -> dict[str, Tensor]:
    """Tensors in an ``.npz`` file; nothing pickled is read.

    Raises
    ------
    CheckpointError
        If it is damaged or holds something other than numbers.
    """
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            return {name: torch.as_tensor(arrays[name]) for name in arrays}
    except OSError as error:
        raise CheckpointError(f"{file}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # what the reader stumbles over in a file that is none may be anything
        raise CheckpointError(
            f"{file}: not an archive that can be read safely; expected arrays of numbers only"
        ) from error


def tensors_of(content: Mapping[str, Any]) -> dict[str, Any] | None:
    """The state dict in a published checkpoint: under a known key or bare, names without ``module.``."""
    state: Any = next((content[key] for key in STATE_KEYS if isinstance(content.get(key), Mapping)), None)
    if state is None and any(isinstance(value, Tensor) for value in content.values()):
        state = content
    if state is None:
        return None
    return {str(name).removeprefix("module."): value for name, value in state.items()}


@cache
def _published_names(architecture: str) -> frozenset[str]:
    with torch.device("meta"):
        network = build_rival(RivalConfig(architecture=architecture))
    return frozenset(network.state_dict())


def overlap(expected: Collection[str], found: Collection[str]) -> float:
    """Share of names that two networks have in common, 0 to 1."""
    return 2 * len(set(expected) & set(found)) / max(len(expected) + len(found), 1)


def recognise(state: Mapping[str, Any]) -> tuple[str, float]:
    """The rival that has most names in common with a state dict, and what share of them."""
    names = from_tensorflow(state) if is_tensorflow(state) else state
    shares = {architecture: overlap(_published_names(architecture), names) for architecture in ARCHITECTURES}
    best = max(shares, key=lambda architecture: shares[architecture])
    return best, shares[best]


def from_published_rival(state: Mapping[str, Any], architecture: str) -> tuple[Rival, dict[str, Any]]:
    """The published network, and a state dict with the shapes of its layers.

    Tensors whose names or shapes do not fit are kept as they are, so that loading can list them.
    """
    image_features = architecture == "lmcnet" and any(name.startswith("image_feats") for name in state)
    side_channels = NUM_IMAGE_FEATURES + NUM_GEOMETRIC_FEATURES if image_features else 0
    network = build_rival(RivalConfig(architecture=architecture, side_channels=side_channels))
    if architecture == "pointcn" and is_tensorflow(state):
        return network, from_tensorflow(state)
    unused = UNUSED.get(architecture)
    kept = {name: value for name, value in state.items() if unused is None or not unused.search(name)}
    return network, _with_rows(kept, network)


def _with_rows(state: Mapping[str, Any], network: nn.Module) -> dict[str, Any]:
    """Convolutions (out,in,width) and (out,in,1,width) as linear layers (out,width*in) where those fit."""
    own = network.state_dict()
    result = {}
    for name, value in state.items():
        if isinstance(value, Tensor) and name in own and value.ndim > own[name].ndim == 2:
            # Our rows hold one neighbour after another.
            rows = value.flatten(2).transpose(1, 2).flatten(1)
            value = rows if rows.shape == own[name].shape else value
        result[name] = value
    return result
