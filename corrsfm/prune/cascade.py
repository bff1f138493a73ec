"""Prune method ``cascade``: the ratio test where it is enough, the network where it helps.

The ratio test and the mutual check cost nothing. Where they leave many matches, a robust estimator finds the
geometry from those as well as from the network's; where they leave hardly any, the photos share too little
for either. The two bounds were chosen on 240 pairs of six validation scenes with 2,000 keypoints a photo.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from corrsfm.prune.classical import RatioPruner
from corrsfm.types import Correspondences, PruneResult

__all__ = ["ENOUGH", "TOO_FEW", "CascadePruner"]

ENOUGH = 100
"""Ratio-tested mutual matches from which on the network is not asked.

On the 134 pairs above, pose AUC@5° was 90.2 with the ratio test and 89.9 with the network that was bundled
first; on the 106 below, 36.7 and 42.8.
"""

TOO_FEW = 15
"""Ratio-tested mutual matches below which nothing is asked: COLMAP accepts no pair of fewer.

None of the validation pairs below 25 had a pose within 10°, whichever method pruned it.
"""

Network = Callable[[Sequence[Correspondences]], list[PruneResult]]


class CascadePruner:
    """Keeps ratio-tested mutual matches where they are enough or too few; asks the network in between.

    Parameters
    ----------
    network : callable
        The learned pruner.
    network_fingerprint : str
        For `fingerprint`.
    max_ratio : float
        Of the ratio test.
    """

    name = "cascade"

    def __init__(self, network: Network, *, network_fingerprint: str, max_ratio: float) -> None:
        self._network = network
        self._ratio = RatioPruner(max_ratio)
        self.fingerprint = f"cascade-2 max_ratio={max_ratio!r} network=[{network_fingerprint}]"

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs; see `corrsfm.prune.PrunerProtocol`. ``decided_by`` is ``ratio`` or ``network``."""
        results = self._ratio(pairs)
        counts = [np.count_nonzero(result.inlier_mask) for result in results]
        doubtful = [index for index, count in enumerate(counts) if TOO_FEW <= count < ENOUGH]
        if doubtful:
            answers = self._network([pairs[index] for index in doubtful])
            for index, answer in zip(doubtful, answers, strict=True):
                results[index] = replace(answer, decided_by="network")
        return results
