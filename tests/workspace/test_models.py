"""Models that were changed since they were written are used if they can be read, and never hang or crash."""

from pathlib import Path

import cv2  # noqa: F401  (before pycolmap)
import numpy as np
import pycolmap
import pytest
from finished_scene import make_finished_scene

from corrsfm.errors import WorkspaceError
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.models import copy_aside, models_of, others_in_models


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    workspace = Workspace(make_finished_scene(tmp_path / "made", camera="SIMPLE_RADIAL").workspace)
    workspace.finish("models", StageRecord(fingerprint="made up"))
    return workspace


def test_a_model_that_another_program_adjusted_is_used_with_a_warning(
    workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    (model,) = models_of(workspace)
    assert not caplog.records
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.01
    model.write_binary(workspace.sparse / "0")
    (again,) = models_of(workspace)
    assert "changed since corrsfm wrote it" in caplog.text
    assert again.num_points3D() == model.num_points3D()


@pytest.mark.parametrize("wild", ["point", "pose", "focal length"])
def test_a_model_of_impossible_numbers_is_damaged(workspace: Workspace, wild: str) -> None:
    (model,) = models_of(workspace)
    if wild == "point":
        next(iter(model.points3D.values())).xyz = np.full(3, np.nan)
    elif wild == "pose":
        frame = next(iter(model.frames.values()))
        frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.array([0.0, 1e300, 0.0]))
    else:
        camera = next(iter(model.cameras.values()))
        camera.params = [-camera.params[0], *camera.params[1:]]
    model.write_binary(workspace.sparse / "0")
    with pytest.raises(WorkspaceError, match="0: damaged, not as it was written; make it again with: "):
        models_of(workspace)


def test_what_others_put_among_the_models_is_told_from_what_corrsfm_wrote(workspace: Workspace) -> None:
    assert others_in_models(workspace) == []
    (workspace.sparse / "0_edited").mkdir()
    (workspace.sparse / "0_edited" / "cameras.txt").touch()
    (workspace.sparse / "0" / "images.bin").write_bytes(b"edited")
    others = [workspace.sparse / "0" / "images.bin", workspace.sparse / "0_edited" / "cameras.txt"]
    assert others_in_models(workspace) == others
    # After a kill between the record and the models there is no record.
    workspace.forget("models")
    assert others_in_models(workspace) == others[1:]


def test_models_are_copied_aside_once_and_never_over_another_copy(workspace: Workspace) -> None:
    first = copy_aside(workspace)
    assert first == copy_aside(workspace) == workspace.root / "sparse.old"
    (workspace.sparse / "notes.txt").write_text("mine")
    second = copy_aside(workspace)
    assert second == copy_aside(workspace) == workspace.root / "sparse.old.2"
    assert (second / "notes.txt").exists() and not (first / "notes.txt").exists()


@pytest.mark.parametrize("name", ["../../mine.jpg", "/tmp/mine.jpg", "unknown.jpg"])
def test_a_model_of_photos_that_the_scene_does_not_hold_is_refused(workspace: Workspace, name: str) -> None:
    (model,) = models_of(workspace)
    next(iter(model.images.values())).name = name
    model.write_binary(workspace.sparse / "0")
    # Whoever sends a workspace may make its record fit.
    for _ in range(2):
        with pytest.raises(WorkspaceError, match=f"does not: {name}; name them as the scene does"):
            models_of(workspace)
        workspace.finish("models", StageRecord(fingerprint="made up"))


@pytest.mark.parametrize("name", ["cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"])
@pytest.mark.parametrize("way", ["cut", "noise", "count"])
def test_a_damaged_model_is_named_with_the_command_that_makes_it_again(
    workspace: Workspace, name: str, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("corrsfm.workspace.models.TRIAL_SECONDS", 4.0)
    path = workspace.sparse / "0" / name
    content = path.read_bytes()
    changed = {
        "cut": content[: len(content) // 2],
        "noise": bytes((97 * place + 13) % 256 for place in range(len(content))),
        "count": (2**40).to_bytes(8, "little") + content[8:],
    }
    path.write_bytes(changed[way])
    with pytest.raises(WorkspaceError, match=r"sparse/0: damaged, .*: corrsfm reconstruct .* --overwrite"):
        models_of(workspace)
