"""How good a network is as a filter before a robust estimator, on pairs it was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.errors import DependencyError
from corrsfm.evaluation.metrics import pose_auc, precision_recall_f
from corrsfm.geometry import pose_error_deg
from corrsfm.labelled.compact import read_labelled_pairs
from corrsfm.labelled.oanet import OANetPair
from corrsfm.model import CorrAdaptor
from corrsfm.prune.correspondences import side_information

__all__ = ["Validation", "match_scores", "pose_error_after_loransac"]

_MIN_MATCHES = 5


def match_scores(network: CorrAdaptor, pair: OANetPair, device: torch.device) -> NDArray[np.float32]:
    """Probability (M,) that each match is right, by the last set of logits that judged it."""
    side = side_information(pair.as_correspondences(), network.side_channels)
    with torch.inference_mode():
        output = network(
            torch.from_numpy(pair.correspondences)[None].to(device),
            torch.from_numpy(side)[None].to(device) if network.side_channels else None,
        )
    return output.last_logits()[0].sigmoid().cpu().numpy()


def pose_error_after_loransac(pair: OANetPair, kept: NDArray, max_error_px: float = 1.0) -> float:
    """Larger of rotation and translation error in degrees of PoseLib's LO-RANSAC on the kept matches.

    Parameters
    ----------
    pair : OANetPair
    kept : (K,) int or (M,) bool
        Matches that are handed to the estimator.
    max_error_px : float

    Returns
    -------
    float
        Infinite if there is no pose.
    """
    try:
        import poselib
    except ImportError as error:
        raise DependencyError("poselib", "validation behind LO-RANSAC", "evaluate") from error
    matches = pair.as_correspondences()
    points0, points1 = matches.points0[kept], matches.points1[kept]
    if len(points0) < _MIN_MATCHES:
        return float("inf")
    cameras = [
        {"model": camera.model, "width": camera.width, "height": camera.height, "params": list(camera.params)}
        for camera in (pair.camera0, pair.camera1)
    ]
    pose, _ = poselib.estimate_relative_pose(
        points0.astype(np.float64), points1.astype(np.float64), *cameras, {"max_epipolar_error": max_error_px}
    )
    largest = max(pose_error_deg(pose.R, pose.t, pair.rotation, pair.translation))
    return largest if np.isfinite(largest) else float("inf")


class Validation:
    """A fixed subset of validation pairs and the score of the classical filter on it.

    Parameters
    ----------
    path : Path
        Compact file of the validation scenes.
    pairs_per_scene : int
    seed : int
    """

    def __init__(self, path: Path, pairs_per_scene: int, seed: int = 0) -> None:
        self.pairs = list(read_labelled_pairs(path, num_per_scene=pairs_per_scene, seed=seed))
        self.baseline = self._summary(
            [pose_error_after_loransac(pair, pair.mutual & (pair.ratios < 0.8)) for pair in self.pairs]
        )

    def run(self, network: CorrAdaptor, device: torch.device, threshold: float = 0.5) -> dict[str, Any]:
        """Scores of a network: pose AUC over all pairs and by scene, precision, recall."""
        network.eval()
        scores = [match_scores(network, pair, device) for pair in self.pairs]
        return self.judge(scores, lambda score: score > threshold)

    def judge(
        self, scores: Sequence[NDArray[np.float32]], keep: Callable[[NDArray[np.float32]], NDArray]
    ) -> dict[str, Any]:
        """Scores of a rule that turns match scores into kept matches."""
        errors, quality = [], []
        for pair, score in zip(self.pairs, scores, strict=True):
            kept = keep(score)
            errors.append(pose_error_after_loransac(pair, kept))
            quality.append(precision_recall_f(kept, pair.inliers()))
        result = self._summary(errors)
        result["precision"], result["recall"], result["f"] = (float(v) for v in np.nanmean(quality, axis=0))
        return result

    def _summary(self, errors: Sequence[float]) -> dict[str, Any]:
        auc5, auc10, auc20 = pose_auc(errors)
        scenes = np.array([pair.scene for pair in self.pairs])
        by_scene = {
            str(scene): pose_auc(np.asarray(errors)[scenes == scene])[0] for scene in np.unique(scenes)
        }
        return {"auc5": auc5, "auc10": auc10, "auc20": auc20, "by_scene": by_scene, "errors": list(errors)}
