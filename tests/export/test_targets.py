"""Every export comes back through its tool's reading rules: the same poses, points and projections."""

import csv
import resource
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_readers import (
    Tracks,
    View,
    read_bundler,
    read_colmap3_model,
    read_database_3_8,
    read_gaussian_splatting,
    read_gsplat,
    read_hloc,
    read_nerfstudio,
    read_nvm,
    read_openmvs,
    read_ply,
)
from finished_scene import CAMERAS, LEFT_OUT, FinishedScene, centre_point, find_spot, make_finished_scene
from numpy.typing import NDArray

from corrsfm import export_scene
from corrsfm.colmap.models import poses_of
from corrsfm.errors import CorrsfmError
from corrsfm.export.tables import CSV_COLUMNS

POSE_TOLERANCE = 1e-6
PIXEL_TOLERANCE = 0.05


def distorted(model: pycolmap.Reconstruction, name: str) -> tuple[NDArray, NDArray, NDArray]:
    """Keypoints of a photo, the ids of their points, and positions of these in its camera."""
    image = model.find_image_with_name(name)
    seen = image.get_observation_points2D()
    ids = np.array([point.point3D_id for point in seen])
    in_camera = image.cam_from_world() * np.array([model.points3D[i].xyz for i in ids])
    return np.array([point.xy for point in seen]), ids, in_camera


def assert_same_poses(views: dict[str, View], model: pycolmap.Reconstruction) -> None:
    poses = poses_of(model)
    assert sorted(views) == sorted(poses)
    for name, (rotation, translation) in poses.items():
        np.testing.assert_allclose(views[name].rotation, rotation, atol=POSE_TOLERANCE)
        np.testing.assert_allclose(views[name].translation, translation, atol=POSE_TOLERANCE)


def assert_projections_are_those_of_the_rays(
    views: dict[str, View], positions: dict[int, NDArray], model: pycolmap.Reconstruction
) -> None:
    """Undistorted keypoints are where the pinhole sees the ray of the distorted keypoint."""
    for name, view in views.items():
        keypoints, ids, _ = distorted(model, name)
        _, _, _, (fx, fy, cx, cy) = view.camera
        rays = model.find_image_with_name(name).camera.cam_from_img(keypoints)
        expected = rays * [fx, fy] + [cx, cy]
        projected = view.project_pinhole(np.array([positions[i] for i in ids]))
        assert np.abs(projected - expected).max() < PIXEL_TOLERANCE
        of_point = dict(zip(view.point_ids, view.keypoints, strict=True))
        assert np.abs([of_point[i] for i in ids] - expected).max() < PIXEL_TOLERANCE


def assert_spots_are_where_points_project(
    views: dict[str, View], positions: dict[int, NDArray], model: pycolmap.Reconstruction
) -> None:
    """The pixels were warped as the cameras say."""
    for name, view in views.items():
        assert view.path is not None
        point = centre_point(model, model.find_image_with_name(name))
        photo = cv2.imread(str(view.path), cv2.IMREAD_GRAYSCALE)
        expected = view.project_pinhole(positions[point][None])[0]
        # Eight bits and bilinear sampling move a centroid a little more than the geometry.
        assert np.abs(find_spot(np.asarray(photo, np.uint8)) - expected).max() < 0.1


def test_splat_is_what_gaussian_splatting_and_gsplat_read(scene: FinishedScene, tmp_path: Path) -> None:
    result = export_scene(scene.workspace, tmp_path / "out", "splat")
    views, positions = read_gaussian_splatting(tmp_path / "out")
    assert [path.name for path in read_gsplat(tmp_path / "out")] == [
        "1.png", "2.png", "3.png", "4.png", "left_0.png",
    ]  # fmt: skip
    views["left/0.png"] = views.pop("left_0.png")
    assert_same_poses(views, scene.model)
    assert_projections_are_those_of_the_rays(views, positions, scene.model)
    assert_spots_are_where_points_project(views, positions, scene.model)
    assert result.photos == tuple(scene.names) and result.left_out == (LEFT_OUT,)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["images", "sparse"]


def test_splats_principal_point_is_in_the_middle_where_the_trainer_takes_it_to_be(
    scene: FinishedScene, tmp_path: Path
) -> None:
    export_scene(scene.workspace, tmp_path / "out", "splat")
    views, _ = read_gaussian_splatting(tmp_path / "out")
    for view in views.values():
        _, width, height, (_, _, cx, cy) = view.camera
        assert np.abs([cx - width / 2, cy - height / 2]).max() <= 0.25


def test_gsplats_pycolmap_reads_splat(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "out", "splat")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_points3D() == scene.model.num_points3D()
    assert model.compute_mean_reprojection_error() < PIXEL_TOLERANCE


def opencv_projection(frame: dict[str, float], points: NDArray, camera_model: str) -> NDArray:
    """OpenCV's own functions, in pixels whose first centre is at 0.5."""
    matrix = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
    zero = np.zeros(3)
    if camera_model == "OPENCV_FISHEYE":
        coefficients = np.array([frame[key] for key in ("k1", "k2", "k3", "k4")])
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, coefficients)
    else:
        coefficients = np.array([frame[key] for key in ("k1", "k2", "p1", "p2")])
        pixels, _ = cv2.projectPoints(points, zero, zero, matrix, coefficients)
    return np.asarray(pixels)[:, 0]


