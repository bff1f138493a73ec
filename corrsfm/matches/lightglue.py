"""Putative matches by LightGlue (Lindenberger et al., ICCV 2023): keypoints and descriptors of both photos.

It keeps what it takes for right, each with its confidence; there is no ratio and nothing that is not mutual.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from corrsfm.config import FeatureKind
from corrsfm.model.lightglue import load_package
from corrsfm.types import Features, Matches

__all__ = ["LightGlueMatcher"]

HALF_PIXEL = 0.5


class LightGlueMatcher:
    """Matches pairs of a scene; threads may share it.

    Parameters
    ----------
    load : callable
        Image name → `Features`.
    kind : FeatureKind
        What they are; the package has weights for `corrsfm.config.LIGHTGLUE_KINDS`.
    device : str
        A torch device.

    Raises
    ------
    DependencyError
        If LightGlue is not installed.
    """

    def __init__(self, load: Callable[[str], Features], kind: FeatureKind, *, device: str = "cpu") -> None:
        network = load_package("--matcher lightglue").LightGlue(features=str(kind))
        self._network = network.eval().to(device)
        self._load = load
        self._device = device
        # HDF5 reads one thing at a time.
        self._lock = threading.Lock()

    def match(self, name0: str, name1: str) -> Matches:
        """Matches of a pair of images."""
        with self._lock:
            pair = self._load(name0), self._load(name1)
        if not all(len(features) for features in pair):
            return _matches(np.zeros((0, 2), np.int32), np.zeros(0, np.float32))
        with torch.inference_mode():
            found = self._network(
                {f"image{side}": self._tensors(features) for side, features in enumerate(pair)}
            )
        indices = found["matches"][0].cpu().numpy().astype(np.int32)
        scores = found["scores"][0].cpu().numpy().astype(np.float32)
        order = np.argsort(indices[:, 0], kind="stable")
        return _matches(indices[order], scores[order])

    def _tensors(self, features: Features) -> dict[str, Any]:
        """A photo as the network reads it: its first pixel's centre is (0, 0)."""

        def tensor(values: Any) -> torch.Tensor:
            return torch.from_numpy(np.asarray(values, np.float32))[None].to(self._device)

        return {
            "keypoints": tensor(features.keypoints - HALF_PIXEL),
            "descriptors": tensor(features.descriptors),
            "image_size": tensor(features.image_size),
        }


def _matches(indices: np.ndarray, scores: np.ndarray) -> Matches:
    return Matches(
        indices=indices,
        ratios=np.full(len(indices), np.nan, np.float32),
        mutual=np.ones(len(indices), np.bool_),
        scores=scores,
    )
