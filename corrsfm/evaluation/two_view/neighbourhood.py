"""Filters that judge a match by the matches around it, from libraries: GMS and AdaLAM.

Rivals of a learned filter that need no training. Both take the nearest neighbour of every keypoint, as the
network does.

GMS: Bian et al., GMS: Grid-based Motion Statistics for Fast, Ultra-robust Feature Correspondence, CVPR 2017.
AdaLAM: Cavalli et al., Handcrafted Outlier Detection Revisited, ECCV 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import DependencyError
from corrsfm.evaluation.two_view.filters import result_of_filter
from corrsfm.labelled.oanet import OANetPair
from corrsfm.types import Correspondences, PruneResult

__all__ = ["AdalamFilter", "GmsFilter"]

# AdaLAM needs neighbours to fit local affine maps to; its code fails on a handful of matches.
_FEWEST_MATCHES = 16
# Both packages contain the module cv2, so only one can be installed.
_OPENCV = "opencv-python-headless"


def _finite(pair: Correspondences) -> NDArray[np.intp]:
    return np.flatnonzero(np.isfinite(pair.points0).all(axis=1) & np.isfinite(pair.points1).all(axis=1))


class GmsFilter:
    """Keeps matches whose grid cell sends enough others to the same place; OpenCV's contributed modules.

    Searches over rotations and changes of scale, as wide baselines need.

    Raises
    ------
    DependencyError
        If OpenCV was built without its contributed modules.
    """

    name = "gms"
    fingerprint = f"gms rotation scale, opencv {cv2.__version__}"

    def __init__(self) -> None:
        if not hasattr(getattr(cv2, "xfeatures2d", None), "matchGMS"):
            raise DependencyError("opencv-contrib-python-headless", f"{self.name}, instead of {_OPENCV},")

    def __call__(self, pairs: Sequence[OANetPair]) -> list[PruneResult]:
        """Filter pairs; see `corrsfm.evaluation.two_view.filters.PairFilter`."""
        return [result_of_filter(self.name, self._keep(pair.as_correspondences())) for pair in pairs]

    def _keep(self, pair: Correspondences) -> NDArray[np.bool_]:
        keep = np.zeros(len(pair), bool)
        rows = _finite(pair)
        if not len(rows):
            return keep
        sizes = [(camera.width, camera.height) for camera in (pair.camera0, pair.camera1)]
        keypoints = [
            # GMS does not check its grid indices: a point beyond the border would crash it.
            [cv2.KeyPoint(float(x), float(y), 1.0) for x, y in np.clip(points[rows], 0, np.array(size) - 1)]
            for points, size in zip((pair.points0, pair.points1), sizes, strict=True)
        ]
        matches = [cv2.DMatch(index, index, 0.0) for index in range(len(rows))]
        kept = vars(cv2)["xfeatures2d"].matchGMS(
            *sizes, *keypoints, matches, withRotation=True, withScale=True
        )
        keep[rows[[match.queryIdx for match in kept]]] = True
        return keep


@dataclass(frozen=True, kw_only=True)
class AdalamFilter:
    """Keeps matches that agree with an affine map of the region around a distinctive one; kornia.

    Raises
    ------
    DependencyError
        If kornia is not installed.
    """

    seed: int = 0
    name: str = "adalam"

    def __post_init__(self) -> None:
        self._library()

    @property
    def fingerprint(self) -> str:
        return f"adalam, kornia {self._library().__version__}, seed={self.seed}"

    @staticmethod
    def _library() -> ModuleType:
        try:
            import kornia
        except ImportError as error:
            raise DependencyError("kornia", "AdaLAM", "evaluate") from error
        return kornia

    def __call__(self, pairs: Sequence[OANetPair]) -> list[PruneResult]:
        """Filter pairs; see `corrsfm.evaluation.two_view.filters.PairFilter`."""
        return [result_of_filter(self.name, self._keep(pair.as_correspondences())) for pair in pairs]

    def _keep(self, pair: Correspondences) -> NDArray[np.bool_]:
        import torch
        from kornia.feature import adalam

        keep = np.zeros(len(pair), bool)
        rows = _finite(pair)
        if len(rows) < _FEWEST_MATCHES:
            return keep

        def tensor(values: NDArray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(values[rows], np.float32))

        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(self.seed)
            kept = adalam.AdalamFilter(adalam.get_adalam_default_config()).filter_matches(
                k1=tensor(pair.points0),
                k2=tensor(pair.points1),
                putative_matches=torch.arange(len(rows)),
                scores=tensor(pair.ratios).square(),  # ratios of squared distances
                mnn=torch.from_numpy(pair.mutual[rows]),
                im1shape=(pair.camera0.width, pair.camera0.height),
                im2shape=(pair.camera1.width, pair.camera1.height),
                # Only differences of angle and ratios of scale count, and those are known.
                o1=torch.zeros(len(rows)),
                o2=torch.rad2deg(tensor(pair.rotations)),
                s1=torch.ones(len(rows)),
                s2=tensor(pair.log_scale_ratios).exp(),
            )
        keep[rows[cast(torch.Tensor, kept)[:, 0].numpy()]] = True
        return keep
