"""The fourth stage: the features of each pair become putative matches."""

from __future__ import annotations

from collections.abc import Iterator

from corrsfm import config as cfg
from corrsfm.machine import count_threads, find_device, threaded, use_threads
from corrsfm.matches import create_matcher
from corrsfm.types import Matches, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, MATCHES
from corrsfm.workspace.imported import imported_from, imported_matches, traits_with
from corrsfm.workspace.resume import StageOutcome, complete, wanted_matches
from corrsfm.workspace.store import ItemStore
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
    store = ItemStore(workspace.matches, MATCHES)
    inputs = {"features": features.fingerprint, "pairs": pairs.fingerprint}
    if (source := imported_from(workspace, "matches")) is not None:
        wanted = imported_matches(workspace)
        return complete(
            workspace, "matches", store, wanted, lambda missing: [], source,
            inputs=inputs, overwrite=False, unit="pair",
        )  # fmt: skip
    device = find_device(run.device)
    # On a CPU each thread takes its own pair: threads that share one wait for each other at every step.
    on_cpu = device == "cpu"
    use_threads(1 if on_cpu else count_threads(run.threads))
    with ItemStore(workspace.features, FEATURES).reader() as read:
        match = create_matcher(config, read, kind, device=device)

        def produce(missing: list[Pair]) -> Iterator[tuple[Pair, Matches]]:
            return threaded(lambda pair: match(*pair), missing, count_threads(run.threads) if on_cpu else 1)

        return complete(
            workspace,
            "matches",
            store,
            wanted_matches(workspace, config.matcher),
            produce,
            config,
            inputs=inputs,
            overwrite=overwrite,
            unit="pair",
        )
