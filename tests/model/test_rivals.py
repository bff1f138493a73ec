"""All rival networks keep one contract: what goes in, what comes out, what does not matter."""

import functools
import re
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from rival_weights import (
    GOLDEN_FILE,
    GOLDEN_TOLERANCE,
    differing,
    drawn_rival,
    golden_arrays,
    golden_output,
    two_view_pairs,
)
from torch import Tensor

from corrsfm.errors import ConfigError
from corrsfm.model.rivals import ARCHITECTURES, Rival, RivalConfig, RivalOutput, build_rival
from corrsfm.model.rivals.inputs import keep_best
from corrsfm.model.rivals.layers import graph_filter
from corrsfm.model.rivals.spectral import coherence_spectrum, graph_laplacian

every_rival = pytest.mark.parametrize("architecture", ARCHITECTURES)

# Share of the correspondences in each set of logits.
LOGIT_SETS = {
    "pointcn": (1,),
    "oanet": (1, 1),
    "lmcnet": (1,),
    "ms2dgnet": (1, 1),
    "clnet": (1, 1, 1 / 2, 1 / 2, 1 / 4),
    "pgfnet": (1, 1),
    "convmatch": (1,) * 6,
    "ncmnet": (1, 1, 1 / 2, 1 / 2, 1 / 4),
    "mgnet": (1, 1, 1),
    "umatch": (1,) * 6,
}


@functools.cache
@torch.inference_mode(False)  # what is built in inference mode is never trained
def _drawn(architecture: str, dtype: torch.dtype) -> tuple[Rival, dict[str, Tensor]]:
    with np.load(GOLDEN_FILE) as stored:
        network = drawn_rival(architecture, str(stored[f"{architecture}/salt"])).to(dtype)
    network.eval()
    return network, {name: value.clone() for name, value in network.state_dict().items()}


def small_rival(architecture: str, dtype: torch.dtype = torch.float64) -> Rival:
    """A narrow network in evaluation mode with the weights of the stored numbers.

    Tests share it, because it takes longer to build than to run; one that a test trained is set back.
    """
    network, state = _drawn(architecture, dtype)
    if network.training:
        network.load_state_dict(state)
        network.zero_grad()
    return network.eval()


def tolerance_of(architecture: str) -> float:
    """LMCNet's eigenvectors are rounded to float32, so that the order of rows shows in them."""
    return 1e-4 if architecture == "lmcnet" else 1e-7


def in_input_order(output: RivalOutput, num_rows: int) -> Iterator[Tensor]:
    """Each set of logits as (B,N), minus infinity where it says nothing."""
    for logits, indices in zip(output.logits, output.indices, strict=True):
        full = logits.new_full((len(logits), num_rows), -torch.inf)
        # Padding may share an index with a kept row, so that it must not write.
        yield full.scatter_reduce(1, indices, logits, "amax")


def assert_same_output(one: RivalOutput, other: RivalOutput, tolerance: float) -> None:
    """Two outputs about the same rows in the same order say the same."""
    num_rows = one.residuals.shape[1]
    sets = zip(in_input_order(one, num_rows), in_input_order(other, num_rows), strict=True)
    for a, b in sets:
        scale = max(float(a[a.isfinite()].abs().max()), 1.0) if a.isfinite().any() else 1.0
        torch.testing.assert_close(b, a, atol=tolerance * scale, rtol=0)
    determining = one.logits[-len(one.essentials) :]
    for a, b, logits in zip(one.essentials, other.essentials, determining, strict=True):
        # With few weighted correspondences any of many matrices is right.
        weighted = logits > 0 if len(one.essentials) == len(one.logits) else logits.isfinite()
        if weighted.sum(1).min() < 12:
            continue
        sign = (a * b).sum((1, 2), keepdim=True).sign()
        torch.testing.assert_close(sign * b, a, atol=10 * tolerance, rtol=0)


def assert_finite(output: RivalOutput) -> None:
    assert not any(logits.isnan().any() for logits in output.logits)
    assert not output.residuals.isnan().any()
    for essential in output.essentials:
        assert essential.isfinite().all()
        norms = essential.norm(dim=(1, 2))
        torch.testing.assert_close(norms, torch.ones_like(norms))


def all_terms(output: RivalOutput) -> Tensor:
    """A scalar that depends on everything the published losses see."""
    logits = [one[one.isfinite()].square().sum() for one in output.logits]
    return sum(logits) + sum(essential.square()[:, 0].sum() for essential in output.essentials)


def mask_of(sizes: list[int], num_rows: int) -> Tensor:
    return torch.arange(num_rows) < torch.tensor(sizes)[:, None]