@pytest.mark.parametrize(
    ("camera", "camera_model"),
    [
        ("SIMPLE_PINHOLE", "PINHOLE"),
        ("SIMPLE_RADIAL", "OPENCV"),
        ("OPENCV", "OPENCV"),
        ("OPENCV_FISHEYE", "OPENCV_FISHEYE"),
        ("THIN_PRISM_FISHEYE", "PINHOLE"),
    ],
)
def test_nerfstudio_frames_have_the_cameras_and_poses_of_the_model(
    tmp_path: Path, camera: str, camera_model: str
) -> None:
    scene = make_finished_scene(tmp_path / "made", camera=camera)
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio")
    read = read_nerfstudio(tmp_path / "out")
    assert read.camera_model == camera_model
    names = [path.relative_to(tmp_path / "out" / "images").as_posix() for path in read.paths]
    assert names == scene.names
    ids = list(scene.model.points3D)
    rays_to_pixels = []
    for name, matrix, frame in zip(names, read.original_poses(), read.intrinsics, strict=True):
        rotation, translation = poses_of(scene.model)[name]
        camera_to_world = np.column_stack([rotation.T * [1, -1, -1], -rotation.T @ translation])
        np.testing.assert_allclose(matrix[:3], camera_to_world, atol=POSE_TOLERANCE)
        keypoints, _, in_camera = distorted(scene.model, name)
        projected = opencv_projection(frame, in_camera, camera_model)
        if camera == "THIN_PRISM_FISHEYE":
            rays = scene.model.find_image_with_name(name).camera.cam_from_img(keypoints)
            keypoints = rays * [frame["fl_x"], frame["fl_y"]] + [frame["cx"], frame["cy"]]
        rays_to_pixels.append(np.abs(projected - keypoints).max())
    assert max(rays_to_pixels) < PIXEL_TOLERANCE
    # Points lie in the frame of the poses, after applied_transform.
    turn = read.applied_transform[:, :3]
    expected = np.array([scene.model.points3D[i].xyz for i in ids]) @ turn.T
    order, wanted = np.lexsort(read.points.T), np.lexsort(expected.astype(np.float32).T)
    np.testing.assert_allclose(read.points[order], expected[wanted], atol=1e-5)
    assert read.colours.std() > 10


def test_nerfstudio_copies_photos_that_keep_their_distortion(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "out", "nerfstudio")
    for name in scene.names:
        copy = tmp_path / "out" / "images" / name
        assert copy.read_bytes() == (scene.photos / name).read_bytes()
        # Trainers resize in place; a link would change the original.
        assert not copy.samefile(scene.photos / name)


def test_openmvs_reads_pinholes_as_text(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "out", "openmvs")
    views, positions = read_openmvs(tmp_path / "out")
    assert_same_poses(views, scene.model)
    assert_projections_are_those_of_the_rays(views, positions, scene.model)
    assert_spots_are_where_points_project(views, positions, scene.model)


def test_openmvs_gets_pinhole_from_simple_pinhole(tmp_path: Path) -> None:
    scene = make_finished_scene(tmp_path / "made", camera="SIMPLE_PINHOLE")
    export_scene(scene.workspace, tmp_path / "out", "openmvs")
    views, positions = read_openmvs(tmp_path / "out")
    np.testing.assert_array_equal(views["1.png"].camera[3], [160.0, 160.0, 100.0, 75.0])
    assert_projections_are_those_of_the_rays(views, positions, scene.model)


def assert_tracks_reproject(tracks: Tracks, model: pycolmap.Reconstruction, flip: NDArray) -> None:
    """Each view of each point is where camera and point say; ``flip`` turns COLMAP's axes to the tool's."""
    poses = poses_of(model)
    for i, path in enumerate(tracks.paths):
        rotation, translation = poses[path.as_posix().rpartition("/images/")[2]]
        np.testing.assert_allclose(tracks.rotations[i], flip[:, None] * rotation, atol=POSE_TOLERANCE)
        np.testing.assert_allclose(tracks.translations[i], flip * translation, atol=POSE_TOLERANCE)
        assert path.is_file()
    num_views = 0
    for position, views in tracks.points:
        for i, x, y in views:
            in_camera = tracks.rotations[i] @ position + tracks.translations[i]
            projected = tracks.focals[i] * in_camera[:2] / (flip[2] * in_camera[2])
            np.testing.assert_allclose([x, y], projected, atol=PIXEL_TOLERANCE)
            num_views += 1
    assert num_views == model.compute_num_observations()


