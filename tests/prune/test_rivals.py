"""Rival networks as prune methods: scores for all matches, batches like single pairs, clear refusals."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from rival_weights import drawn_rival
from two_view_pairs import make_pair

from corrsfm.config import (
    FeatureKind,
    MatchInput,
    MatchTraits,
    NetworkUsage,
    OperatingPoint,
    Precision,
    PruneConfig,
    PruneMethod,
)
from corrsfm.errors import CheckpointError, ConfigError
from corrsfm.evaluation.two_view.filters import parse_prune_method
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.model.rivals import ARCHITECTURES, RivalConfig, build_rival
from corrsfm.model.weights import REGISTRY, load_network, save_network
from corrsfm.prune import Pruner, build_pruner, checkpoint_sha256
from corrsfm.prune.correspondences import SIDE_LAYOUTS

PRUNING = {"clnet", "ncmnet", "mgnet"}


def make(seed: int, num: int):
    return make_pair(seed=seed, num=num, inlier_ratio=0.6, noise_px=0.3).as_correspondences()


def pruner_of(network, **options) -> Pruner:
    """A pruner whose network computes in float64: what it chooses at a near-tie hangs on no processor."""
    pruner = Pruner(network, device="cpu", threads=1, precision=Precision.FLOAT32, **options)
    exact = network.double()
    pruner._network = lambda matches, side, mask: exact(matches.double(), None, mask)
    return pruner


def test_the_prune_methods_are_the_networks_that_there_are():
    rivals = {method.architecture for method in PruneMethod} - {None, "corradaptor"}
    assert rivals == set(ARCHITECTURES)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_pairs_of_any_size_get_scores_that_do_not_depend_on_their_batch(architecture):
    pairs = [make(seed, num) for seed, num in enumerate([60, 0, 90, 3, 1])]
    network = drawn_rival(architecture, "")
    together = pruner_of(network, batched=True, operating_point=OperatingPoint.POSE)(pairs)
    alone = pruner_of(network, batched=False, operating_point=OperatingPoint.POSE)(pairs)
    for pair, result, other in zip(pairs, together, alone, strict=True):
        assert result.scores.shape == (len(pair),) == result.inlier_mask.shape
        assert np.isfinite(result.scores).all() and result.decided_by == architecture
        # Fewer than eight matches leave the matrix open that a second block looks at.
        if len(pair) >= 8:
            np.testing.assert_allclose(result.scores, other.scores, atol=1e-6)
        threshold = network.usage.pose_min_score
        np.testing.assert_array_equal(result.inlier_mask, result.scores > threshold)
    assert together[0].model is not None and together[3].model is None


@pytest.mark.parametrize("architecture", sorted(PRUNING))
def test_a_network_that_prunes_judges_every_match_by_its_matrix(architecture):
    pair = make(7, 80)
    result = pruner_of(drawn_rival(architecture, ""), operating_point=OperatingPoint.POSE)([pair])[0]
    clear = np.abs(np.log(result.residuals / INLIER_THRESHOLD)) > 1e-3
    found = result.inlier_mask[clear]
    np.testing.assert_array_equal(found, result.residuals[clear] < INLIER_THRESHOLD)


def test_matches_beyond_those_read_are_scored_too():
    pruner = pruner_of(drawn_rival("oanet", ""), max_candidates=40)
    result = pruner([make(3, 100)])[0]
    assert result.scores.shape == (100,) and np.isfinite(result.scores).all()


def test_a_checkpoint_keeps_what_a_rival_reads_and_how_strict_it_is(tmp_path):
    network = build_rival(RivalConfig(architecture="clnet", channels=8, side_channels=2))
    network.usage = NetworkUsage(input=MatchInput.MUTUAL, pose_min_score=0.25)
    save_network(network, tmp_path / "clnet.pt")
    assert load_network(tmp_path / "clnet.pt").usage == network.usage
    config = PruneConfig(method=PruneMethod.CLNET, model=tmp_path / "clnet.pt")
    pruner = build_pruner(config, device="cpu", threads=1)
    assert pruner.name == "clnet" and "pose_min_score=0.25" in pruner.fingerprint
    assert checkpoint_sha256(config) in pruner.fingerprint
    assert len(pruner([make(1, 50)])[0].scores) == 50
    # The file of a rival that says nothing has the published threshold.
    torch.save(
        {"state_dict": build_rival(RivalConfig(architecture="lmcnet")).state_dict()}, tmp_path / "l.pth"
    )
    assert load_network(tmp_path / "l.pth").usage.pose_min_score == 0.95


def test_oanet_comes_with_weights():
    pruner = build_pruner(PruneConfig(method=PruneMethod.OANET), device="cpu")
    assert pruner.name == "oanet"
    config = PruneConfig(method=PruneMethod.OANET)
    assert checkpoint_sha256(config) == REGISTRY["small-oanet"].sha256
    named = dataclasses.replace(config, model=Path("small-oanet"))
    assert build_pruner(named, device="cpu").fingerprint == pruner.fingerprint
    lacking = MatchTraits(features=FeatureKind.ALIKED, has_shapes=False)
    with pytest.raises(CheckpointError, match=r"small-oanet: this network reads .*; use --method loransac$"):
        build_pruner(config, traits=lacking, device="cpu")


def test_what_does_not_fit_is_refused_before_any_work(tmp_path):
    with pytest.raises(ConfigError, match="--method clnet: no weights of this network come with corrsfm"):
        build_pruner(PruneConfig(method=PruneMethod.CLNET), device="cpu")
    save_network(build_rival(RivalConfig(architecture="oanet", channels=8, clusters=4)), tmp_path / "o.pt")
    with pytest.raises(CheckpointError, match="oanet, expected clnet; --method oanet reads it"):
        build_pruner(PruneConfig(method=PruneMethod.CLNET, model=tmp_path / "o.pt"), device="cpu")
    assert 3 not in SIDE_LAYOUTS
    save_network(
        build_rival(RivalConfig(architecture="clnet", channels=8, side_channels=3)), tmp_path / "s.pt"
    )
    with pytest.raises(CheckpointError, match="reads 3 side channels"):
        build_pruner(PruneConfig(method=PruneMethod.CLNET, model=tmp_path / "s.pt"), device="cpu")


def test_methods_to_compare_name_the_network_and_its_file():
    config = parse_prune_method("ms2dgnet@pose:weights/ms.pth", PruneConfig())
    assert config.method is PruneMethod.MS2DGNET and str(config.model) == "weights/ms.pth"
    assert config.operating_point is OperatingPoint.POSE
    with pytest.raises(ConfigError, match="'ratio:x.pt': ratio reads no checkpoint; leave it out"):
        parse_prune_method("ratio:x.pt", PruneConfig())
