"""Pictures of training: learning curves of a run, and real beside synthetic pairs."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import DependencyError, InputError
from corrsfm.files import atomic_path, open_file
from corrsfm.training.dataset import Batch

__all__ = ["plot_distributions", "plot_learning_curves"]

_SMOOTHING = 9
_COLOURS = {"real": "#20639b", "synthetic": "#ed553b"}


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Any, NDArray]:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise DependencyError("matplotlib", "plots of training", "train") from error
    # Not pyplot's figure, which needs a window system and keeps global state.
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, np.atleast_1d(figure.subplots(rows, columns)).reshape(-1)


def _read_columns(path: Path, needed: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    try:
        with io.TextIOWrapper(open_file(path), encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        if rows and (missing := [name for name in needed if name not in rows[0]]):
            raise ValueError(f"no column {', '.join(missing)}")
        return (
            {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]} if rows else {}
        )
    except (ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: is damaged ({error}); expected the log of a training run") from error


def _save(figure: Any, output: Path, dpi: int) -> None:
    with atomic_path(output) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png")


def plot_learning_curves(run_folder: Path, output: Path) -> None:
    """Draw losses, learning rate and validation scores of a run into a PNG."""
    losses = ("step", "classification", "essential", "learning_rate")
    log_path = Path(run_folder) / "log.csv"
    was_begun = (Path(run_folder) / "recipe.json").exists()
    log = _read_columns(log_path, losses) if log_path.exists() or not was_begun else {}
    validation_path = Path(run_folder) / "validation.csv"
    scores = ("step", "auc5", "auc10", "auc20", "baseline_auc5")
    validation = _read_columns(validation_path, scores) if validation_path.exists() else {}
    if not log:
        raise InputError(
            f"{run_folder}: nothing was logged yet; train for longer, or with a smaller --log-every"
        )
    figure, axes = _figure(1, 4, 17, 3.6)
    for axis, name, title in zip(
        axes, ("classification", "essential", "learning_rate"),
        ("classification loss", "essential loss", "learning rate"), strict=False,
    ):  # fmt: skip
        values = log[name]
        axis.plot(log["step"], values, color="#bbbbbb", linewidth=0.8)
        if name != "learning_rate" and len(values) > 2 * _SMOOTHING:
            smooth = np.convolve(values, np.ones(_SMOOTHING) / _SMOOTHING, mode="valid")
            half = _SMOOTHING // 2
            axis.plot(log["step"][half:-half], smooth, color=_COLOURS["real"])
        axis.set(title=title, xlabel="step")
    for name, style in (("auc5", "o-"), ("auc10", "s-"), ("auc20", "^-")):
        if validation:
            axes[3].plot(validation["step"], validation[name], style, label=name.replace("auc", "AUC@"))
    if validation:
        axes[3].axhline(
            validation["baseline_auc5"][-1], color="black", linestyle=":", label="ratio + mutual, AUC@5"
        )
        axes[3].legend(fontsize="small")
    axes[3].set(title="pose AUC behind LO-RANSAC, validation", xlabel="step")
    _save(figure, output, dpi=90)


def _measures(batches: Sequence[Batch]) -> dict[str, NDArray[np.float64]]:
    """Measures that real and synthetic pairs are compared by."""
    found: dict[str, list[NDArray]] = {}
    for batch in batches:
        distances, inliers = batch.distances(), batch.inliers()
        outliers = ~inliers & batch.mask
        motion = (batch.correspondences[..., 2:] - batch.correspondences[..., :2]).norm(dim=-1)
        share = inliers.sum(1) / batch.mask.sum(1)
        values = {
            "inlier ratio of a pair": share,
            "motion of inliers (focal lengths)": motion[inliers],
            "motion of outliers (focal lengths)": motion[outliers],
            "distance of outliers to the line (log₁₀)": distances[outliers].clamp(min=1e-9).log10() / 2,
            "distance of inliers to the line (log₁₀)": distances[inliers].clamp(min=1e-12).log10() / 2,
            "ratio, inliers": batch.ratios[inliers],
            "ratio, outliers": batch.ratios[outliers],
            "mutual share, inliers": (batch.mutual * inliers).sum(1) / inliers.sum(1).clamp(min=1),
            "mutual share, outliers": (batch.mutual * outliers).sum(1) / outliers.sum(1).clamp(min=1),
            "log scale ratio, inliers": batch.log_scale_ratios[inliers],
            "cos rotation, inliers": batch.rotations[inliers].cos(),
            "matches that share a point of image 1": _share_of_repeats(batch),
        }
        for name, value in values.items():
            found.setdefault(name, []).append(value.double().cpu().numpy().ravel())
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _share_of_repeats(batch: Batch) -> Any:
    """Share (B,) of matches that have their place in image 1 in common with another."""
    places = (batch.correspondences[..., 2:] * 1e5).round().long()
    keys = places[..., 0] * 1_000_003 + places[..., 1]
    ordered = keys.sort(1).values
    same = ordered[:, 1:] == ordered[:, :-1]
    return same.double().mean(1)


def plot_distributions(real: Sequence[Batch], synthetic: Sequence[Batch], output: Path) -> None:
    """Draw a page of histograms that compare real and synthetic pairs into a PNG.

    Parameters
    ----------
    real, synthetic : sequence of Batch
        Without augmentation, so that the page shows what the sources are like.
    output : Path
    """
    figure, axes = _figure(4, 3, 14, 14)
    measures = {"real": _measures(real), "synthetic": _measures(synthetic)}
    for axis, name in zip(axes, measures["real"], strict=True):
        both = np.concatenate([measure[name] for measure in measures.values()])
        low, high = np.quantile(both, [0.005, 0.995])
        bins = np.linspace(low, high, 41)
        for kind, measure in measures.items():
            axis.hist(measure[name], bins=bins, density=True, alpha=0.5, color=_COLOURS[kind], label=kind)
        axis.set(title=name, yticks=[])
    axes[0].legend()
    _save(figure, output, dpi=70)
