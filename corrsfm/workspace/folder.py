"""The folder of a workspace: begun, held by one process, read by others, converted from earlier versions.

Every file is written under another name and renamed, so a file that exists is whole; but for features.db,
matches.db and those of pruned, which take in one item after the other (`corrsfm.workspace.store`).
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

from corrsfm import config as cfg
from corrsfm.disk import why_not
from corrsfm.errors import ConfigError, InputError, WorkspaceError, first_few
from corrsfm.files import OWN_RECORD, replaced_name
from corrsfm.workspace.entries import check_entries
from corrsfm.workspace.lease import hold, hold_for_reading
from corrsfm.workspace.ledger import Ledger
from corrsfm.workspace.manifest import FORMAT_VERSION, has_lost_manifest, read_manifest

__all__ = ["Workspace"]

logger = logging.getLogger("corrsfm")

# SQLite opens no file whose path is longer than about 500 bytes; names of files inside take up to 100.
LONGEST_PATH_BYTES = 400


class Workspace(Ledger):
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
        folder of the photos, or its path is too long.
    """

    def __init__(self, root: Path, *, create: bool = False, images_dir: Path | None = None) -> None:
        if images_dir is not None and root.resolve() == images_dir.resolve():
            raise WorkspaceError(
                f"{root}: is the folder of the photos; choose another for the workspace, such as"
                f" {root / 'corrsfm'}"
            )
        super().__init__(root)
        if len(os.fsencode(os.path.realpath(root))) > LONGEST_PATH_BYTES:
            raise WorkspaceError(
                f"{root}: path longer than the {LONGEST_PATH_BYTES} bytes that databases there allow; "
                "choose a folder with a shorter one"
            )
        # What was there before this workspace was begun, and which folders were made for it; None if it was
        # begun earlier.
        self._begun: tuple[set[str], list[Path]] | None = None
        self.is_only_read = False
        self._may_begin = create
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
                f"{self.root}: not a corrsfm workspace; make one with: corrsfm extract IMAGES "
                f"{shlex.quote(str(self.root))}"
            )
        if self.root.exists() and not self.root.is_dir():
            raise WorkspaceError(f"{self.root}: is a file; expected a folder for the workspace")
        own = has_lost_manifest(self.root)
        # Pictures that are there already are told from our own by a record of theirs.
        names = [name for name in self._own_names if name != self.frames.name]
        foreign = [name for name in names if os.path.lexists(self.root / name)]
        if foreign and not own:
            raise WorkspaceError(
                f"{self.root}: holds {first_few(foreign)} of another tool, which a workspace would replace; "
                f"choose an empty folder, such as {self.root / 'corrsfm'}; nothing was touched"
            )
        if not own:
            before = set(os.listdir(self.root)) if self.root.exists() else set()
            self._begun = before, [path for path in (self.root, *self.root.parents) if not path.exists()]
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WorkspaceError(why_not(error, self.root, "made")) from error
        self._values = {"format_version": FORMAT_VERSION, "images_dir": None, "stages": {}}
        self._write()

    @property
    def made_its_folder(self) -> bool:
        """Whether there was no such folder before this workspace was begun, by this process."""
        return self._begun is not None and self.root in self._begun[1]

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
        with hold(self.root / ".lock", wait=wait, make=self._may_begin):
            # The one that was waited for had begun it, with input that cannot be used, and took it away.
            if self._may_begin and not self.manifest.exists():
                self._start(create=True)
            check_entries(self.root, self._own_names, may_link=False)
            self._values = read_manifest(self.manifest)
            if self._values["format_version"] < FORMAT_VERSION:
                self._convert()
            # A kill came while other models took their place.
            aside = replaced_name(self.sparse)
            if aside.is_dir() and not self.sparse.exists():
                os.replace(aside, self.sparse)
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
        with hold_for_reading(self.root / ".lock"), contextlib.ExitStack() as stack:
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

    def obstacles(self) -> dict[Path, str]:
        """What keeps every command from writing here, with the reason: links, and no file for the lock."""
        links = [path for name in self._own_names if (path := self.root / name).is_symlink()]
        found = dict.fromkeys(links, "is a link, and nothing is written through links")
        lock = self.root / ".lock"
        if os.path.lexists(lock) and (lock.is_symlink() or not lock.is_file()):
            found[lock] = "is no file, expected one"
        return found

    def place_aside(self) -> Path:
        """Where models go that others replace: the first free one of ``sparse.old``, ``sparse.old.2``, …"""
        names = ("sparse.old" if number == 1 else f"sparse.old.{number}" for number in itertools.count(1))
        return next(path for name in names if not os.path.lexists(path := self.root / name))

    def put_models_aside(self) -> None:
        """Remember that mapping failed, and move the models of earlier matches out of the way.

        They go to `place_aside`, with the reports about them, so that they are not mistaken for new ones. An
        addition to them can no longer be finished.
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
        aside = self.place_aside()
        os.replace(self.sparse, aside)
        logger.warning("the models of the earlier matches were moved to %s", aside)
