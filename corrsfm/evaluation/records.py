"""Result files: what was measured, with everything needed to measure it again.

A result file is JSON with ``kind``, ``provenance`` (versions, machine, seed, command), ``subject`` (what it
was measured on, with hashes) and ``methods``. Each method carries a fingerprint, so a repeated run measures
only what is new or changed.
"""

from __future__ import annotations

import json
import math
import platform
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import InputError, lack_or_text
from corrsfm.evaluation.metrics import (
    POSE_THRESHOLDS_DEG,
    Interval,
    auc_contributions,
    bootstrap_mean,
    pose_auc,
)
from corrsfm.files import atomic_write_text, read_text
from corrsfm.machine import count_threads, versions

__all__ = [
    "auc_intervals",
    "by_threshold",
    "finite_or_none",
    "kept_methods",
    "load_results",
    "provenance",
    "rounded_interval",
    "save_results",
]

FORMAT_VERSION = 1
_LIBRARIES = ("numpy", "opencv-python-headless", "pycolmap", "poselib", "torch", "h5py")


def provenance(*, seed: int, command: str = "", device: str = "cpu") -> dict[str, Any]:
    """Versions, machine, seed and command of a measurement."""
    return {
        "versions": versions(_LIBRARIES),
        "machine": {
            "system": f"{platform.system()} {platform.machine()}",
            "processor": _processor(),
            "cores": count_threads(0),
            "device": _device_name(device),
        },
        "seed": seed,
        "command": command,
    }


def by_threshold(
    scores: Sequence[float], thresholds: Sequence[float] = POSE_THRESHOLDS_DEG
) -> dict[str, float]:
    """Scores by threshold, as result files hold them."""
    return {f"{t:g}": round(score, 3) for t, score in zip(thresholds, scores, strict=True)}


def rounded_interval(interval: Interval) -> list[float]:
    """Mean, lower and upper end of an interval, as result files hold them."""
    return [round(value, 3) for value in (interval.mean, interval.low, interval.high)]


def auc_intervals(
    errors: NDArray[np.float64], thresholds: Sequence[float], seed: int
) -> dict[str, list[float]]:
    """Bootstrap intervals of the AUC of errors (n,) by threshold, around the very `pose_auc`.

    What is resampled is the area below the steps; it is moved by what the trapezoid rule adds to that.
    """
    intervals = {}
    for threshold, area in zip(thresholds, pose_auc(errors, thresholds), strict=True):
        steps = bootstrap_mean(auc_contributions(errors, threshold), seed=seed)
        added = area - steps.mean
        intervals[f"{threshold:g}"] = rounded_interval(
            Interval(mean=area, low=steps.low + added, high=steps.high + added)
        )
    return intervals


def finite_or_none(value: float, digits: int | None = None) -> float | None:
    """Number for JSON, which has no infinity: None for a failure."""
    if not math.isfinite(value):
        return None
    return float(value) if digits is None else round(float(value), digits)


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor()


def _device_name(device: str) -> str:
    if not device.startswith("cuda"):
        return device
    import torch

    return torch.cuda.get_device_name(device)


def load_results(path: Path, kind: str | None = None) -> dict[str, Any]:
    """Read a result file.

    Raises
    ------
    InputError
        If it is missing, damaged, of another version or of another kind than wanted.
    """
    try:
        values = json.loads(read_text(path))
        version, found = values["format_version"], values["kind"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path}: not a result file ({error}); make it with: corrsfm evaluate, or delete it"
        ) from error
    if version != FORMAT_VERSION or (kind is not None and found != kind):
        raise InputError(
            f"{path}: result file of kind {found}, version {version}; expected {kind or found}, "
            f"version {FORMAT_VERSION}; choose another --results file"
        )
    return values


def kept_methods(
    results: Path | None,
    kind: str,
    subject: dict[str, Any],
    read: Callable[[dict[str, Any]], object],
    *,
    overwrite: bool,
) -> dict[str, Any]:
    """Read the methods that a result file already holds for the same subject.

    Parameters
    ----------
    results : Path, optional
    kind : str
    subject : dict
    read : callable
        Called with each method's entry; raises KeyError, TypeError or ValueError if that cannot be used.
    overwrite : bool
        Keep none.

    Raises
    ------
    InputError
        If the file is not a result file, or was measured on something else and ``overwrite`` is not given.
    """
    if results is None or not results.exists():
        return {}
    values = load_results(results, kind)
    if overwrite:
        return {}
    try:
        other, methods = dict(values["subject"]), dict(values["methods"])
        if other != subject:
            raise InputError(
                f"{results}: measured on something else than asked for ({other.get('name')}, "
                f"{other.get('num_pairs')} pairs); use --overwrite or another file"
            )
        for entry in methods.values():
            if not isinstance(entry["fingerprint"], str):
                raise TypeError("a fingerprint is no text")
            read(entry)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{results}: damaged ({lack_or_text(error)}); use --overwrite to measure again, or another file"
        ) from error
    return methods


def save_results(path: Path, kind: str, values: dict[str, Any]) -> None:
    """Write a result file whole or not at all."""
    text = json.dumps({"format_version": FORMAT_VERSION, "kind": kind, **values}, indent=1, allow_nan=False)
    # Lists of numbers on one line each: files stay readable and small, and differ line by line.
    text = re.sub(r"\[\n[^\[\]{}]*\]", lambda match: re.sub(r"\n\s*", " ", match[0]), text)
    atomic_write_text(path, text + "\n")
