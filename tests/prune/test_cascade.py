import numpy as np
import pytest
from two_view_pairs import make_pair

from corrsfm.config import PruneConfig, PruneMethod
from corrsfm.prune import build_pruner, checkpoint_sha256
from corrsfm.prune.cascade import ENOUGH, TOO_FEW, CascadePruner
from corrsfm.prune.classical import RatioPruner
from corrsfm.types import Correspondences, PruneResult


class Recorder:
    """A network that keeps every third match and remembers the pairs it was asked about."""

    def __init__(self):
        self.asked = []

    def __call__(self, pairs):
        self.asked.append([pair.name for pair in pairs])
        masks = [np.arange(len(pair)) % 3 == 0 for pair in pairs]
        return [
            PruneResult(scores=mask.astype(np.float32), inlier_mask=mask, decided_by="corradaptor")
            for mask in masks
        ]


def cascade(network) -> CascadePruner:
    return CascadePruner(network, network_fingerprint="n", max_ratio=0.8)


def pair_with(num_passing: int) -> Correspondences:
    """A pair of 300 matches of which the first so many pass the ratio test and are mutual."""
    index = np.arange(300)
    pair = make_pair(seed=0, num=300, inlier_ratio=0.5).as_correspondences()
    ratios = np.where(index < num_passing, 0.8, 0.81).astype(np.float32)
    return Correspondences(
        **{**vars(pair), "ratios": ratios, "mutual": np.ones(300, bool), "name": str(num_passing)}
    )


def test_network_is_asked_only_where_ratio_matches_are_neither_enough_nor_too_few():
    network = Recorder()
    pairs = [pair_with(num) for num in (0, TOO_FEW - 1, TOO_FEW, ENOUGH - 1, ENOUGH, 300)]
    results = cascade(network)(pairs)
    assert network.asked == [[str(TOO_FEW), str(ENOUGH - 1)]]
    assert [result.decided_by for result in results] == [
        "ratio", "ratio", "network", "network", "ratio", "ratio",
    ]  # fmt: skip
    assert [result.inlier_mask.sum() for result in results] == [0, TOO_FEW - 1, 100, 100, ENOUGH, 300]


def test_what_the_ratio_test_decides_is_the_ratio_methods_result():
    pairs = [pair_with(3), pair_with(200)]
    for result, expected in zip(cascade(Recorder())(pairs), RatioPruner(0.8)(pairs), strict=True):
        np.testing.assert_array_equal(result.inlier_mask, expected.inlier_mask)
        np.testing.assert_array_equal(result.scores, expected.scores)


def test_network_is_not_called_for_nothing():
    network = Recorder()
    cascade(network)([pair_with(0), pair_with(300)])
    assert network.asked == []


def test_fingerprint_names_the_network_and_the_ratio():
    pruner = build_pruner(PruneConfig(method=PruneMethod.CASCADE, max_ratio=0.75), device="cpu")
    network = build_pruner(PruneConfig(method=PruneMethod.CORRADAPTOR), device="cpu")
    assert network.fingerprint in pruner.fingerprint
    assert "max_ratio=0.75" in pruner.fingerprint


@pytest.mark.parametrize("method", ["none", "ratio", "loransac", "magsac"])
def test_classical_methods_have_no_checkpoint(method):
    assert checkpoint_sha256(PruneConfig(method=PruneMethod(method))) is None
