"""The consumers' own packages read what we export; each test runs where its package is installed.

`make test-consumers` installs them all, see `tests/consumers.sh`.
"""

import functools
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from finished_scene import FinishedScene, make_finished_scene
from numpy.typing import NDArray

from corrsfm import export_scene
from corrsfm.colmap.models import poses_of

POSE_TOLERANCE = 1e-6
PIXEL_TOLERANCE = 0.05
# Photos are cropped by whole pixels so that the principal point is in the middle.
MOST_OFF_CENTRE = 0.25

# Packages warn of each other's ages; that is not ours.
pytestmark = pytest.mark.filterwarnings("ignore")


def keypoints_and_points(scene: FinishedScene, name: str) -> tuple[NDArray, NDArray, NDArray]:
    """Keypoints of a photo, the rays that its camera gives them, and the points that they see."""
    image = scene.model.find_image_with_name(name)
    seen = image.get_observation_points2D()
    points = np.array([scene.model.points3D[point.point3D_id].xyz for point in seen])
    keypoints = np.array([point.xy for point in seen])
    return keypoints, np.asarray(image.camera.cam_from_img(keypoints)), points


@pytest.fixture
def splat_dataset(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """The dataset of the package gaussian-splatting on the CPU; its rasteriser alone needs CUDA."""
    pytest.importorskip("plyfile")
    for name in ("diff_gaussian_rasterization", "simple_knn"):
        compiled = types.ModuleType(f"gaussian_splatting.{name}._C")
        compiled.distCUDA2 = None  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, compiled.__name__, compiled)
    package = pytest.importorskip("gaussian_splatting.dataset.colmap")
    on_cpu = functools.partial(package.dataset.build_camera, device="cpu")
    monkeypatch.setattr(package.dataset, "build_camera", on_cpu)
    return package


def test_the_dataset_of_a_splat_trainer_reads_the_photos_and_cameras(
    scene: FinishedScene, tmp_path: Path, splat_dataset: types.ModuleType
) -> None:
    export_scene(scene.workspace, tmp_path / "out", "splat")
    dataset = splat_dataset.ColmapCameraDataset(str(tmp_path / "out"), load_mask=False, load_depth=False)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    pinholes = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    names = {name.replace("/", "_"): name for name in scene.names}
    cameras = {names[Path(camera.ground_truth_image_path).name]: camera for camera in dataset}
    assert sorted(cameras) == scene.names
    for name, camera in cameras.items():
        rotation, translation = poses_of(scene.model)[name]
        # It keeps float32.
        np.testing.assert_allclose(camera.R.numpy(), rotation, atol=POSE_TOLERANCE)
        np.testing.assert_allclose(camera.T.numpy(), translation, rtol=POSE_TOLERANCE, atol=POSE_TOLERANCE)
        assert camera.ground_truth_image.shape == (3, camera.image_height, camera.image_width)
        _, rays, points = keypoints_and_points(scene, name)
        in_clip = np.column_stack([points, np.ones(len(points))]) @ camera.full_proj_transform.numpy()
        projected = in_clip[:, :2] / in_clip[:, 3:]
        size = np.array([camera.image_width, camera.image_height])
        given = (projected + 1) * size / 2
        # The principal point is where the export put it, and the trainer takes it for the middle.
        written = pinholes[name.replace("/", "_")]
        expected = rays * written.params[:2] + written.params[2:]
        assert np.abs(given - expected).max() < PIXEL_TOLERANCE + MOST_OFF_CENTRE


def test_a_splat_trainer_starts_from_the_points(
    scene: FinishedScene, tmp_path: Path, splat_dataset: types.ModuleType
) -> None:
    from gaussian_splatting.dataset.colmap.params_init import read_colmap_points3D

    export_scene(scene.workspace, tmp_path / "out", "splat")
    positions, colours, _ = read_colmap_points3D(str(tmp_path / "out"))
    points = [scene.model.points3D[number] for number in sorted(scene.model.points3D)]
    order = np.lexsort(positions.T)
    wanted = np.array([point.xyz for point in points])
    wanted_order = np.lexsort(wanted.T)
    np.testing.assert_allclose(positions[order], wanted[wanted_order], atol=POSE_TOLERANCE)
    np.testing.assert_array_equal(
        colours[order], np.array([point.color for point in points])[wanted_order].astype(float)
    )


