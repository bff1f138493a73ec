"""Each rival computes in float64 what its published implementation does."""

import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from rival_weights import draw

from corrsfm.model.network import symmetric_epipolar_squared
from corrsfm.model.rivals import ARCHITECTURES, Rival
from corrsfm.model.rivals.checkpoints import from_published_rival
from corrsfm.model.rivals.layers import eight_point

TOLERANCE = 1e-6

# Networks that prune say which inputs their logits belong to.
PRUNING = ("clnet", "ncmnet", "mgnet")


@pytest.fixture(scope="module")
def rivals_dir(shared_dir: Path) -> Path:
    return shared_dir / "parity" / "rivals"


def published_tensors(rivals_dir: Path, listing: str, gain: float) -> dict[str, torch.Tensor]:
    state = {}
    for line in (rivals_dir / f"{listing}_state_dict.txt").read_text().splitlines():
        name, text = line.split()
        shape = () if text == "scalar" else tuple(int(size) for size in text.split("x"))
        state[name] = draw(name, shape, gain)
    return state


def published_network(rivals_dir: Path, architecture: str, listing: str, gain: float) -> Rival:
    state = published_tensors(rivals_dir, listing, gain)
    network, state = from_published_rival(state, architecture)
    network.load_state_dict(state, strict=True)
    return network.double().eval()


def assert_logits(found: list[torch.Tensor], expected: list[np.ndarray]) -> None:
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.numpy(), other, rtol=0, atol=TOLERANCE)


def assert_up_to_sign(found: torch.Tensor, expected: np.ndarray) -> None:
    flat = found.flatten(1).numpy()
    sign = np.sign((flat * expected).sum(1, keepdims=True))
    np.testing.assert_allclose(sign * flat, expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("prefix", ["", "n500_"])
@pytest.mark.parametrize("architecture", [name for name in ARCHITECTURES if name != "lmcnet"])
def test_published_numbers_are_reproduced(rivals_dir, architecture, prefix):
    golden = np.load(rivals_dir / f"{architecture}.npz")
    network = published_network(rivals_dir, architecture, architecture, float(golden["gain"]))
    with torch.inference_mode():
        output = network(torch.as_tensor(golden[f"{prefix}correspondences"]))
    names = [name for name in golden if name.startswith(f"{prefix}logits")]
    assert_logits(output.logits, [golden[name] for name in names])
    estimates = [golden[name] for name in golden if name.startswith(f"{prefix}essential")]
    assert len(output.essentials) == len(estimates) > 0
    for found, expected in zip(output.essentials, estimates, strict=True):
        assert_up_to_sign(found, expected)
    assert_up_to_sign(output.essential, estimates[-1])
    for name in (f"{prefix}sym_epipolar_sq", f"{prefix}residual_1"):
        if name in golden:
            np.testing.assert_allclose(output.residuals.numpy(), golden[name], rtol=TOLERANCE)
    if architecture in PRUNING:
        for step, indices in enumerate(output.indices):
            assert np.array_equal(indices.numpy(), golden[f"{prefix}index_{step}"])


@pytest.mark.parametrize("prefix", ["", "n500_"])
@pytest.mark.parametrize("given", [True, False], ids=["spectrum given", "spectrum computed"])
@pytest.mark.parametrize("listing", ["lmcnet", "lmcnet_full"])
def test_published_numbers_of_lmcnet_are_reproduced(rivals_dir, listing, given, prefix):
    golden = np.load(rivals_dir / "lmcnet.npz")
    network = published_network(rivals_dir, "lmcnet", listing, float(golden["gain"]))
    correspondences = torch.as_tensor(golden[f"{prefix}correspondences"])
    side, kind = None, ""
    if listing == "lmcnet_full":
        kind, parts = "full_", []
        for name, width in (("image_feats", 134), ("geom_feats", 2)):
            generator = np.random.default_rng(zlib.crc32((prefix + name).encode()))
            drawn = 0.5 * generator.standard_normal((*correspondences.shape[:2], width))
            parts.append(torch.as_tensor(drawn.astype(np.float32)).double())
        side = torch.cat(parts, dim=-1)
    spectrum = {name: torch.as_tensor(golden[prefix + name]) for name in ("eig_val", "eig_vec")}
    with torch.inference_mode():
        output = network(correspondences, side, **(spectrum if given else {}))
    expected = golden[f"{prefix}{kind}logits"]
    # Computed eigenvectors that another solver rounds to the other neighbouring float32 move the logits,
    # which are in the hundreds here, by some 1e-6: the tolerance is relative then.
    tolerance = TOLERANCE if given else TOLERANCE * np.abs(expected).max()
    np.testing.assert_allclose(output.logits[0].numpy(), expected, rtol=0, atol=tolerance)
    assert_up_to_sign(output.essential, golden[f"{prefix}{kind}essential"])
    expected = golden[f"{prefix}{kind}sym_epipolar_sq"]
    np.testing.assert_allclose(output.residuals.numpy(), expected, rtol=TOLERANCE)


@pytest.mark.parametrize("prefix", ["", "n500_"])
def test_pgfnet_keeps_the_published_half(rivals_dir, prefix):
    golden = np.load(rivals_dir / "pgfnet.npz")
    network = published_network(rivals_dir, "pgfnet", "pgfnet", float(golden["gain"]))
    seen = {}
    network.weights_iter[0].register_forward_hook(lambda _, args, out: seen.update(rows=args[0], logits=out))
    correspondences = torch.as_tensor(golden[f"{prefix}correspondences"])
    with torch.inference_mode():
        network(correspondences)
    kept = torch.as_tensor(golden[f"{prefix}index_kept"]).long()
    assert torch.equal(seen["rows"][..., :4], correspondences.gather(1, kept[..., None].expand(-1, -1, 4)))
    assert_logits([seen["logits"]], [golden[f"{prefix}stage1_logits_kept"]])
    rows = seen["rows"][..., :4]
    essential = eight_point(rows, seen["logits"], None)
    assert_up_to_sign(essential, golden[f"{prefix}stage1_essential_kept"])
    residuals = symmetric_epipolar_squared(rows, essential).numpy()
    np.testing.assert_allclose(residuals, golden[f"{prefix}stage1_residual_kept"], rtol=TOLERANCE)


@pytest.mark.parametrize("prefix", ["", "n500_"])
def test_umatch_pools_the_published_rows(rivals_dir, prefix):
    golden = np.load(rivals_dir / "umatch.npz")
    network = published_network(rivals_dir, "umatch", "umatch", float(golden["gain"]))
    kept = {}
    for b, block in enumerate(network.layer_blocks):
        for level, pool in enumerate(block.pools):
            name = f"{prefix}pool_{b}_{level}"
            pool.register_forward_hook(lambda _, args, out, name=name: kept.update({name: out[2].numpy()}))
    with torch.inference_mode():
        network(torch.as_tensor(golden[f"{prefix}correspondences"]))
    assert len(kept) == 18
    for name, indices in kept.items():
        assert np.array_equal(indices, golden[name]), name


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_published_tensor_is_asked_for_and_no_other(rivals_dir, architecture):
    state = published_tensors(rivals_dir, architecture, 1.0)
    network, fitted = from_published_rival(state, architecture)
    assert fitted.keys() == network.state_dict().keys()
