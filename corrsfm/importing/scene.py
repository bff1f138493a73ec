"""Importing into a workspace: everything is read and checked against the photos, then written."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from corrsfm import config as cfg
from corrsfm.errors import ConfigError, InputError, WorkspaceError, first_few
from corrsfm.images.stage import index_photos
from corrsfm.importing import Source
from corrsfm.importing.database import open_database
from corrsfm.importing.hloc import open_hloc
from corrsfm.types import Features, ImageRecord, Matches, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import (
    fingerprint_of_imported,
    is_unfinished_import,
    record_imported_pairs,
)
from corrsfm.workspace.items import FEATURES, MATCHES, Arrays
from corrsfm.workspace.layout import Layout
from corrsfm.workspace.lists import Index, read_index
from corrsfm.workspace.resume import complete
from corrsfm.workspace.stores import features_of, matches_of

__all__ = ["ImportResult", "import_features"]

logger = logging.getLogger("corrsfm")


@dataclass(frozen=True, kw_only=True)
class ImportResult:
    """What was imported.

    Attributes
    ----------
    workspace : Path
    source : str
        The file, or both.
    kind : FeatureKind
    num_photos, num_keypoints : int
        Keypoints of all photos together.
    descriptor_size : int
        Numbers of a descriptor; 0 if there are none.
    has_shapes : bool
        Whether keypoints came with scale and orientation.
    num_pairs, num_matches : int
        0 if no matches were imported.
    """

    workspace: Path
    source: str
    kind: cfg.FeatureKind
    num_photos: int
    num_keypoints: int
    descriptor_size: int
    has_shapes: bool
    num_pairs: int
    num_matches: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**asdict(self), "workspace": str(self.workspace), "kind": str(self.kind)}


def import_features(
    photos: Path | str,
    workspace: Path | str,
    *,
    features: Path | str | None = None,
    matches: Path | str | None = None,
    database: Path | str | None = None,
    kind: cfg.FeatureKind | str = cfg.FeatureKind.OTHER,
    with_matches: bool = True,
    images: cfg.ImagesConfig | None = None,
    overwrite: bool = False,
) -> ImportResult:
    """Bring features, and matches, of another tool into a workspace; `corrsfm.run_scene` goes on from there.

    Parameters
    ----------
    photos, workspace : path
    features, matches : path, optional
        Files of hloc.
    database : path, optional
        A COLMAP database, in place of these.
    kind : FeatureKind or str
        What the features are, so that the network made for them is used.
    with_matches : bool
        Whether to take the matches of a database, too; files of hloc are given without them instead.
    images : ImagesConfig, optional
        Which photos, and what is known about their cameras.
    overwrite : bool
        Replace features that the workspace holds.

    Returns
    -------
    ImportResult

    Raises
    ------
    InputError
        If a file cannot be used, naming it and the photo or pair. Nothing is left behind.
    ConfigError
        If not one of ``features`` and ``database`` is given, or an option does not fit.
    WorkspaceError
        If the workspace holds features already, and ``overwrite`` is not set.
    """
    images = images or cfg.ImagesConfig()
    if (features is None) == (database is None):
        raise ConfigError("give --features, or --database")
    if matches is not None and features is None:
        raise ConfigError("--matches belongs to --features; a database holds its own")
    if not with_matches and database is None:
        raise ConfigError("--rematch belongs to --database; give --features without --matches to match again")
    if images.mask_dir is not None:
        raise ConfigError("--mask-dir: imported keypoints are not masked; leave out masked ones before")
    folder = Path(workspace)
    files = cfg.ImportedConfig(
        features=_absolute(features),
        matches=_absolute(matches),
        database=_absolute(database),
        kind=cfg.FeatureKind(kind),
    )
    if files.database is not None and files.database.resolve() == Layout(folder).database.resolve():
        raise InputError(
            f"{database}: the workspace {folder} writes its own database there; copy this one to another "
            "place, or choose another folder for the workspace"
        )
    opened: contextlib.AbstractContextManager[Source]
    if files.features is not None:
        opened = open_hloc(files.features, files.matches)
    else:
        opened = open_database(Path(str(files.database)), with_matches=with_matches)
    with opened as source:
        return _import(source, files, Path(photos), folder, images, overwrite)


def _absolute(path: Path | str | None) -> Path | None:
    return None if path is None else Path(path).absolute()


def _import(
    source: Source,
    files: cfg.ImportedConfig,
    photos: Path,
    folder: Path,
    images: cfg.ImagesConfig,
    overwrite: bool,
) -> ImportResult:
    workspace = Workspace(folder, create=True, images_dir=photos)
    with workspace.lock():
        if workspace.features.exists() and not overwrite and not is_unfinished_import(workspace):
            raise WorkspaceError(
                f"{workspace.features}: is there already; choose another folder, or add --overwrite to "
                "replace these features and what was made from them"
            )
        try:
            index_photos(workspace, photos, images, cfg.RunConfig())
            index = read_index(workspace)
            _check_names(source, photos, index, may_have_more=images.image_list is not None)
            return _write(source, files, workspace, index)
        except BaseException:
            # Only under its lock: another import may have begun there in the meantime.
            if workspace.made_its_folder:
                shutil.rmtree(folder, ignore_errors=True)
            raise


def _check_names(source: Source, photos: Path, index: Index, *, may_have_more: bool) -> None:
    """Photos and names must be the same."""
    known, given = set(index.names), set(source.names)
    if lacking := sorted(known - given):
        hint = ""
        if not known & given:
            hint = f"; its names are like '{source.names[0]}', these photos are like '{index.names[0]}'"
        raise InputError(
            f"{source.label}: no features of {first_few(lacking)} in {photos}{hint}; give the folder that "
            "the names are relative to, or leave these photos out with --image-list"
        )
    if (unknown := sorted(given - known)) and not may_have_more:
        raise InputError(
            f"{source.label}: features of {first_few(unknown)}, which {photos} does not hold; give all "
            "photos, or name those to use with --image-list"
        )


def _write(source: Source, files: cfg.ImportedConfig, workspace: Workspace, index: Index) -> ImportResult:
    records = {record.name: record for record in index.records}

    def read(name: str) -> Features:
        camera = index.camera_of(records[name])
        return source.features(name, (camera.width, camera.height))

    wanted, counts, size, has_shapes, is_sift = _survey(source, records, read)
    pairs = [pair for pair in source.pairs if set(pair) <= records.keys()]
    if source.pairs and not pairs:
        raise InputError(f"{source.label}: no pair of the photos has matches; give matches of these photos")

    def read_pair(pair: Pair) -> Matches:
        return source.matches(pair, counts[pair[0]], counts[pair[1]])

    wanted_pairs: dict[Pair, str] = {}
    num_matches = 0
    for pair in pairs:
        found = read_pair(pair)
        num_matches += len(found)
        wanted_pairs[pair] = cfg.config_hash(
            "imported", _content(MATCHES.encode(found)[0]), *map(wanted.get, pair)
        )
    for remark in source.remarks():
        logger.warning("%s", remark)
    kind = cfg.FeatureKind.SIFT if is_sift else files.kind
    config = dataclasses.replace(files, kind=kind, has_shapes=has_shapes)
    for stage in ("features", "pairs", "matches"):
        workspace.forget(stage)
    # Both before the first item: features without the matches that came with them must not look finished.
    features_of(workspace).clear(json.dumps(cfg.to_dict(config)))
    matches_of(workspace).clear(json.dumps(cfg.to_dict(config)) if pairs else "")
    complete(
        workspace, "features", features_of(workspace), wanted,
        lambda missing: ((name, read(name)) for name in missing), config,
        inputs={"images": workspace.require("images").fingerprint}, overwrite=False, unit="photo",
    )  # fmt: skip
    if pairs:
        record_imported_pairs(workspace, pairs, config)
        inputs = {stage: workspace.require(stage).fingerprint for stage in ("features", "pairs")}
        complete(
            workspace, "matches", matches_of(workspace), wanted_pairs,
            lambda missing: ((pair, read_pair(pair)) for pair in missing), config,
            inputs=inputs, overwrite=False, unit="pair",
        )  # fmt: skip
    return ImportResult(
        workspace=workspace.root,
        source=source.label,
        kind=kind,
        num_photos=len(records),
        num_keypoints=sum(counts.values()),
        descriptor_size=size,
        has_shapes=has_shapes,
        num_pairs=len(pairs),
        num_matches=num_matches,
    )


def _survey(
    source: Source, records: Mapping[str, ImageRecord], read: Callable[[str], Features]
) -> tuple[dict[str, str], dict[str, int], int, bool, bool]:
    """Fingerprints and numbers of keypoints by photo; length, shapes and bytes of all descriptors."""
    wanted: dict[str, str] = {}
    counts: dict[str, int] = {}
    layouts: dict[tuple[int, str], str] = {}
    has_shapes = True
    for name, record in records.items():
        features = read(name)
        wanted[name] = fingerprint_of_imported(record.sha256, _content(FEATURES.encode(features)[0]))
        counts[name] = len(features)
        if len(features):
            has_shapes &= features.scales is not None
            layouts.setdefault((features.descriptors.shape[1], str(features.descriptors.dtype)), name)
    if not layouts:
        raise InputError(f"{source.label}: no photo has a keypoint; extract the features again")
    if len(layouts) > 1:
        (size0, type0), (size1, type1) = list(layouts)[:2]
        raise InputError(
            f"{source.label}: descriptors of {list(layouts.values())[0]} are {size0} × {type0}, those of "
            f"{list(layouts.values())[1]} are {size1} × {type1}; extract all photos with one network"
        )
    ((size, dtype),) = layouts
    if not size and not source.pairs:
        raise InputError(
            f"{source.label}: no descriptors and no matches to take from there, so nothing can be matched; "
            "give matches too, or import those there are, without --rematch"
        )
    return wanted, counts, size, has_shapes, dtype == str(np.dtype(np.uint8))


def _content(arrays: Arrays) -> str:
    digest = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
