"""The fifth stage: the putative matches of each pair are pruned; what is kept goes on."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator

from corrsfm import config as cfg
from corrsfm.config import config_hash
from corrsfm.errors import WorkspaceError
from corrsfm.files import share_file
from corrsfm.machine import count_threads, find_device, use_threads
from corrsfm.prune import build_pruner, make_correspondences
from corrsfm.types import Correspondences, Matches, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, MATCHES, PRUNED, PrunedMatches
from corrsfm.workspace.imported import traits_of
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.resume import StageOutcome, complete, wanted_matches
from corrsfm.workspace.store import ItemStore
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["prune_matches"]

logger = logging.getLogger("corrsfm")

CACHED_IMAGES = 512
# A killed run loses at most the pairs pruned together, a few seconds of work: many on a GPU or with native
# threads, few with a network on a CPU, which takes up to a second for one.
PAIRS_PRUNED_TOGETHER = 128
PAIRS_PRUNED_TOGETHER_PER_CPU_THREAD = 2


@keeps_warnings("pruned matches")
def prune_matches(
    workspace: Workspace, config: cfg.PruneConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Prune the putative matches of every pair; those of other methods are kept for when they are wanted."""
    index = read_index(workspace)
    cameras = {record.name: index.camera_of(record) for record in index.records}
    matches = workspace.require("matches")
    putative = ItemStore(workspace.matches, MATCHES)
    match_fingerprints = wanted_matches(workspace)
    device, threads = find_device(run.device), count_threads(run.threads)
    pruner = build_pruner(config, traits=traits_of(workspace), device=device, seed=run.seed, threads=threads)
    group_size = _num_pruned_together(config.method, device, threads)
    wanted = {
        pair: config_hash("prune", fingerprint, pruner.fingerprint, cameras[pair[0]], cameras[pair[1]])
        for pair, fingerprint in match_fingerprints.items()
    }
    use_threads(threads)
    with ItemStore(workspace.features, FEATURES).reader() as load, putative.reader() as read_matches:
        read_features = functools.lru_cache(maxsize=CACHED_IMAGES)(load)

        def gather(pair: Pair, matched: Matches) -> Correspondences:
            features0, features1 = (read_features(name) for name in pair)
            camera0, camera1 = (cameras[name] for name in pair)
            return make_correspondences(features0, features1, matched, camera0, camera1, " – ".join(pair))

        def produce(missing: list[Pair]) -> Iterator[tuple[Pair, PrunedMatches]]:
            found = putative.fingerprints(missing)
            if any(found[pair] != match_fingerprints[pair] for pair in missing):
                raise WorkspaceError(
                    f"{workspace.matches}: older than the features; run: {workspace.command_for('matches')}"
                )
            for start in range(0, len(missing), group_size):
                batch = [(pair, read_matches(pair)) for pair in missing[start : start + group_size]]
                results = pruner([gather(pair, matched) for pair, matched in batch])
                for (pair, matched), result in zip(batch, results, strict=True):
                    yield pair, PrunedMatches.from_result(matched, result)

        return complete(
            workspace,
            "pruned matches",
            _store_of(workspace, config.method),
            wanted,
            produce,
            config,
            inputs={"matches": matches.fingerprint},
            overwrite=overwrite,
            unit="pair",
            shown_as=workspace.pruned,
        )


def _store_of(workspace: Workspace, method: cfg.PruneMethod) -> ItemStore[Pair, PrunedMatches]:
    path = workspace.pruned_by(method)
    path.parent.mkdir(exist_ok=True)
    if not path.exists() and workspace.pruned.exists():
        # Of a workspace that kept one method only; items of another method do not count as finished.
        share_file(workspace.pruned, path)
    return ItemStore(path, PRUNED)


def _num_pruned_together(method: cfg.PruneMethod, device: str, threads: int) -> int:
    with_network = method.architecture is not None
    on_cpu = device == "cpu"
    return (
        PAIRS_PRUNED_TOGETHER_PER_CPU_THREAD * threads if with_network and on_cpu else PAIRS_PRUNED_TOGETHER
    )