@pytest.mark.parametrize("camera", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("upright", [False, True])
def test_nerfstudios_dataparser_gives_the_rays_of_the_cameras(
    tmp_path: Path, camera: str, upright: bool
) -> None:
    parser = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    torch = pytest.importorskip("torch")
    scene = make_finished_scene(tmp_path / "made", camera=camera)
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio", upright=upright)
    config = parser.NerfstudioDataParserConfig(
        data=tmp_path / "out", orientation_method="none", center_method="none", auto_scale_poses=False,
        eval_mode="all",
    )  # fmt: skip
    read = config.setup().get_dataparser_outputs("train")
    names = [path.relative_to(tmp_path / "out" / "images").as_posix() for path in read.image_filenames]
    assert names == scene.names
    turn = read.dataparser_transform[:, :3].numpy().astype(np.float64) / read.dataparser_scale
    for i, name in enumerate(names):
        keypoints, rays, points = keypoints_and_points(scene, name)
        coordinates = torch.tensor(keypoints[:, ::-1].copy(), dtype=torch.float32)
        bundle = read.cameras.generate_rays(camera_indices=i, coords=coordinates)
        rotation, translation = poses_of(scene.model)[name]
        if not upright:
            centre = turn @ (-rotation.T @ translation)
            np.testing.assert_allclose(bundle.origins[0].numpy(), centre, rtol=1e-6, atol=1e-6)
            camera_to_world = turn @ rotation.T
        else:
            camera_to_world = read.cameras.camera_to_worlds[i, :, :3].numpy() * [1, -1, -1]
        in_camera = bundle.directions.numpy().astype(np.float64) @ camera_to_world
        given = in_camera[:, :2] / in_camera[:, 2:]
        focal = float(read.cameras.fx[i, 0])
        assert np.abs(given - rays).max() * focal < PIXEL_TOLERANCE
        assert len(points)


def test_nerfstudios_dataset_loads_the_photos_and_the_points(scene: FinishedScene, tmp_path: Path) -> None:
    parser = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    datasets = pytest.importorskip("nerfstudio.data.datasets.base_dataset")
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio")
    config = parser.NerfstudioDataParserConfig(data=tmp_path / "out", eval_mode="all")
    dataset = datasets.InputDataset(config.setup().get_dataparser_outputs("train"))
    assert len(dataset) == len(scene.names)
    assert dataset[0]["image"].shape[2] == 3
    pytest.importorskip("open3d")
    config.load_3D_points, config.orientation_method, config.center_method = True, "none", "none"
    config.auto_scale_poses = False
    read = config.setup().get_dataparser_outputs("train")
    turn = read.dataparser_transform[:, :3].numpy()
    wanted = np.array([point.xyz for point in scene.model.points3D.values()]) @ turn.T
    given = read.metadata["points3D_xyz"].numpy()
    np.testing.assert_allclose(given[np.lexsort(given.T)], wanted[np.lexsort(wanted.T)], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("package", ["plyfile", "trimesh", "open3d", "pyntcloud"])
def test_readers_of_ply_find_the_points_and_their_colours(
    scene: FinishedScene, tmp_path: Path, package: str
) -> None:
    reader = pytest.importorskip(package)
    path = tmp_path / "points.ply"
    export_scene(scene.workspace, path, "ply")
    if package == "plyfile":
        vertices = reader.PlyData.read(path)["vertex"]
        positions = np.column_stack([vertices[axis] for axis in "xyz"])
        colours = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
    elif package == "trimesh":
        cloud = reader.load(path)
        positions, colours = np.asarray(cloud.vertices), np.asarray(cloud.colors)[:, :3]
    elif package == "open3d":
        cloud = reader.io.read_point_cloud(str(path))
        positions, colours = np.asarray(cloud.points), np.rint(np.asarray(cloud.colors) * 255)
    else:
        table = reader.PyntCloud.from_file(str(path)).points
        positions = table[["x", "y", "z"]].to_numpy()
        colours = table[["red", "green", "blue"]].to_numpy()
    points = list(scene.model.points3D.values())
    found = sorted((*np.round(p, 4), *c) for p, c in zip(positions.tolist(), colours.tolist(), strict=True))
    wanted = sorted((*np.round(point.xyz, 4), *point.color) for point in points)
    np.testing.assert_allclose(found, wanted, atol=2e-4)


MAP_WITH_OLD_PYCOLMAP = """
import sys, pycolmap
assert int(pycolmap.__version__.split(".")[0]) == 0, pycolmap.__version__
out = sys.argv[1]
model = pycolmap.Reconstruction(out + "/sparse/0")
print(model.num_reg_images(), model.num_points3D())
for image in model.images.values():
    print(image.name, *image.cam_from_world.matrix().ravel())
mapped = pycolmap.incremental_mapping(out + "/database.db", out + "/images", out)
print(max(one.num_reg_images() for one in mapped.values()))
"""


def test_a_colmap_of_before_rigs_reads_the_model_and_maps_the_database(
    scene: FinishedScene, tmp_path: Path
) -> None:
    folder = os.environ.get("CORRSFM_OLD_PYCOLMAP")
    if not folder:
        pytest.skip("CORRSFM_OLD_PYCOLMAP names no folder with pycolmap 0.6.1")
    export_scene(scene.workspace, tmp_path / "out", "colmap3")
    command = [sys.executable, "-c", MAP_WITH_OLD_PYCOLMAP, str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": folder}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    # Its adjuster prints in between.
    first, *lines, num_mapped = done.stdout.splitlines()
    poses = lines[: len(scene.names)]
    assert first == f"{len(scene.names)} {scene.model.num_points3D()}"
    for line in poses:
        name, *numbers = line.split()
        rotation, translation = poses_of(scene.model)[name]
        wanted = np.column_stack([rotation, translation])
        np.testing.assert_allclose(np.array(numbers, float).reshape(3, 4), wanted, atol=POSE_TOLERANCE)
    assert int(num_mapped) >= len(scene.names) - 1
