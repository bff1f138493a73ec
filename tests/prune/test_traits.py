"""Which method fits which matches: told before any work, and again where the matches are."""

import logging
from pathlib import Path

import numpy as np
import pytest

from corrsfm.config import FeatureKind, MatchTraits, PruneConfig, PruneMethod
from corrsfm.errors import CheckpointError, ConfigError, InputError
from corrsfm.model import CorrAdaptor, NetworkConfig, save_network
from corrsfm.prune import build_pruner, make_correspondences
from corrsfm.prune.learned import Pruner
from corrsfm.types import Camera, Correspondences, Features, Matches

CAMERA = Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=(500.0, 320.0, 240.0))
ALIKED = MatchTraits(features=FeatureKind.ALIKED, has_shapes=False)
NO_RATIOS = MatchTraits(features=FeatureKind.ALIKED, has_shapes=False, has_ratios=False)


def network(side_channels: int) -> CorrAdaptor:
    return CorrAdaptor.from_config(
        NetworkConfig(channels=8, clusters=4, neighbors=(6, 3), heads=2, side_channels=side_channels)
    )


def checkpoint(folder: Path, side_channels: int) -> Path:
    path = folder / f"{side_channels}.pt"
    save_network(network(side_channels), path)
    return path


def pair(*, with_scores: bool = False, num: int = 50) -> Correspondences:
    rng = np.random.default_rng(0)
    features = Features(
        keypoints=rng.uniform(0, 480, (num, 2)).astype(np.float32), scales=None, orientations=None,
        scores=np.ones(num, np.float32), descriptors=np.zeros((num, 8), np.float32), image_size=(640, 480),
    )  # fmt: skip
    matches = Matches(
        indices=np.column_stack([np.arange(num)] * 2).astype(np.int32),
        ratios=np.full(num, np.nan if with_scores else 0.95, np.float32),
        mutual=np.ones(num, bool),
        scores=np.linspace(0, 1, num, dtype=np.float32) if with_scores else None,
    )
    return make_correspondences(features, features, matches, CAMERA, CAMERA, "a – b")


def test_features_without_scale_have_no_scale_ratios() -> None:
    correspondences = pair()
    assert not correspondences.shapes_known
    assert np.isnan(correspondences.log_scale_ratios).all() and np.isnan(correspondences.rotations).all()


@pytest.mark.parametrize(
    ("channels", "traits", "missing"),
    [
        (5, ALIKED, "scale and orientation of keypoints"),
        (5, NO_RATIOS, "the ratio of descriptor distances"),
        (2, NO_RATIOS, "the ratio of descriptor distances"),
        (2, ALIKED, ""),
        (0, NO_RATIOS, ""),
    ],
)
def test_a_network_that_reads_what_is_missing_is_refused(
    tmp_path: Path, channels: int, traits: MatchTraits, missing: str
) -> None:
    config = PruneConfig(model=checkpoint(tmp_path, channels))
    if not missing:
        build_pruner(config, traits=traits, device="cpu", threads=1)
        return
    with pytest.raises(
        CheckpointError, match=rf"{channels}\.pt: this network reads {missing}.*--method loransac"
    ):
        build_pruner(config, traits=traits, device="cpu", threads=1)


def test_a_network_of_other_features_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "corrsfm"):
        build_pruner(PruneConfig(model=checkpoint(tmp_path, 2)), traits=ALIKED, device="cpu", threads=1)
    assert "trained on matches of sift, these are of aliked" in caplog.text


def test_a_pair_that_lacks_what_the_network_reads_is_named() -> None:
    with pytest.raises(InputError, match="a – b: this network reads scale and orientation"):
        Pruner(network(5), device="cpu", threads=1)([pair()])
    with pytest.raises(InputError, match="a – b: this network reads the ratio"):
        Pruner(network(2), device="cpu", threads=1)([pair(with_scores=True)])
    assert len(Pruner(network(2), device="cpu", threads=1)([pair()])[0]) == 50


@pytest.mark.parametrize("method", [PruneMethod.RATIO, PruneMethod.CASCADE])
def test_the_ratio_test_without_ratios_is_refused(method: PruneMethod) -> None:
    with pytest.raises(ConfigError, match="no ratio of descriptor distances; use --method none"):
        build_pruner(PruneConfig(method=method), traits=NO_RATIOS, device="cpu", threads=1)


def test_without_ratios_the_scores_of_the_matcher_are_kept() -> None:
    (result,) = build_pruner(PruneConfig(method=PruneMethod.NONE), traits=NO_RATIOS)([pair(with_scores=True)])
    np.testing.assert_allclose(result.scores, np.linspace(0, 1, 50), atol=1e-6)
    assert result.inlier_mask.all()


def test_robust_estimators_take_all_mutual_matches_without_ratios() -> None:
    config = PruneConfig(method=PruneMethod.LORANSAC)
    (result,) = build_pruner(config, traits=NO_RATIOS, threads=1)([pair(with_scores=True)])
    # Two copies of one photo agree with each other.
    assert result.inlier_mask.all()
