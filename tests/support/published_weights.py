"""Weights that anyone can make from the names of the published checkpoint."""

import zlib
from pathlib import Path

import numpy as np
import torch

UNUSED = (".m_proj.", ".fusion1.", ".fusion2.", ".embed_1.")


def _value(name: str, shape: tuple[int, ...]) -> np.ndarray:
    z = np.random.default_rng(zlib.crc32(name.encode())).standard_normal(shape)
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    if name.endswith("running_var"):
        value = 1 + 0.2 * np.abs(z)
    elif name.endswith(("running_mean", ".bias", ".gamma")):
        value = 0.1 * z
    elif len(shape) == 1:
        value = 1 + 0.1 * z
    else:
        value = z * np.sqrt(1.5 / np.prod(shape[1:]))
    return value.astype(np.float32)


def published_state(listing: Path) -> dict[str, torch.Tensor]:
    """State dict of the run behind ``published_network.npz``; ``listing`` names its tensors."""
    state = {}
    for line in listing.read_text().splitlines():
        name, text = line.split()
        shape = () if text == "scalar" else tuple(int(size) for size in text.split("x"))
        state[name] = torch.as_tensor(_value(name, shape))
    return state
