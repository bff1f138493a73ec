"""Filters of putative matches under one interface: they decide what an estimator sees.

A short text names a filter, see `parse_filter`. To add one, write a class like `PairFilter`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from corrsfm.config import OperatingPoint, PruneConfig, PruneMethod
from corrsfm.errors import ConfigError
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.labelled.oanet import OANetPair
from corrsfm.prune.correspondences import distinctiveness
from corrsfm.types import PruneResult

__all__ = [
    "OracleFilter",
    "PairFilter",
    "PrunerFilter",
    "SideFilter",
    "parse_filter",
    "parse_prune_method",
    "result_of_filter",
]


class PairFilter(Protocol):
    """A filter of putative matches.

    Attributes
    ----------
    name : str
        The text that `parse_filter` reads.
    fingerprint : str
        Options and the hash of a checkpoint; changes whenever results may.
    """

    @property
    def name(self) -> str: ...

    @property
    def fingerprint(self) -> str: ...

    def __call__(self, pairs: Sequence[OANetPair]) -> list[PruneResult]:
        """Filter pairs, empty ones included; pairs and matches keep their order."""


def result_of_filter(
    name: str, keep: NDArray[np.bool_], confidence: NDArray[np.float32] | float = 1.0
) -> PruneResult:
    """Result of a filter that has no scores: a confidence in what it keeps, none in the rest."""
    scores = np.where(keep, confidence, 0.0).astype(np.float32)
    return PruneResult(scores=scores, inlier_mask=keep, decided_by=name)


@dataclass(frozen=True, kw_only=True)
class SideFilter:
    """Keep matches by what the matcher knows: ratio test, mutual check, both or neither.

    Attributes
    ----------
    max_ratio : float or None
        Largest ratio kept; no ratio test if None.
    mutual : bool
        Keep mutual nearest neighbours only.
    """

    max_ratio: float | None = None
    mutual: bool = False

    @property
    def name(self) -> str:
        parts = [] if self.max_ratio is None else [f"ratio{self.max_ratio:g}"]
        return "+".join(parts + ["mutual"] * self.mutual) or "nn"

    @property
    def fingerprint(self) -> str:
        return self.name

    def __call__(self, pairs: Sequence[OANetPair]) -> list[PruneResult]:
        results = []
        for pair in pairs:
            keep = np.ones(len(pair), bool) if self.max_ratio is None else pair.ratios <= self.max_ratio
            keep = keep & pair.mutual if self.mutual else keep
            results.append(result_of_filter(self.name, keep, distinctiveness(pair.ratios)))
        return results


@dataclass(frozen=True, kw_only=True)
class OracleFilter:
    """Keep exactly the inliers, as a perfect filter would: the ceiling of all others."""

    threshold: float = INLIER_THRESHOLD
    name: str = "oracle"

    @property
    def fingerprint(self) -> str:
        return f"{self.name} {self.threshold}"

    def __call__(self, pairs: Sequence[OANetPair]) -> list[PruneResult]:
        return [
            result_of_filter(self.name, pair.inliers(self.threshold), distinctiveness(pair.ratios))
            for pair in pairs
        ]


class PrunerFilter:
    """A method of `corrsfm prune`, with its checkpoint and operating point.

    Parameters
    ----------
    name : str
    config : PruneConfig
    device : str
    seed : int
    threads : int
    """

    def __init__(self, name: str, config: PruneConfig, *, device: str, seed: int, threads: int) -> None:
        from corrsfm.prune import build_pruner

        self.name = name
        self._prune = build_pruner(config, device=device, seed=seed, threads=threads)
        self.fingerprint = self._prune.fingerprint

    def __call__(self, pairs: Sequence[OANetPair]) -> list[PruneResult]:
        return self._prune([pair.as_correspondences() for pair in pairs])


_SIDE = re.compile(r"(?:nn|mutual|ratio(?P<ratio>0?\.\d+|1(?:\.0)?)(?P<mutual>\+mutual)?)")
_PRUNER = re.compile(r"(?P<method>[a-z0-9]+)(?:@(?P<point>[a-z]+))?(?::(?P<model>.+))?")


def parse_filter(
    text: str, *, device: str = "auto", seed: int = 0, threads: int = 0, is_sift: bool = True
) -> PairFilter:
    """Build a filter from its name.

    Parameters
    ----------
    text : str
        ``nn`` (all matches), ``mutual``, ``ratio0.8``, ``ratio0.8+mutual`` (any ratio), ``gms``, ``adalam``,
        ``oracle`` (the inliers), or a method of `corrsfm prune` as ``METHOD[@sfm|@pose][:CHECKPOINT]``.
    device, seed, threads
        For methods of `corrsfm prune`.
    is_sift : bool
        Whether these methods apply SIFT's ratio test, as they do to matches of SIFT alone.

    Raises
    ------
    ConfigError
        If no filter has this name.
    DependencyError
        If the library of the filter is not installed.
    """
    if text == "oracle":
        return OracleFilter()
    if text in ("gms", "adalam"):
        # Imported here because their libraries are optional.
        from corrsfm.evaluation.two_view.neighbourhood import AdalamFilter, GmsFilter

        return GmsFilter() if text == "gms" else AdalamFilter(seed=seed)
    if side := _SIDE.fullmatch(text):
        ratio = float(side["ratio"]) if side["ratio"] else None
        return SideFilter(max_ratio=ratio, mutual=text.endswith("mutual"))
    methods = [str(method) for method in PruneMethod]
    if not (match := _PRUNER.fullmatch(text)) or match["method"] not in methods:
        raise ConfigError(
            f"no filter '{text}'; expected nn, mutual, ratioT, ratioT+mutual with T such as 0.8, gms, "
            f"adalam, oracle, or METHOD[@POINT][:CHECKPOINT] with METHOD of {', '.join(methods)}"
        )
    from corrsfm.prune import NO_MAX_RATIO

    config = parse_prune_method(text, PruneConfig(max_ratio=None if is_sift else NO_MAX_RATIO))
    return PrunerFilter(text, config, device=device, seed=seed, threads=threads)


def parse_prune_method(text: str, base: PruneConfig) -> PruneConfig:
    """Read the options of a method of `corrsfm prune` from ``METHOD[@POINT][:CHECKPOINT]``.

    Parameters
    ----------
    text : str
    base : PruneConfig
        Options that the text leaves open.

    Raises
    ------
    ConfigError
        If the method or operating point is unknown, or a checkpoint is given to a method that reads none.
    """
    match = _PRUNER.fullmatch(text)
    methods, points = [str(m) for m in PruneMethod], [str(p) for p in OperatingPoint]
    if not match or match["method"] not in methods or match["point"] not in (None, *points):
        raise ConfigError(
            f"no prune method '{text}'; expected METHOD[@POINT][:CHECKPOINT] with METHOD of "
            f"{', '.join(methods)} and POINT of {', '.join(points)}"
        )
    (model,) = (entry for entry in dataclasses.fields(PruneConfig) if entry.name == "model")
    _, with_network = model.metadata["used_with"]
    if match["model"] and match["method"] not in with_network:
        raise ConfigError(f"'{text}': {match['method']} reads no checkpoint; leave it out")
    return dataclasses.replace(
        base,
        method=PruneMethod(match["method"]),
        operating_point=OperatingPoint(match["point"]) if match["point"] else base.operating_point,
        model=Path(match["model"]) if match["model"] else base.model,
    )
