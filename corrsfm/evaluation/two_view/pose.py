"""Two-view methods measured on labelled pairs: the matches they keep and the poses they find."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import ConfigError, InputError
from corrsfm.evaluation.metrics import (
    POSE_THRESHOLDS_DEG,
    auc_contributions,
    paired_bootstrap,
    pose_auc,
    pose_map,
    precision_recall_f,
)
from corrsfm.evaluation.records import (
    auc_intervals,
    by_threshold,
    finite_or_none,
    kept_methods,
    provenance,
    rounded_interval,
    save_results,
)
from corrsfm.evaluation.two_view.estimators import pose_errors_deg
from corrsfm.evaluation.two_view.methods import MethodOutput, TwoViewMethod, parse_method
from corrsfm.files import sha256_of
from corrsfm.geometry import INLIER_THRESHOLD, essential_from_pose, symmetric_epipolar_distance_sq
from corrsfm.labelled.compact import is_compact, lacks_shapes, read_labelled_pairs
from corrsfm.labelled.oanet import OANetPair, read_pairs

__all__ = [
    "PairScores",
    "evaluate_pose",
    "load_labelled_pairs",
    "score_pairs",
    "summarise",
]

_BATCH = 8

_PER_PAIR = (
    "rotation_error_deg",
    "translation_error_deg",
    "precision",
    "recall",
    "f_score",
    "pose_precision",
    "pose_recall",
    "pose_f_score",
    "num_kept",
    "filter_seconds",
    "estimator_seconds",
)


def load_labelled_pairs(path: Path, *, max_per_scene: int | None = None, seed: int = 0) -> list[OANetPair]:
    """Read the pairs of a file in OANet's or in the compact layout.

    Raises
    ------
    InputError
        If the file is of neither layout, or holds no pairs.
    """
    if is_compact(path):
        pairs = list(read_labelled_pairs(path, num_per_scene=max_per_scene, seed=seed))
    else:
        pairs = list(read_pairs(path, max_per_scene=max_per_scene, seed=seed))
    if not pairs:
        raise InputError(f"{path}: holds no pairs; expected a file of: corrsfm train prepare")
    return pairs


@dataclass(frozen=True, kw_only=True)
class PairScores:
    """Scores of one method, one entry per pair.

    Attributes
    ----------
    rotation_error_deg, translation_error_deg : (P,) float64
        inf where the method found no pose.
    precision, recall, f_score : (P,) float64
        Percent; of the matches the filter keeps.
    pose_precision, pose_recall, pose_f_score : (P,) float64
        Percent; of all matches within `INLIER_THRESHOLD` of the estimated pose, as papers do that judge the
        network's essential matrix.
    num_kept : (P,) float64
    filter_seconds, estimator_seconds : (P,) float64
    """

    rotation_error_deg: NDArray[np.float64]
    translation_error_deg: NDArray[np.float64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    f_score: NDArray[np.float64]
    pose_precision: NDArray[np.float64]
    pose_recall: NDArray[np.float64]
    pose_f_score: NDArray[np.float64]
    num_kept: NDArray[np.float64]
    filter_seconds: NDArray[np.float64]
    estimator_seconds: NDArray[np.float64]

    @property
    def pose_error_deg(self) -> NDArray[np.float64]:
        """(P,) the larger of the two errors."""
        return np.maximum(self.rotation_error_deg, self.translation_error_deg)


def _score_one(pair: OANetPair, output: MethodOutput) -> dict[str, float]:
    inliers = pair.inliers()
    kept = precision_recall_f(output.result.inlier_mask, inliers)
    by_pose = (0.0, 0.0, 0.0)
    if output.pose is not None:
        essential = essential_from_pose(output.pose.rotation, output.pose.translation)
        distances = symmetric_epipolar_distance_sq(essential, pair.correspondences)
        by_pose = precision_recall_f(distances < INLIER_THRESHOLD, inliers)
    values = (
        *pose_errors_deg(output.pose, pair),
        *kept,
        *by_pose,
        float(output.result.inlier_mask.sum()),
        output.filter_seconds,
        output.estimator_seconds,
    )
    return dict(zip(_PER_PAIR, values, strict=True))


def score_pairs(
    methods: Sequence[TwoViewMethod],
    pairs: Sequence[OANetPair],
    *,
    seed: int = 0,
    on_progress: Callable[[int], None] = lambda count: None,
) -> list[PairScores]:
    """Run methods that share a filter over labelled pairs and score each pair.

    Parameters
    ----------
    methods : sequence of TwoViewMethod
        Of one filter, which runs once for all of them.
    pairs : sequence of OANetPair
    seed : int
    on_progress : callable
        Called with the number of pairs just done.
    """

    def outputs_of(some: Sequence[OANetPair]) -> list[list[MethodOutput]]:
        kept = methods[0].keep(some)
        return [method.estimate(some, *kept, seed=seed) for method in methods]

    # Libraries load and compile on first use, which is not the method's time.
    outputs_of(pairs[:1])
    rows: list[list[dict[str, float]]] = [[] for _ in methods]
    for start in range(0, len(pairs), _BATCH):
        batch = pairs[start : start + _BATCH]
        for own, outputs in zip(rows, outputs_of(batch), strict=True):
            own.extend(_score_one(pair, output) for pair, output in zip(batch, outputs, strict=True))
        on_progress(len(batch))
    return [PairScores(**{name: np.array([row[name] for row in own]) for name in _PER_PAIR}) for own in rows]


def summarise(
    scores: PairScores,
    scenes: Sequence[str],
    *,
    baseline: PairScores | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Summarise scores over all pairs and per scene, with bootstrap intervals.

    Parameters
    ----------
    scores : PairScores
    scenes : sequence of str
        Scene of every pair.
    baseline : PairScores, optional
        Of another method on the same pairs; differences to it are given with paired intervals.
    seed : int
        Of the resampling.

    Returns
    -------
    dict
        Plain values for JSON.
    """
    errors = scores.pose_error_deg
    summary: dict[str, Any] = {
        "num_pairs": len(errors),
        "num_failed": int(np.sum(~np.isfinite(errors))),
        "auc": by_threshold(pose_auc(errors)),
        "map": by_threshold(pose_map(errors)),
        "auc_interval": auc_intervals(errors, POSE_THRESHOLDS_DEG, seed),
    }
    for name in _PER_PAIR[2:]:
        summary[name] = round(float(np.mean(getattr(scores, name))), 6)
    if baseline is not None:
        other = baseline.pose_error_deg
        summary["auc_minus_baseline"] = {
            f"{t:g}": rounded_interval(
                paired_bootstrap(auc_contributions(errors, t), auc_contributions(other, t), seed=seed)
            )
            for t in POSE_THRESHOLDS_DEG
        }
    members = np.array(scenes)
    summary["scenes"] = {
        scene: {
            "num_pairs": int(np.sum(members == scene)),
            "auc": by_threshold(pose_auc(errors[members == scene])),
        }
        for scene in sorted(set(scenes))
    }
    return summary


