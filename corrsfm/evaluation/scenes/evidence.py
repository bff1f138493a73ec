"""What models are compared by where no camera is known: explained share, predicted matches, verdict."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from corrsfm.colmap.pairs import read_verified_matches
from corrsfm.files import read_json
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.views import Views
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.models import changed_models
from corrsfm.workspace.stores import features_of

__all__ = ["ModelEvidence", "common_evidence", "evidence_of"]


@dataclass(frozen=True, kw_only=True)
class ModelEvidence:
    """What speaks for and against the largest model of a workspace.

    Attributes
    ----------
    explained_share : float
        Explained over verified matches of the workspace.
    num_contradicted_pairs : int
    grade : str or None
        Of the verdict; None if the mapper had no choice to judge.
    """

    explained_share: float
    num_contradicted_pairs: int
    grade: str | None


def evidence_of(workspace: Workspace, views: Views) -> ModelEvidence:
    """The evidence on record, or what of it can be had afterwards if mapping left none.

    Parameters
    ----------
    workspace : Workspace
        With current models.
    views : mapping of str to View
        Of its largest model.
    """
    try:
        if changed_models(workspace):
            raise ValueError("is of models that were changed since")
        record = read_json(workspace.evidence)
        return ModelEvidence(
            explained_share=float(record["explained_share"]),
            num_contradicted_pairs=len(record["contradicted_pairs"]),
            grade=str(record["verdict"]["grade"]),
        )
    except (OSError, ValueError, KeyError, TypeError):
        with common_evidence([workspace]) as evidence:
            explained = evidence.explain(views)
        return ModelEvidence(
            explained_share=explained.share,
            num_contradicted_pairs=len(explained.contradicted),
            grade=None,
        )


@contextlib.contextmanager
def common_evidence(workspaces: Sequence[Workspace], *, seed: int = 0) -> Iterator[SceneEvidence]:
    """What models of several workspaces can be compared by: `SceneEvidence.count_predicted` of each.

    All are counted over the same pairs of photos, drawn from what is verified in any of the workspaces, and
    the nearest descriptors of a pair are found once for all models.

    Parameters
    ----------
    workspaces : sequence of Workspace
        Of one scene, with the same features, at least one; each with verified matches.
    seed : int
        Of the sample of pairs in a large scene.
    """
    verified = {}
    for workspace in workspaces:
        verified.update(read_verified_matches(workspace.database))
    with features_of(workspaces[0]).reader() as load:
        yield SceneEvidence(read_index(workspaces[0]).names, verified, load, seed=seed)
