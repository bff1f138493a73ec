"""The network equals the published one, whatever the batch, and survives any input."""

from pathlib import Path

import numpy as np
import pytest
import torch
from float64_judge import UNIT_ROUNDOFF, essential_tolerance, rounding_share, watched
from published_weights import UNUSED, published_state

from corrsfm.errors import ConfigError
from corrsfm.model import CorrAdaptor, NetworkConfig, PruningOutput
from corrsfm.model.network import (
    SmallestEigenvector,
    nearest_neighbors,
    symmetric_epipolar_squared,
    weighted_eight_point,
)
from corrsfm.model.plain import PlainCorrAdaptor
from corrsfm.model.published import from_published

SMALL = {"channels": 16, "clusters": 12, "heads": 2, "motion_stacking": 1}


@pytest.fixture(scope="module")
def parity_dir(shared_dir: Path) -> Path:
    return shared_dir / "parity"


@pytest.fixture(scope="module")
def published(parity_dir: Path) -> dict[str, torch.Tensor]:
    return published_state(parity_dir / "published_network_state_dict.txt")


def small_network(seed: int = 0, **options) -> CorrAdaptor:
    """A small network in evaluation mode whose layers all matter: no layer scale of 1e-5."""
    torch.manual_seed(seed)
    network = CorrAdaptor.from_config(NetworkConfig(**{**SMALL, **options}))
    for name, value in network.state_dict().items():
        if name.endswith(("running_mean", "layer_scale")):
            value.normal_(std=0.3)
        elif name.endswith("running_var"):
            value.uniform_(0.5, 1.5)
    return network.eval()


def two_view_pairs(num_pairs: int, num_rows: int, seed: int = 0, outliers: float = 0.5) -> torch.Tensor:
    """Correspondences of a sideways moving camera, some replaced by noise: (B,N,4) float32."""
    generator = np.random.default_rng(seed)
    points = generator.uniform([-1, -1, 2], [1, 1, 6], (num_pairs, num_rows, 3))
    moved = points + [0.5, 0.1, 0.05]
    rows = np.concatenate([points[..., :2] / points[..., 2:], moved[..., :2] / moved[..., 2:]], axis=-1)
    wrong = generator.random((num_pairs, num_rows)) < outliers
    rows[wrong] = generator.uniform(-0.5, 0.5, (int(wrong.sum()), 4))
    return torch.as_tensor(rows, dtype=torch.float32)


def assert_finite(output: PruningOutput) -> None:
    assert not any(logits.isnan().any() for logits in output.logits)
    assert output.essential.isfinite().all()
    torch.testing.assert_close(output.essential.norm(dim=(1, 2)), torch.ones(len(output.essential)))
    assert not output.residuals.isnan().any()


def assert_same_pair(
    one: PruningOutput, batched: PruningOutput, row: int, share: float, essential: float | None = None
) -> None:
    """The only pair of `one` is the pair `row` of `batched`, up to a share of the logits' scale.

    Matrices may differ by `essential`, in units of their norm; by the same share if it is not given.
    """
    for a, b, index_a, index_b in zip(one.logits, batched.logits, one.indices, batched.indices, strict=True):
        kept = a.shape[1]
        assert (b[row, :kept] - a[0]).abs().max() <= share * a.abs().max()
        assert torch.equal(index_b[row, :kept], index_a[0])
        assert (b[row, kept:] == -torch.inf).all()
    if one.logits[-1].shape[1] < 9:
        return  # fewer correspondences than unknowns: any of many matrices is right
    sign = (one.essential[0] * batched.essential[row]).sum().sign()
    moved = (sign * batched.essential[row] - one.essential[0]).norm()
    assert moved <= (share if essential is None else essential)


def test_published_numbers_are_reproduced_in_float64(parity_dir, published):
    network = CorrAdaptor.from_config(NetworkConfig()).eval()
    network.load_state_dict(from_published(published))
    expected = np.load(parity_dir / "published_network.npz")
    with torch.inference_mode():
        output = network.double()(torch.as_tensor(expected["correspondences"]))
    assert len(output.logits) == 5
    for step in range(5):
        scale = np.abs(expected[f"logits_{step}"]).max()
        difference = np.abs(output.logits[step].numpy() - expected[f"logits_{step}"]).max()
        assert difference <= 1e-9 * scale
        assert np.array_equal(output.indices[step].numpy(), expected[f"index_{step}"])
    essential = output.essential.flatten(1).numpy()
    sign = np.sign((essential * expected["essential"]).sum(1, keepdims=True))
    np.testing.assert_allclose(sign * essential, expected["essential"], atol=1e-6, rtol=0)
    np.testing.assert_allclose(output.residuals.numpy(), expected["sym_epipolar_sq"], rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 6_573_344),
        ({"clusters": 500}, 9_090_344),
        ({"clusters": 1000}, 18_624_344),
        ({"motion_stacking": 1}, 4_451_616),
        ({"motion_stacking": 4}, 10_816_800),
    ],
)
def test_ablations_have_the_parameter_counts_of_the_paper(options, expected):
    with torch.device("meta"):
        network = CorrAdaptor.from_config(NetworkConfig(**options))
    assert sum(parameter.numel() for parameter in network.parameters()) == expected