@every_rival
def test_small_network_gives_the_stored_numbers(architecture):
    stored = np.load(GOLDEN_FILE)
    expected = {
        name: stored[name]
        for name in stored
        if name.startswith(f"{architecture}/") and not name.endswith("salt")
    }
    output = golden_output(architecture, str(stored[f"{architecture}/salt"]))
    assert differing(expected, golden_arrays(architecture, output), GOLDEN_TOLERANCE) == []


@every_rival
def test_output_has_the_sets_and_sizes_of_the_published_loss(architecture):
    with torch.inference_mode():
        output = small_rival(architecture)(two_view_pairs(2, 61))
    assert isinstance(output.logits, list)
    widths = [logits.shape for logits in output.logits]
    halves = {1: 61, 1 / 2: 30, 1 / 4: 15}
    assert widths == [(2, halves[share]) for share in LOGIT_SETS[architecture]]
    assert [indices.shape for indices in output.indices] == widths
    assert output.essential.shape == (2, 3, 3)
    assert output.essential is output.essentials[-1]
    assert len(output.essentials) in (1, len(output.logits))
    assert output.residuals.shape == (2, 61)
    for indices in output.indices:
        assert all(len(set(row)) == len(row) for row in indices.tolist())
    assert_finite(output)


@every_rival
def test_order_of_matches_does_not_matter(architecture):
    network, pairs = small_rival(architecture), two_view_pairs(2, 61)
    order = torch.randperm(61, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        straight, shuffled = network(pairs), network(pairs[:, order])
    back = shuffled._replace(
        indices=[order[indices] for indices in shuffled.indices],
        residuals=shuffled.residuals[:, order.argsort()],
    )
    assert_same_output(straight, back, tolerance_of(architecture))


@every_rival
def test_pairs_of_different_sizes_give_in_a_batch_what_they_give_alone(architecture):
    network, pairs, sizes = small_rival(architecture), two_view_pairs(4, 70), [70, 70, 45, 27]
    mask = mask_of(sizes, 70)
    with torch.inference_mode():
        batched = network(torch.where(mask[..., None], pairs, 7.0), mask=mask)
        for row, size in enumerate(sizes):
            alone = network(pairs[row : row + 1, :size])
            widths = [logits.shape[1] for logits in alone.logits]
            for logits, width in zip(batched.logits, widths, strict=True):
                assert (logits[row, width:] == -torch.inf).all()
            assert (batched.residuals[row, size:] == torch.inf).all()
            part = RivalOutput(
                logits=[x[row : row + 1, :n] for x, n in zip(batched.logits, widths, strict=True)],
                indices=[x[row : row + 1, :n] for x, n in zip(batched.indices, widths, strict=True)],
                essential=batched.essential[row : row + 1],
                residuals=batched.residuals[row : row + 1, :size],
                essentials=[x[row : row + 1] for x in batched.essentials],
            )
            assert_same_output(alone, part, tolerance_of(architecture))


@every_rival
def test_mask_of_all_rows_changes_nothing(architecture):
    network, pairs = small_rival(architecture), two_view_pairs(2, 50)
    with torch.inference_mode():
        plain, masked = network(pairs), network(pairs, mask=torch.ones(2, 50, dtype=torch.bool))
    assert_same_output(plain, masked, 1e-7)


@every_rival
def test_padding_changes_neither_training_statistics_nor_gradients(architecture):
    pairs = two_view_pairs(3, 60)
    padded = torch.cat([pairs, torch.full((3, 9, 4), 3.0, dtype=torch.float64)], dim=1)
    results = []
    for inputs, mask in ((pairs, None), (padded, mask_of([60, 60, 60], 69))):
        network = small_rival(architecture).train()
        output = network(inputs, mask=mask)
        sum(logits[:, :15].square().sum() for logits in output.logits).backward()
        gradients = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
        statistics = {name: value.clone() for name, value in network.named_buffers()}
        results.append((statistics, gradients))
    tolerance = 1e-3 if architecture == "lmcnet" else 1e-6  # of the largest: biases get sums that cancel
    for one, other in zip(*results, strict=True):
        assert one.keys() == other.keys()
        largest = max(float(value.abs().max()) for value in one.values())
        for name, value in one.items():
            torch.testing.assert_close(other[name], value, atol=tolerance * largest, rtol=0, msg=name)


@every_rival
@pytest.mark.parametrize("num_rows", range(11))
def test_few_matches_give_finite_output(architecture, num_rows):
    network = small_rival(architecture, torch.float32)
    with torch.inference_mode():
        output = network(two_view_pairs(2, 10)[:, :num_rows].float())
    assert_finite(output)
    assert output.residuals.shape == output.logits[0].shape == (2, num_rows)
    for share, logits, indices in zip(LOGIT_SETS[architecture], output.logits, output.indices, strict=True):
        width = num_rows if share == 1 else min(max(int(num_rows * share), 1), num_rows)
        assert logits.shape == indices.shape == (2, width)
        assert ((indices >= 0) & (indices < num_rows)).all()


@every_rival
def test_batch_without_pairs_gives_empty_output(architecture):
    with torch.inference_mode():
        output = small_rival(architecture)(torch.zeros(0, 50, 4, dtype=torch.float64))
    assert output.residuals.shape == (0, 50)
    assert output.essential.shape == (0, 3, 3)


def degenerate_inputs() -> dict[str, Tensor]:
    rows = two_view_pairs(1, 40, outliers=0).float()
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
        "all outliers": two_view_pairs(1, 40, outliers=1).float(),
        "a line": torch.stack([line, 0 * line, line, 0 * line], dim=-1)[None],
        "infinities": with_infinities,
        "only infinities": torch.full((1, 40, 4), torch.inf),
        "huge": 1e3 * rows,
    }


