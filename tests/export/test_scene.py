"""What cannot be exported is refused with the reason, and nothing is left behind."""

import json
import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from finished_scene import CAMERAS, FinishedScene, make_finished_scene

from corrsfm import export_scene
from corrsfm.errors import DatabaseError, InputError, WorkspaceError
from corrsfm.export import ExportTarget
from corrsfm.export.photos import _pinhole_of, flat_names, is_undistortable
from corrsfm.workspace import StageRecord, Workspace


def files_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.fixture
def copied(scene: FinishedScene, tmp_path: Path) -> FinishedScene:
    """A scene to break, in a folder of its own."""
    root = tmp_path / "made"
    shutil.copytree(scene.workspace.parent, root)
    Workspace(root / "scene").images_dir = root / "photos"
    return FinishedScene(workspace=root / "scene", photos=root / "photos", model=scene.model)


def test_an_unknown_target_names_the_others(scene: FinishedScene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no export for 'obj'; choose one of splat, nerfstudio"):
        export_scene(scene.workspace, tmp_path / "out", "obj")


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("scene", "is the workspace; choose another folder"),
        ("scene/sparse/0", "lies in the folder of the models"),
        ("scene/sparse/9", "lies in the folder of the models"),
        ("photos/out", "lies in the folder of the photos"),
        ("full", "is not empty"),
        ("full/file", "is a file; expected a folder"),
    ],
)
def test_places_where_something_would_be_lost_are_refused(
    copied: FinishedScene, place: str, text: str
) -> None:
    root = copied.workspace.parent
    (root / "full").mkdir()
    (root / "full" / "file").touch()
    before = files_in(root)
    with pytest.raises(InputError, match=text):
        export_scene(copied.workspace, root / place, "splat")
    assert files_in(root) == before