@pytest.mark.parametrize("num_pairs", [1, 3])
def test_fast_path_equals_plain_reference(parity_dir, published, num_pairs):
    network = CorrAdaptor.from_config(NetworkConfig()).eval()
    network.load_state_dict(from_published(published))
    plain = PlainCorrAdaptor().eval()
    plain.load_state_dict(
        {name: x for name, x in published.items() if not any(part in name for part in UNUSED)}
    )
    pairs = two_view_pairs(num_pairs, 61).double()
    with torch.inference_mode():
        fast, reference = network.double()(pairs), plain.double()(pairs)
    for a, b in zip(fast.logits, reference.logits, strict=True):
        torch.testing.assert_close(a, b, atol=1e-10, rtol=1e-10)
    torch.testing.assert_close(fast.essential.abs(), reference.essential.abs(), atol=1e-8, rtol=0)


def test_training_forward_equals_plain_reference(parity_dir, published):
    """Batch statistics that are derived from instance statistics are the batch statistics."""
    network = CorrAdaptor.from_config(NetworkConfig()).train()
    network.load_state_dict(from_published(published))
    plain = PlainCorrAdaptor().train()
    plain.load_state_dict(
        {name: x for name, x in published.items() if not any(part in name for part in UNUSED)}
    )
    pairs = two_view_pairs(2, 40).double()
    fast, reference = network.double()(pairs), plain.double()(pairs)
    for a, b in zip(fast.logits, reference.logits, strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=1e-9)
    updated = from_published(plain.state_dict())
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, updated[name].to(value.dtype), atol=1e-9, rtol=1e-9, msg=name)


@pytest.mark.parametrize(
    ("name", "block"),
    [
        ("blocks.0.stem.weight", 0),
        ("blocks.0.rounds.0.explicit.embed.weight", 0),
        ("blocks.0.rounds.0.injection.0.self_attention.key.weight", 0),
        ("blocks.0.rounds.1.implicit.pool.weight", 0),
        ("blocks.1.motion.linear1.weight", 1),
        ("blocks.1.rounds.1.explicit.ring.weight", 1),
        ("head.linear1.weight", 1),
    ],
)
def test_gradient_is_the_slope_of_the_loss(name, block):
    """What passes from the first block to the second is detached, so each block has its own loss."""
    network = small_network(side_channels=1).double().train()
    pairs, side = two_view_pairs(2, 40).double(), torch.rand(2, 40, 1, dtype=torch.float64)

    def loss() -> torch.Tensor:
        output = network(pairs, side)
        if block == 0:
            return sum(logits.square().mean() for logits in output.logits[:2])
        sign = output.essential[:, 0, 0].detach().sign()[:, None, None]
        return (
            sum(logits.square().mean() for logits in output.logits[2:])
            + (sign * output.essential)[:, 1].sum()
        )

    loss().backward()
    parameter = network.get_parameter(name)
    step, direction = 1e-6, torch.randn_like(parameter)
    with torch.no_grad():
        parameter.add_(step * direction)
        above = loss()
        parameter.sub_(2 * step * direction)
        slope = float((above - loss()) / (2 * step))
    assert float((parameter.grad * direction).sum()) == pytest.approx(slope, rel=1e-4, abs=1e-7)


def test_every_trained_parameter_gets_a_gradient():
    network = small_network(side_channels=1).train()
    output = network(two_view_pairs(2, 40), torch.rand(2, 40, 1))
    (sum(logits.sum() for logits in output.logits) + output.essential.sum()).backward()
    without = [name for name, p in network.named_parameters() if p.requires_grad and p.grad is None]
    assert without == []


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"attention": "softmax"},
        {"motion": False},
        {"motion_stacking": 0},
        {"branches": "explicit"},
        {"branches": "implicit"},
        {"fusion_rounds": 1, "neighbors": (6, 3), "mlp_ratio": 2, "oa_filters": 1},
        {"estimate": "fundamental"},
        {"pruning_ratio": 0.7},
    ],
)
def test_pairs_of_different_sizes_give_in_a_batch_what_they_give_alone(options):
    network = small_network(**options).double()
    pairs = two_view_pairs(4, 90).double()
    sizes = [90, 57, 13, 3]
    mask = torch.arange(90) < torch.tensor(sizes)[:, None]
    garbage = torch.where(mask[..., None], pairs, 7.0)
    with torch.inference_mode():
        batched = network(garbage, mask=mask)
        for row, size in enumerate(sizes):
            assert_same_pair(network(pairs[row : row + 1, :size]), batched, row, 1e-9)
            assert (batched.residuals[row, size:] == torch.inf).all()


