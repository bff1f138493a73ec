"""Two-view methods: a filter of putative matches and an estimator of the pose, named together."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from corrsfm.errors import ConfigError
from corrsfm.evaluation.two_view.estimators import (
    PoseEstimate,
    PoseEstimator,
    estimator_fingerprint,
    parse_estimator,
)
from corrsfm.evaluation.two_view.filters import PairFilter, parse_filter
from corrsfm.labelled.oanet import OANetPair
from corrsfm.types import PruneResult

__all__ = ["CLASSICAL_METHODS", "MethodOutput", "TwoViewMethod", "parse_method"]

CLASSICAL_METHODS = (
    "nn/ransac",
    "nn/poselib",
    "mutual/poselib",
    "ratio0.7+mutual/poselib",
    "ratio0.8/poselib",
    "ratio0.8+mutual/poselib",
    "ratio0.9+mutual/poselib",
    "adalam/poselib",
    "ratio0.8+mutual/colmap",
    "ratio0.8+mutual/ransac",
    "ratio0.8+mutual/magsac",
    "ratio0.8+mutual/prosac",
    "ratio0.8+mutual/accurate",
    "ratio0.8+mutual/degensac",
    "oracle/poselib",
)
"""Classical rivals of a learned filter, and the ceiling; without ``gms``, which needs another OpenCV."""


@dataclass(frozen=True, kw_only=True)
class MethodOutput:
    """Output of a method for one pair.

    Attributes
    ----------
    result : PruneResult
        Of the filter.
    pose : PoseEstimate or None
    filter_seconds, estimator_seconds : float
    """

    result: PruneResult
    pose: PoseEstimate | None
    filter_seconds: float
    estimator_seconds: float


@dataclass(frozen=True, kw_only=True)
class TwoViewMethod:
    """A filter followed by an estimator.

    Attributes
    ----------
    name : str
        ``FILTER/ESTIMATOR``.
    filter : PairFilter
    estimator : PoseEstimator
    """

    name: str
    filter: PairFilter
    estimator: PoseEstimator

    @property
    def fingerprint(self) -> str:
        """Text that changes whenever results may."""
        estimator = estimator_fingerprint(self.name.rpartition("/")[2])
        return f"{self.filter.fingerprint} | {estimator}"

    def __call__(self, pairs: Sequence[OANetPair], *, seed: int = 0) -> list[MethodOutput]:
        """Filter all pairs together, then estimate each pose.

        Parameters
        ----------
        pairs : sequence of OANetPair
        seed : int

        Returns
        -------
        list of MethodOutput
            In the order of the pairs; each has an equal share of the filter's time.
        """
        return self.estimate(pairs, *self.keep(pairs), seed=seed)

    def keep(self, pairs: Sequence[OANetPair]) -> tuple[list[PruneResult], float]:
        """Filter all pairs together, and the filter's seconds a pair."""
        start = time.perf_counter()
        results = self.filter(pairs)
        return results, (time.perf_counter() - start) / max(len(pairs), 1)

    def estimate(
        self, pairs: Sequence[OANetPair], results: Sequence[PruneResult], filter_seconds: float, *, seed: int
    ) -> list[MethodOutput]:
        """Estimate the pose of each pair from what the filter, perhaps that of another method, kept."""
        outputs = []
        for pair, result in zip(pairs, results, strict=True):
            start = time.perf_counter()
            pose = self.estimator(pair.as_correspondences(), result, seed)
            outputs.append(
                MethodOutput(
                    result=result,
                    pose=pose,
                    filter_seconds=filter_seconds,
                    estimator_seconds=time.perf_counter() - start,
                )
            )
        return outputs


def parse_method(
    text: str, *, device: str = "auto", seed: int = 0, threads: int = 0, is_sift: bool = True
) -> TwoViewMethod:
    """Build a method from ``FILTER/ESTIMATOR``, such as ``ratio0.8+mutual/poselib``.

    See `parse_filter` and `parse_estimator`.

    Raises
    ------
    ConfigError
        If the filter or estimator is unknown.
    """
    # The checkpoint of a filter may be a path with slashes; an estimator has none.
    filter_text, slash, estimator_text = text.rpartition("/")
    if not slash:
        raise ConfigError(f"method '{text}': expected FILTER/ESTIMATOR, such as ratio0.8+mutual/poselib")
    estimator = parse_estimator(estimator_text)
    return TwoViewMethod(
        name=text,
        filter=parse_filter(filter_text, device=device, seed=seed, threads=threads, is_sift=is_sift),
        estimator=estimator,
    )
