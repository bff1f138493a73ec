"""A folded model, mapped again without the pairs that fold it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.sqlite import copy_database, database_errors
from corrsfm.reconstruction.budget import TimeBudget
from corrsfm.reconstruction.calibration import Refinement
from corrsfm.reconstruction.candidates import Candidate, MapperKind, map_candidate
from corrsfm.reconstruction.folds.unfold import Attempt, UnfoldRule, best_unfolding, try_unfolding
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.types import Pair

__all__ = ["unfold_model"]


def unfold_model(
    first: Attempt,
    evidence: SceneEvidence,
    database: Path,
    workdir: Path,
    seed: int,
    refinement: Refinement,
    budget: TimeBudget,
) -> Attempt:
    """The best model without pairs that fold the first one; or the first one.

    Parts that only chance joins are looked for in any case: there, evidence of a fold may be too little.
    """

    def map_without(removed: Sequence[Pair]) -> pycolmap.Reconstruction | None:
        if not budget.seconds_left:
            return None
        with budget.spent():
            folder = workdir / "unfolded"
            return _map_without(removed, database, folder, seed, refinement, budget.seconds_left)

    attempts = try_unfolding(
        first,
        evidence.verified,
        map_without,
        rules=tuple(UnfoldRule) if first.evidence.folded else (UnfoldRule.VOTES,),
    )
    return best_unfolding(first, attempts)


def _map_without(
    removed: Sequence[Pair],
    database: Path,
    workdir: Path,
    seed: int,
    refinement: Refinement,
    max_runtime_seconds: int,
) -> pycolmap.Reconstruction | None:
    """The model of the verified pairs without some of them."""
    shutil.rmtree(workdir, ignore_errors=True)
    workdir.mkdir(parents=True)
    copy = workdir / "database.db"
    copy_database(database, copy)
    with colmap_log(), database_errors(copy), pycolmap.Database.open(copy) as tables:
        ids = {image.name: image.image_id for image in tables.read_all_images()}
        for name0, name1 in removed:
            tables.delete_two_view_geometry(ids[name0], ids[name1])
    candidate = Candidate(mapper=MapperKind.INCREMENTAL, seed=seed)
    return map_candidate(
        candidate, copy, workdir / "model", refinement=refinement, max_runtime_seconds=max_runtime_seconds
    )
