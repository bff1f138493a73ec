import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from float64_judge import in_float64
from two_view_pairs import make_pair

from corrsfm.config import MatchInput, NetworkUsage, OperatingPoint, Precision, PruneConfig, PruneMethod
from corrsfm.errors import CheckpointError, CorrsfmError, InputError
from corrsfm.model import CorrAdaptor, NetworkConfig, save_network
from corrsfm.model.rivals import RivalConfig, build_rival
from corrsfm.prune import Pruner, build_pruner
from corrsfm.prune.learned import choose_precision, pack_batches
from corrsfm.prune.selection import select_candidates

SMALL = NetworkConfig(
    channels=16, clusters=12, neighbors=(6, 3), fusion_rounds=1, motion_stacking=1, heads=2, side_channels=2
)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    network = CorrAdaptor.from_config(SMALL)
    # Fresh layer scales of 1e-5 would hide mistakes in what they scale.
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("layer_scale"):
                value.fill_(0.5)
    return network.eval()


@pytest.fixture(scope="module")
def mutual_network(network):
    reader = CorrAdaptor.from_config(SMALL)
    reader.load_state_dict(network.state_dict())
    reader.usage = NetworkUsage(input=MatchInput.MUTUAL)
    return reader.eval()


def rows_of(pair, rows):
    """Some matches of a pair."""
    names = ("points0", "points1", "normalised", "ratios", "mutual", "log_scale_ratios", "rotations")
    return dataclasses.replace(pair, **{name: getattr(pair, name)[rows] for name in names})


def make(seed=0, num=120, inlier_ratio=0.5):
    return make_pair(seed=seed, num=num, inlier_ratio=inlier_ratio, noise_px=0.5).as_correspondences()


def pruner_of(network, **options):
    defaults = {"precision": Precision.FLOAT32, "batched": True, "threads": 2}
    return Pruner(network, device="cpu", **{**defaults, **options})


def exact_pruner_of(network, **options):
    """A pruner whose network computes in float64: what it chooses at a near-tie hangs on no processor."""
    pruner = pruner_of(network, **options)
    pruner._network = in_float64(network)
    return pruner


def assert_equal_results(results, others):
    """Equal but for float64's rounding, which a matrix may magnify, and that of a score to float32."""
    for result, other in zip(results, others, strict=True):
        np.testing.assert_allclose(result.scores, other.scores, atol=2.0**-23, rtol=0)
        np.testing.assert_array_equal(result.inlier_mask, other.inlier_mask)
        if result.model is None:
            assert other.model is None
            continue
        sign = np.sign(np.sum(result.model.matrix * other.model.matrix))
        np.testing.assert_allclose(result.model.matrix, sign * other.model.matrix, atol=1e-7)


@pytest.mark.parametrize("point", list(OperatingPoint))
def test_batches_of_mixed_sizes_equal_one_by_one(network, point):
    pairs = [make(seed, num) for seed, num in enumerate([60, 0, 200, 8, 60, 1, 133, 32])]
    pruner = exact_pruner_of(network, operating_point=point)
    together = pruner(pairs)
    assert_equal_results(together, [pruner([pair])[0] for pair in pairs])
    assert [result.model is None for result in together] == [len(pair) < 32 for pair in pairs]


def test_a_pair_a_thread_equals_batches_and_leaves_torchs_threads_alone(network):
    pairs = [make(seed, num) for seed, num in enumerate([60, 0, 200, 8, 133])]
    before = torch.get_num_threads()
    assert_equal_results(exact_pruner_of(network, batched=False)(pairs), exact_pruner_of(network)(pairs))
    assert torch.get_num_threads() == before


def test_small_batches_equal_large_ones(network):
    pairs = [make(seed, 40 + 10 * seed) for seed in range(6)]
    assert_equal_results(
        exact_pruner_of(network, max_batch_matches=100)(pairs),
        exact_pruner_of(network, max_batch_matches=10_000)(pairs),
    )


def test_pack_batches_covers_all_and_bounds_memory():
    sizes = [5, 100, 7, 50, 0, 49, 300]
    batches = pack_batches(sizes, 120)
    assert sorted(index for batch in batches for index in batch) == list(range(7))
    assert batches[0] == [6]
    assert all(len(b) == 1 or len(b) * max(sizes[i] for i in b) <= 120 for b in batches)
    assert [3, 5] in batches
    assert pack_batches([], 120) == []