def test_a_file_is_not_overwritten(scene: FinishedScene, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        export_scene(scene.workspace, tmp_path / "poses.csv", "csv")
    assert (tmp_path / "poses.csv").read_text() == "mine"


def test_what_a_link_leads_to_is_filled_and_the_link_stays(scene: FinishedScene, tmp_path: Path) -> None:
    (tmp_path / "large").mkdir()
    (tmp_path / "out").symlink_to("large")
    export_scene(scene.workspace, tmp_path / "out", "splat")
    assert (tmp_path / "out").is_symlink()
    assert (tmp_path / "large" / "sparse" / "0" / "cameras.bin").exists()


def test_an_empty_folder_is_filled(scene: FinishedScene, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    export_scene(scene.workspace, tmp_path / "out", "splat")
    assert (tmp_path / "out" / "sparse" / "0" / "cameras.bin").exists()


def test_a_workspace_without_models_names_the_command(tmp_path: Path, copied: FinishedScene) -> None:
    workspace = Workspace(copied.workspace)
    for stage in ("images", "features", "pairs", "matches", "pruned matches", "verified matches", "models"):
        workspace.forget(stage)
    with pytest.raises(WorkspaceError, match="no models yet; run: corrsfm reconstruct"):
        export_scene(copied.workspace, tmp_path / "out", "csv")


def test_photos_that_are_gone_are_named_and_may_be_elsewhere(copied: FinishedScene, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    copied.photos.rename(moved)
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"5 photos of the model are not there: 1.png.*--images FOLDER"):
        export_scene(copied.workspace, out, "nerfstudio")
    assert not out.exists()
    export_scene(copied.workspace, out, "nerfstudio", images_dir=moved)
    assert (out / "transforms.json").exists()


@pytest.mark.parametrize("target", ["splat", "openmvs", "bundler", "nvm", "ply"])
def test_a_model_without_points_is_refused_where_points_are_needed(
    copied: FinishedScene, tmp_path: Path, target: str
) -> None:
    model = pycolmap.Reconstruction(copied.model)
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    model.write_binary(copied.workspace / "sparse" / "0")
    with pytest.raises(InputError, match=f"holds no points, which --for {target} needs"):
        export_scene(copied.workspace, tmp_path / "out", target)
    export_scene(copied.workspace, tmp_path / "nerf", "nerfstudio")
    assert "ply_file_path" not in json.loads((tmp_path / "nerf" / "transforms.json").read_text())


def test_a_photo_of_another_size_is_refused(copied: FinishedScene, tmp_path: Path) -> None:
    assert cv2.imwrite(str(copied.photos / "2.png"), np.zeros((75, 100, 3), np.uint8))
    for target in ("splat", "nerfstudio", "colmap"):
        with pytest.raises(InputError, match="2.png"):
            export_scene(copied.workspace, tmp_path / "out", target)
    assert not (tmp_path / "out").exists()


def test_a_model_outlives_a_run_that_stopped_at_a_bad_photo(
    copied: FinishedScene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    workspace = Workspace(copied.workspace)
    for stage, inputs in (("features", {}), ("verified matches", {"features": "f"})):
        workspace.finish(stage, StageRecord(fingerprint=stage[0], inputs=inputs))
    workspace.finish("models", StageRecord(fingerprint="m", inputs={"verified matches": "v"}))
    workspace.forget("features")
    with caplog.at_level(logging.WARNING, "corrsfm"):
        export_scene(workspace.root, tmp_path / "poses.csv", "csv")
    assert "no features yet; run: corrsfm extract" in caplog.text
    assert "the model from before is exported" in caplog.text
    with pytest.raises(WorkspaceError, match="no features yet"):
        export_scene(workspace.root, tmp_path / "hloc", "hloc")
    workspace.finish("verified matches", StageRecord(fingerprint="newer"))
    with pytest.raises(WorkspaceError, match="models are older than verified matches"):
        export_scene(workspace.root, tmp_path / "newer.csv", "csv")


def test_a_photo_with_other_pixels_is_named_and_one_that_was_cut_is_refused(
    copied: FinishedScene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = copied.photos / "2.png"
    assert cv2.imwrite(str(path), 255 - cv2.imread(str(path)))
    with caplog.at_level(logging.WARNING, "corrsfm"):
        export_scene(copied.workspace, tmp_path / "out", "nerfstudio")
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.startswith(f"changed since they were reconstructed: 2.png in {copied.photos};")
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match=r"2\.png: is damaged, cut off"):
        export_scene(copied.workspace, tmp_path / "cut", "nerfstudio")
    assert not (tmp_path / "cut").exists()


@pytest.mark.parametrize("content", [b"", b"no photo at all"])
def test_a_photo_that_cannot_be_read_leaves_nothing_behind(
    copied: FinishedScene, tmp_path: Path, content: bytes
) -> None:
    (copied.photos / "2.png").write_bytes(content)
    before = files_in(tmp_path)
    with pytest.raises(InputError, match="2.png"):
        export_scene(copied.workspace, tmp_path / "out", "splat")
    assert files_in(tmp_path) == before


def test_a_fisheye_beyond_180_degrees_stays_a_fisheye_or_is_refused(tmp_path: Path) -> None:
    scene = make_finished_scene(tmp_path / "made", camera="WIDE_FISHEYE")
    with pytest.raises(InputError, match="camera 1 .OPENCV_FISHEYE. cannot be undistorted"):
        export_scene(scene.workspace, tmp_path / "out", "splat")
    assert files_in(tmp_path) == ["made", *(f"made/{name}" for name in files_in(tmp_path / "made"))]
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio")
    assert json.loads((tmp_path / "out" / "transforms.json").read_text())["camera_model"] == "OPENCV_FISHEYE"


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        *((name, params, True) for name, params in CAMERAS.items() if name != "WIDE_FISHEYE"),
        ("OPENCV_FISHEYE", CAMERAS["WIDE_FISHEYE"], False),
        ("SIMPLE_RADIAL", [160.0, 100.0, 75.0, -1.5], False),
        ("EQUIRECTANGULAR", [200.0, 150.0], False),
    ],
)
def test_cameras_that_a_pinhole_can_show(model: str, params: list[float], expected: bool) -> None:
    camera = pycolmap.Camera(camera_id=1, model=model, width=200, height=150, params=params)
    assert is_undistortable(camera) is expected


@pytest.mark.parametrize("target", ["bundler", "nvm"])
def test_two_focal_lengths_do_not_fit_one(scene: FinishedScene, tmp_path: Path, target: str) -> None:
    with pytest.raises(InputError, match="do not fit a format with one focal length"):
        export_scene(scene.workspace, tmp_path / "out", target)
    assert not list(tmp_path.iterdir())


def test_colmap_3_8_does_not_get_a_camera_it_does_not_know(tmp_path: Path, copied: FinishedScene) -> None:
    model = pycolmap.Reconstruction(copied.model)
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.SIMPLE_DIVISION
        camera.params = [160.0, 100.0, 75.0, 0.0]
    model.write_binary(copied.workspace / "sparse" / "0")
    with pytest.raises(InputError, match="COLMAP 3.8 does not know the model SIMPLE_DIVISION"):
        export_scene(copied.workspace, tmp_path / "out", "colmap3")


@pytest.mark.parametrize("target", ["colmap", "colmap3", "hloc"])
def test_a_database_that_is_gone_is_not_made_up(copied: FinishedScene, tmp_path: Path, target: str) -> None:
    (copied.workspace / "database.db").unlink()
    before = files_in(tmp_path)
    with pytest.raises(DatabaseError, match="no such database"):
        export_scene(copied.workspace, tmp_path / "out", target)
    assert files_in(tmp_path) == before


def test_names_with_spaces_are_refused_by_lists_alone(tmp_path: Path) -> None:
    scene = make_finished_scene(tmp_path / "made", folder="my photos")
    for target in ("hloc", "openmvs", "bundler", "nvm"):
        with pytest.raises(InputError, match="cannot hold spaces: my photos/0.png"):
            export_scene(scene.workspace, tmp_path / "out", target)
    export_scene(scene.workspace, tmp_path / "out", "splat")
    assert (tmp_path / "out" / "images" / "my photos_0.png").exists()


def test_names_that_are_one_without_their_folders_are_refused() -> None:
    assert flat_names(["a/b.jpg", "c.jpg"]) == {"a/b.jpg": "a_b.jpg", "c.jpg": "c.jpg"}
    with pytest.raises(InputError, match="have one name: a/b.jpg, a_b.jpg"):
        flat_names(["a/b.jpg", "a_b.jpg"])


def test_a_verdict_that_is_not_good_is_said(
    copied: FinishedScene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert export_scene(copied.workspace, tmp_path / "a.csv", "csv").verdict == "good"
    assert not caplog.records
    verdict = {"grade": "doubtful", "reasons": ["it is bent"], "next_steps": ["more photos"]}
    (copied.workspace / "evidence.json").write_text(json.dumps({"verdict": verdict}))
    with caplog.at_level(logging.WARNING, "corrsfm"):
        assert export_scene(copied.workspace, tmp_path / "b.csv", "csv").verdict == "doubtful"
    assert "the verdict on this model is doubtful: it is bent; try more photos" in caplog.text
    (copied.workspace / "evidence.json").unlink()
    assert export_scene(copied.workspace, tmp_path / "c.csv", ExportTarget.CSV).verdict is None


def test_every_target_is_written_by_its_function(radial_scene: FinishedScene, tmp_path: Path) -> None:
    for target in ExportTarget:
        result = export_scene(radial_scene.workspace, tmp_path / target, target)
        assert result.target is target and (tmp_path / target).exists()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [700.0, 400.0, 300.0]),
        ("SIMPLE_RADIAL", [700.0, 400.0, 300.0, 0.0]),
        ("RADIAL", [700.0, 400.0, 300.0, 0.0, 0.0]),
        ("OPENCV", [700.0, 700.0, 400.0, 300.0, 0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_cameras_without_distortion_are_pinholes_whatever_their_model(
    model: str, params: list[float]
) -> None:
    pinhole = _pinhole_of(pycolmap.Camera(model=model, width=800, height=600, params=params))
    assert pinhole.model_name == "PINHOLE" and pinhole.params.tolist() == [700.0, 700.0, 400.0, 300.0]