@every_rival
@pytest.mark.parametrize("name", degenerate_inputs())
def test_degenerate_input_gives_finite_output(architecture, name):
    network, inputs = small_rival(architecture, torch.float32), degenerate_inputs()[name]
    with torch.inference_mode():
        assert_finite(network(inputs))
        assert_finite(network.train()(torch.cat([inputs, two_view_pairs(1, 40).float()])))


# Where all rows are equal, an instance normalisation multiplies gradients by up to 316, and forty of them one
# behind the other, as published, leave float32.
@every_rival
@pytest.mark.parametrize(
    "name",
    [name for name in degenerate_inputs() if name not in ("the same point", "zeros", "only infinities")],
)
def test_degenerate_input_gives_finite_gradient(architecture, name):
    network, inputs = small_rival(architecture, torch.float32).train(), degenerate_inputs()[name]
    all_terms(network(torch.cat([inputs, two_view_pairs(1, 40).float()]))).backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert gradients and all(gradient.isfinite().all() for gradient in gradients)


@every_rival
def test_rows_that_are_not_finite_count_as_padding(architecture):
    network, pairs = small_rival(architecture), two_view_pairs(1, 60)
    broken = torch.cat([pairs, torch.full((1, 5, 4), torch.inf, dtype=torch.float64)], dim=1)
    with torch.inference_mode():
        alone, among = network(pairs), network(broken)
    assert (among.residuals[0, 60:] == torch.inf).all()
    whole = [logits.shape[1] > 60 for logits in among.logits]
    part = among._replace(
        logits=[x[:, :60] if cut else x for x, cut in zip(among.logits, whole, strict=True)],
        indices=[x[:, :60] if cut else x for x, cut in zip(among.indices, whole, strict=True)],
        residuals=among.residuals[:, :60],
    )
    assert_same_output(alone, part, tolerance_of(architecture))


@every_rival
def test_every_trained_matrix_gets_a_gradient(architecture):
    network = small_rival(architecture).train()
    all_terms(network(two_view_pairs(3, 160))).backward()  # U-Match's third pool keeps five of 160
    trained = {name: p for name, p in network.named_parameters() if p.requires_grad}
    assert [name for name, p in trained.items() if p.grad is None] == []
    matrices = {name: p for name, p in trained.items() if p.ndim >= 2}
    assert len(matrices) >= 26
    assert [name for name, p in matrices.items() if not p.grad.abs().max() > 0] == []


@every_rival
def test_side_information_is_used_and_checked(architecture):
    network, pairs = drawn_rival(architecture, "", side_channels=2), two_view_pairs(1, 50)
    side = torch.linspace(0, 1, 100, dtype=torch.float64).view(1, 50, 2)
    with torch.inference_mode():
        one, other = network(pairs, side), network(pairs, side.flip(1))
    assert not torch.allclose(one.logits[0], other.logits[0])
    with pytest.raises(ValueError, match=re.escape("expects (1, 50, 2)")):
        network(pairs)


@pytest.mark.parametrize(
    ("architecture", "parameters", "never_trained"),
    [
        ("pointcn", 397_057, 0),
        ("oanet", 2_472_538, 0),
        ("lmcnet", 925_513, 0),
        ("ms2dgnet", 2_613_340, 0),
        ("clnet", 1_267_334, 313_728),
        ("pgfnet", 2_988_695, 0),
        ("convmatch", 7_493_670, 0),
        ("ncmnet", 4_765_942, 280_704 + 67_588),
        ("mgnet", 1_314_950, 313_986),
        ("umatch", 7_764_568, 0),
    ],
)
def test_published_sizes_have_the_published_parameter_counts(architecture, parameters, never_trained):
    with torch.device("meta"):
        network = build_rival(RivalConfig(architecture=architecture))
    counts = [(p.numel(), p.requires_grad) for p in network.parameters()]
    assert sum(count for count, _ in counts) == parameters
    assert sum(count for count, trained in counts if not trained) == never_trained


