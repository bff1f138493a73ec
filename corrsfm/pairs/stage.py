"""The third stage: features become the list of pairs to match."""

from __future__ import annotations

import dataclasses
import logging
import time

from corrsfm import config as cfg
from corrsfm.config import config_hash, hash_of_content
from corrsfm.errors import InputError
from corrsfm.graph import describe_components
from corrsfm.pairs import strategies
from corrsfm.types import PairList
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import (
    drop_foreign_record,
    imported_from,
    record_imported_pairs,
    warn_of_no_effect,
)
from corrsfm.workspace.lists import Index, read_added, read_index, read_pairs, write_pairs
from corrsfm.workspace.resume import StageOutcome, explain, finish, photos_left_out
from corrsfm.workspace.stores import features_of, matches_of
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["fingerprint_of", "make_pairs"]

logger = logging.getLogger("corrsfm")


@keeps_warnings("pairs")
def make_pairs(
    workspace: Workspace, config: cfg.PairsConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Choose the pairs to match, and warn if they do not connect all photos.

    Photos that were left out as unreadable have no pairs.
    """
    started = time.monotonic()
    index = read_index(workspace)
    features = workspace.require("features")
    drop_foreign_record(workspace, "pairs")
    if (source := imported_from(workspace, "pairs")) is not None:
        warn_of_no_effect("pairs", config, overwrite=overwrite)
        return _keep_imported(workspace, source, index.names)
    fingerprint = fingerprint_of(
        index, features.fingerprint, config, run.seed, is_sequence=workspace.is_sequence
    )
    left_out = photos_left_out(workspace, index.names)
    records = [record for record in index.records if record.name not in left_out]
    if len(records) < 2:
        raise InputError(
            f"{workspace.root}: {len(left_out)} of {len(index.records)} photos cannot be read, at least 2 "
            "are needed; replace them and run again"
        )
    names = [record.name for record in records]
    if not overwrite and workspace.is_current("pairs", fingerprint, workspace.pair_origins):
        pair_list = read_pairs(workspace)
        if not workspace.is_current("pairs", fingerprint, workspace.pairs):
            write_pairs(workspace, pair_list)
        _warn_if_disconnected(names, pair_list)
        return StageOutcome(stage="pairs", num_items=len(pair_list), num_reused=len(pair_list), skipped=True)
    explain(workspace, "pairs", config)
    if read_added(workspace):
        logger.warning("pairs: chosen again for all photos; those that corrsfm add chose are not kept")
    with features_of(workspace).reader() as read:
        # A list or a model may name photos that were left out.
        candidates = index.records if config.pairs_file or config.covisible_model else records
        pair_list = _without(
            left_out,
            strategies.make_pairs(
                candidates, config, load_features=read, seed=run.seed, is_sequence=workspace.is_sequence
            ),
        )
    if not len(pair_list):
        raise InputError(
            f"{workspace.root}: no pair of photos to match; choose another --pairing or larger neighbourhoods"
        )
    _warn_if_disconnected(names, pair_list)
    workspace.forget("pairs")
    write_pairs(workspace, pair_list)
    outcome = StageOutcome(stage="pairs", num_items=len(pair_list), seconds=time.monotonic() - started)
    finish(workspace, outcome, fingerprint, config, inputs={"features": features.fingerprint})
    return outcome


def _keep_imported(workspace: Workspace, source: cfg.ImportedConfig, names: list[str]) -> StageOutcome:
    """The pairs of imported matches of the photos that are there; those of others wait for their return."""
    photos = set(names)
    known = {tuple(text.split("\t")) for text in matches_of(workspace).texts()}
    known.update(read_pairs(workspace).pairs)
    pairs = sorted((pair[0], pair[1]) for pair in known if len(pair) == 2 and photos.issuperset(pair))
    pair_list = record_imported_pairs(workspace, pairs, source)
    _warn_if_disconnected(names, pair_list)
    return StageOutcome(stage="pairs", num_items=len(pair_list), num_reused=len(pair_list), skipped=True)


def fingerprint_of(
    index: Index, features: str, config: cfg.PairsConfig, seed: int, *, is_sequence: bool
) -> str:
    """What the record of the stage must carry to be current; ``features`` is the fingerprint of theirs."""
    files = [hash_of_content(path) for path in (config.pairs_file, config.covisible_model) if path]
    order = ["in the order of time"] if is_sequence else []
    photos = [[r.name, r.gps] for r in index.records]
    # What is in a file decides about equal pairs, not where it is.
    options = dataclasses.replace(config, pairs_file=None, covisible_model=None)
    return config_hash("pairs", options, seed, photos, features, *files, *order)


def _without(names: set[str], pair_list: PairList) -> PairList:
    """Drop the pairs that contain one of these photos."""
    kept = [number for number, pair in enumerate(pair_list.pairs) if names.isdisjoint(pair)]
    return PairList(
        pairs=tuple(pair_list.pairs[number] for number in kept),
        origins=tuple(pair_list.origins[number] for number in kept),
    )


def _warn_if_disconnected(names: list[str], pair_list: PairList) -> None:
    text = describe_components(names, pair_list.pairs)
    if text:
        logger.warning("%s", text)