def test_bundler_looks_along_minus_z(radial_scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(radial_scene.workspace, tmp_path / "out", "bundler")
    tracks = read_bundler(tmp_path / "out")
    assert_tracks_reproject(tracks, radial_scene.model, np.array([1.0, -1.0, -1.0]))


def test_nvm_holds_centres_and_no_distortion(radial_scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(radial_scene.workspace, tmp_path / "out", "nvm")
    assert_tracks_reproject(read_nvm(tmp_path / "out"), radial_scene.model, np.ones(3))


def test_colmap_opens_database_and_both_models(scene: FinishedScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scene(scene.workspace, out, "colmap")
    assert (out / "image_list.txt").read_text().split() == scene.names
    for folder in ("sparse", "sparse_text"):
        model = pycolmap.Reconstruction(out / folder / "0")
        for name, (rotation, translation) in poses_of(model).items():
            np.testing.assert_allclose(rotation, poses_of(scene.model)[name][0], atol=POSE_TOLERANCE)
            np.testing.assert_allclose(translation, poses_of(scene.model)[name][1], atol=POSE_TOLERANCE)
        assert model.compute_mean_reprojection_error() < 1e-6
    assert sorted(path.name for path in out.iterdir()) == [
        "database.db", "image_list.txt", "images", "sparse", "sparse_text",
    ]  # fmt: skip
    with pycolmap.Database.open(out / "database.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        assert ids == {image.name: image.image_id for image in scene.model.images.values()}
        assert database.num_verified_image_pairs() == len(ids) * (len(ids) - 1) // 2


def test_the_exported_database_maps_again(scene: FinishedScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scene(scene.workspace, out, "colmap")
    models = pycolmap.incremental_mapping(out / "database.db", out / "images", tmp_path / "again")
    assert sorted(image.name for image in models[0].images.values()) == scene.names


def test_colmap_3_8_finds_its_schema_and_its_three_files(scene: FinishedScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scene(scene.workspace, out, "colmap3")
    database = read_database_3_8(out / "database.db")
    camera_model, params = next(iter(database.cameras.values()))
    assert camera_model == "OPENCV" and list(params) == CAMERAS["OPENCV"]
    assert sorted(database.keypoints) == scene.names == sorted(database.priors)
    views, positions, _ = read_colmap3_model(out / "sparse" / "0")
    assert_same_poses(views, scene.model)
    for name, view in views.items():
        np.testing.assert_allclose(database.keypoints[name][:, :2], view.keypoints, atol=1e-4)
    assert len(database.inliers) == len(database.matches) == 10
    for (name0, name1), matches in database.inliers.items():
        ids0 = views[name0].point_ids[matches[:, 0]]
        assert len(ids0) and list(ids0) == list(views[name1].point_ids[matches[:, 1]])
    assert len(positions) == scene.model.num_points3D()
    assert sorted(path.name for path in out.iterdir()) == [
        "database.db", "image_list.txt", "images", "sparse",
    ]  # fmt: skip


def test_colmap_4_opens_the_database_of_3_8_too(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "out", "colmap3")
    with pycolmap.Database.open(tmp_path / "out" / "database.db") as database:
        assert sorted(image.name for image in database.read_all_images()) == scene.names


def test_hloc_reads_features_matches_and_sfm(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "out", "hloc")
    keypoints, matches = read_hloc(tmp_path / "out")
    assert sorted(keypoints) == scene.names and len(matches) == 10
    model = pycolmap.Reconstruction(tmp_path / "out" / "sfm")
    ids = {}
    for name in scene.names:
        points = model.find_image_with_name(name).points2D
        np.testing.assert_allclose(keypoints[name], [point.xy for point in points], atol=1e-4)
        ids[name] = np.array([point.point3D_id for point in points])
    for (name0, name1), pair in matches.items():
        assert len(pair) and list(ids[name0][pair[:, 0]]) == list(ids[name1][pair[:, 1]])


def test_ply_has_the_points_and_their_colours(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "points.ply", "ply")
    positions, colours = read_ply(tmp_path / "points.ply")
    expected = {
        tuple(point.xyz.astype(np.float32)): tuple(point.color) for point in scene.model.points3D.values()
    }
    found = zip(positions, colours, strict=True)
    assert {tuple(position): tuple(colour) for position, colour in found} == expected


def test_points_that_do_not_fit_on_the_disk_are_said(scene: FinishedScene, tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, before[1]))
    try:
        with pytest.raises(CorrsfmError, match="points.ply: cannot be written"):
            export_scene(scene.workspace, tmp_path / "points.ply", "ply")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.glob("*points.ply*"))


def test_csv_has_a_line_a_photo(scene: FinishedScene, tmp_path: Path) -> None:
    export_scene(scene.workspace, tmp_path / "poses.csv", "csv")
    with open(tmp_path / "poses.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == CSV_COLUMNS and [row["name"] for row in rows] == scene.names
    for row in rows:
        image = scene.model.find_image_with_name(row["name"])
        pose = image.cam_from_world()
        quaternion = [float(row[key]) for key in ("qx", "qy", "qz", "qw")]
        np.testing.assert_allclose(quaternion, pose.rotation.quat, atol=1e-12)
        np.testing.assert_allclose([float(row[f"t{axis}"]) for axis in "xyz"], pose.translation)
        np.testing.assert_allclose([float(row[axis]) for axis in "xyz"], image.projection_center())
        assert float(row["focal_px"]) == 162.0 and int(row["num_points"]) == image.num_points3D