def test_wrong_configuration_names_every_problem():
    with pytest.raises(ConfigError, match="architecture is 'supernet', expected one of pointcn, oanet"):
        RivalConfig(architecture="supernet")
    with pytest.raises(ConfigError) as error:
        RivalConfig(architecture="umatch", channels=30, clusters=5, side_channels=-1)
    for words in ("channels is 30", "clusters is 5, but this network has none", "side_channels is -1"):
        assert words in str(error.value)


def test_graph_filter_is_the_normalised_graph_convolution():
    generator = torch.Generator().manual_seed(0)
    f = torch.randn(2, 20, 3, generator=generator, dtype=torch.float64)
    logits = torch.randn(2, 20, generator=generator, dtype=torch.float64)
    a = logits.tanh().relu()
    adjacency = a[:, :, None] * a[:, None] + torch.eye(20, dtype=torch.float64)
    scale = adjacency.sum(2).rsqrt().diag_embed()
    torch.testing.assert_close(graph_filter(f, logits, None), scale @ adjacency @ scale @ f)


@pytest.mark.parametrize(("ratio", "expected"), [(0.5, [[1, 3], [2, 0]]), (0.1, [[1], [2]])])
def test_best_rows_come_first(ratio, expected):
    index, mask = keep_best(torch.tensor([[0.0, 4, 1, 3], [2, 1, 3, 0]]), None, ratio)
    assert index.tolist() == expected
    assert mask is None


def test_best_rows_of_a_padded_pair_are_a_share_of_its_own():
    scores = torch.tensor([[0.0, 4, 1, 3], [2, 1, 9, 9]])
    index, mask = keep_best(scores, mask_of([4, 2], 4), 0.5)
    assert index[0].tolist() == [1, 3]
    assert mask.tolist() == [[True, True], [True, False]]
    assert index[1, 0] == 0


def test_laplacian_joins_near_correspondences():
    """Three rows on a line: each is joined to both others, with weights 1/e, 1/e and the smallest allowed."""
    points = torch.zeros(3, 4, dtype=torch.float64)
    points[:, 0] = torch.tensor([0.0, 0.1, 0.2])
    near, far = np.exp(-1), 0.05
    graph = np.array([[0, near, far], [near, 0, near], [far, near, 0]])
    scale = 1 / np.sqrt(graph.sum(1))
    adjacency = scale[:, None] * graph * scale
    np.testing.assert_allclose(graph_laplacian(points), np.diag(adjacency.sum(1)) - adjacency, atol=1e-15)


def test_spectrum_holds_the_smallest_eigenpairs_of_each_pair():
    pairs, sizes = two_view_pairs(2, 60), [60, 20]
    values, vectors = coherence_spectrum(pairs, mask_of(sizes, 60))
    assert values.shape == (2, 32)
    assert vectors.shape == (2, 60, 32)
    for pair, size in enumerate(sizes):
        found = min(size, 32)
        laplacian = graph_laplacian(pairs[pair, :size])
        u, lam = vectors[pair, :size, :found], values[pair, :found]
        torch.testing.assert_close(laplacian @ u, u * lam, atol=1e-6, rtol=0)
        torch.testing.assert_close(u.mT @ u, torch.eye(found, dtype=torch.float64), atol=1e-6, rtol=0)
        torch.testing.assert_close(lam, torch.linalg.eigvalsh(laplacian)[:found], atol=1e-6, rtol=0)
        assert (vectors[pair, size:] == 0).all() and (vectors[pair, :, found:] == 0).all()


def test_lmcnet_is_blind_to_the_signs_of_eigenvectors():
    network, pairs = small_rival("lmcnet"), two_view_pairs(2, 50)
    values, vectors = coherence_spectrum(pairs)
    signs = torch.where(torch.arange(32) % 3 == 0, -1.0, 1.0)
    with torch.inference_mode():
        computed = network(pairs)
        given = network(pairs, eig_val=values, eig_vec=signs * vectors)
    assert_same_output(computed, given, 1e-9)


def test_lmcnet_refuses_eigenpairs_of_another_size():
    network, pairs = small_rival("lmcnet"), two_view_pairs(2, 50)
    values, vectors = coherence_spectrum(pairs)
    with pytest.raises(ValueError, match=re.escape("expected (2, 32) and (2, 50, 32)")):
        network(pairs, eig_val=values, eig_vec=vectors[:, :40])
