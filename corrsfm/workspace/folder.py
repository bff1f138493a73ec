"""The folder of a workspace: where every file lies, and which stages are finished.

::

    WORKSPACE/
    ├── workspace.json      format version, image folder, per stage fingerprint, options and seconds
    ├── frames/             frames of a video, and frames.json with their times
    ├── converted/          JPEGs of HEIC and AVIF photos, and links to the other photos
    ├── images.txt          names of the photos, one per line
    ├── images.json         photos and cameras as corrsfm knows them
    ├── features.db         keypoints and descriptors
    ├── pairs.txt           pairs to match, ``name0 name1``
    ├── pair_origins.tsv    the strategies that proposed each pair
    ├── matches.db          putative matches
    ├── pruned/METHOD.db    matches that passed pruning, for each method that was tried
    ├── .shards/            items that workers of a cluster made and that were not merged yet
    ├── cameras.json        which photos share a camera, and by what evidence
    ├── database.db         COLMAP database with verified two-view geometries
    ├── sparse/0, 1, …      models, the largest first
    ├── evidence.json       why the first model was chosen, and the verdict on it
    ├── added.json          photos that `corrsfm add` put into finished models, and what became of each
    ├── adding.json         those of an addition that has not finished
    ├── sparse.old/         models of earlier matches, moved here when mapping failed
    ├── warnings.json       what each stage warned of
    ├── report.json, report.html
    ├── .seeds/SEED/        workspaces of further seeds, for `corrsfm compare` and `corrsfm evaluate scene`
    ├── run.json            versions, options, hashes and seconds of the last `corrsfm run`
    └── log.txt             what pycolmap had to say

Every file is written under another name and renamed, so a file that exists is whole; but for features.db,
matches.db and those of pruned, which take in one item after the other (`corrsfm.workspace.store`). A stage is
current if its recorded fingerprint, a hash of its options and of the fingerprints of its inputs, equals the
wanted one.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import shlex
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from corrsfm import config as cfg
from corrsfm.colmap.sqlite import rows_digest
from corrsfm.disk import explain
from corrsfm.errors import ConfigError, InputError, WorkspaceError
from corrsfm.files import FRAME_TIMES, OWN_RECORD, read_bytes, sha256_of
from corrsfm.workspace.commands import command_for, label_of
from corrsfm.workspace.entries import check_entries
from corrsfm.workspace.lease import hold, holder_of
from corrsfm.workspace.manifest import (
    FORMAT_VERSION,
    StageRecord,
    has_lost_manifest,
    read_manifest,
    write_manifest,
)

__all__ = ["Workspace"]

logger = logging.getLogger("corrsfm")

_FILES = {
    "images": ("images.json", "images.txt"),
    "pairs": ("pairs.txt", "pair_origins.tsv"),
    "verified matches": ("cameras.json", "database.db"),
    "models": ("evidence.json", "added.json"),
}


class Workspace:
    """The folder of one scene.

    Parameters
    ----------
    root : Path
    create : bool
        Make the folder if it does not exist; otherwise that is an error.
    images_dir : Path, optional
        Folder of its photos.

    Raises
    ------
    WorkspaceError
        If the folder is not a workspace, or one of another version, or its manifest is damaged, or it is the
        folder of the photos.
    """

    def __init__(self, root: Path, *, create: bool = False, images_dir: Path | None = None) -> None:
        if images_dir is not None and root.resolve() == images_dir.resolve():
            raise WorkspaceError(
                f"{root}: is the folder of the photos; choose another for the workspace, such as"
                f" {root / 'corrsfm'}"
            )
        self.root = root
        self.manifest = root / "workspace.json"
        self.frames = root / "frames"
        self.converted = root / "converted"
        self.images_txt = root / "images.txt"
        self.images_json = root / "images.json"
        self.photo_cache = root / ".photos.json"
        self.features = root / "features.db"
        self.pairs = root / "pairs.txt"
        self.pair_origins = root / "pair_origins.tsv"
        self.matches = root / "matches.db"
        self.shards = root / ".shards"
        self.cameras_json = root / "cameras.json"
        self.database = root / "database.db"
        self.sparse = root / "sparse"
        self.evidence = root / "evidence.json"
        self.added = root / "added.json"
        self.adding = root / "adding.json"
        self.candidates = root / ".candidates"
        self.warnings_json = root / "warnings.json"
        self.seeds = root / ".seeds"
        self.report_json = root / "report.json"
        self.report_html = root / "report.html"
        self.run_json = root / "run.json"
        self.log = root / "log.txt"
        # What was there before this workspace was begun, and which folders were made for it; None if it was
        # begun earlier.
        self._begun: tuple[set[str], list[Path]] | None = None
        self.is_only_read = False
        if not self.manifest.exists():
            self._start(create)
        self._values = read_manifest(self.manifest)

    def _start(self, create: bool) -> None:
        if not create and has_lost_manifest(self.root):
            raise WorkspaceError(
                f"{self.root}: is a workspace that lost {self.manifest.name}; make it again with the command "
                f"and the options that made it, such as: corrsfm run PHOTOS "
                f"{shlex.quote(str(self.root))}; finished features and matches are kept"
            )
        if not create:
            raise WorkspaceError(
                f"{self.root}: not a corrsfm workspace; make one with: corrsfm extract IMAGES {self.root}"
            )
        if self.root.exists() and not self.root.is_dir():
            raise WorkspaceError(f"{self.root}: is a file; expected a folder for the workspace")
        # Only corrsfm writes these files: the folder is a workspace that lost its manifest.
        own = self.photo_cache.exists() or self.images_json.exists()
        foreign = [path.name for path in (self.database, self.sparse) if path.exists()]
        if foreign and not own:
            raise WorkspaceError(
                f"{self.root}: holds {' and '.join(foreign)} of another tool; choose an empty folder, "
                "nothing was touched"
            )
        if not own:
            before = set(os.listdir(self.root)) if self.root.exists() else set()
            self._begun = before, [path for path in (self.root, *self.root.parents) if not path.exists()]
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WorkspaceError(f"{self.root}: cannot be made ({error.strerror})") from error
        self._values = {"format_version": FORMAT_VERSION, "images_dir": None, "stages": {}}
        self._write()

    def _write(self) -> None:
        write_manifest(self.manifest, self._values)

    @contextlib.contextmanager
    def lock(self, *, wait: bool = False) -> Iterator[None]:
        """Hold the workspace for this process; one that was begun with unusable input vanishes again.

        Parameters
        ----------
        wait : bool
            Wait for another process that holds it instead of failing.

        Raises
        ------
        WorkspaceError
            If another process holds it, or nothing can be written there.
        """
        with hold(self.root / ".lock", wait=wait):
            check_entries(self.root, self._own_names, may_link=False)
            self._values = read_manifest(self.manifest)
            if self._values["format_version"] < FORMAT_VERSION:
                self._convert()
            try:
                yield
            except (ConfigError, InputError):
                if self._begun is not None and not self._values["stages"]:
                    self._vanish(*self._begun)
                raise

    def modernise(self) -> None:
        """Convert a workspace of an earlier version, which reading alone cannot use.

        Raises
        ------
        WorkspaceError
            As `lock`, or if a file of it cannot be read.
        """
        if self._values["format_version"] < FORMAT_VERSION:
            with self.lock():
                pass

    def _convert(self) -> None:
        from corrsfm.workspace.conversion import convert_items

        convert_items(self)
        self._values.pop("costs", None)
        self._values["format_version"] = FORMAT_VERSION
        self._write()

    def _vanish(self, before: set[str], made: list[Path]) -> None:
        """Remove what making the workspace left, so that a mistyped command leaves nothing."""
        for path in (self.manifest, self.photo_cache, self.warnings_json, self.log, self.root / ".lock"):
            if path.name not in before:
                path.unlink(missing_ok=True)
        for folder in (self.frames, self.converted):
            if folder.name not in before and (folder / OWN_RECORD).is_file():
                shutil.rmtree(folder)
        # Fails where something of use is there.
        with contextlib.suppress(OSError):
            for folder in made:
                folder.rmdir()

    @property
    def pruned(self) -> Path:
        """Where the kept matches lie of the prune method that was used last."""
        record = self.record_of("pruned matches")
        method = record.config.get("method") if record is not None else None
        return self.pruned_by(method or cfg.PruneConfig().method)

    def pruned_by(self, method: str) -> Path:
        """Where the kept matches of a prune method lie, whichever is the current one."""
        return self.root / "pruned" / f"{method}.db"

    @contextlib.contextmanager
    def reading(self) -> Iterator[None]:
        """Read the workspace while nobody writes there; it is not changed, and may be read-only.

        Raises
        ------
        WorkspaceError
            If another process works there.
        """
        self.modernise()
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):
                handle = stack.enter_context(open(self.root / ".lock", "rb", buffering=0))
                try:
                    fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    who = holder_of(handle)
                    raise WorkspaceError(
                        f"{self.root}: another corrsfm works in this workspace{who}; wait for it"
                    ) from error
            check_entries(self.root, self._own_names, may_link=True)
            self._values = read_manifest(self.manifest)
            self.is_only_read = True
            stack.callback(setattr, self, "is_only_read", False)
            yield

    @property
    def _own_names(self) -> list[str]:
        """Names of what is written in the root, but for the copies of photos, which are links by design."""
        places = {path for path in vars(self).values() if isinstance(path, Path) and path.parent == self.root}
        return sorted({path.name for path in places - {self.converted}} | {"pruned"})

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
        # A folder inside the workspace moves with it.
        return self.root / self._values["images_dir"]

    @images_dir.setter
    def images_dir(self, folder: Path) -> None:
        resolved, root = folder.resolve(), self.root.resolve()
        inside = resolved in (self.frames.resolve(), self.converted.resolve())
        self._values["images_dir"] = str(resolved.relative_to(root) if inside else resolved)
        self._write()

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
            raise WorkspaceError(f"{self.root}: no {label_of(stage)} yet; run: {self._remedy(stage)}")
        for name, fingerprint in record.inputs.items():
            if self.require(name).fingerprint != fingerprint:
                raise WorkspaceError(
                    f"{self.root}: {label_of(stage)} are older than {label_of(name)};"
                    f" run: {self._remedy(stage)}"
                )
        return record

    def _remedy(self, stage: str) -> str:
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

    def put_models_aside(self) -> None:
        """Remember that mapping failed, and move the models of earlier matches out of the way.

        They go to ``sparse.old``, with the reports about them, so that they are not mistaken for new ones,
        and replace what was moved there before. An addition to them can no longer be finished.
        """
        self.forget("models")
        self._values.pop("written", None)
        self.adding.unlink(missing_ok=True)
        if verified := self.record_of("verified matches"):
            self._values["mapping_failed"] = verified.fingerprint
            self._write()
        if not self.sparse.is_dir():
            self.run_json.unlink(missing_ok=True)
            return
        for path in (self.run_json, self.evidence, self.added, self.report_json, self.report_html):
            if path.exists():
                os.replace(path, self.sparse / path.name)
        aside = self.sparse.with_name("sparse.old")
        if aside.exists():
            shutil.rmtree(aside)
        os.replace(self.sparse, aside)
        logger.warning("the models of the earlier matches were moved to %s", aside)
