"""The fourth stage: the features of each pair become putative matches."""

from __future__ import annotations

from collections.abc import Iterator

from corrsfm import config as cfg
from corrsfm.machine import count_threads, find_device, threaded, use_threads
from corrsfm.matches.nearest import Matcher
from corrsfm.types import Matches, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, MATCHES
from corrsfm.workspace.resume import StageOutcome, complete, wanted_matches
from corrsfm.workspace.store import ItemStore
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["match_pairs"]


@keeps_warnings("matches")
def match_pairs(
    workspace: Workspace, config: cfg.MatchesConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Find the putative matches of every pair."""
    features = workspace.require("features")
    pairs = workspace.require("pairs")
    store = ItemStore(workspace.features, FEATURES)
    wanted = wanted_matches(workspace)
    device = find_device(run.device)
    # On a CPU each thread takes its own pair: threads that share one wait for each other at every step.
    on_cpu = device == "cpu"
    use_threads(1 if on_cpu else count_threads(run.threads))
    with store.reader() as read:
        matcher = Matcher(lambda name: read(name).descriptors, device=device, block_size=config.block_size)

        def produce(missing: list[Pair]) -> Iterator[tuple[Pair, Matches]]:
            return threaded(
                lambda pair: matcher.match(*pair), missing, count_threads(run.threads) if on_cpu else 1
            )

        return complete(
            workspace,
            "matches",
            ItemStore(workspace.matches, MATCHES),
            wanted,
            produce,
            config,
            inputs={"features": features.fingerprint, "pairs": pairs.fingerprint},
            overwrite=overwrite,
            unit="pair",
        )
