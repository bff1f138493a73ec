"""The models of a workspace, read without harm from what may have happened to them since."""

from __future__ import annotations

import logging
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from corrsfm.colmap.models import read_models
from corrsfm.errors import WorkspaceError, first_few
from corrsfm.files import atomic_path, sha256_of
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.lists import read_index

if TYPE_CHECKING:
    import pycolmap

__all__ = ["changed_models", "copy_aside", "models_of", "others_in_models", "what_mapping_again_moves"]

logger = logging.getLogger("corrsfm")

TRIAL_SECONDS = 20.0
SECONDS_PER_MB = 0.2
# Numbers that no model has, of which one flipped bit makes wild ones; everything that is looked up later, so
# that an index that leads nowhere shows here; and files that end too early, of which pycolmap makes up the
# rest, are longer when they are written again.
_TRIAL = """
import sys, tempfile, pathlib, numpy, pycolmap
folder = pathlib.Path(sys.argv[1])
model = pycolmap.Reconstruction(folder)
for camera in model.cameras.values():
    assert numpy.isfinite(camera.params).all() and camera.width > 0 and camera.height > 0
    assert all(camera.params[number] > 0 for number in camera.focal_length_idxs())
with tempfile.TemporaryDirectory() as copy:
    model.write_binary(copy)
    for path in folder.glob("*.bin"):
        assert path.stat().st_size == (pathlib.Path(copy) / path.name).stat().st_size, path
for image in model.images.values():
    assert not image.has_pose or numpy.abs(image.cam_from_world().matrix()).max() < 1e12
    assert all(model.exists_point3D(p.point3D_id) for p in image.points2D if p.has_point3D())
for point in model.points3D.values():
    assert numpy.abs(point.xyz).max() < 1e12
    for element in point.track.elements:
        model.images[element.image_id].points2D[element.point2D_idx]
"""


def changed_models(workspace: Workspace, changed: Iterable[Path] | None = None) -> list[Path]:
    """Folders of the models that are not those that corrsfm wrote and judged.

    Parameters
    ----------
    workspace : Workspace
    changed : iterable of Path, optional
        What `Workspace.changed_files` found, if the caller has asked already.
    """
    inside = (
        path.relative_to(workspace.sparse)
        for path in (workspace.changed_files("models") if changed is None else changed)
        if path.is_relative_to(workspace.sparse)
    )
    return sorted({workspace.sparse / path.parts[0] for path in inside})


def what_mapping_again_moves(workspace: Workspace) -> str:
    """To append to advice to map again: models that photos were added to do not come out as they were."""
    if not workspace.added.exists():
        return ""
    return "; photos were added to the models: mapped again every pose moves, and a copy of them is kept"


def models_of(workspace: Workspace, changed: Iterable[Path] | None = None) -> list[pycolmap.Reconstruction]:
    """The reconstructed models, the largest first.

    Models that are not as they were written, by an edit or by damage, are read in a process of their own
    first: pycolmap does not come to an end with some damaged bytes, and ends the process with others.

    Parameters
    ----------
    workspace, changed
        As for `changed_models`.

    Raises
    ------
    WorkspaceError
        If there is none, or one cannot be read.
    """
    for folder in changed_models(workspace, changed):
        if not _can_be_read(folder):
            raise WorkspaceError(
                f"{folder}: damaged, not as it was written"
                f"{what_mapping_again_moves(workspace)}; make it again with: {_mapping_again(workspace)}"
            )
        logger.warning(
            "%s: changed since corrsfm wrote it; it is used as it is, without the verdict on the old "
            "one; for a new one: %s",
            folder,
            workspace.command_for("models", "--overwrite"),
        )
    models = read_models(workspace.sparse)
    _require_own_photos(workspace, models)
    return models


def _mapping_again(workspace: Workspace) -> str:
    """The commands that map again; an addition that was interrupted needs the models, and is given up."""
    if not workspace.adding.exists():
        return workspace.command_for("models", "--overwrite")
    giving_up = shlex.join(["rm", str(workspace.adding)])
    *others, _ = workspace.commands_from("images")
    return "; ".join([giving_up, *others, workspace.command_for("models", "--overwrite")])


def others_in_models(workspace: Workspace) -> list[Path]:
    """What a user has put among the models, or changed there."""
    record = workspace.record_of("models")
    wanted = record.files if record is not None else {}
    found = [path for path in sorted(workspace.sparse.rglob("*")) if not path.is_dir()]
    written = {workspace.root / name for name in wanted}
    # Of models without a record, those of corrsfm are numbered.
    others = [
        path
        for path in found
        if path not in written and (wanted or not path.relative_to(workspace.sparse).parts[0].isdecimal())
    ]
    changed = [path for path in workspace.changed_files("models") if path in found]
    return sorted({*others, *changed})


def copy_aside(workspace: Workspace) -> Path:
    """Copy the models, before others replace them, to where nothing replaces the copy.

    Returns
    -------
    Path
        Of the copy; the last one if that is the same.
    """
    place = workspace.place_aside()
    copies = sorted(workspace.root.glob("sparse.old*"), key=lambda path: (len(path.name), path.name))
    # A run that was killed and goes on makes one copy.
    if copies and _contents(copies[-1]) == _contents(workspace.sparse):
        return copies[-1]
    with atomic_path(place) as copy:
        shutil.copytree(workspace.sparse, copy)
    return place


def _contents(folder: Path) -> dict[Path, str]:
    return {path.relative_to(folder): sha256_of(path) for path in folder.rglob("*") if path.is_file()}


def _require_own_photos(workspace: Workspace, models: Iterable[pycolmap.Reconstruction]) -> None:
    """Refuse models of photos that the scene does not hold, whose names lead anywhere, or of other sizes."""
    index = read_index(workspace)
    cameras = {record.name: index.camera_of(record) for record in index.records}
    images = [image for model in models for image in model.images.values()]
    if strange := sorted({image.name for image in images} - cameras.keys()):
        raise WorkspaceError(
            f"{workspace.sparse}: holds photos that this scene does not: {first_few(strange)}; name them as "
            f"the scene does, or make the models again with: {_mapping_again(workspace)}"
        )
    for image in images:
        there, wanted = image.camera, cameras[image.name]
        if (there.width, there.height) != (wanted.width, wanted.height):
            raise WorkspaceError(
                f"{workspace.sparse}: says that {image.name} has {there.width}×{there.height} pixels, not "
                f"{wanted.width}×{wanted.height}; make the models again with: {_mapping_again(workspace)}"
            )


def _can_be_read(folder: Path) -> bool:
    size = sum(path.stat().st_size for path in folder.glob("*") if path.is_file())
    limit = TRIAL_SECONDS + SECONDS_PER_MB * size / 1e6
    command = [sys.executable, "-c", _TRIAL, str(folder)]
    try:
        return subprocess.run(command, capture_output=True, timeout=limit, check=False).returncode == 0
    except subprocess.TimeoutExpired:
        return False
