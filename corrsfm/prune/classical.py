"""Prune methods without a network: none, ratio, loransac, magsac."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from corrsfm.prune import robust
from corrsfm.prune.correspondences import confidence
from corrsfm.types import Correspondences, PruneResult

__all__ = ["EstimatorPruner", "KeepAll", "RatioPruner", "select_ratio"]


def select_ratio(pair: Correspondences, max_ratio: float) -> NDArray[np.bool_]:
    """Matches that pass the ratio test and are mutual; without ratios those that are mutual.

    Parameters
    ----------
    pair : Correspondences
    max_ratio : float
        Largest ratio that passes.

    Returns
    -------
    (M,) bool
    """
    return pair.mutual & (np.isnan(pair.ratios) | (pair.ratios <= max_ratio))


def _result_from_estimate(
    pair: Correspondences,
    candidates: NDArray[np.bool_],
    estimate: robust.TwoViewEstimate,
    max_error_px: float,
    decided_by: str,
) -> PruneResult:
    """Turn a robust estimate into a prune result.

    Parameters
    ----------
    pair : Correspondences
    candidates : (M,) bool
        Matches that took part in the estimation; others score 0.
    estimate : TwoViewEstimate
    max_error_px : float
        Error in pixels at which the score reaches 0.
    decided_by : str

    Returns
    -------
    PruneResult
        Scores are the MSAC terms: 1 on the epipolar line, 0 from ``max_error_px`` on.
    """
    if estimate.model is None:
        return PruneResult(
            scores=np.zeros(len(pair), np.float32),
            inlier_mask=np.zeros(len(pair), bool),
            decided_by=decided_by,
        )
    scores = robust.msac_scores(robust.sampson_errors_px(estimate.model, pair), max_error_px)
    return PruneResult(
        scores=np.where(candidates, scores, np.float32(0)),
        inlier_mask=estimate.inlier_mask,
        model=estimate.model,
        residuals=robust.normalised_residuals(estimate.model, pair),
        decided_by=decided_by,
    )


class KeepAll:
    """Method ``none``: every match is kept; its score is the one it brought, or one minus its ratio."""

    name = "none"
    fingerprint = "none"

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs; see `corrsfm.prune.PrunerProtocol`."""
        return [
            PruneResult(
                scores=confidence(pair),
                inlier_mask=np.ones(len(pair), bool),
                decided_by=self.name,
            )
            for pair in pairs
        ]


class RatioPruner:
    """Method ``ratio``: mutual matches that pass the ratio test.

    Scores are one minus the ratio, 0 where not mutual.

    Parameters
    ----------
    max_ratio : float
    """

    name = "ratio"

    def __init__(self, max_ratio: float) -> None:
        self._max_ratio = max_ratio
        self.fingerprint = f"ratio max_ratio={max_ratio!r}"

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs; see `corrsfm.prune.PrunerProtocol`."""
        return [
            PruneResult(
                scores=confidence(pair) * pair.mutual,
                inlier_mask=select_ratio(pair, self._max_ratio),
                decided_by=self.name,
            )
            for pair in pairs
        ]


class EstimatorPruner:
    """Methods ``loransac`` and ``magsac``: the inliers of a robust estimate on ratio-tested mutual matches.

    Parameters
    ----------
    name : {"loransac", "magsac"}
    max_ratio : float
    max_error_px : float
        Inlier threshold, pixels.
    seed, threads : int
        As for `corrsfm.prune.build_pruner`.
    """

    def __init__(self, name: str, *, max_ratio: float, max_error_px: float, seed: int, threads: int) -> None:
        self.name = name
        self._estimate = {"loransac": robust.lo_ransac, "magsac": robust.magsac}[name]
        self._max_ratio = max_ratio
        self._max_error_px = max_error_px
        self._seed = seed
        self._threads = threads
        self.fingerprint = f"{name} max_ratio={max_ratio!r} max_error_px={max_error_px!r} seed={seed}"

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs; see `corrsfm.prune.PrunerProtocol`."""
        candidates = [select_ratio(pair, self._max_ratio) for pair in pairs]
        estimates = self._estimate(
            pairs, candidates, max_error_px=self._max_error_px, seed=self._seed, threads=self._threads
        )
        return [
            _result_from_estimate(pair, mask, estimate, self._max_error_px, self.name)
            for pair, mask, estimate in zip(pairs, candidates, estimates, strict=True)
        ]
