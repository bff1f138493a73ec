"""A workspace: where every artefact lies, and what is finished.

::

    WORKSPACE/
    ├── workspace.json      format version, image folder, and per stage: fingerprint, options, seconds
    ├── images.txt          names of the photos, one per line
    ├── images.json         photos and cameras as corrsfm knows them
    ├── features.h5         keypoints and descriptors
    ├── pairs.txt           pairs to match, ``name0 name1``
    ├── pair_origins.tsv    the strategies that proposed each pair
    ├── matches.h5          putative matches
    ├── pruned.h5           pruned matches
    ├── database.db         COLMAP database with verified two-view geometries
    ├── sparse/0, 1, …      models, the largest first
    ├── report.json, report.html
    ├── run.json            versions, options, hashes and seconds of the last `corrsfm run`
    └── log.txt             what pycolmap had to say

Every file is written under another name and renamed, so a file that exists is whole. A stage is current if
its recorded fingerprint, a hash of its options and of the fingerprints of its inputs, equals the wanted one.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from corrsfm.errors import WorkspaceError
from corrsfm.files import atomic_path, atomic_write_json, atomic_write_text

__all__ = [
    "STAGE_COMMANDS",
    "StageRecord",
    "Workspace",
    "atomic_path",
    "atomic_write_json",
    "atomic_write_text",
]

FORMAT_VERSION = 1
STAGE_COMMANDS = {
    "images": "extract IMAGES {workspace}",
    "features": "extract IMAGES {workspace}",
    "pairs": "pairs {workspace}",
    "matches": "match {workspace}",
    "pruned matches": "prune {workspace}",
    "verified matches": "prune {workspace}",
    "models": "reconstruct {workspace}",
}
"""The stages, in order, and the command that makes each."""


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
        Wall-clock seconds of the run that finished it.
    num_items, num_reused : int
        Items of the stage, and how many of them an earlier run had done.
    """

    fingerprint: str
    config: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    num_items: int = 0
    num_reused: int = 0
    finished_at: str = ""


class Workspace:
    """A folder with the artefacts of one scene.

    Parameters
    ----------
    root : Path
    create : bool
        Make the folder if it does not exist; otherwise that is an error.

    Raises
    ------
    WorkspaceError
        If the folder is not a workspace, or one of another version, or its manifest is damaged.
    """

    def __init__(self, root: Path, *, create: bool = False) -> None:
        self.root = root
        self.manifest = root / "workspace.json"
        self.images_txt = root / "images.txt"
        self.images_json = root / "images.json"
        self.photo_cache = root / ".photos.json"
        self.features = root / "features.h5"
        self.pairs = root / "pairs.txt"
        self.pair_origins = root / "pair_origins.tsv"
        self.matches = root / "matches.h5"
        self.pruned = root / "pruned.h5"
        self.database = root / "database.db"
        self.sparse = root / "sparse"
        self.report_json = root / "report.json"
        self.report_html = root / "report.html"
        self.run_json = root / "run.json"
        self.log = root / "log.txt"
        if not self.manifest.exists():
            self._start(create)
        self._values = self._load()

    def _start(self, create: bool) -> None:
        if not create:
            raise WorkspaceError(
                f"{self.root}: not a corrsfm workspace; make one with: corrsfm extract IMAGES {self.root}"
            )
        if self.root.exists() and not self.root.is_dir():
            raise WorkspaceError(f"{self.root}: is a file; expected a folder for the workspace")
        foreign = [path.name for path in (self.database, self.sparse) if path.exists()]
        if foreign:
            raise WorkspaceError(
                f"{self.root}: holds {' and '.join(foreign)} of another tool; choose an empty folder, "
                "nothing was touched"
            )
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WorkspaceError(f"{self.root}: cannot be made ({error.strerror})") from error
        atomic_write_json(self.manifest, {"format_version": FORMAT_VERSION, "images_dir": None, "stages": {}})

    def _load(self) -> dict[str, Any]:
        try:
            values = json.loads(self.manifest.read_text(encoding="utf-8"))
            version = values["format_version"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WorkspaceError(
                f"{self.manifest}: damaged ({error}); delete it to start this workspace afresh"
            ) from error
        if version != FORMAT_VERSION:
            raise WorkspaceError(
                f"{self.root}: workspace of format version {version}, this corrsfm reads version "
                f"{FORMAT_VERSION}; use the corrsfm that made it, or another folder"
            )
        return values

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the workspace for this process.

        Raises
        ------
        WorkspaceError
            If another process holds it.
        """
        with open(self.root / ".lock", "w", encoding="utf-8") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise WorkspaceError(
                    f"{self.root}: another corrsfm works in this workspace; wait for it or choose another "
                    "folder"
                ) from error
            self._values = self._load()
            yield

    @property
    def images_dir(self) -> Path:
        """Folder of the photos.

        Raises
        ------
        WorkspaceError
            If no photos were indexed yet.
        """
        if not self._values["images_dir"]:
            raise WorkspaceError(
                f"{self.root}: no photos indexed yet; run: corrsfm extract IMAGES {self.root}"
            )
        return Path(self._values["images_dir"])

    @images_dir.setter
    def images_dir(self, folder: Path) -> None:
        self._values["images_dir"] = str(folder.resolve())
        atomic_write_json(self.manifest, self._values)

    def record_of(self, stage: str) -> StageRecord | None:
        """What is recorded of a stage, or None if it never finished."""
        values = self._values["stages"].get(stage)
        return StageRecord(**values) if values else None

    def is_current(self, stage: str, fingerprint: str, *artefacts: Path) -> bool:
        """True if the stage finished with this fingerprint and its artefacts are still there."""
        record = self.record_of(stage)
        return (
            record is not None
            and record.fingerprint == fingerprint
            and all(path.exists() for path in artefacts)
        )

    def require(self, stage: str) -> StageRecord:
        """The record of a stage that must have finished, with inputs that have not changed since.

        Raises
        ------
        WorkspaceError
            Naming the command to run.
        """
        record = self.record_of(stage)
        if record is None:
            raise WorkspaceError(f"{self.root}: no {stage} yet; run: {self._command(stage)}")
        for name, fingerprint in record.inputs.items():
            if self.require(name).fingerprint != fingerprint:
                raise WorkspaceError(
                    f"{self.root}: {stage} are older than {name}; run: {self._command(stage)}"
                )
        return record

    def _command(self, stage: str) -> str:
        return f"corrsfm {STAGE_COMMANDS[stage].format(workspace=self.root)}"

    def finish(self, stage: str, record: StageRecord) -> None:
        """Record a stage as finished now."""
        stamped = {**record.__dict__, "finished_at": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        self._values["stages"][stage] = stamped
        atomic_write_json(self.manifest, self._values)

    def forget(self, stage: str) -> None:
        """Drop the record of a stage, so that it is not taken for finished."""
        if self._values["stages"].pop(stage, None) is not None:
            atomic_write_json(self.manifest, self._values)