def _to_json(scores: PairScores) -> dict[str, list[float | None]]:
    return {name: [finite_or_none(value, 5) for value in getattr(scores, name)] for name in _PER_PAIR}


def _from_json(values: dict[str, list[float | None]]) -> PairScores:
    return PairScores(
        **{
            name: np.array([math.inf if v is None else v for v in values[name]], np.float64)
            for name in _PER_PAIR
        }
    )


@dataclass(frozen=True, kw_only=True)
class _Subject:
    """The pairs that methods are measured on, and a description that identifies them."""

    pairs: list[OANetPair]
    scenes: list[str] = field(default_factory=list)
    description: dict[str, Any] = field(default_factory=dict)


def _load_subject(path: Path, max_per_scene: int | None, seed: int) -> _Subject:
    pairs = load_labelled_pairs(path, max_per_scene=max_per_scene, seed=seed)
    scenes = [pair.scene or path.stem for pair in pairs]
    description = {
        "name": path.name,
        "sha256": sha256_of(path),
        "max_per_scene": max_per_scene,
        "selection_seed": seed,
        "num_pairs": len(pairs),
        "num_matches": round(float(np.mean([len(pair) for pair in pairs])), 1),
        "inlier_percent": round(
            float(np.mean([100.0 * pair.inliers().mean() if len(pair) else 0.0 for pair in pairs])), 2
        ),
        "pair_scenes": scenes,
    }
    return _Subject(pairs=pairs, scenes=scenes, description=description)


