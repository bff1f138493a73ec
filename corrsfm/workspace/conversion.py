"""Features and matches of workspaces of version 1, which were HDF5 files in hloc's layout.

They are read once, and no stage is done again. A journal beside a file held what a run that was killed had
finished: an SQLite table of archives.
"""

from __future__ import annotations

import contextlib
import io
import logging
import sqlite3
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.sqlite import require_tables
from corrsfm.errors import WorkspaceError
from corrsfm.files import read_json
from corrsfm.hdf5 import lies_elsewhere, open_hdf5
from corrsfm.types import Features, Matches, TwoViewModel
from corrsfm.workspace.hloc import HALF_PIXEL
from corrsfm.workspace.items import FEATURES, MATCHES, PRUNED, Kind, PrunedMatches
from corrsfm.workspace.store import ItemStore

if TYPE_CHECKING:
    from corrsfm.workspace.folder import Workspace

__all__ = ["convert_items"]

logger = logging.getLogger("corrsfm")

Row = tuple[str, str, Mapping[str, Any], Mapping[str, Any]]
"""HDF5 group, fingerprint, arrays and attributes."""


def convert_items(workspace: Workspace) -> None:
    """Move the features and matches of a workspace of version 1 into item stores.

    Killed half-way, it begins again with the files that are left.

    Raises
    ------
    WorkspaceError
        If a file cannot be read, naming it and what to do.
    """
    root = workspace.root
    names = _Names(workspace)
    kept = root / "pruned.h5"
    by_method = {
        path.stem: path for path in sorted((root / ".pruned").glob("*.h5")) if not path.stem.startswith(".")
    }
    record = workspace.record_of("pruned matches")
    if kept.exists() and record is not None:
        by_method.setdefault(str(record.config["method"]), kept)
    files: list[tuple[str, Path, Path, Kind, Callable, Callable[[str], Any]]] = [
        ("features", root / "features.h5", workspace.features, FEATURES, _features, str),
        ("matches", root / "matches.h5", workspace.matches, MATCHES, _matches, names.pair),
    ]
    for method, path in by_method.items():
        target = workspace.pruned_by(method)
        files.append(("pruned matches", path, target, PRUNED, _pruned, names.pair))
    for stage, source, target, kind, decode, key_of in files:
        journal = source.with_name(f"{source.name}.journal")
        if not (_is_own(source) or journal.exists()):
            continue
        logger.info("%s: converted to %s, once", source.name, target.relative_to(root))
        finished = workspace.record_of(stage)
        store: ItemStore = ItemStore(target, kind, remedy=workspace.command_for(stage))
        each = finished.seconds / max(finished.num_items, 1) if finished is not None else 0.0
        in_file: dict[Any, str] = {}
        try:
            for group, fingerprint, arrays, attributes in _rows(source):
                key = key_of(group)
                store.add(key, fingerprint, decode(arrays, attributes), each)
                in_file[key] = fingerprint
            if finished is not None and target in (workspace.features, workspace.matches, workspace.pruned):
                store.commit(in_file, finished.fingerprint)
            for group, fingerprint, arrays, attributes in _rows_of_journal(journal):
                store.add(
                    key_of(group), fingerprint, decode(arrays, attributes), attributes.get("seconds", 0.0)
                )
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
            store.close()
            target.unlink(missing_ok=True)
            raise WorkspaceError(
                f"{source}: cannot be converted ({error}); move the file away and run again"
            ) from error
        store.close()
        for suffix in ("", "-wal", "-shm"):
            journal.with_name(journal.name + suffix).unlink(missing_ok=True)
        if _is_own(source):
            source.unlink()
    if _is_own(kept):
        kept.unlink()
    with contextlib.suppress(OSError):
        (root / ".pruned").rmdir()


