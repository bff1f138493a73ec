"""Why a model was selected, as plain values for `evidence.json` and the report."""

from __future__ import annotations

from typing import Any

from corrsfm.reconstruction.best_model import Selection
from corrsfm.reconstruction.candidates import StartingCameras
from corrsfm.reconstruction.choice import Tried
from corrsfm.reconstruction.explained import ExplainedPair
from corrsfm.reconstruction.scene_evidence import SceneEvidence

__all__ = ["FORMAT_VERSION", "record_of"]

FORMAT_VERSION = 1
_NUM_WORST = 5
# Pairs of which every match is recorded, for pictures; all of them would make the record long.
_NUM_IN_FULL = 12

_CAMERA_REMARKS = {
    StartingCameras.SHARED: "the model that was chosen has one camera for all photos of a size: it predicts "
    "as many matches",
    StartingCameras.SEPARATE: "the model that was chosen has a camera for each photo: it predicts clearly "
    "more matches",
}


def record_of(selection: Selection, evidence: SceneEvidence) -> dict[str, Any]:
    """The verdict on a model and what it rests on.

    Parameters
    ----------
    selection : Selection
    evidence : SceneEvidence
        That the selection was made by.

    Returns
    -------
    dict
        ``verdict`` (grade, reasons, next steps), ``explained_share``, ``num_predicted_matches`` (null if no
        choice had to be made), ``support``, ``contradicted_pairs``, ``misplaced_photos``, ``loose_ends``,
        ``pairs`` (verified and explained matches of every verified pair), ``models_tried``,
        ``stopped_because``, ``camera_remark`` (what the choice decided about cameras; mostly empty) and
        ``folds`` (null where too few pairs tell). The twelve least explained of ``contradicted_pairs`` have
        ``explained_matches``: a digit for each verified match in the order of the database, 1 if the model
        explains it, else 0.
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
        "contradicted_pairs": [
            _pair(pair) | (_matches(pair, choice.chosen, evidence) if rank < _NUM_IN_FULL else {})
            for rank, pair in enumerate(explained.contradicted)
        ],
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
        "camera_remark": _CAMERA_REMARKS.get(selection.cameras, ""),
    }


def _pair(pair: ExplainedPair) -> dict[str, Any]:
    return {
        "name0": pair.name0,
        "name1": pair.name1,
        "num_verified": pair.num_verified,
        "num_explained": pair.num_explained,
        "registered": pair.is_registered,
    }


def _matches(pair: ExplainedPair, model: Tried, evidence: SceneEvidence) -> dict[str, str]:
    explained = evidence.explained_matches(model.views, (pair.name0, pair.name1))
    return {"explained_matches": "".join("01"[int(match)] for match in explained)}


def _tried(model: Tried, *, chosen: bool) -> dict[str, Any]:
    return {
        "name": model.name,
        "num_registered": model.num_registered,
        "explained_share": model.explained_share,
        "num_predicted_matches": model.num_predicted,
        "seconds": round(model.seconds, 3),
        "chosen": chosen,
    }
