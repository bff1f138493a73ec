"""Whether the files of a scene can be read to the last item, and what makes a damaged one again."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from corrsfm.colmap import sqlite
from corrsfm.colmap.models import read_models
from corrsfm.errors import CorrsfmError, WorkspaceError, first_few
from corrsfm.finished.advice import command_again
from corrsfm.types import Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.items import K, T
from corrsfm.workspace.lists import read_index, read_pairs
from corrsfm.workspace.models import what_mapping_again_moves
from corrsfm.workspace.store import ItemStore
from corrsfm.workspace.stores import features_of, matches_of, pruned_of

__all__ = ["Damage", "find_damage"]


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A file that cannot be read as the stage left it.

    Attributes
    ----------
    path : Path
    problem : str
    remedy : str
        Commands that make it again, and what hangs on it.
    """

    path: Path
    problem: str
    remedy: str


def find_damage(workspace: Workspace) -> list[Damage]:
    """Read everything that the finished stages of a workspace left; nothing is changed.

    Features and matches are held against their checksums.

    Parameters
    ----------
    workspace : Workspace

    Returns
    -------
    list of Damage
        In the order of the stages.
    """
    reader = _Reader(workspace)
    found = [
        Damage(path=path, problem=problem, remedy=_put_in_place(path))
        for path, problem in workspace.obstacles().items()
    ]
    for stage, (path, read) in reader.stages().items():
        if workspace.record_of(stage) is None:
            continue
        changed: list[Path] = []
        try:
            # Before pycolmap meets damaged bytes, with which it may not come to an end.
            if changed := workspace.changed_files(stage):
                raise WorkspaceError(f"not as it was written: {first_few(map(str, changed))}")
            read()
        except CorrsfmError as error:
            problem = str(error).removeprefix(f"{path}: ")
        # Whatever a library stumbles over in damaged bytes.
        except Exception as error:
            problem = f"damaged ({type(error).__name__}: {error})"
        else:
            continue
        if workspace.adding.exists() and stage == "models":
            remedy = shlex.join(["corrsfm", "add", str(workspace.root)])
        elif changed == [workspace.added]:
            problem += "; what it says of added photos is lost, the models are not"
            remedy = _report_without(workspace.added, workspace)
        elif changed == [workspace.evidence] and workspace.added.exists():
            problem += "; the verdict is lost, the models are not"
            remedy = _report_without(workspace.evidence, workspace)
        elif stage in _STORES and path.exists():
            remedy = command_again(workspace, stage, "--verify")
        elif stage == "models":
            problem += what_mapping_again_moves(workspace)
            remedy = command_again(workspace, stage, "--overwrite")
        else:
            remedy = command_again(workspace, stage)
            if stage == "verified matches":
                problem += what_mapping_again_moves(workspace)
            if path.exists():
                remedy = f"{shlex.join(['rm', '-r', str(path)])}; {remedy}"
        found.append(Damage(path=path, problem=problem, remedy=remedy))
    return [*found, *_changed_records(workspace)]


def _report_without(lost: Path, workspace: Workspace) -> str:
    """The commands that take the loss of a file for granted."""
    return "; ".join(
        [shlex.join(["rm", "-rf", str(lost)]), shlex.join(["corrsfm", "report", str(workspace.root)])]
    )


def _put_in_place(path: Path) -> str:
    """The command that puts what a link leads to in its place, or takes away what leads nowhere."""
    if path.is_symlink() and path.exists():
        return shlex.join(["cp", "-r", "--remove-destination", str(path.resolve()), str(path)])
    return shlex.join(["rm", "-r", str(path)])


def _changed_records(workspace: Workspace) -> list[Damage]:
    """What hangs on no stage: the reports, and the record of the last run, which only a run can write."""
    found = []
    for path in workspace.changed_records():
        remedy = shlex.join(["rm", "-r", str(path)])
        if path != workspace.run_json:
            remedy += "; " + shlex.join(["corrsfm", "report", str(workspace.root)])
        found.append(Damage(path=path, problem="not as it was written", remedy=remedy))
    return found


# A damaged item of these is made again alone.
_STORES = ("features", "matches", "pruned matches")


class _Reader:
    """Reads what the stages of a workspace left, and raises where it cannot be."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace

    def stages(self) -> dict[str, tuple[Path, Callable[[], None]]]:
        """Stage → its file or folder, and what reads it."""
        workspace = self._workspace
        return {
            "images": (workspace.images_json, self._images),
            "features": (workspace.features, self._features),
            "pairs": (workspace.pairs, self._pairs),
            "matches": (workspace.matches, self._matches),
            "pruned matches": (workspace.pruned, self._pruned),
            "verified matches": (workspace.database, self._database),
            "models": (workspace.sparse, self._models),
        }

    def _images(self) -> None:
        read_index(self._workspace)

    @cached_property
    def _names(self) -> tuple[str, ...]:
        try:
            return tuple(read_index(self._workspace).names)
        except CorrsfmError:  # a finding of its own
            return ()

    def _features(self) -> None:
        _whole(features_of(self._workspace), self._names)

    @cached_property
    def _known_pairs(self) -> tuple[Pair, ...]:
        try:
            return read_pairs(self._workspace).pairs
        except CorrsfmError:  # a finding of its own
            return ()

    def _pairs(self) -> None:
        if missing := [
            path for path in (self._workspace.pairs, self._workspace.pair_origins) if not path.exists()
        ]:
            raise WorkspaceError(f"{missing[0]}: missing")
        names = set(self._names)
        strange = {name for pair in read_pairs(self._workspace).pairs for name in pair} - names
        if strange and names:
            raise WorkspaceError(f"names {min(strange)}, which is no photo of the scene")

    def _matches(self) -> None:
        _whole(matches_of(self._workspace), self._known_pairs)

    def _pruned(self) -> None:
        _whole(pruned_of(self._workspace), self._known_pairs)

    def _database(self) -> None:
        if problem := sqlite.find_damage(self._workspace.database):
            raise WorkspaceError(f"damaged ({problem})")

    def _models(self) -> None:
        # As they were written, see above: no need to try them first.
        for number, model in enumerate(read_models(self._workspace.sparse)):
            if not model.num_reg_images():
                raise WorkspaceError(f"model {number} holds no photo")


def _whole(store: ItemStore[K, T], keys: Iterable[K]) -> None:
    store.fingerprints(keys)
    if damaged := store.find_damage():
        raise WorkspaceError(f"damaged: {first_few(damaged)}")
