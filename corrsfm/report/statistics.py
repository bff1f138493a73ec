"""Statistics of a scene as a record, and as plain values for JSON."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from corrsfm.graph import connected_components
from corrsfm.report.missing import MissingPhoto, missing_photos
from corrsfm.types import ModelSummary, PairStatistics

__all__ = ["SceneReport", "StageWarning", "make_report"]

FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class StageWarning:
    """Something that a stage warned of when it was last done.

    Attributes
    ----------
    stage : str
        As in `SceneReport.stage_seconds`, "run" before the first of them, or "report" for what making the
        report met.
    message : str
        May have several lines.
    """

    stage: str
    message: str


@dataclass(frozen=True, kw_only=True)
class SceneReport:
    """The statistics of a scene.

    Attributes
    ----------
    scene : str
        What to call it.
    image_names : tuple of str
        All photos, sorted.
    models : tuple of ModelSummary
        The largest first; "registered" means "in the first model".
    pairs : tuple of PairStatistics
        In order of their names.
    components : tuple of tuple of str
        Connected components of the graph of verified pairs, the largest first; photos without a verified
        pair are not part of any.
    missing : tuple of MissingPhoto
        Photos that are not registered, sorted by name.
    stage_seconds : dict
        Stage → seconds of wall clock that what is there took to make, over all runs, in the order of the
        stages.
    configuration : dict
        The options of the run.
    versions : dict
        Program → version.
    evidence : dict
        Why the first model was selected and the verdict on it, see `corrsfm.reconstruction.record.record_of`;
        empty for models that were taken as they came.
    camera_remarks : tuple of str
        Which photos share a camera and by what evidence, where EXIF did not tell.
    warnings : tuple of StageWarning
        In the order of the stages.
    added : tuple of str
        Photos that joined finished models which were not moved for them, sorted.
    """

    scene: str
    image_names: tuple[str, ...]
    models: tuple[ModelSummary, ...]
    pairs: tuple[PairStatistics, ...]
    components: tuple[tuple[str, ...], ...]
    missing: tuple[MissingPhoto, ...]
    stage_seconds: dict[str, float]
    configuration: dict[str, Any]
    versions: dict[str, str]
    evidence: dict[str, Any] = dataclasses.field(default_factory=dict)
    camera_remarks: tuple[str, ...] = ()
    warnings: tuple[StageWarning, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The verdict in one line; empty if there is none."""
        if "verdict" in self.evidence:
            verdict = self.evidence["verdict"]
            step = f"; try {verdict['next_steps'][0]}" if verdict["next_steps"] else ""
            return f"{verdict['grade']}: {'; '.join(verdict['reasons'])}{step}"
        if self.models or not self.missing:
            return ""
        return f"no model: {self.why_no_model}; {self.missing[0].next_step}"

    @property
    def why_no_model(self) -> str:
        """What most photos lack, where there is no model."""
        reason, num = Counter(photo.reason for photo in self.missing).most_common(1)[0]
        return f"{num:,} of {len(self.image_names):,} photos: {reason}"

    @property
    def num_registered(self) -> int:
        """Photos in the first model."""
        return self.models[0].num_images if self.models else 0

    @property
    def registered_percent(self) -> float:
        """Share of the photos that are in the first model."""
        return 100.0 * self.num_registered / max(len(self.image_names), 1)

    @property
    def num_in_models(self) -> int:
        """Photos in any of the models."""
        return len({name for model in self.models for name in model.image_names})

    @property
    def num_verified_pairs(self) -> int:
        """Pairs with a verified two-view geometry."""
        return sum(pair.num_verified > 0 for pair in self.pairs)

    @property
    def num_empty_pairs(self) -> int:
        """Pairs pruned to nothing."""
        return sum(pair.num_kept == 0 for pair in self.pairs)

    @property
    def num_matches(self) -> tuple[int, int, int]:
        """Putative, kept and verified matches over all pairs."""
        return (
            sum(pair.num_putative for pair in self.pairs),
            sum(pair.num_kept for pair in self.pairs),
            sum(pair.num_verified for pair in self.pairs),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON: a ``summary`` to read first, then everything; undefined numbers are null."""
        putative, kept, verified = self.num_matches
        largest = self.models[0] if self.models else None
        values = {
            "format_version": FORMAT_VERSION,
            "summary": {
                "num_images": len(self.image_names),
                "num_registered": self.num_registered,
                "registered_percent": self.registered_percent,
                "num_in_models": self.num_in_models,
                "num_models": len(self.models),
                "model_sizes": [model.num_images for model in self.models],
                "num_points": largest.num_points if largest else 0,
                "num_observations": largest.num_observations if largest else 0,
                "mean_track_length": largest.mean_track_length if largest else None,
                "mean_observations_per_image": largest.mean_observations_per_image if largest else None,
                "mean_error_px": largest.mean_error_px if largest else None,
                "median_error_px": largest.median_error_px if largest else None,
                "p95_error_px": largest.p95_error_px if largest else None,
                "num_pairs": len(self.pairs),
                "num_empty_pairs": self.num_empty_pairs,
                "num_verified_pairs": self.num_verified_pairs,
                "num_putative_matches": putative,
                "num_kept_matches": kept,
                # The old name of what was kept; goes with the next version.
                "num_pruned_matches": kept,
                "num_verified_matches": verified,
                "num_components": len(self.components),
                "seconds": sum(self.stage_seconds.values()),
                "verdict": self.evidence.get("verdict", {}).get("grade"),
                "explained_share": self.evidence.get("explained_share"),
                "num_predicted_matches": self.evidence.get("num_predicted_matches"),
            },
            "verdict": self.evidence.get("verdict"),
            **{entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self)},
        }
        plain: dict[str, Any] = _plain(values)
        for pair in plain["pairs"]:
            pair["num_pruned"] = pair["num_kept"]  # the old name, as above
        return plain


def make_report(
    *,
    scene: str,
    image_names: Iterable[str],
    pairs: Iterable[PairStatistics],
    models: Sequence[ModelSummary],
    left_out: Collection[str] = (),
    mapped: bool = True,
    stage_seconds: Mapping[str, float] | None = None,
    configuration: Mapping[str, Any] | None = None,
    versions: Mapping[str, str] | None = None,
    evidence: Mapping[str, Any] | None = None,
    camera_remarks: Iterable[str] = (),
    warnings: Iterable[StageWarning] = (),
    added: Iterable[str] = (),
) -> SceneReport:
    """Build the report of a scene and find out why photos are missing.

    Parameters
    ----------
    scene : str
        What to call it.
    image_names : iterable of str
        All photos that went in.
    pairs : iterable of PairStatistics
        All pairs that were matched, those pruned to nothing included.
    models : sequence of ModelSummary
        The largest first; none if mapping failed.
    left_out : collection of str, optional
        Photos that could not be read.
    mapped : bool
        False if the pairs have not been mapped yet, so that there are no models for that reason alone.
    stage_seconds, configuration, versions, evidence : mapping, optional
        See `SceneReport`.
    camera_remarks : iterable of str, optional
    warnings : iterable of StageWarning, optional
    added : iterable of str, optional

    Returns
    -------
    SceneReport
    """
    names = tuple(sorted(image_names))
    pairs = tuple(sorted(pairs, key=lambda pair: (pair.name0, pair.name1)))
    verified = [(pair.name0, pair.name1) for pair in pairs if pair.num_verified > 0]
    paired = sorted({name for pair in verified for name in pair})
    components = tuple(tuple(component) for component in connected_components(paired, verified))
    return SceneReport(
        scene=scene,
        image_names=names,
        models=tuple(models),
        pairs=pairs,
        components=components,
        missing=missing_photos(names, pairs, components, models, left_out, mapped),
        stage_seconds=dict(stage_seconds or {}),
        configuration=dict(configuration or {}),
        versions=dict(versions or {}),
        evidence=dict(evidence or {}),
        camera_remarks=tuple(camera_remarks),
        warnings=tuple(warnings),
        added=tuple(sorted(added)),
    )


def _plain(value: Any) -> Any:
    """Records as dicts, tuples as lists and NaN as None, all the way down."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, StrEnum) else value
