"""The item stores of a workspace, opened as the stages that write and read them do."""

from __future__ import annotations

from pathlib import Path

from corrsfm.types import Features, Matches, Pair
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.items import FEATURES, MATCHES, PRUNED, K, Kind, PrunedMatches, T
from corrsfm.workspace.store import ItemStore

__all__ = ["features_of", "matches_of", "pruned_of"]


def features_of(workspace: Workspace) -> ItemStore[str, Features]:
    """Features by the names of photos."""
    return _store(workspace, "features", workspace.features, FEATURES)


def matches_of(workspace: Workspace) -> ItemStore[Pair, Matches]:
    """Putative matches."""
    return _store(workspace, "matches", workspace.matches, MATCHES)


def pruned_of(workspace: Workspace, method: str | None = None) -> ItemStore[Pair, PrunedMatches]:
    """Kept matches of a prune method, or of that which was used last."""
    path = workspace.pruned if method is None else workspace.pruned_by(method)
    return _store(workspace, "pruned matches", path, PRUNED)


def _store(workspace: Workspace, stage: str, path: Path, kind: Kind[K, T]) -> ItemStore[K, T]:
    record = workspace.record_of(stage)
    seal = record.fingerprint if record is not None else None
    remedy, mend = workspace.command_for(stage), workspace.command_for(stage, "--verify")
    merges = not workspace.is_only_read
    return ItemStore(path, kind, remedy=remedy, mend=mend, seal=seal, merges=merges)
