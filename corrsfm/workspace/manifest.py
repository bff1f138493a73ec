"""What a workspace remembers in `workspace.json`: where its photos are, and a record of each stage."""

from __future__ import annotations

import hashlib
import json
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from corrsfm.disk import explain
from corrsfm.errors import WorkspaceError, lack_or_text
from corrsfm.files import atomic_write_json, read_json

__all__ = ["FORMAT_VERSION", "StageRecord", "has_lost_manifest", "read_manifest", "write_manifest"]

FORMAT_VERSION = 2
# The features and matches of version 1 were HDF5 files; they are converted when a command writes there.
READABLE_VERSIONS = (1, FORMAT_VERSION)


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """What the workspace remembers of a finished stage.

    Attributes
    ----------
    fingerprint : str
        Hash of the stage's options and of the fingerprints of its inputs.
    config : dict
        The options, for people to read.
    inputs : dict
        Stage → fingerprint of what it read.
    seconds : float
        Wall-clock seconds that what is there took to make, over all runs that had a part in it.
    num_items, num_reused : int
        Items of the stage, and how many of them an earlier run had done.
    files : dict
        Name → SHA-256 of the lists that the stage wrote.
    """

    fingerprint: str
    config: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    num_items: int = 0
    num_reused: int = 0
    finished_at: str = ""
    files: dict[str, str] = field(default_factory=dict)


def has_lost_manifest(folder: Path) -> bool:
    """Whether a folder holds what only corrsfm writes, but no manifest."""
    if (folder / "workspace.json").exists():
        return False
    return _has_tables(folder / ".photos.json", "photos") or _has_tables(
        folder / "images.json", "cameras", "images"
    )


def _has_tables(path: Path, *names: str) -> bool:
    """Whether a file is JSON with these lists or tables; other tools have files of these names too."""
    try:
        values = read_json(path)
        return all(isinstance(values[name], list | dict) for name in names)
    except (OSError, ValueError, LookupError, TypeError):
        return False


def write_manifest(path: Path, values: dict[str, Any]) -> None:
    """Write a manifest, with a checksum of what it says of stages."""
    atomic_write_json(path, {**values, "checksum": _checksum(values)})


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest.

    Returns
    -------
    dict
        ``format_version``, ``images_dir`` and ``stages`` at least.

    Raises
    ------
    WorkspaceError
        If it cannot be read, is not as it was written, or is of a later version.
    """
    try:
        values = read_json(path)
        if isinstance(values, dict) and values and not {"format_version", "stages"} & values.keys():
            raise WorkspaceError(f"{path}: is of another tool; choose another folder for the workspace")
        version = values["format_version"]
        if not isinstance(version, int):
            raise ValueError("its format version is no number")
        if version in READABLE_VERSIONS:
            _check_manifest(values)
            if values.pop("checksum", wanted := _checksum(values)) != wanted:
                raise ValueError("not as it was written")
    except PermissionError as error:
        raise WorkspaceError(explain(error)) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) else lack_or_text(error)
        if isinstance(error, TypeError | AttributeError):
            reason = "not what a workspace records"
        raise WorkspaceError(
            f"{path}: damaged ({reason}); remove it alone, with: {shlex.join(['rm', '-r', str(path)])}; then "
            "run the commands of the workspace again, finished features and matches are kept"
        ) from error
    if version not in READABLE_VERSIONS:
        raise WorkspaceError(
            f"{path.parent}: workspace of format version {version}, this corrsfm reads versions up to "
            f"{FORMAT_VERSION}; use the corrsfm that made it, or another folder"
        )
    return dict(values)


def _checksum(values: dict[str, Any]) -> str:
    """Of what a manifest says of stages and reports; where the photos are may be edited."""
    stages = [
        values["stages"],
        values.get("mapping_failed"),
        *([values["written"]] if "written" in values else []),
    ]
    return hashlib.sha256(json.dumps(stages, sort_keys=True).encode()).hexdigest()


def _check_manifest(values: dict[str, Any]) -> None:
    """Check a manifest on loading, so that damage is reported at once."""
    if not isinstance(values["images_dir"], str | None):
        raise TypeError("images_dir is not text")
    given = values.get("given", [])
    if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
        raise TypeError("given is not a list of texts")
    written = values.get("written", {})
    if not isinstance(written, dict) or not all(isinstance(digest, str) for digest in written.values()):
        raise TypeError("written is not a table of texts")
    for record in values["stages"].values():
        StageRecord(**record)
