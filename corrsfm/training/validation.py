"""How well a network filters matches for a robust estimator, on pairs that it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.evaluation.metrics import pose_auc, precision_recall_f
from corrsfm.evaluation.two_view.estimators import parse_estimator, pose_errors_deg
from corrsfm.evaluation.two_view.filters import parse_filter
from corrsfm.labelled.compact import read_labelled_pairs
from corrsfm.labelled.oanet import OANetPair
from corrsfm.model import CorrAdaptor, Rival
from corrsfm.prune.correspondences import side_information
from corrsfm.prune.selection import select_candidates
from corrsfm.types import PruneResult

__all__ = ["Validation", "match_scores", "pose_error_deg"]

BASELINE = "ratio0.8+mutual"
"""The classical filter that networks are compared with."""

_ESTIMATE = parse_estimator("poselib")
_SEED = 0


def match_scores(network: CorrAdaptor | Rival, pair: OANetPair, device: torch.device) -> NDArray[np.float32]:
    """Probability (M,) that each match is an inlier, by its last logit; 0 for those not read."""
    seen = pair.as_correspondences()
    rows = select_candidates(seen, len(pair), network.usage.input)
    scores = np.zeros(len(pair), np.float32)
    if not len(rows):
        return scores
    side = side_information(seen, network.side_channels)[rows]
    with torch.inference_mode():
        output = network(
            torch.from_numpy(pair.correspondences[rows])[None].to(device),
            torch.from_numpy(side)[None].to(device) if network.side_channels else None,
        )
    scores[rows] = output.last_logits()[0].sigmoid().cpu().numpy()
    return scores


def pose_error_deg(pair: OANetPair, kept: NDArray[np.bool_]) -> float:
    """Larger of rotation and translation error in degrees, by the estimator of `corrsfm evaluate pose`.

    Parameters
    ----------
    pair : OANetPair
    kept : (M,) bool
        Matches that the estimator gets.

    Returns
    -------
    float
        Infinite if there is no pose.
    """
    result = PruneResult(scores=kept.astype(np.float32), inlier_mask=kept)
    return max(pose_errors_deg(_ESTIMATE(pair.as_correspondences(), result, _SEED), pair))


class Validation:
    """A fixed subset of validation pairs, and the score of the classical filter on it.

    Parameters
    ----------
    path : Path
        Compact file of the validation scenes.
    pairs_per_scene : int
    seed : int
    """

    def __init__(self, path: Path, pairs_per_scene: int, seed: int = 0) -> None:
        self.pairs = list(read_labelled_pairs(path, num_per_scene=pairs_per_scene, seed=seed))
        kept = [result.inlier_mask for result in parse_filter(BASELINE)(self.pairs)]
        self.baseline = self._summary(list(map(pose_error_deg, self.pairs, kept)))

    def run(self, network: CorrAdaptor | Rival, device: torch.device) -> dict[str, Any]:
        """Score a network at its ``pose_min_score``: pose AUC overall and by scene, precision, recall."""
        network.eval()
        threshold = network.usage.pose_min_score
        scores = [match_scores(network, pair, device) for pair in self.pairs]
        return self.judge(scores, lambda score: score > threshold)

    def judge(
        self, scores: Sequence[NDArray[np.float32]], keep: Callable[[NDArray[np.float32]], NDArray]
    ) -> dict[str, Any]:
        """Score a rule that turns match scores into kept matches."""
        errors, quality = [], []
        for pair, score in zip(self.pairs, scores, strict=True):
            kept = keep(score)
            errors.append(pose_error_deg(pair, kept))
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