class OutOfMemory:
    """A network that refuses batches of more than two pairs."""

    def __init__(self, network, limit=2):
        self.network, self.limit, self.batches = network, limit, []

    def __call__(self, coordinates, side, mask):
        self.batches.append(len(coordinates))
        if len(coordinates) > self.limit:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return self.network(coordinates, side, mask)


def test_out_of_memory_halves_the_batch_and_goes_on(network, monkeypatch):
    pairs = [make(seed, 50 + seed) for seed in range(5)]
    pruner = exact_pruner_of(network)
    expected = pruner(pairs)
    small = OutOfMemory(in_float64(network))
    monkeypatch.setattr(pruner, "_network", small)
    assert_equal_results(pruner(pairs), expected)
    assert small.batches == [5, 2, 3, 1, 2]


def test_pair_that_never_fits_is_an_error_that_says_what_to_try(network, monkeypatch):
    pruner = pruner_of(network)
    monkeypatch.setattr(pruner, "_network", OutOfMemory(network, limit=0))
    with pytest.raises(CorrsfmError, match="60 matches do not fit.*--max-candidates"):
        pruner([make(num=60)])


def test_other_errors_of_the_network_are_not_swallowed(network, monkeypatch):
    pruner = pruner_of(network)

    def broken(*_):
        raise RuntimeError("shape mismatch")

    monkeypatch.setattr(pruner, "_network", broken)
    with pytest.raises(RuntimeError, match="shape mismatch"):
        pruner([make(), make(1)])


