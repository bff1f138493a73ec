"""The fourth stage: the features of each pair become putative matches."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator

from corrsfm import config as cfg
from corrsfm.cluster import connected
from corrsfm.machine import count_threads, find_device, threaded, use_threads
from corrsfm.matches import create_matcher
from corrsfm.types import Matches, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import (
    drop_foreign_record,
    imported_from,
    imported_matches,
    traits_with,
    warn_of_no_effect,
)
from corrsfm.workspace.resume import StageOutcome, complete, wanted_matches
from corrsfm.workspace.shards import make_items
from corrsfm.workspace.stores import features_of, matches_of
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["match_pairs"]


@keeps_warnings("matches")
def match_pairs(
    workspace: Workspace, config: cfg.MatchesConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Find the putative matches of every pair.

    Raises
    ------
    ConfigError
        If the matcher does not know the features, or the matches were imported.
    DependencyError
        If the matcher is not installed.
    """
    kind = traits_with(workspace, config).features
    features = workspace.require("features")
    pairs = workspace.require("pairs")
    drop_foreign_record(workspace, "matches")
    store = matches_of(workspace)
    inputs = {"features": features.fingerprint, "pairs": pairs.fingerprint}
    if (source := imported_from(workspace, "matches")) is not None:
        warn_of_no_effect("matches", config, overwrite=overwrite)
        if run.verify:
            store.require_whole()
        wanted = imported_matches(workspace)
        return complete(
            workspace, "matches", store, wanted, lambda missing: [], source,
            inputs=inputs, overwrite=False, unit="pair",
        )  # fmt: skip
    find_device(run.device)
    wanted = wanted_matches(workspace, config.matcher)
    work = functools.partial(_match, config=config, kind=kind)
    with connected(run.cluster, run.workers) as cluster:
        return complete(
            workspace,
            "matches",
            store,
            wanted,
            lambda missing: make_items(
                cluster, workspace, store, work, missing, lambda pair: pair, wanted, run
            ),
            config,
            inputs=inputs,
            overwrite=overwrite,
            unit="pair",
            verify=run.verify,
        )


def _match(
    workspace: Workspace,
    pairs: Iterable[Pair],
    run: cfg.RunConfig,
    *,
    config: cfg.MatchesConfig,
    kind: cfg.FeatureKind,
) -> Iterator[tuple[Pair, Matches]]:
    """Match pairs, here or on a worker."""
    device = find_device(run.device)
    # On a CPU each thread takes its own pair: threads that share one wait for each other at every step.
    on_cpu = device == "cpu"
    use_threads(1 if on_cpu else count_threads(run.threads))
    with features_of(workspace).reader() as read:
        match = create_matcher(config, read, kind, device=device)
        yield from threaded(lambda pair: match(*pair), pairs, count_threads(run.threads) if on_cpu else 1)
