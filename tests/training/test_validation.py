"""Validation measures what `corrsfm evaluate pose` measures, with the same filter and estimator."""

import numpy as np
import pytest
import torch
from labelled_scene import make_scene

from corrsfm.config import MatchInput, NetworkUsage
from corrsfm.evaluation.two_view.methods import parse_method
from corrsfm.evaluation.two_view.pose import score_pairs
from corrsfm.labelled.compact import write_scenes
from corrsfm.model import CorrAdaptor, NetworkConfig
from corrsfm.training.validation import Validation, match_scores

NETWORK = NetworkConfig(
    channels=8, clusters=4, heads=2, mlp_ratio=1, oa_filters=1, motion_stacking=1, fusion_rounds=1,
    neighbors=(3, 3), side_channels=5,
)  # fmt: skip


@pytest.fixture(scope="module")
def validation(tmp_path_factory: pytest.TempPathFactory) -> Validation:
    path = tmp_path_factory.mktemp("validation") / "pairs.h5"
    write_scenes(path, [make_scene("a"), make_scene("b", seed=1)])
    return Validation(path, pairs_per_scene=3)


def test_errors_are_those_of_the_evaluation(validation: Validation) -> None:
    assert len(validation.pairs) == 6
    (baseline,) = score_pairs([parse_method("ratio0.8+mutual/poselib")], validation.pairs)
    assert validation.baseline["errors"] == list(baseline.pose_error_deg)
    inliers = [pair.inliers().astype(np.float32) for pair in validation.pairs]
    judged = validation.judge(inliers, lambda score: score > 0.5)
    (oracle,) = score_pairs([parse_method("oracle/poselib")], validation.pairs)
    assert judged["errors"] == list(oracle.pose_error_deg)
    assert (judged["precision"], judged["recall"], judged["f"]) == (100.0, 100.0, 100.0)
    assert list(judged["by_scene"]) == ["a", "b"]


def test_every_match_gets_a_probability(validation: Validation) -> None:
    torch.manual_seed(0)
    network = CorrAdaptor.from_config(NETWORK).eval()
    scores = match_scores(network, validation.pairs[0], torch.device("cpu"))
    assert scores.shape == (len(validation.pairs[0]),)
    assert ((scores > 0) & (scores < 1)).all()
    network.usage = NetworkUsage(input=MatchInput.MUTUAL)
    scores = match_scores(network, validation.pairs[0], torch.device("cpu"))
    np.testing.assert_array_equal(scores > 0, validation.pairs[0].mutual)
    result = validation.run(network, torch.device("cpu"))
    assert len(result["errors"]) == 6 and set(result["by_scene"]) == {"a", "b"}
