"""The stages in order: each reads and writes files of a workspace and skips what is finished.

Every function here takes a workspace and the options of its stage and returns a `StageOutcome`; `report`
alone summarises what all of them did.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from corrsfm import config as cfg
from corrsfm.config import config_hash
from corrsfm.errors import ImageError, InputError, WorkspaceError
from corrsfm.files import sha256_of
from corrsfm.index import Index, PhotoCache, read_index, read_pairs, write_index, write_pairs
from corrsfm.machine import count_threads, find_device, threaded, use_threads
from corrsfm.mapping import reconstruct
from corrsfm.resume import (
    StageOutcome,
    complete,
    explain,
    explain_photos,
    finish,
    mark_left_out,
    photos_left_out,
    refuse_vanished_photos,
)
from corrsfm.store import FEATURES, MATCHES, PRUNED, ItemStore, PrunedMatches, check_hloc_keys
from corrsfm.summary import report
from corrsfm.types import Correspondences, Features, ImageRecord, Matches, Pair, PairList
from corrsfm.workspace import Workspace

__all__ = [
    "StageOutcome",
    "check_options",
    "extract_features",
    "index_photos",
    "make_pairs",
    "match_pairs",
    "prune_matches",
    "reconstruct",
    "report",
    "verify_matches",
]

logger = logging.getLogger("corrsfm")

CACHED_IMAGES = 512
# A killed run loses at most the pairs that are pruned together, which take a few seconds: a GPU and the
# estimators on native threads want many, a network on a CPU takes up to a second for one.
PAIRS_PRUNED_TOGETHER = 128
PAIRS_PRUNED_TOGETHER_PER_CPU_THREAD = 2


def index_photos(
    workspace: Workspace,
    images_dir: Path,
    config: cfg.ImagesConfig,
    run: cfg.RunConfig,
    *,
    overwrite: bool = False,
) -> StageOutcome:
    """List the photos, read their cameras and write the index.

    Raises
    ------
    InputError
        If there are fewer than two photos, or the folder, list, masks or camera options cannot be used, or,
        without ``overwrite``, if most of the photos that the workspace knows are not in the folder.
    """
    from corrsfm.images import duplicate_images, index_images, name_remarks

    started = time.monotonic()
    if images_dir.is_dir() and not overwrite:
        refuse_vanished_photos(workspace, images_dir)
    cache = PhotoCache(workspace.photo_cache)
    records, cameras = index_images(
        images_dir, config, threads=count_threads(run.threads), hash_of=cache.hash_of, info_of=cache.info_of
    )
    cache.save()
    check_hloc_keys(record.name for record in records)
    for remark in name_remarks([record.name for record in records]):
        logger.warning("%s", remark)
    for names in duplicate_images(records):
        logger.warning("photos with the same content: %s", ", ".join(names))
    index = Index(records=tuple(records), cameras=tuple(cameras))
    fingerprint = config_hash("images", index.records, index.cameras)
    explain_photos(workspace, index)
    if not workspace.is_current("images", fingerprint, workspace.images_json, workspace.images_txt):
        workspace.forget("images")
        write_index(workspace, index)
    workspace.images_dir = images_dir
    outcome = StageOutcome(stage="images", num_items=len(records), seconds=time.monotonic() - started)
    finish(workspace, outcome, fingerprint, config)
    return outcome


def check_options(run: cfg.RunConfig, prune: cfg.PruneConfig | None = None) -> None:
    """Find out before any work whether the device, and the checkpoint of a method, can be used.

    Parameters
    ----------
    run : RunConfig
    prune : PruneConfig, optional
        The method that comes later; none if matching is the last stage.

    Raises
    ------
    ConfigError
        If there is no such device.
    CheckpointError
        If the method needs a checkpoint and it is missing or cannot be read.
    """
    from corrsfm.prune import build_pruner

    device = find_device(run.device)
    if prune is not None:
        build_pruner(prune, device=device, seed=run.seed, threads=count_threads(run.threads))


def extract_features(
    workspace: Workspace, config: cfg.FeaturesConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Extract the features of every photo of the index.

    Raises
    ------
    ImageError
        Naming every photo that cannot be read; the features of the others are kept.
    """
    from corrsfm.colmap import colmap_log
    from corrsfm.features import algorithm_of, create_extractor
    from corrsfm.images import read_image, read_mask

    index = read_index(workspace)
    images = workspace.require("images")
    algorithm = algorithm_of(config.extractor)
    wanted = {
        record.name: config_hash(algorithm, record.sha256, record.mask_sha256 or "", config)
        for record in index.records
    }
    of_left_out = {name: mark_left_out(fingerprint) for name, fingerprint in wanted.items()}
    store = ItemStore(workspace.features, FEATURES)
    records = {record.name: record for record in index.records}
    extract = create_extractor(config)
    mask_dir = images.config.get("mask_dir")
    unreadable: list[str] = []

    def work(name: str) -> Features | ImageError:
        record = records[name]
        try:
            image = read_image(workspace.images_dir / name)
            mask = read_mask(Path(mask_dir) / record.mask, image.shape) if mask_dir and record.mask else None
            return extract(image, mask)
        except ImageError as error:
            return error

    def produce(missing: list[str]) -> Iterator[tuple[str, Features]]:
        for name, result in threaded(work, missing, count_threads(run.threads)):
            if isinstance(result, Features):
                yield name, result
            elif images.config.get("skip_unreadable"):
                logger.warning("left out: %s", result)
                wanted[name] = of_left_out[name]
                yield name, _no_features(index, records[name])
            else:
                unreadable.append(str(result))
        if unreadable:
            raise ImageError(
                "\n".join(unreadable)
                + "\nremove or replace these photos and run again, or use --skip-unreadable; the features of "
                "the others are kept"
            )

    with colmap_log(workspace.log) if config.extractor is cfg.Extractor.PYCOLMAP else nullcontext():
        if images.config.get("skip_unreadable"):
            for name in sorted(store.finished(of_left_out)):
                if isinstance(result := work(name), ImageError):
                    logger.warning("left out: %s", result)
                    wanted[name] = of_left_out[name]
        return complete(
            workspace,
            "features",
            store,
            wanted,
            produce,
            config,
            inputs={"images": images.fingerprint},
            overwrite=overwrite,
            unit="photo",
        )