def test_matches_beyond_the_candidates_are_judged_by_the_same_matrix(network):
    pair = make(num=300, inlier_ratio=0.7)
    (result,) = pruner_of(network, max_candidates=100)([pair])
    assert len(result) == 300
    assert np.isfinite(result.residuals).all()
    rows = select_candidates(pair, 100)
    (alone,) = pruner_of(network)([rows_of(pair, rows)])
    # The network sees the same numbers in the same shape, so it says the same, bit by bit.
    np.testing.assert_array_equal(alone.scores, result.scores[rows])
    np.testing.assert_array_equal(alone.model.matrix, result.model.matrix)
    np.testing.assert_allclose(alone.residuals, result.residuals[rows], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("point", list(OperatingPoint))
def test_a_network_of_mutual_matches_is_fed_nothing_else(network, mutual_network, point):
    pair = make(num=300)
    mutual = np.flatnonzero(pair.mutual)
    assert 32 < len(mutual) < 300
    (result,) = pruner_of(mutual_network, operating_point=point)([pair])
    # The other network sees the same numbers in the same shape, so it says the same, bit by bit.
    (alone,) = pruner_of(network, operating_point=point)([rows_of(pair, mutual)])
    np.testing.assert_array_equal(result.scores[mutual], alone.scores)
    np.testing.assert_array_equal(result.model.matrix, alone.model.matrix)
    np.testing.assert_array_equal(result.inlier_mask[mutual], alone.inlier_mask)
    assert not result.scores[~pair.mutual].any() and not result.inlier_mask[~pair.mutual].any()
    # Candidates are counted among the mutual ones; those left over are judged by the matrix.
    (bounded,) = pruner_of(mutual_network, max_candidates=len(mutual) - 1)([pair])
    assert not bounded.scores[~pair.mutual].any()


def test_a_pair_without_mutual_matches_keeps_nothing(mutual_network):
    pair = dataclasses.replace(make(num=60), mutual=np.zeros(60, bool))
    for result in pruner_of(mutual_network)([make(num=60), pair, make(num=0)])[1:]:
        assert result.model is None and not result.scores.any() and not result.inlier_mask.any()


def test_points_without_mutual_flags_are_refused_by_a_network_that_reads_those_only(network, mutual_network):
    pair = dataclasses.replace(make(), mutual_known=False)
    pruner_of(network)([pair])
    with pytest.raises(InputError, match="mutual="):
        pruner_of(mutual_network)([pair])


def test_usage_is_part_of_the_fingerprint(network, mutual_network):
    fingerprints = {pruner_of(each).fingerprint for each in (network, mutual_network)}
    assert len(fingerprints) == 2 and any("input=mutual" in each for each in fingerprints)


@pytest.mark.parametrize("num", [0, 1, 8, 10, 40])
@pytest.mark.parametrize("case", ["plain", "one point", "line", "no motion", "not finite", "huge"])
def test_degenerate_matches_give_finite_scores(network, num, case):
    pair = make(num=num)
    normalised = pair.normalised.copy()
    if case == "one point":
        normalised[:] = 0.25
    elif case == "line":
        normalised[:, 1] = normalised[:, 3] = 0
    elif case == "no motion":
        normalised[:, 2:] = normalised[:, :2]
    elif case == "not finite":
        normalised[::2] = np.nan
        normalised[1::2, 2] = np.inf
    elif case == "huge":
        normalised *= np.float32(1e30)
    pair = dataclasses.replace(pair, normalised=normalised)
    (result,) = pruner_of(network)([pair])
    assert len(result) == num
    assert np.isfinite(result.scores).all()
    assert ((result.scores >= 0) & (result.scores <= 1)).all()
    assert result.model is None or np.isfinite(result.model.matrix).all()
    assert not np.isnan(result.residuals).any() or result.model is None


def test_mutual_matches_alone_are_what_a_network_of_mutual_matches_expects(network, mutual_network, caplog):
    pair = dataclasses.replace(make(num=100, inlier_ratio=0.3), mutual=np.ones(100, bool))
    with caplog.at_level(logging.WARNING):
        pruner_of(mutual_network)([pair])
        assert caplog.text == ""
        pruner_of(network)([pair])
    assert "trained on all nearest neighbours" in caplog.text


def test_filtered_matches_are_warned_about_once(network, caplog):
    filtered = dataclasses.replace(make(num=100), ratios=np.full(100, 0.5, np.float32), name="a – b")
    pruner = pruner_of(network)
    with caplog.at_level(logging.WARNING):
        pruner([make(num=100, inlier_ratio=0.3)])
        # Two copies of one photo match perfectly, which says nothing about how they were matched.
        pruner([dataclasses.replace(filtered, points1=filtered.points0)])
        assert caplog.text == ""
        pruner([filtered])
        pruner([filtered])
    assert len(caplog.records) == 1
    assert "a – b" in caplog.text and "loransac" in caplog.text


def test_bfloat16_stays_close_to_float32(network):
    pairs = [make(seed, 150) for seed in range(2)]
    for exact, rounded in zip(
        pruner_of(network)(pairs), pruner_of(network, precision=Precision.BFLOAT16)(pairs), strict=True
    ):
        # The median: where two logits almost tie, rounding decides who reaches the next round.
        assert np.median(np.abs(exact.scores - rounded.scores)) < 0.02


def test_auto_precision_never_chooses_emulation(monkeypatch):
    device = torch.device("cpu")
    for question in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"):
        monkeypatch.setattr(torch.cpu, question, lambda: False, raising=False)
    assert choose_precision(Precision.AUTO, device, 128) is torch.float32
    assert choose_precision(Precision.BFLOAT16, device, 128) is torch.bfloat16
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    assert choose_precision(Precision.AUTO, device, 128) is torch.bfloat16
    assert choose_precision(Precision.AUTO, device, 32) is torch.float32


def test_checkpoint_is_loaded_by_the_builder_and_named_in_the_fingerprint(network, tmp_path):
    path = tmp_path / "small.pt"
    digest = save_network(network, path)
    config = PruneConfig(method=PruneMethod.CORRADAPTOR, model=path, precision=Precision.FLOAT32)
    pruner = build_pruner(config, device="cpu")
    assert pruner.name == "corradaptor"
    assert digest in pruner.fingerprint
    pairs = [make(seed) for seed in range(2)]
    # A pair at a time, as the builder's pruner does on a CPU: the same operations, the same bits.
    assert_equal_results(pruner(pairs), pruner_of(network, batched=False)(pairs))


def test_missing_checkpoint_is_an_error_that_names_it(tmp_path):
    with pytest.raises(CheckpointError, match="nowhere.pt"):
        Pruner.load(tmp_path / "nowhere.pt", device="cpu")


def test_a_checkpoint_of_another_network_is_refused_by_name(tmp_path: Path) -> None:
    rival = build_rival(RivalConfig(architecture="oanet", channels=8, clusters=4))
    save_network(rival, tmp_path / "rival.pt")
    with pytest.raises(CheckpointError, match="oanet"):
        Pruner.load(tmp_path / "rival.pt", device="cpu")
