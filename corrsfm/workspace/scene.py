"""Reading a finished workspace from Python: its features, matches and models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from corrsfm.types import Camera, Features, Matches, Pair
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.items import PrunedMatches
from corrsfm.workspace.lists import read_index, read_pairs
from corrsfm.workspace.stores import features_of, matches_of, pruned_of

if TYPE_CHECKING:
    import pycolmap

__all__ = ["Scene", "open_workspace"]


def open_workspace(folder: Path | str) -> Scene:
    """Open a workspace for reading.

    Parameters
    ----------
    folder : path
        A folder that `corrsfm run` or `corrsfm extract` wrote.

    Raises
    ------
    WorkspaceError
        If it is not a workspace, or photos have not been indexed yet.
    """
    workspace = Workspace(Path(folder))
    workspace.modernise()
    return Scene(workspace)


class Scene:
    """What the stages left in a workspace; each item is read when asked for.

    Parameters
    ----------
    workspace : Workspace

    Attributes
    ----------
    photos : tuple of str
        Names of the photos, sorted.
    pairs : tuple of Pair
        The pairs that are matched, sorted.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._index = read_index(workspace)
        self.photos = tuple(self._index.names)

    @property
    def pairs(self) -> tuple[Pair, ...]:
        return read_pairs(self._workspace).pairs

    def camera(self, photo: str) -> Camera:
        """The camera of a photo, as known before reconstruction.

        Raises
        ------
        KeyError
            If the workspace has no such photo.
        """
        cameras = {record.name: self._index.camera_of(record) for record in self._index.records}
        return cameras[photo]

    def features(self, photo: str) -> Features:
        """Keypoints and descriptors of a photo.

        Raises
        ------
        WorkspaceError
            If they are missing or cannot be read.
        """
        return features_of(self._workspace).read(photo)

    def matches(self, pair: Pair) -> Matches:
        """Putative matches of a pair; raises as `features`."""
        return matches_of(self._workspace).read(pair)

    def kept(self, pair: Pair) -> PrunedMatches:
        """Matches of a pair that passed pruning; raises as `features`."""
        return pruned_of(self._workspace).read(pair)

    def models(self) -> list[pycolmap.Reconstruction]:
        """The reconstructed models, the largest first.

        Raises
        ------
        WorkspaceError
            If there are none, they are older than the matches, or one cannot be read.
        """
        from corrsfm.workspace.models import models_of

        self._workspace.require("models")
        return models_of(self._workspace)
