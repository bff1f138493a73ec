"""Prune method ``cascade``: classical where it is beyond doubt, competing hypotheses elsewhere.

The numbers were chosen on 120 wide-baseline pairs of six validation scenes with 2,000 keypoints a photo.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from corrsfm.prune.classical import select_ratio
from corrsfm.prune.robust import (
    TwoViewEstimate,
    best_model,
    lo_ransac,
    msac_scores,
    normalised_residuals,
    sampson_errors_px,
)
from corrsfm.types import Correspondences, PruneResult

__all__ = [
    "MIN_INLIERS",
    "MIN_INLIER_RATIO",
    "CascadePruner",
    "estimated_precision",
    "is_beyond_doubt",
    "select_explained",
]

# Of the 73 pairs that these accept (of 120), none had less than 86 % right matches.
MIN_INLIERS = 50
MIN_INLIER_RATIO = 0.6

# Besides the ratio of the options; with the tight threshold below it finds more right models than 0.8.
LOOSE_RATIO = 0.9

# Models are estimated and compared more tightly than matches are kept: with all at 4 px AUC@5/20° is
# 52.4/64.1, with models at 1 px 59.8/68.7 at the same number of kept matches.
_ESTIMATION_SHARE = 0.25
_COMPARISON_SHARE = 0.5

# A challenger must explain this much more than the incumbent: without a margin the hypothesis that overfits
# wins too often (AUC@5/20° 57.6/65.8 instead of 60.1/69.3).
_MARGIN = 0.2

# Estimated precision from which on loosely selected matches are kept, and below which nothing is: of 82
# pairs above the first one was wrong, of the 8 pairs below the second all were.
_TRUSTED_PRECISION = 0.9
_MIN_PRECISION = 0.7

# Chance of a wrong match to agree with a model, before any was seen: the weight is in matches.
_CHANCE, _CHANCE_WEIGHT = 0.05, 20

Network = Callable[[Sequence[Correspondences]], list[PruneResult]]


def is_beyond_doubt(inlier_mask: NDArray[np.bool_], candidates: NDArray[np.bool_]) -> bool:
    """Whether a LO-RANSAC result on ratio-tested mutual matches needs no second opinion.

    Parameters
    ----------
    inlier_mask, candidates : (M,) bool
        Inliers, and the matches that they are among.

    Returns
    -------
    bool
        True from 50 inliers and an inlier ratio of 0.6 on.
    """
    num_inliers, num_candidates = int(np.count_nonzero(inlier_mask)), int(np.count_nonzero(candidates))
    return num_inliers >= MIN_INLIERS and num_inliers >= MIN_INLIER_RATIO * num_candidates


def estimated_precision(
    pair: Correspondences, candidates: NDArray[np.bool_], explained: NDArray[np.bool_]
) -> float:
    """Share of right matches among the candidates that a model explains, without knowing the truth.

    Matches that are neither mutual nor distinctive are almost all wrong: how many of them a model explains
    tells how often it explains a wrong match by chance.

    Parameters
    ----------
    pair : Correspondences
    candidates, explained : (M,) bool

    Returns
    -------
    float
        At most 1; below 0 if the model explains no more candidates than chance would. 0 without explained
        candidates.
    """
    num_explained = int(np.count_nonzero(candidates & explained))
    if num_explained == 0:
        return 0.0
    background = ~pair.mutual & (pair.ratios > LOOSE_RATIO)
    chance = (np.count_nonzero(background & explained) + _CHANCE * _CHANCE_WEIGHT) / (
        np.count_nonzero(background) + _CHANCE_WEIGHT
    )
    # The unexplained candidates are the 1 − chance of all wrong ones that missed the model.
    num_wrong = min(chance / max(1.0 - chance, 1e-3), 1e3) * np.count_nonzero(candidates & ~explained)
    return float(1.0 - num_wrong / num_explained)


def select_explained(
    pair: Correspondences,
    errors_px: NDArray[np.float64],
    *,
    max_ratio: float,
    max_error_px: float,
    network_kept: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """The matches to keep, given the errors to the model of a pair.

    Parameters
    ----------
    pair : Correspondences
    errors_px : (M,) float64
    max_ratio : float
        Of the strict ratio test.
    max_error_px : float
    network_kept : (M,) bool, optional
        What the network would keep, if it was asked.

    Returns
    -------
    (M,) bool
        Explained mutual matches. Where those of a ratio up to 0.9 are estimated to be at least 90 % right,
        they and what the network would keep; where less than 70 %, none; in between only what the network
        would keep, or without it those of the strict ratio.
    """
    explained = errors_px < max_error_px
    loose = select_ratio(pair, max(LOOSE_RATIO, max_ratio))
    precision = estimated_precision(pair, loose, explained)
    if precision < _MIN_PRECISION:
        return np.zeros(len(pair), bool)
    if precision < _TRUSTED_PRECISION:
        return explained & (select_ratio(pair, max_ratio) if network_kept is None else network_kept)
    return explained & (loose if network_kept is None else loose | network_kept)


class CascadePruner:
    """Accepts what LO-RANSAC on ratio-tested mutual matches finds beyond doubt; else lets hypotheses compete.

    The hypotheses of a doubtful pair are LO-RANSAC models of up to three sets: mutual matches of a loose
    ratio, of the strict ratio, and what the network keeps. The one that explains most of the mutual matches
    wins. A hypothesis from all mutual matches was measured and left out: it is the slowest of all, won only
    where all were wrong, and is judged on the very matches that it was fitted to.

    Parameters
    ----------
    network : callable, optional
        The learned pruner; without it the two classical hypotheses compete.
    network_fingerprint : str
        For `fingerprint`.
    max_ratio : float
        The strict ratio.
    max_error_px : float
        Largest error of a kept match, pixels. Models are estimated with a quarter of it.
    seed, threads : int
        As for `corrsfm.prune.build_pruner`.
    """

    name = "cascade"

    def __init__(
        self,
        network: Network | None,
        *,
        network_fingerprint: str = "",
        max_ratio: float,
        max_error_px: float,
        seed: int,
        threads: int,
    ) -> None:
        self._network = network
        self._max_ratio = max_ratio
        self._max_error_px = max_error_px
        self._seed = seed
        self._threads = threads
        self.fingerprint = (
            f"cascade-1 max_ratio={max_ratio!r} max_error_px={max_error_px!r} seed={seed} "
            f"network=[{network_fingerprint}]"
        )

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs; see `corrsfm.prune.PrunerProtocol`.

        ``decided_by`` is ``beyond doubt``, or the winning hypothesis: ``loose ratio``, ``ratio`` or
        ``network``; ``nothing`` if no hypothesis found a model. Scores are the MSAC terms of mutual matches.
        """
        strict = [select_ratio(pair, self._max_ratio) for pair in pairs]
        estimates = self._estimate(pairs, strict)
        results: list[PruneResult | None] = [
            self._accept(pair, mask, estimate)
            for pair, mask, estimate in zip(pairs, strict, estimates, strict=True)
        ]
        doubtful = [index for index, result in enumerate(results) if result is None]
        decided = iter(self._decide([pairs[i] for i in doubtful], [estimates[i] for i in doubtful]))
        return [result if result is not None else next(decided) for result in results]

    def _estimate(
        self, pairs: Sequence[Correspondences], candidates: Sequence[NDArray[np.bool_]]
    ) -> list[TwoViewEstimate]:
        return lo_ransac(
            pairs,
            candidates,
            max_error_px=_ESTIMATION_SHARE * self._max_error_px,
            seed=self._seed,
            threads=self._threads,
        )

    def _accept(
        self, pair: Correspondences, candidates: NDArray[np.bool_], estimate: TwoViewEstimate
    ) -> PruneResult | None:
        """The result of a pair beyond doubt; None for a doubtful one."""
        if estimate.model is None:
            return None
        explained = sampson_errors_px(estimate.model, pair) < self._max_error_px
        if not is_beyond_doubt(candidates & explained, candidates):
            return None
        return self._result(pair, estimate, "beyond doubt")

    def _decide(
        self, pairs: Sequence[Correspondences], strict: Sequence[TwoViewEstimate]
    ) -> list[PruneResult]:
        """Results of doubtful pairs, given what the strict ratio found."""
        if not pairs:
            return []
        loose_ratio = max(LOOSE_RATIO, self._max_ratio)
        hypotheses = {
            "loose ratio": self._estimate(pairs, [select_ratio(pair, loose_ratio) for pair in pairs]),
            "ratio": strict,
        }
        network_kept: list[NDArray[np.bool_] | None] = [None] * len(pairs)
        if self._network is not None:
            masks = [
                pair.mutual & result.inlier_mask
                for pair, result in zip(pairs, self._network(pairs), strict=True)
            ]
            hypotheses["network"] = self._estimate(pairs, masks)
            network_kept = list(masks)
        return [
            self._compete(pair, dict(zip(hypotheses, estimates, strict=True)), kept)
            for pair, kept, *estimates in zip(pairs, network_kept, *hypotheses.values(), strict=True)
        ]

    def _compete(
        self,
        pair: Correspondences,
        hypotheses: dict[str, TwoViewEstimate],
        network_kept: NDArray[np.bool_] | None,
    ) -> PruneResult:
        found = {name: estimate for name, estimate in hypotheses.items() if estimate.model is not None}
        winner = best_model(
            [estimate.model for estimate in found.values() if estimate.model is not None],
            pair,
            pair.mutual,
            max_error_px=_COMPARISON_SHARE * self._max_error_px,
            margin=_MARGIN,
        )
        if winner is None:
            return PruneResult(
                scores=np.zeros(len(pair), np.float32),
                inlier_mask=np.zeros(len(pair), bool),
                decided_by="nothing",
            )
        name = list(found)[winner]
        return self._result(pair, found[name], name, network_kept)

    def _result(
        self,
        pair: Correspondences,
        estimate: TwoViewEstimate,
        decided_by: str,
        network_kept: NDArray[np.bool_] | None = None,
    ) -> PruneResult:
        if estimate.model is None:
            raise ValueError("a result needs a model")
        errors_px = sampson_errors_px(estimate.model, pair)
        return PruneResult(
            scores=np.where(pair.mutual, msac_scores(errors_px, self._max_error_px), np.float32(0)),
            inlier_mask=select_explained(
                pair,
                errors_px,
                max_ratio=self._max_ratio,
                max_error_px=self._max_error_px,
                network_kept=network_kept,
            ),
            model=estimate.model,
            residuals=normalised_residuals(estimate.model, pair),
            decided_by=decided_by,
        )
