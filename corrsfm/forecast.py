"""How long a run will take and how much disk it needs, by running its first stages on a few photos."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from corrsfm import config as cfg
from corrsfm.database.stage import verify_matches
from corrsfm.errors import InputError
from corrsfm.features.stage import extract_features
from corrsfm.files import atomic_write_text
from corrsfm.images.stage import index_photos
from corrsfm.machine import count_threads
from corrsfm.matches.stage import match_pairs
from corrsfm.pairs.stage import make_pairs
from corrsfm.pairs.strategies import natural_order, num_pairs_expected
from corrsfm.prune.stage import prune_matches
from corrsfm.workspace import Workspace
from corrsfm.workspace.resume import StageOutcome

__all__ = ["Forecast", "forecast_run"]

# Photos of the first measurement, which also pays for loading libraries and the network, and at most those
# of the second, which is the cost of more. It is left out where the first has taken longer than this.
_NUM_FIRST = 2
_NUM_SECOND = 4
_LONGEST_FIRST_S = 5.0

logger = logging.getLogger("corrsfm")


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What a run is expected to cost on this machine.

    Attributes
    ----------
    num_photos, num_pairs : int
    seconds_per_photo, seconds_per_pair : float
        Features; and matching, pruning and verification.
    bytes_per_photo, bytes_per_pair : float
        Of the workspace.
    """

    num_photos: int
    num_pairs: int
    seconds_per_photo: float
    seconds_per_pair: float
    bytes_per_photo: float
    bytes_per_pair: float

    @property
    def minutes(self) -> float:
        """Until mapping begins."""
        return (self.num_photos * self.seconds_per_photo + self.num_pairs * self.seconds_per_pair) / 60

    @property
    def megabytes(self) -> float:
        """Of the workspace before mapping; a model adds little."""
        return (self.num_photos * self.bytes_per_photo + self.num_pairs * self.bytes_per_pair) / 1e6

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**asdict(self), "minutes": self.minutes, "megabytes": self.megabytes}

    def __str__(self) -> str:
        """One line for a person."""
        minutes = f"{self.minutes:.0f} min" if self.minutes >= 2 else f"{60 * self.minutes:.0f} s"
        return (
            f"a run matches {self.num_pairs:,} pairs: about {minutes} on this machine, then mapping, and "
            f"{max(1.0, self.megabytes):,.0f} MB of disk"
        )


def forecast_run(folder: Path, names: Sequence[str], config: cfg.PipelineConfig | None = None) -> Forecast:
    """Run the stages before mapping on a few photos in a temporary workspace, and extrapolate.

    Parameters
    ----------
    folder : Path
    names : sequence of str
        The photos that the run will use, relative to the folder.
    config : PipelineConfig, optional

    Raises
    ------
    InputError
        If there are fewer than two photos.
    CorrsfmError
        What the stages raise.
    """
    config = config or cfg.PipelineConfig()
    if len(names) < _NUM_FIRST:
        raise InputError(f"{folder}: {len(names)} photos; a forecast needs two")
    # Neighbours in the middle of the scene overlap more often than its first photos.
    num_second = min(_NUM_SECOND, max(2, count_threads(config.run.threads)))
    order = [names[i] for i in natural_order(names)]
    start = max(0, (len(names) - _NUM_FIRST - num_second) // 2)
    chosen = order[start : start + _NUM_FIRST + num_second]
    with tempfile.TemporaryDirectory() as scratch, _quiet():
        workspace = Workspace(Path(scratch) / "scene", create=True)
        started = time.monotonic()
        first = _run(workspace, folder, chosen[:_NUM_FIRST], config)
        sizes = _sizes(workspace)
        if time.monotonic() - started > _LONGEST_FIRST_S or len(chosen) == _NUM_FIRST:
            return _extrapolated(names, config, first, sizes)
        second = _run(workspace, folder, chosen, config)
        return _extrapolated(names, config, second, _sizes(workspace))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what the stages say about a few photos to ourselves."""
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _run(
    workspace: Workspace, folder: Path, names: Sequence[str], config: cfg.PipelineConfig
) -> dict[str, StageOutcome]:
    """The outcomes of the stages before mapping."""
    chosen = workspace.root.parent / "photos.txt"
    atomic_write_text(chosen, "".join(f"{name}\n" for name in names))
    images = dataclasses.replace(config.images, image_list=chosen)
    pairs = cfg.PairsConfig(pairing=(cfg.PairStrategy.EXHAUSTIVE,))
    with workspace.lock():
        outcomes = (
            index_photos(workspace, folder, images, config.run, overwrite=True),
            extract_features(workspace, config.features, config.run),
            make_pairs(workspace, pairs, config.run),
            match_pairs(workspace, config.matches, config.run),
            prune_matches(workspace, config.prune, config.run),
            verify_matches(workspace, config.database, config.run),
        )
    return {outcome.stage: outcome for outcome in outcomes}


def _sizes(workspace: Workspace) -> tuple[int, int]:
    """Bytes that grow with the photos, and with the pairs."""
    of_photos = [workspace.features, *workspace.converted.glob("**/*.jpg")]
    of_pairs = [workspace.matches, workspace.pruned, workspace.database]
    sums = [sum(p.lstat().st_size for p in paths if p.exists()) for paths in (of_photos, of_pairs)]
    return sums[0], sums[1]


def _extrapolated(
    names: Sequence[str],
    config: cfg.PipelineConfig,
    outcomes: dict[str, StageOutcome],
    sizes: tuple[int, int],
) -> Forecast:
    def rate(stage: str) -> float:
        """Seconds an item, of those that an earlier outcome did not make."""
        made = outcomes[stage].num_items - outcomes[stage].num_reused
        return outcomes[stage].seconds / max(1, made)

    num_photos, num_pairs = outcomes["features"].num_items, outcomes["pairs"].num_items
    return Forecast(
        num_photos=len(names),
        num_pairs=num_pairs_expected(len(names), config.pairs),
        seconds_per_photo=rate("features"),
        seconds_per_pair=sum(rate(stage) for stage in ("matches", "pruned matches", "verified matches")),
        bytes_per_photo=sizes[0] / num_photos,
        bytes_per_pair=sizes[1] / num_pairs,
    )