def make_pairs(
    workspace: Workspace, config: cfg.PairsConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Choose the pairs to match, and warn if they do not connect all photos.

    Photos that were left out as unreadable have no pairs.
    """
    from corrsfm import pairs as pairing

    started = time.monotonic()
    index = read_index(workspace)
    features = workspace.require("features")
    files = [_content(path) for path in (config.pairs_file, config.covisible_model) if path is not None]
    fingerprint = config_hash(
        "pairs", config, run.seed, [[r.name, r.gps] for r in index.records], features.fingerprint, *files
    )
    left_out = photos_left_out(workspace, index.names)
    records = [record for record in index.records if record.name not in left_out]
    if len(records) < 2:
        raise InputError(
            f"{workspace.root}: {len(left_out)} of {len(index.records)} photos cannot be read, at least 2 "
            "are needed; replace them and run again"
        )
    names = [record.name for record in records]
    if not overwrite and workspace.is_current("pairs", fingerprint, workspace.pairs, workspace.pair_origins):
        pair_list = read_pairs(workspace)
        _warn_if_disconnected(names, pair_list)
        return StageOutcome(stage="pairs", num_items=len(pair_list), num_reused=len(pair_list), skipped=True)
    explain(workspace, "pairs", config)
    with ItemStore(workspace.features, FEATURES).reader() as read:
        # A list or a model may well name photos that were left out; that is no mistake.
        candidates = index.records if files else records
        pair_list = _without(
            left_out, pairing.make_pairs(candidates, config, load_features=read, seed=run.seed)
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


def match_pairs(
    workspace: Workspace, config: cfg.MatchesConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Find the putative matches of every pair."""
    from corrsfm.matches import Matcher

    features = workspace.require("features")
    pairs = workspace.require("pairs")
    store = ItemStore(workspace.features, FEATURES)
    wanted = _wanted_matches(workspace)
    device = find_device(run.device)
    # On a CPU a thread takes a pair: threads that share a pair wait for each other at every step.
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


def prune_matches(
    workspace: Workspace, config: cfg.PruneConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Prune the putative matches of every pair."""
    from corrsfm.prune import build_pruner, make_correspondences

    index = read_index(workspace)
    cameras = {record.name: index.camera_of(record) for record in index.records}
    matches = workspace.require("matches")
    putative = ItemStore(workspace.matches, MATCHES)
    match_fingerprints = _wanted_matches(workspace)
    device, threads = find_device(run.device), count_threads(run.threads)
    pruner = build_pruner(config, device=device, seed=run.seed, threads=threads)
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
            ItemStore(workspace.pruned, PRUNED),
            wanted,
            produce,
            config,
            inputs={"matches": matches.fingerprint},
            overwrite=overwrite,
            unit="pair",
        )


def verify_matches(
    workspace: Workspace, config: cfg.DatabaseConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Write the COLMAP database and verify the pruned matches geometrically."""
    from corrsfm.colmap import is_truncated, pycolmap_version
    from corrsfm.database import write_database

    started = time.monotonic()
    index = read_index(workspace)
    pruned = workspace.require("pruned matches")
    fingerprint = config_hash(
        "verified matches", pycolmap_version(), pruned.fingerprint, index.cameras, config, run.seed
    )
    pair_list = read_pairs(workspace)
    damaged = workspace.database.is_file() and is_truncated(workspace.database)
    if damaged:
        logger.warning("%s: damaged, its end is missing; it is written anew", workspace.database)
    current = workspace.is_current("verified matches", fingerprint, workspace.database)
    if current and not overwrite and not damaged:
        return StageOutcome(
            stage="verified matches", num_items=len(pair_list), num_reused=len(pair_list), skipped=True
        )
    if not damaged:
        explain(workspace, "verified matches", config)
    workspace.forget("verified matches")
    with (
        ItemStore(workspace.features, FEATURES).reader() as read_features,
        ItemStore(workspace.pruned, PRUNED).reader() as read_pruned,
    ):
        write_database(
            workspace.database,
            images=index.records,
            cameras=index.cameras,
            features=read_features,
            pruned=((*pair, read_pruned(pair).indices) for pair in pair_list.pairs),
            config=config,
            seed=run.seed,
            num_threads=count_threads(run.threads),
            log_file=workspace.log,
        )
    outcome = StageOutcome(
        stage="verified matches", num_items=len(pair_list), seconds=time.monotonic() - started
    )
    finish(workspace, outcome, fingerprint, config, inputs={"pruned matches": pruned.fingerprint})
    return outcome


def _without(names: set[str], pair_list: PairList) -> PairList:
    """The pairs of a list that are of other photos than these."""
    kept = [number for number, pair in enumerate(pair_list.pairs) if names.isdisjoint(pair)]
    return PairList(
        pairs=tuple(pair_list.pairs[number] for number in kept),
        origins=tuple(pair_list.origins[number] for number in kept),
    )


def _warn_if_disconnected(names: list[str], pair_list: PairList) -> None:
    from corrsfm.pairs import describe_components

    text = describe_components(names, pair_list.pairs)
    if text:
        logger.warning("%s", text)


def _content(path: Path) -> str:
    """Hash of what a file or all files of a folder hold; missing ones are reported by whoever reads them."""
    files = sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []
    return config_hash(*[[file.name, sha256_of(file)] for file in files if file.is_file()])


def _wanted_matches(workspace: Workspace) -> dict[Pair, str]:
    """Fingerprint that the putative matches of each pair must carry."""
    fingerprints = ItemStore(workspace.features, FEATURES).fingerprints(read_index(workspace).names)
    return {
        pair: config_hash("matches-1", fingerprints[pair[0]], fingerprints[pair[1]])
        for pair in read_pairs(workspace).pairs
    }


def _num_pruned_together(method: cfg.PruneMethod, device: str, threads: int) -> int:
    with_network = method in (cfg.PruneMethod.CORRADAPTOR, cfg.PruneMethod.CASCADE)
    on_cpu = device == "cpu"
    return (
        PAIRS_PRUNED_TOGETHER_PER_CPU_THREAD * threads if with_network and on_cpu else PAIRS_PRUNED_TOGETHER
    )


def _no_features(index: Index, record: ImageRecord) -> Features:
    """Features of a photo that was left out."""
    camera = index.camera_of(record)
    none = np.zeros(0, np.float32)
    return Features(
        keypoints=np.zeros((0, 2), np.float32), scales=none, orientations=none, scores=none,
        descriptors=np.zeros((0, 128), np.uint8), image_size=(camera.width, camera.height),
    )  # fmt: skip
