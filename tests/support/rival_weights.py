"""Weights, pairs and goldens of the rival networks that anyone can make again.

``PYTHONPATH=. python tests/support/rival_weights.py`` writes ``tests/data/rivals_golden.npz``: outputs of a
small network of each kind, in float64. Weights and inputs are exact in float32. The script takes the first
weights whose numbers a change of 1e-12 in the inputs moves by less than a tenth of `GOLDEN_TOLERANCE`,
choices of neighbours and ranks included, and with which every estimate rests on enough correspondences.
"""

import zlib
from pathlib import Path

import numpy as np
import torch

from corrsfm.model.rivals import ARCHITECTURES, Rival, RivalConfig, RivalOutput, build_rival

GOLDEN_FILE = Path(__file__).parents[1] / "data" / "rivals_golden.npz"

# Relative to the largest value of an array. Rounding moves these networks as inputs do that change by some
# 1e-13, the error of a sum of a thousand terms in float64.
GOLDEN_TOLERANCE = 1e-7


def draw(name: str, shape: tuple[int, ...], gain: float = 1.5, salt: str = "") -> torch.Tensor:
    """A tensor made from its name, by the rule behind the published goldens."""
    z = np.random.default_rng(zlib.crc32((salt + name).encode())).standard_normal(shape)
    kernel = shape[:-1] if "/" in name else shape[1:]  # TensorFlow's kernels end with their outputs
    if name.endswith("num_batches_tracked"):
        return torch.zeros(shape, dtype=torch.int64)
    if name.endswith(("running_var", "/moving_variance")):
        value = 1 + 0.2 * np.abs(z)
    elif name.endswith(("running_mean", "/moving_mean", ".bias", "/biases", "gamma")):
        value = 0.1 * z
    elif len(shape) == 1:
        value = 1 + 0.1 * z
    else:
        value = z * np.sqrt(gain / np.prod(kernel))
    return torch.as_tensor(value.astype(np.float32))


def gain_of(architecture: str) -> float:
    """U-Match's scores saturate with more, and equal scores have no order."""
    return 0.6 if architecture == "umatch" else 1.5


def drawn_rival(architecture: str, salt: str, **sizes: int) -> Rival:
    """A narrow network in evaluation mode and float64 whose layers all matter."""
    sizes = {"channels": 32, **sizes}
    if architecture not in ("pointcn", "clnet", "convmatch", "umatch"):
        sizes.setdefault("clusters", 12)
    network = build_rival(RivalConfig(architecture=architecture, **sizes))
    gain = gain_of(architecture)
    network.load_state_dict(
        {name: draw(name, tuple(value.shape), gain, salt) for name, value in network.state_dict().items()}
    )
    return network.double().eval()


def two_view_pairs(num_pairs: int, num_rows: int, seed: int = 0, outliers: float = 0.5) -> torch.Tensor:
    """Correspondences of a sideways moving camera, some replaced by noise: (B,N,4), exact in float32."""
    generator = np.random.default_rng(seed)
    points = generator.uniform([-1, -1, 2], [1, 1, 6], (num_pairs, num_rows, 3))
    moved = points + [0.5, 0.1, 0.05]
    rows = np.concatenate([points[..., :2] / points[..., 2:], moved[..., :2] / moved[..., 2:]], axis=-1)
    wrong = generator.random((num_pairs, num_rows)) < outliers
    rows[wrong] = generator.uniform(-0.5, 0.5, (int(wrong.sum()), 4))
    return torch.as_tensor(rows.astype(np.float32)).double()


def golden_spectrum(num_pairs: int, num_rows: int) -> dict[str, torch.Tensor]:
    """Stand-ins for LMCNet's eigenpairs, so that its golden does not depend on an eigensolver."""
    values = torch.linspace(0, 1, 32, dtype=torch.float64).expand(num_pairs, -1)
    vectors = draw("eig_vec", (num_pairs, num_rows, 32), gain=num_rows).double()
    return {"eig_val": values, "eig_vec": vectors}


def golden_output(architecture: str, salt: str, change: float = 0.0) -> RivalOutput:
    """What a small network says about two pairs of 48, whose inputs may be changed a little."""
    pairs = two_view_pairs(2, 48, seed=5)
    pairs = pairs + change * torch.sin(torch.arange(pairs.numel()).view(pairs.shape))
    options = golden_spectrum(2, 48) if architecture == "lmcnet" else {}
    with torch.inference_mode():
        return drawn_rival(architecture, salt)(pairs, **options)


def golden_arrays(architecture: str, output: RivalOutput) -> dict[str, np.ndarray]:
    """The arrays of an output, with the sign of each estimate made positive at its largest entry."""
    arrays = {}
    for step, logits in enumerate(output.logits):
        arrays[f"{architecture}/logits_{step}"] = logits.numpy()
        arrays[f"{architecture}/index_{step}"] = output.indices[step].numpy().astype(np.int16)
    for step, essential in enumerate(output.essentials):
        flat = essential.flatten(1)
        largest = flat.gather(1, flat.abs().argmax(1, keepdim=True))
        arrays[f"{architecture}/essential_{step}"] = (flat * largest.sign()).numpy()
    return arrays


def differing(one: dict[str, np.ndarray], other: dict[str, np.ndarray], tolerance: float) -> list[str]:
    """Names of arrays that differ by more than a share of their largest value; of indices, at all."""
    assert one.keys() == other.keys()
    names = []
    for name, value in one.items():
        allowed = 0 if value.dtype.kind == "i" else tolerance * np.abs(value).max()
        if value.shape != other[name].shape or np.abs(value - other[name]).max() > allowed:
            names.append(name)
    return names


def is_firm(architecture: str, salt: str) -> bool:
    """Whether a golden does not rest on rounding, nor an estimate on too few correspondences."""
    output = golden_output(architecture, salt)
    weighted = [(logits > 0).sum(1).min() for logits in output.logits]
    if len(output.essentials) == len(output.logits) and min(weighted) < 12:
        return False
    exact = golden_arrays(architecture, output)
    return not any(
        differing(
            exact,
            golden_arrays(architecture, golden_output(architecture, salt, change)),
            GOLDEN_TOLERANCE / 10,
        )
        for change in (1e-12, -1e-12)
    )


def write_goldens() -> None:
    arrays = {}
    for architecture in ARCHITECTURES:
        salt = next(str(number) for number in range(1000) if is_firm(architecture, str(number)))
        arrays[f"{architecture}/salt"] = np.array(salt)
        arrays.update(golden_arrays(architecture, golden_output(architecture, salt)))
    np.savez_compressed(GOLDEN_FILE, **arrays)


if __name__ == "__main__":
    write_goldens()