@pytest.mark.parametrize("sizes", [(150, 96, 40), (70, 70, 70)])
def test_float32_equals_float64_up_to_rounding_in_a_batch_and_alone(sizes):
    """With the choices of float64, which `test_pairs_of_different_sizes...` compares; see `float64_judge`."""
    network, exact = small_network(), small_network().double()
    pairs = two_view_pairs(3, max(sizes))
    mask = torch.arange(max(sizes)) < torch.tensor(sizes)[:, None]
    share = rounding_share(network, max(sizes))
    with torch.inference_mode():
        with watched() as judge:
            expected = exact(pairs.double(), mask=None if mask.all() else mask)
        with watched(follow=judge) as together:
            batched = network(pairs, mask=None if mask.all() else mask)
        for row, size in enumerate(sizes):
            with watched(follow=judge, pairs=slice(row, row + 1)) as single:
                alone = network(pairs[row : row + 1, :size])
            assert_same_pair(alone, expected, row, share, essential_tolerance(judge, single, row, 0))
            one = pair_of(batched, row, size)
            assert_same_pair(one, expected, row, share, essential_tolerance(judge, together, row, row))


def pair_of(batched: PruningOutput, row: int, size: int) -> PruningOutput:
    """One pair of a batch as it would be alone."""
    kept = [size, size, size // 2, size // 2, size // 4]
    return PruningOutput(
        logits=tuple(x[row : row + 1, :num] for x, num in zip(batched.logits, kept, strict=True)),
        indices=tuple(x[row : row + 1, :num] for x, num in zip(batched.indices, kept, strict=True)),
        essential=batched.essential[row : row + 1],
        residuals=batched.residuals[row : row + 1, :size],
    )


@pytest.mark.parametrize("by_blocks", [True, False])
@pytest.mark.parametrize("num_padding", [0, 13])
def test_float32_neighbours_are_the_nearest_up_to_rounding(num_padding, by_blocks, monkeypatch):
    """The p-th neighbour is as far as the p-th nearest, which may be another one at a near-tie.

    If every ranking value is off by at most τ, so is the p-th smallest of them, and the distance of the one
    that holds the place is within 2 τ of the p-th smallest distance. With all centred features shorter than
    R, a ranking value sums C products and a square of up to 2 R² and R² (C + 1 roundings each), the square
    itself was rounded C times, and moving each feature by a rounding of the centring moves it by 4 R² u.
    """
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: not by_blocks)  # as on a GPU if it compiles
    channels, k = 16, 9
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 300, channels, generator=generator) + 5
    garbage = torch.full((2, num_padding, channels), 5.1)
    mask = (torch.arange(300 + num_padding) < 300).expand(2, -1)
    found = nearest_neighbors(torch.cat([features, garbage], 1), k, mask if num_padding else None)[:, :300]
    exact = features.double()
    distances = torch.cdist(exact, exact, compute_mode="donot_use_mm_for_euclid_dist").square()
    radius_squared = (exact - exact.mean(1, keepdim=True)).square().sum(-1).max()
    tau = (3 * (channels + 1) + channels + 4) * radius_squared * UNIT_ROUNDOFF
    assert (found < 300).all()
    chosen, nearest = distances.gather(2, found), distances.sort(-1).values[..., :k]
    assert (chosen - nearest).abs().max() <= 2 * tau
    assert tau < 1e-4 * nearest[..., 1].min()
    assert (found.sort(-1).values.diff(dim=-1) > 0).all()


@pytest.mark.parametrize("num_padding", [0, 5])
def test_neighbours_that_are_well_apart_come_in_exact_order(num_padding):
    """Whole numbers of mean zero whose distances all differ: exact in float32, in any order."""
    places = torch.tensor([4.0**power for power in range(5)])
    places = torch.cat([places, -places])
    features = torch.cat([places, torch.zeros(num_padding)])[None, :, None]
    mask = torch.arange(10 + num_padding)[None] < 10
    found = nearest_neighbors(features, 9, mask if num_padding else None)[0, :10]
    distances = (places[:, None] - places).abs()
    assert all(len(row.unique()) == 10 for row in distances)
    assert torch.equal(found, distances.argsort(1)[:, :9])