def evaluate_pose(
    path: Path,
    methods: Sequence[str],
    *,
    results: Path | None = None,
    baseline: str | None = None,
    max_per_scene: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    threads: int = 0,
    overwrite: bool = False,
    command: str = "",
    on_filter: Callable[[str, int], Callable[[int], None]] = lambda name, total: lambda count: None,
) -> dict[str, Any]:
    """Measure methods on a file of labelled pairs.

    Parameters
    ----------
    path : Path
        In OANet's or the compact layout.
    methods : sequence of str
        See `corrsfm.evaluation.two_view.methods.parse_method`.
    results : Path, optional
        Result file. Methods it already holds for the same pairs are kept, not measured again, and all of its
        methods take part in the comparison.
    baseline : str, optional
        Method that differences refer to; the first one if not given.
    max_per_scene : int, optional
        Random pairs to use of each scene; all if not given.
    seed : int
        Seed of the choice of pairs, of the estimators and of the resampling.
    device, threads
        For learned methods.
    overwrite : bool
        Measure again what the result file holds.
    command : str
        Recorded in the result file.
    on_filter : callable
        Called with a filter's name and the number of pairs when it starts; what it returns is called with
        the number of pairs done.

    Returns
    -------
    dict
        The content of the result file.

    Raises
    ------
    InputError, ConfigError
    """
    is_sift = not lacks_shapes(path)
    built = [
        parse_method(name, device=device, seed=seed, threads=threads, is_sift=is_sift) for name in methods
    ]
    subject = _load_subject(path, max_per_scene, seed)

    def read(entry: dict[str, Any]) -> None:
        if {len(values) for values in vars(_from_json(entry["pairs"])).values()} != {len(subject.pairs)}:
            raise ValueError("other numbers of pairs")

    old = kept_methods(results, "pose", subject.description, read, overwrite=overwrite)
    entries: dict[str, Any] = dict(old)
    _require_measured(baseline, [*old, *(method.name for method in built)])
    groups: dict[str, list[TwoViewMethod]] = {}
    for method in built:
        if not (method.name in old and old[method.name]["fingerprint"] == method.fingerprint):
            groups.setdefault(method.filter.fingerprint, []).append(method)
    for group in groups.values():
        progress = on_filter(group[0].filter.name, len(subject.pairs))
        for method, scores in zip(
            group, score_pairs(group, subject.pairs, seed=seed, on_progress=progress), strict=True
        ):
            entries[method.name] = {
                "fingerprint": method.fingerprint,
                "measured": provenance(seed=seed, command=command, device=device),
                "pairs": _to_json(scores),
            }
        if results is not None:
            # After every filter, so that a long run can be stopped and resumed.
            known = baseline if baseline in entries else None
            _write(results, subject, entries, known, seed, command, device)
    return _write(results, subject, entries, baseline, seed, command, device)


def _require_measured(baseline: str | None, names: Collection[str]) -> None:
    """Check, before hours of measuring, that differences can refer to the baseline."""
    if baseline is not None and baseline not in names:
        raise ConfigError(
            f"baseline '{baseline}' is none of the methods to measure: {', '.join(names)}; if it is a "
            "FILTER/ESTIMATOR, add it by another --method"
        )


def _write(
    results: Path | None,
    subject: _Subject,
    entries: dict[str, Any],
    baseline: str | None,
    seed: int,
    command: str,
    device: str,
) -> dict[str, Any]:
    """Summarise all methods, and write the result file if there is one."""
    baseline = baseline or next(iter(entries))
    scores = {name: _from_json(entry["pairs"]) for name, entry in entries.items()}
    for name, entry in entries.items():
        other = None if name == baseline else scores[baseline]
        entry["summary"] = summarise(scores[name], subject.scenes, baseline=other, seed=seed)
    values = {
        "provenance": provenance(seed=seed, command=command, device=device),
        "subject": subject.description,
        "baseline": baseline,
        "methods": entries,
    }
    if results is not None:
        save_results(results, "pose", values)
    return values
