"""The second stage: photos become features."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from corrsfm import config as cfg
from corrsfm.cluster import connected
from corrsfm.colmap.log import colmap_log
from corrsfm.config import config_hash
from corrsfm.errors import ClusterError, CorrsfmError, ImageError, InputError
from corrsfm.features import algorithm_of, create_extractor, reads_colour
from corrsfm.files import sha256_of
from corrsfm.images.photos import read_colour, read_image, read_mask
from corrsfm.machine import count_threads, find_device, threaded, use_threads
from corrsfm.types import Features, ImageRecord
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import (
    drop_foreign_record,
    imported_features,
    imported_from,
    traits_to_come,
    warn_of_no_effect,
)
from corrsfm.workspace.lists import Index, read_index
from corrsfm.workspace.resume import StageOutcome, complete, finished_or_mended, mark_left_out
from corrsfm.workspace.shards import make_items
from corrsfm.workspace.stores import features_of
from corrsfm.workspace.warned import keeps_warnings

__all__ = ["extract_features"]

logger = logging.getLogger("corrsfm")


@keeps_warnings("features")
def extract_features(
    workspace: Workspace, config: cfg.FeaturesConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Extract the features of every photo of the index.

    Raises
    ------
    ImageError
        Naming every photo that cannot be read; the features of the others are kept.
    InputError
        Naming photos that have changed since they were indexed.
    WorkspaceError
        If the features were imported and a photo has none.
    ConfigError
        If they were imported and others are asked for.
    """
    index = read_index(workspace)
    images = workspace.require("images")
    drop_foreign_record(workspace, "features")
    store = features_of(workspace)
    if (source := imported_from(workspace, "features")) is not None:
        traits_to_come(workspace, config, cfg.MatchesConfig())
        warn_of_no_effect("features", config, overwrite=overwrite)
        if run.verify:
            store.require_whole()
        return complete(
            workspace,
            "features",
            store,
            imported_features(workspace),
            lambda missing: [],
            source,
            inputs={"images": images.fingerprint},
            overwrite=False,
            unit="photo",
        )
    algorithm = algorithm_of(config)
    wanted = {
        record.name: config_hash(algorithm, record.sha256, record.mask_sha256 or "", config)
        for record in index.records
    }
    of_left_out = {name: mark_left_out(fingerprint) for name, fingerprint in wanted.items()}
    records = {record.name: record for record in index.records}
    if config.extractor.kind != cfg.FeatureKind.SIFT:
        find_device(run.device)
    mask_dir = os.path.abspath(images.config["mask_dir"]) if images.config.get("mask_dir") else None
    work = functools.partial(_extract, config=cfg.absolute(config), mask_dir=mask_dir, algorithm=algorithm)
    may_skip = bool(images.config.get("skip_unreadable"))

    def produce(missing: list[str]) -> Iterator[tuple[str, Features | None]]:
        unreadable, changed = [], []
        results = make_items(cluster, workspace, store, work, missing, records.__getitem__, wanted, run)
        for name, result in results:
            if not isinstance(result, CorrsfmError):
                yield name, result
            elif not isinstance(result, ImageError):
                changed.append(str(result))
            elif may_skip:
                logger.warning("left out: %s", result)
                wanted[name] = of_left_out[name]
                yield name, _no_features(index, records[name])
            else:
                unreadable.append(str(result))
        if changed:
            raise InputError(
                "\n".join(sorted(changed)) + "\nrun the command again; the features of the others are kept"
            )
        if unreadable:
            # `corrsfm add` leaves out none of the photos that were named.
            skip = "" if workspace.adding.exists() else ", or use --skip-unreadable"
            raise ImageError(
                "\n".join(sorted(unreadable)) + f"\nremove or replace these photos and run again{skip}; the "
                "features of the others are kept"
            )

    log = colmap_log(workspace.log) if config.extractor is cfg.Extractor.PYCOLMAP else nullcontext()
    with connected(run.cluster, run.workers) as cluster, log:
        if may_skip and not overwrite:
            left_out = [records[name] for name in sorted(finished_or_mended(store, of_left_out))]
            for name, result in work(workspace, left_out, run) if left_out else ():
                if isinstance(result, ImageError):
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
            verify=run.verify,
        )


def _extract(
    workspace: Workspace,
    records: Iterable[ImageRecord],
    run: cfg.RunConfig,
    *,
    config: cfg.FeaturesConfig,
    mask_dir: str | None,
    algorithm: str,
) -> Iterator[tuple[str, Features | InputError]]:
    """Extract the features of photos, here or on a worker, which must have the same libraries."""
    if algorithm_of(config) != algorithm:
        raise ClusterError(f"extracts by {algorithm_of(config)}, the run by {algorithm}; install the same")
    device = find_device(run.device) if config.extractor.kind != cfg.FeatureKind.SIFT else "cpu"
    extract = create_extractor(config, device)
    read = read_colour if reads_colour(config.extractor) else read_image

    def work(record: ImageRecord) -> Features | InputError:
        path, mask_path = workspace.images_dir / record.name, None
        if mask_dir and record.mask:
            mask_path = Path(mask_dir) / record.mask
        try:
            image = read(path)
            mask = read_mask(mask_path, image.shape) if mask_path else None
            # After the pixels were read, so that the features are of the photo that the record names.
            for read_from, sha256 in ((path, record.sha256), (mask_path, record.mask_sha256)):
                if read_from is not None and sha256_of(read_from) != sha256:
                    return InputError(f"{read_from}: has changed since the photos were listed")
            return extract(image, mask)
        except ImageError as error:
            return error

    # On a CPU each photo takes one thread, on a GPU one photo goes at a time.
    num_at_once = count_threads(run.threads) if device == "cpu" else 1
    if config.extractor.kind != cfg.FeatureKind.SIFT:
        use_threads(1)
    for record, result in threaded(work, records, num_at_once):
        yield record.name, result


def _no_features(index: Index, record: ImageRecord) -> Features:
    """Empty features for a photo that was left out."""
    camera = index.camera_of(record)
    return Features(
        keypoints=np.zeros((0, 2), np.float32), scales=None, orientations=None,
        scores=np.zeros(0, np.float32), descriptors=np.zeros((0, 128), np.uint8),
        image_size=(camera.width, camera.height),
    )  # fmt: skip
