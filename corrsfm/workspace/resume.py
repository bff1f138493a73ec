"""Bring the items of a stage up to date: keep finished ones, make missing ones, say why.

An item (a photo's features, a pair's matches) carries the fingerprint of everything it was made from. A stage
is the set of its items; it is current when every item is there with the fingerprint wanted now.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from corrsfm import config as cfg
from corrsfm.disk import explain as explain_error
from corrsfm.disk import require_room
from corrsfm.errors import CorrsfmError, DamageError, WorkspaceError
from corrsfm.types import Pair
from corrsfm.workspace.commands import label_of
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.imported import imported_from, imported_matches
from corrsfm.workspace.lists import read_index, read_pairs
from corrsfm.workspace.manifest import StageRecord
from corrsfm.workspace.shards import discard_shards, merge_shards
from corrsfm.workspace.store import ItemStore
from corrsfm.workspace.stores import features_of

__all__ = [
    "StageOutcome",
    "complete",
    "explain",
    "finish",
    "finished_or_mended",
    "mark_left_out",
    "photos_left_out",
    "require_database",
    "wanted_matches",
]

logger = logging.getLogger("corrsfm")

_LEFT_OUT = "left out"
# What is written anew lies in the log first, beside what it replaces.
_ROOM_FACTOR = 3
_MATCHER_VERSIONS = {cfg.Matcher.NEAREST: "matches-1", cfg.Matcher.LIGHTGLUE: "lightglue-1"}

K = TypeVar("K")
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class StageOutcome:
    """What a stage did.

    Attributes
    ----------
    stage : str
    num_items, num_reused : int
        Items of the stage, and how many of them an earlier run had made.
    seconds : float
        Wall-clock seconds of this call.
    skipped : bool
        True if everything was up to date.
    """

    stage: str
    num_items: int
    num_reused: int = 0
    seconds: float = 0.0
    skipped: bool = False

    def __str__(self) -> str:
        """One line for a person; the columns of several stages are aligned."""
        state = "up to date" if self.skipped else f"{self.seconds:.1f} s"
        return f"{label_of(self.stage):<17}{self.num_items:>8}   {state}"


def complete(
    workspace: Workspace,
    stage: str,
    store: ItemStore[K, T],
    wanted: Mapping[K, str],
    produce: Callable[[list[K]], Iterable[tuple[K, T | CorrsfmError | None]]],
    config: Any,
    *,
    inputs: dict[str, str],
    overwrite: bool,
    unit: str,
    verify: bool = False,
) -> StageOutcome:
    """Bring a store to exactly the wanted items, keeping finished ones.

    Parameters
    ----------
    workspace : Workspace
    stage : str
    store : ItemStore
    wanted : mapping
        Key → fingerprint of every item the stage consists of.
    produce : callable
        Missing keys → (key, item) as they are done, None for an item that it put into the store itself, and
        an error to end with. Each is safe on disk before the next is asked for. It may change the ``wanted``
        fingerprint of a key that it could not make.
    config : dataclass
        The stage's options, for the record.
    inputs : dict
        Stage → fingerprint of what the items are made from.
    overwrite : bool
        Make all items again.
    unit : str
        What an item is, for the progress bar.
    verify : bool
        Read what is finished and make damaged items again.

    Raises
    ------
    WorkspaceError
        If the store cannot be read or written.
    """
    started = time.monotonic()
    fingerprint = cfg.config_hash(stage, sorted(wanted.values()), inputs)
    finished = set() if overwrite else _finished(store, wanted, fingerprint, verify=verify)
    missing = [key for key in wanted if key not in finished]
    is_whole = not missing and store.seal() == fingerprint
    if is_whole and workspace.is_current(stage, fingerprint, store.path):
        discard_shards(workspace, store)
        return StageOutcome(stage=stage, num_items=len(wanted), num_reused=len(wanted), skipped=True)
    explain(workspace, stage, config)
    record = workspace.record_of(stage)
    if overwrite:
        workspace.forget(stage)
        record = None
    # The store of another method may be the one that the record is about.
    holds_what_is_recorded = record is not None and store.seal() == record.fingerprint
    if holds_what_is_recorded and missing:
        _require_room(store.path, len(missing) / len(wanted))
    spent_on_items = 0.0
    try:
        if overwrite:
            discard_shards(workspace, store)
            store.renew()
        elif merge_shards(workspace, store):
            finished = store.finished(wanted)
            missing = [key for key in wanted if key not in finished]
            is_whole = False
        if finished:
            logger.info(
                "%s: %d of %d up to date, %d to do", label_of(stage), len(finished), len(wanted), len(missing)
            )
        with tqdm(
            total=len(wanted), initial=len(finished), desc=label_of(stage), unit=unit, leave=False
        ) as bar:
            before = time.monotonic()
            for key, item in produce(missing):
                if isinstance(item, CorrsfmError):
                    raise item
                now = time.monotonic()
                if item is not None:
                    store.add(key, wanted[key], item, now - before)
                if holds_what_is_recorded:
                    # Not before something is in: where a full disk takes nothing, nothing is lost.
                    workspace.forget(stage)
                    holds_what_is_recorded = False
                spent_on_items += now - before
                before = now
                bar.update()
        discard_shards(workspace, store)
        fingerprint = cfg.config_hash(stage, sorted(wanted.values()), inputs)
        # Another method's store may have been the one in use meanwhile.
        if not is_whole:
            store.commit(wanted, fingerprint, known=finished)
        seconds_of_items = store.seconds()
    finally:
        store.close()
    outcome = StageOutcome(
        stage=stage, num_items=len(wanted), num_reused=len(finished), seconds=time.monotonic() - started
    )
    cost = seconds_of_items + outcome.seconds - spent_on_items
    finish(workspace, outcome, fingerprint, config, inputs=inputs, cost=cost)
    return outcome


def _require_room(path: Path, share: float) -> None:
    """Refuse to change a finished store where a share of it finds no room again."""
    try:
        require_room(path.parent, round(_ROOM_FACTOR * share * path.stat().st_size))
    except OSError as error:
        raise WorkspaceError(f"{explain_error(error, path)}; nothing was changed") from error


def _finished(store: ItemStore[K, T], wanted: Mapping[K, str], fingerprint: str, *, verify: bool) -> Set[K]:
    """Keys of finished items; damaged ones are dropped from the store with a warning."""
    if verify:
        _mend(store)
    else:
        with contextlib.suppress(DamageError):
            if store.seal() == fingerprint:
                return wanted.keys()
    return finished_or_mended(store, wanted)


def finished_or_mended(store: ItemStore[K, T], wanted: Mapping[K, str]) -> Set[K]:
    """As `ItemStore.finished`; of a damaged store what is whole, with a warning."""
    try:
        return store.finished(wanted)
    except DamageError:
        _mend(store)
        return store.finished(wanted)


def _mend(store: ItemStore[K, T]) -> None:
    for what in store.mend():
        logger.warning("%s", what)


def finish(
    workspace: Workspace,
    outcome: StageOutcome,
    fingerprint: str,
    config: Any,
    inputs: dict[str, str] | None = None,
    cost: float | None = None,
) -> None:
    """Record what a stage did; ``cost`` is what all of it took if earlier runs had a part in it."""
    workspace.finish(
        outcome.stage,
        StageRecord(
            fingerprint=fingerprint,
            # A later command, from another folder, reads them from here.
            config=cfg.to_dict(cfg.absolute(config)),
            inputs=inputs or {},
            seconds=round(outcome.seconds if cost is None else cost, 3),
            num_items=outcome.num_items,
            num_reused=outcome.num_reused,
        ),
    )


def explain(workspace: Workspace, stage: str, config: Any) -> None:
    """Say which changed option makes a finished stage stale."""
    record = workspace.record_of(stage)
    if record is None:
        return
    new = cfg.to_dict(cfg.absolute(config))
    changes = [
        f"{key} {_shown(record.config.get(key))} → {_shown(new[key])}"
        for key in new
        if record.config.get(key) != new[key]
    ]
    reason = ", ".join(changes) if changes else "what it depends on changed"
    logger.info("%s: redone where needed (%s)", label_of(stage), reason)


def _shown(value: object) -> str:
    return "+".join(value) if isinstance(value, list) else str(value)


def wanted_matches(workspace: Workspace, matcher: cfg.Matcher | None = None) -> dict[Pair, str]:
    """Fingerprint that the putative matches of each pair must carry.

    Parameters
    ----------
    workspace : Workspace
    matcher : Matcher, optional
        That of the recorded matches if not given.
    """
    if imported_from(workspace, "matches") is not None:
        return imported_matches(workspace)
    if matcher is None:
        record = workspace.record_of("matches")
        # Version 0.1.0 knew one matcher and did not record it.
        matcher = cfg.Matcher(record.config.get("matcher", "nearest")) if record else cfg.Matcher.NEAREST
    algorithm = cfg.encoded(_MATCHER_VERSIONS[matcher])
    fingerprints = features_of(workspace).fingerprints(read_index(workspace).names)
    texts = {name: cfg.encoded(fingerprint) for name, fingerprint in fingerprints.items()}
    return {
        pair: cfg.hash_encoded(algorithm, texts[pair[0]], texts[pair[1]])
        for pair in read_pairs(workspace).pairs
    }


def mark_left_out(fingerprint: str) -> str:
    """Fingerprint for a photo that was left out, in place of that of its features.

    The two differ, so that a later run tries the photo again.
    """
    return f"{_LEFT_OUT} {fingerprint}"


def photos_left_out(workspace: Workspace, names: Iterable[str]) -> set[str]:
    """Photos of the index that could not be read and so have no features.

    Raises
    ------
    WorkspaceError
        If the features cannot be read.
    """
    fingerprints = features_of(workspace).fingerprints(names)
    return {name for name, fingerprint in fingerprints.items() if fingerprint.startswith(_LEFT_OUT)}


def require_database(workspace: Workspace) -> StageRecord:
    """The record of the verified matches; their database must be whole.

    Raises
    ------
    WorkspaceError
        Naming the command to run.
    """
    from corrsfm.colmap.sqlite import find_strange_table, is_truncated

    record = workspace.require("verified matches")
    path = workspace.database
    if not path.is_file() or is_truncated(path):
        what = "damaged, its end is missing" if path.is_file() else "missing"
        raise WorkspaceError(f"{path}: {what}; run: {workspace.command_for('verified matches')}")
    if strange := find_strange_table(path):
        raise WorkspaceError(f"{path}: damaged, {strange}; run: {workspace.command_for('verified matches')}")
    return record
