"""What a workspace remembers: where its photos are, which stages finished, and what their files held."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from corrsfm.colmap.sqlite import rows_digest
from corrsfm.disk import explain
from corrsfm.errors import WorkspaceError
from corrsfm.files import FRAME_TIMES, read_bytes, sha256_of
from corrsfm.workspace.commands import STAGE_COMMANDS, command_for, label_of
from corrsfm.workspace.layout import Layout
from corrsfm.workspace.manifest import StageRecord, write_manifest

__all__ = ["Ledger"]

_FILES = {
    "images": ("images.json", "images.txt"),
    "pairs": ("pairs.txt", "pair_origins.tsv"),
    "verified matches": ("cameras.json", "database.db"),
    "models": ("evidence.json", "added.json"),
}


class Ledger(Layout):
    """The manifest of a workspace, and what it says of each stage and of the files there.

    A stage is current if its recorded fingerprint, a hash of its options and of the fingerprints of its
    inputs, equals the wanted one.

    Parameters
    ----------
    root : Path
    """

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._values: dict[str, Any] = {}

    def _write(self) -> None:
        write_manifest(self.manifest, self._values)

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
                f"{self.root}: no photos indexed yet; run: corrsfm extract IMAGES "
                f"{shlex.quote(str(self.root))}"
            )
        # A folder inside the workspace moves with it.
        return self.root / self._values["images_dir"]

    @images_dir.setter
    def images_dir(self, folder: Path) -> None:
        resolved, root = folder.resolve(), self.root.resolve()
        inside = resolved in (self.frames.resolve(), self.converted.resolve())
        self._values["images_dir"] = str(resolved.relative_to(root) if inside else resolved)
        self._write()

    @property
    def has_own_photos(self) -> bool:
        """Whether the photos lie in the workspace: frames of a video, or readable copies."""
        return self.images_dir in (self.frames, self.converted)

    @property
    def given_photos(self) -> tuple[str, ...]:
        """What the user named as photos, as absolute paths; empty if no photos were indexed yet."""
        given = self._values.get("given") or [self._values["images_dir"]]
        return tuple(given) if given[0] else ()

    def remember_photos(self, given: Sequence[str], folder: Path) -> None:
        """Record what the user named as photos, and the folder where they are."""
        self._values["given"] = list(given)
        self.images_dir = folder

    @property
    def is_sequence(self) -> bool:
        """Whether the photos are frames of a video, in the order of time."""
        return (self.images_dir / FRAME_TIMES).is_file()

    def record_of(self, stage: str) -> StageRecord | None:
        """The record of a stage, or None if it never finished."""
        values = self._values["stages"].get(stage)
        return StageRecord(**values) if values else None

    def is_current(self, stage: str, fingerprint: str, *artefacts: Path) -> bool:
        """True if the stage finished with this fingerprint and its artefacts are still there, and whole."""
        record = self.record_of(stage)
        return (
            record is not None
            and record.fingerprint == fingerprint
            and all(path.exists() for path in artefacts)
            and all(
                self._digest(path.name) == record.files[path.name]
                for path in artefacts
                if path.name in record.files
            )
        )

    def read_list(self, stage: str, path: Path) -> bytes:
        """What a list holds that a stage wrote.

        Raises
        ------
        WorkspaceError
            If it may not be read.
        OSError
            If it cannot be read.
        ValueError
            If it is not what the stage wrote.
        """
        try:
            content = read_bytes(path)
        except PermissionError as error:
            raise WorkspaceError(explain(error)) from error
        record = self.record_of(stage)
        wanted = record.files.get(path.name) if record is not None else None
        if wanted is not None and hashlib.sha256(content).hexdigest() != wanted:
            raise ValueError("not as it was written")
        return content

    def require(self, stage: str) -> StageRecord:
        """The record of a stage that must have finished, with inputs that have not changed since.

        Raises
        ------
        WorkspaceError
            Naming the command to run.
        """
        record = self.record_of(stage)
        if record is None and stage == "models" and self.mapping_failed:
            why = shlex.join(["corrsfm", "report", str(self.root)])
            raise WorkspaceError(f"{self.root}: mapping gave no model; why: {why}")
        if record is None:
            raise WorkspaceError(f"{self.root}: no {label_of(stage)} yet; run: {self.remedy_for(stage)}")
        for name, fingerprint in record.inputs.items():
            if self.require(name).fingerprint != fingerprint:
                raise WorkspaceError(
                    f"{self.root}: {label_of(stage)} are older than {label_of(name)};"
                    f" run: {self.remedy_for(stage)}"
                )
        return record

    def remedy_for(self, stage: str) -> str:
        """The command that makes a stage current; an addition that was interrupted is finished first."""
        if self.adding.exists():
            return shlex.join(["corrsfm", "add", str(self.root)])
        return self.command_for(stage)

    def current_record_of(self, stage: str) -> StageRecord | None:
        """The record of a stage if its inputs have not changed since; else None."""
        try:
            return self.require(stage)
        except WorkspaceError:
            return None

    def commands_from(self, stage: str) -> list[str]:
        """The commands that make a stage and all that hang on it, in order."""
        stages = list(STAGE_COMMANDS)
        return list(dict.fromkeys(map(self.command_for, stages[stages.index(stage) :])))

    def command_for(
        self, stage: str, *flags: str, images_dir: str | None = None, imported: dict[str, Any] | None = None
    ) -> str:
        """The command that makes a stage, with the options that it was made with, quoted for a shell.

        The seed is not recorded with a stage and so not repeated.

        Parameters
        ----------
        stage : str
        flags : str
            Further options, such as ``--overwrite``; what was imported is imported again whatever they are.
        images_dir : str, optional
            To take the place of the folder of photos that the workspace knows.
        imported : dict, optional
            Where the stage was imported from, if it has no record.
        """
        recorded = {name: StageRecord(**values).config for name, values in self._values["stages"].items()}
        if imported is not None:
            recorded |= {"features": imported, stage: imported}
        return command_for(
            stage,
            self.root,
            [images_dir] if images_dir else self.given_photos or ["PHOTOS"],
            recorded,
            flags,
        )

    def finish(self, stage: str, record: StageRecord) -> None:
        """Record a stage as finished now."""
        if stage == "models":
            self._values.pop("mapping_failed", None)
        files = {name: digest for name in self._files_of(stage) if (digest := self._digest(name)) is not None}
        now = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        stamped = {**record.__dict__, "files": files, "finished_at": now}
        self._values["stages"][stage] = stamped
        self._write()

    def _files_of(self, stage: str) -> list[str]:
        """Files that a stage leaves, but for stores, which have checksums of their own."""
        models = sorted(self.sparse.glob("*/*")) if stage == "models" else []
        return [*_FILES.get(stage, ()), *(path.relative_to(self.root).as_posix() for path in models)]

    def _digest(self, name: str) -> str | None:
        """Hash of what a file holds; of COLMAP's database of its rows, whose bytes reading changes."""
        path = self.root / name
        if not path.is_file():
            return None
        return rows_digest(path) if path == self.database else sha256_of(path)

    def changed_files(self, stage: str) -> list[Path]:
        """Files of a finished stage that do not hold what it wrote, or are gone.

        Those of stages that an earlier version finished are not known, nor are stores, which have checksums
        of their own.
        """
        record = self.record_of(stage)
        wanted = record.files if record is not None else {}
        return [self.root / name for name, digest in wanted.items() if self._digest(name) != digest]

    def forget_file(self, stage: str, path: Path) -> None:
        """Take the loss of a file for granted that a stage wrote, and that cannot be made again."""
        record = self._values["stages"].get(stage, {})
        if record.get("files", {}).pop(path.name, None) is not None:
            self._write()

    @contextlib.contextmanager
    def writing(self, *paths: Path) -> Iterator[None]:
        """Write reports or records that hang on no stage; what they then hold is remembered.

        A kill leaves them unknown, not changed.
        """
        written = self._values.setdefault("written", {})
        if any([written.pop(path.name, None) for path in paths]):
            self._write()
        yield
        written |= {path.name: digest for path in paths if (digest := self._digest(path.name)) is not None}
        self._write()

    def changed_records(self) -> list[Path]:
        """Files of `writing` that do not hold what was written; one that is gone was removed on purpose."""
        return [
            self.root / name
            for name, wanted in self._values.get("written", {}).items()
            if os.path.lexists(self.root / name) and self._digest(name) != wanted
        ]

    def forget(self, stage: str) -> None:
        """Drop the record of a stage, so that it is not taken for finished."""
        if self._values["stages"].pop(stage, None) is not None:
            self._write()

    @property
    def mapping_failed(self) -> bool:
        """Whether mapping the current verified matches produced no model."""
        verified = self.record_of("verified matches")
        return verified is not None and self._values.get("mapping_failed") == verified.fingerprint
