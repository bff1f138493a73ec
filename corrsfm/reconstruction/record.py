"""Why a model was selected, as plain values for `evidence.json` and the report."""

from __future__ import annotations

from typing import Any

from corrsfm.reconstruction.best_model import Selection
from corrsfm.reconstruction.choice import Tried
from corrsfm.reconstruction.explained import ExplainedPair

__all__ = ["FORMAT_VERSION", "record_of"]

FORMAT_VERSION = 1
_NUM_WORST = 5


def record_of(selection: Selection) -> dict[str, Any]:
    """The verdict on a model and what it rests on.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    dict
        ``verdict`` (grade, reasons, next steps), ``explained_share``, ``num_predicted_matches`` (null if no
        choice had to be made), ``support``, ``contradicted_pairs``, ``misplaced_photos``, ``loose_ends``,
        ``pairs`` (verified and explained matches of every verified pair), ``models_tried``,
        ``stopped_because`` and ``folds`` (null where too few pairs tell).
    """
    choice, explained = selection.choice, selection.choice.chosen.explained
    return {
        "format_version": FORMAT_VERSION,
        "verdict": {
            "grade": str(selection.verdict.grade),
            "reasons": list(selection.verdict.reasons),
            "next_steps": list(selection.verdict.next_steps),
        },
        "explained_share": explained.share,
        "num_predicted_matches": choice.chosen.num_predicted,
        "support": choice.support,
        "contradicted_pairs": [_pair(pair) for pair in explained.contradicted],
        "misplaced_photos": list(explained.misplaced),
        "loose_ends": list(explained.loose_ends),
        "pairs": [_pair(pair) for pair in explained.pairs],
        "models_tried": [_tried(model, chosen=model is choice.chosen) for model in choice.tried],
        "num_failed": choice.num_failed,
        "folds": {
            "folded": selection.folds.folded,
            "value": selection.folds.value,
            "num_near_pairs": selection.folds.num_near_pairs,
            "worst_pairs": [
                {
                    "name0": pair.name0,
                    "name1": pair.name1,
                    "share_conflict": pair.share_conflict,
                    "hole": pair.hole,
                }
                for pair in selection.folds.worst(_NUM_WORST)
            ],
            "left_out": [list(pair) for pair in selection.left_out],
        },
        "stopped_because": choice.reason,
    }


def _pair(pair: ExplainedPair) -> dict[str, Any]:
    return {
        "name0": pair.name0,
        "name1": pair.name1,
        "num_verified": pair.num_verified,
        "num_explained": pair.num_explained,
        "registered": pair.is_registered,
    }


def _tried(model: Tried, *, chosen: bool) -> dict[str, Any]:
    return {
        "name": model.name,
        "num_registered": model.num_registered,
        "explained_share": model.explained_share,
        "num_predicted_matches": model.num_predicted,
        "seconds": round(model.seconds, 3),
        "chosen": chosen,
    }