def test_mask_of_all_rows_changes_nothing():
    network = small_network().double()
    pairs = two_view_pairs(2, 50).double()
    with torch.inference_mode():
        plain, masked = network(pairs), network(pairs, mask=torch.ones(2, 50, dtype=torch.bool))
    for row in range(2):
        assert_same_pair(pair_of(plain, row, 50), masked, row, 1e-9)


def test_padding_changes_neither_training_statistics_nor_gradients():
    pairs = two_view_pairs(2, 40)
    padded = torch.cat([pairs, torch.full((2, 9, 4), 3.0)], dim=1)
    mask = torch.arange(49).expand(2, -1) < 40
    results = []
    for inputs, rows in ((pairs, None), (padded, mask)):
        network = small_network().double().train()
        output = network(inputs.double(), mask=rows)
        sum(logits[:, :10].square().sum() for logits in output.logits).backward()
        gradients = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
        results.append(({**network.state_dict()}, gradients))
    for one, other in zip(*results, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            torch.testing.assert_close(one[name], other[name], atol=1e-8, rtol=1e-7, msg=name)


@pytest.mark.parametrize("num_rows", range(11))
def test_few_matches_give_finite_output(num_rows):
    network = small_network()
    with torch.inference_mode():
        output = network(two_view_pairs(2, 10)[:, :num_rows])
    assert_finite(output)
    assert output.residuals.shape == (2, num_rows)
    assert output.logits[0].shape == (2, num_rows)
    assert all(logits.shape[1] <= max(num_rows // 2, 1) for logits in output.logits[2:])
    assert all(((index >= 0) & (index < num_rows)).all() for index in output.indices)


def degenerate_inputs() -> dict[str, torch.Tensor]:
    rows = two_view_pairs(1, 40, outliers=0)
    line = torch.linspace(-1, 1, 40)
    x, y = rows[0, :, 0], rows[0, :, 1]
    turned = torch.stack([x, y, (x + 0.1) / (1 - 0.1 * x), y * 1.005 / (1 - 0.1 * x)], dim=-1)
    with_infinities = rows.clone()
    with_infinities[0, ::3, 2] = torch.inf
    with_infinities[0, 1, 0] = torch.nan
    with_infinities[0, 2, 0] = 1e30
    return {
        "the same point": rows[:, :1].expand(1, 40, 4).clone(),
        "zeros": torch.zeros(1, 40, 4),
        "pure rotation": turned[None],
        "no motion": torch.cat([rows[..., :2], rows[..., :2]], dim=-1),
        "all outliers": two_view_pairs(1, 40, outliers=1),
        "a line": torch.stack([line, 0 * line, line, 0 * line], dim=-1)[None],
        "infinities": with_infinities,
        "only infinities": torch.full((1, 40, 4), torch.inf),
        "huge": 1e3 * rows,
    }


@pytest.mark.parametrize("name", degenerate_inputs())
@pytest.mark.parametrize("estimate", ["essential", "fundamental"])
def test_degenerate_input_gives_finite_output_and_gradient(name, estimate):
    network = small_network(estimate=estimate)
    inputs = degenerate_inputs()[name]
    with torch.inference_mode():
        assert_finite(network(inputs))
    output = network.train()(torch.cat([inputs, two_view_pairs(1, 40)]))
    finite = [logits[logits.isfinite()].square().sum() for logits in output.logits]
    (sum(finite) + output.essential[:, 0].sum()).backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert gradients and all(gradient.isfinite().all() for gradient in gradients)


def test_rows_that_are_not_finite_count_as_padding():
    network = small_network().double()
    pairs = two_view_pairs(1, 60).double()
    broken = torch.cat([pairs, torch.full((1, 5, 4), torch.inf)], dim=1)
    with torch.inference_mode():
        assert_same_pair(network(pairs), network(broken), 0, 1e-9)
        assert (network(broken).residuals[0, 60:] == torch.inf).all()


def test_side_information_reaches_both_blocks_and_is_checked():
    network = small_network(side_channels=2)
    pairs, side = two_view_pairs(1, 50), torch.rand(1, 50, 2)
    with torch.inference_mode():
        one, other = network(pairs, side), network(pairs, side.flip(1))
    assert not torch.allclose(one.logits[0], other.logits[0])
    assert network.blocks[0].stem.in_features == 6
    assert network.blocks[1].stem.in_features == 8
    with pytest.raises(ValueError, match=r"expects \(1, 50, 2\)"):
        network(pairs)


def test_order_of_matches_does_not_matter():
    network = small_network().double()
    pairs = two_view_pairs(1, 50).double()
    order = torch.randperm(50)
    with torch.inference_mode():
        straight, shuffled = network(pairs), network(pairs[:, order])
    torch.testing.assert_close(shuffled.logits[1], straight.logits[1][:, order])
    assert torch.equal(order[shuffled.indices[4][0]], straight.indices[4][0])


def test_eight_point_finds_the_essential_matrix_of_exact_correspondences():
    pairs = two_view_pairs(2, 30, outliers=0).double()
    matrix = weighted_eight_point(pairs, torch.ones(2, 30, dtype=torch.float64))
    translation = np.array([0.5, 0.1, 0.05])
    expected = np.cross(np.eye(3), translation).T
    expected /= np.linalg.norm(expected)
    for estimated in matrix.numpy():
        sign = np.sign((estimated * expected).sum())
        np.testing.assert_allclose(sign * estimated, expected, atol=1e-5)
    assert symmetric_epipolar_squared(pairs, matrix).max() < 1e-10


def test_eight_point_ignores_correspondences_of_weight_zero():
    pairs = two_view_pairs(1, 30, outliers=0).double()
    weights = (torch.arange(40) < 30).double()[None]
    noisy = torch.cat([pairs, torch.rand(1, 10, 4, dtype=torch.float64)], dim=1)
    matrix = weighted_eight_point(noisy, weights)
    assert symmetric_epipolar_squared(pairs, matrix).max() < 1e-10


def test_fundamental_matrix_is_singular():
    matrix = weighted_eight_point(two_view_pairs(3, 30, outliers=0.3), torch.ones(3, 30), fundamental=True)
    # Singular in float64, then rounded: no singular value moves farther than the norm of the rounding.
    assert torch.linalg.svdvals(matrix.double())[:, 2].max() < UNIT_ROUNDOFF
    torch.testing.assert_close(matrix.double().norm(dim=(1, 2)), torch.ones(3).double(), atol=1e-7, rtol=0)


def test_gradient_of_smallest_eigenvector_is_exact_where_it_is_defined_and_finite_elsewhere():
    rows = torch.rand(2, 9, 4, dtype=torch.float64)
    matrix = (rows.mT @ rows).requires_grad_()
    symmetric = lambda m: SmallestEigenvector.apply((m + m.mT) / 2).square()  # noqa: E731
    assert torch.autograd.gradcheck(symmetric, matrix)
    equal = torch.eye(4, dtype=torch.float64, requires_grad=True)
    SmallestEigenvector.apply(equal).sum().backward()
    assert torch.equal(equal.grad, torch.zeros(4, 4, dtype=torch.float64))


def test_the_last_logit_of_an_input_is_that_of_the_last_set_that_judged_it():
    padding = -torch.inf
    output = PruningOutput(
        logits=(torch.tensor([[1.0, 2.0, 3.0, padding]]), torch.tensor([[4.0, padding]])),
        indices=(torch.tensor([[0, 1, 2, 3]]), torch.tensor([[2, 1]])),
        essential=torch.eye(3)[None],
        residuals=torch.zeros(1, 4),
    )
    assert output.last_logits().tolist() == [[1.0, 2.0, 4.0, padding]]


def test_bfloat16_ranks_like_float32():
    network = small_network(channels=32)
    pairs = two_view_pairs(2, 200)
    with torch.inference_mode():
        exact = network(pairs)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = network(pairs)
    assert rounded.logits[0].dtype == torch.float32
    correlation = np.corrcoef(exact.logits[0].flatten(), rounded.logits[0].flatten())[0, 1]
    assert correlation > 0.99


def test_small_networks_are_legal_and_small():
    config = NetworkConfig(
        channels=64,
        clusters=64,
        neighbors=(6, 3),
        fusion_rounds=2,
        motion_stacking=1,
        heads=2,
        mlp_ratio=2,
        oa_filters=2,
        side_channels=5,
    )
    network = CorrAdaptor.from_config(config).eval()
    assert sum(parameter.numel() for parameter in network.parameters()) < 1_000_000
    with torch.inference_mode():
        assert_finite(network(two_view_pairs(1, 100), torch.rand(1, 100, 5)))


def test_wrong_configuration_names_every_problem():
    with pytest.raises(ConfigError) as error:
        NetworkConfig(channels=30, neighbors=(9, 5), attention="linear")
    for word in ("channels is 30", "neighbors is (9, 5)", "attention is 'linear'"):
        assert word in str(error.value)
