"""Whether the files of a scene can be read to the last item, and what makes a damaged one again."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from corrsfm.colmap.models import read_models
from corrsfm.colmap.sqlite import open_for_reading
from corrsfm.errors import CorrsfmError, WorkspaceError
from corrsfm.finished.advice import command_again
from corrsfm.types import Matches, Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, MATCHES, PRUNED, PrunedMatches
from corrsfm.workspace.lists import read_index, read_pairs
from corrsfm.workspace.store import ItemStore

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

    Every keypoint and match is read, and no match may name a keypoint that is not there. Changed values that
    are still possible ones are not noticed.

    Parameters
    ----------
    workspace : Workspace

    Returns
    -------
    list of Damage
        In the order of the stages.
    """
    reader = _Reader(workspace)
    found = []
    for stage, (path, read) in reader.stages().items():
        if workspace.record_of(stage) is None:
            continue
        try:
            read()
        except CorrsfmError as error:
            problem = str(error).removeprefix(f"{path}: ")
        # Whatever a library stumbles over in damaged bytes.
        except Exception as error:
            problem = f"damaged ({type(error).__name__}: {error})"
        else:
            continue
        remedy = command_again(workspace, stage)
        if path.exists():
            remedy = f"{shlex.join(['rm', '-r', *map(str, _names_of(path, workspace))])}; {remedy}"
        found.append(Damage(path=path, problem=problem, remedy=remedy))
    return found


def _names_of(path: Path, workspace: Workspace) -> list[Path]:
    """All names of a file that is there: that of a prune method's matches would bring the damage back."""
    others = workspace.pruned_by("*")
    return [path, *(other for other in sorted(others.parent.glob(others.name)) if path.samefile(other))]


class _Reader:
    """Reads what the stages of a workspace left, and raises where it cannot be."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._num_keypoints: dict[str, int] = {}

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
        with ItemStore(self._workspace.features, FEATURES).reader() as read:
            for name in self._names:
                features = read(name)
                if not np.isfinite(features.keypoints).all():
                    raise WorkspaceError(f"{name}: keypoints that are not finite")
                if len(features.descriptors) != len(features.keypoints):
                    raise WorkspaceError(f"{name}: not as many descriptors as keypoints")
                self._num_keypoints[name] = len(features.keypoints)

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
        with ItemStore(self._workspace.matches, MATCHES).reader() as read:
            self._check_matches(read)

    def _pruned(self) -> None:
        with ItemStore(self._workspace.pruned, PRUNED).reader() as read:
            self._check_matches(read)

    def _check_matches(self, read: Callable[[Pair], Matches] | Callable[[Pair], PrunedMatches]) -> None:
        for pair in self._known_pairs:
            indices = read(pair).indices
            if indices.ndim != 2 or indices.shape[1] != 2:
                raise WorkspaceError(f"{' – '.join(pair)}: matches of shape {indices.shape}")
            for column, name in enumerate(pair):
                # Where features are damaged, their number is not known.
                num = self._num_keypoints.get(name, np.inf)
                if not ((indices[:, column] >= 0) & (indices[:, column] < num)).all():
                    where = " – ".join(pair)
                    raise WorkspaceError(f"{where}: matches of keypoints that {name} does not have")

    def _database(self) -> None:
        with open_for_reading(self._workspace.database) as connection:
            (result,) = connection.execute("PRAGMA integrity_check").fetchone()
        if result != "ok":
            raise WorkspaceError(f"damaged ({result})")

    def _models(self) -> None:
        for number, model in enumerate(read_models(self._workspace.sparse)):
            if not model.num_reg_images():
                raise WorkspaceError(f"model {number} holds no photo")