class _Names:
    """Photos by the keys of hloc's match files, where slashes are dashes."""

    def __init__(self, workspace: Workspace) -> None:
        try:
            values = read_json(workspace.images_json)
            names = [str(image["name"]) for image in values["images"]]
        except (OSError, ValueError, KeyError, TypeError):
            # Its stage says what is wrong with the file; names are their own keys then.
            names = []
        self._photo_of = {name.replace("/", "-"): name for name in names}

    def pair(self, group: str) -> tuple[str, str]:
        name0, name1 = group.split("/")
        return self._photo_of.get(name0, name0), self._photo_of.get(name1, name1)


def _is_own(path: Path) -> bool:
    """Whether corrsfm wrote a file; one that is no HDF5 file any more cannot be another tool's."""
    if not path.exists():
        return False
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format", "")).startswith("corrsfm-")
    except OSError:
        return True


def _rows(path: Path) -> Iterator[Row]:
    if not path.exists():
        return
    with open_hdf5(path) as file:
        found: list[str] = []
        file.visititems(
            lambda name, item: (
                found.append(name) if isinstance(item, h5py.Group) and "fingerprint" in item.attrs else None
            )
        )
        for name in found:
            group = file[name]
            arrays = {key: _own(value)[()] for key, value in group.items()}
            yield name, str(group.attrs["fingerprint"]), arrays, dict(group.attrs)


def _own(dataset: h5py.Dataset) -> h5py.Dataset:
    if lies_elsewhere(dataset):
        raise ValueError("its values lie in another file")
    return dataset


def _rows_of_journal(path: Path) -> Iterator[Row]:
    """Items of a journal; one that is damaged counts as not finished."""
    if not path.exists():
        return
    with contextlib.closing(sqlite3.connect(path)) as connection, contextlib.suppress(sqlite3.DatabaseError):
        require_tables(connection, ("items",))
        for key, fingerprint, item in connection.execute("SELECT key, fingerprint, item FROM items"):
            try:
                with np.load(io.BytesIO(item), allow_pickle=False) as stored:
                    values = dict(stored)
            except (ValueError, EOFError, zipfile.BadZipFile):
                continue
            arrays = {name: value for name, value in values.items() if not name.startswith("@")}
            yield (
                key,
                fingerprint,
                arrays,
                {name[1:]: value.item() for name, value in values.items() if name.startswith("@")},
            )


def _features(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> Features:
    descriptors: NDArray = np.ascontiguousarray(np.asarray(arrays["descriptors"], np.float32).T)
    if attributes.get("descriptors") != "unit":
        descriptors = np.clip(np.rint(descriptors * 512), 0, 255).astype(np.uint8)
    width, height = (int(value) for value in arrays["image_size"])
    return Features(
        keypoints=np.asarray(arrays["keypoints"], np.float32) + HALF_PIXEL,
        scales=arrays.get("scales"),
        orientations=arrays.get("oris"),
        scores=np.asarray(arrays["scores"], np.float32),
        descriptors=descriptors,
        image_size=(width, height),
    )


def _indices(arrays: Mapping[str, Any]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    matches0 = np.asarray(arrays["matches0"], np.int32)
    kept = np.flatnonzero(matches0 >= 0)
    indices = np.column_stack([kept, matches0[kept]]).astype(np.int32)
    return indices, np.asarray(arrays["matching_scores0"], np.float32)[kept]


def _matches(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> Matches:
    indices, scores = _indices(arrays)
    mutual = np.asarray(arrays["mutual0"], np.bool_)[indices[:, 0]]
    if attributes.get("scored_by") == "matcher":
        unknown = np.full(len(indices), np.nan, np.float32)
        return Matches(indices=indices, ratios=unknown, mutual=mutual, scores=scores)
    return Matches(indices=indices, ratios=np.clip(np.float32(1) - scores, 0, 1), mutual=mutual)


def _pruned(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> PrunedMatches:
    indices, scores = _indices(arrays)
    model = None
    if "model" in arrays:
        kind = attributes["model_kind"]
        model = TwoViewModel(kind=kind, matrix=np.asarray(arrays["model"], np.float64))
    return PrunedMatches(
        indices=indices,
        scores=scores,
        num_putative=int(attributes["num_putative"]),
        model=model,
        decided_by=str(attributes["decided_by"]),
    )
