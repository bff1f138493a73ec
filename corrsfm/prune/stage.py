"""The fifth stage: the putative matches of each pair are pruned; what is kept goes on."""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Iterable, Iterator

from corrsfm import config as cfg
from corrsfm.cluster import connected
from corrsfm.config import encoded, hash_encoded
from corrsfm.errors import ClusterError, CorrsfmError, WorkspaceError
from corrsfm.machine import count_threads, find_device, use_threads
from corrsfm.prune import PrunerProtocol, build_pruner, make_correspondences
from corrsfm.types import Camera, Correspondences, Matches, Pair, check_indices
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import traits_of
from corrsfm.workspace.items import PrunedMatches
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.resume import StageOutcome, complete, wanted_matches
from corrsfm.workspace.shards import make_items
from corrsfm.workspace.stores import features_of, matches_of, pruned_of
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
    match_fingerprints = wanted_matches(workspace)
    device, threads = find_device(run.device), count_threads(run.threads)
    pruner = build_pruner(config, traits=traits_of(workspace), device=device, seed=run.seed, threads=threads)
    texts = {camera: encoded(camera) for camera in index.cameras}
    of_photo = {name: texts[camera] for name, camera in cameras.items()}
    prune, by = encoded("prune"), encoded(pruner.fingerprint)
    wanted = {
        pair: hash_encoded(prune, encoded(fingerprint), by, of_photo[pair[0]], of_photo[pair[1]])
        for pair, fingerprint in match_fingerprints.items()
    }
    store = pruned_of(workspace, config.method)

    def produce(missing: list[Pair]) -> Iterator[tuple[Pair, PrunedMatches | CorrsfmError | None]]:
        found = matches_of(workspace).fingerprints(missing)
        if any(found[pair] != match_fingerprints[pair] for pair in missing):
            raise WorkspaceError(
                f"{workspace.matches}: older than the features; run: {workspace.command_for('matches')}"
            )
        work = functools.partial(_prune, pruner=pruner, method=config.method)
        if cluster is not None:
            work = functools.partial(
                _prune_on_worker, config=cfg.absolute(config), fingerprint=pruner.fingerprint
            )

        def source_of(pair: Pair) -> Source:
            return pair, cameras[pair[0]], cameras[pair[1]]

        return make_items(cluster, workspace, store, work, missing, source_of, wanted, run)

    with connected(run.cluster, run.workers) as cluster:
        return complete(
            workspace,
            "pruned matches",
            store,
            wanted,
            produce,
            config,
            inputs={"matches": matches.fingerprint},
            overwrite=overwrite,
            unit="pair",
            verify=run.verify,
        )


Source = tuple[Pair, Camera, Camera]
"""A pair and the cameras of its photos."""


def _prune_on_worker(
    workspace: Workspace,
    sources: Iterable[Source],
    run: cfg.RunConfig,
    *,
    config: cfg.PruneConfig,
    fingerprint: str,
) -> Iterator[tuple[Pair, PrunedMatches]]:
    device, threads = find_device(run.device), count_threads(run.threads)
    pruner = build_pruner(config, traits=traits_of(workspace), device=device, seed=run.seed, threads=threads)
    if pruner.fingerprint != fingerprint:
        raise ClusterError(
            f"would prune otherwise ({pruner.fingerprint}) than the run asks for ({fingerprint}); "
            "try --precision float32"
        )
    return _prune(workspace, sources, run, pruner=pruner, method=config.method)


def _prune(
    workspace: Workspace,
    sources: Iterable[Source],
    run: cfg.RunConfig,
    *,
    pruner: PrunerProtocol,
    method: cfg.PruneMethod,
) -> Iterator[tuple[Pair, PrunedMatches]]:
    """Prune pairs, here or on a worker."""
    device, threads = find_device(run.device), count_threads(run.threads)
    use_threads(threads)
    group_size = _num_pruned_together(method, device, threads)
    with features_of(workspace).reader() as load, matches_of(workspace).reader() as read_matches:
        read_features = functools.lru_cache(maxsize=CACHED_IMAGES)(load)

        def gather(source: Source, matched: Matches) -> Correspondences:
            pair, camera0, camera1 = source
            features0, features1 = (read_features(name) for name in pair)
            check_indices(pair, matched.indices, (len(features0), len(features1)))
            return make_correspondences(features0, features1, matched, camera0, camera1, " – ".join(pair))

        waiting = iter(sources)
        while batch := [
            (source, read_matches(source[0])) for source in itertools.islice(waiting, group_size)
        ]:
            results = pruner([gather(source, matched) for source, matched in batch])
            for ((pair, _, _), matched), result in zip(batch, results, strict=True):
                yield pair, PrunedMatches.from_result(matched, result)


def _num_pruned_together(method: cfg.PruneMethod, device: str, threads: int) -> int:
    with_network = method.architecture is not None
    on_cpu = device == "cpu"
    return (
        PAIRS_PRUNED_TOGETHER_PER_CPU_THREAD * threads if with_network and on_cpu else PAIRS_PRUNED_TOGETHER
    )
