"""The bundled sample scenes are whole, small, and their cameras are the ones that took the photos."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

SCENES = sorted(
    path.parent for path in (Path(__file__).resolve().parents[1] / "sample_scenes").glob("*/images")
)
EXPECTED_KEYS = {
    "registered_photos_min",
    "points_min",
    "median_reprojection_error_px_max",
    "camera_position_error_max",
}
MAX_TOTAL_BYTES = 8_000_000

each_scene = pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)


def test_there_are_an_easy_and_a_hard_scene() -> None:
    assert {"courtyard", "colonnade"} <= {scene.name for scene in SCENES}


def test_scenes_are_small() -> None:
    assert sum(path.stat().st_size for scene in SCENES for path in scene.rglob("*")) < MAX_TOTAL_BYTES


@each_scene
def test_ground_truth_names_every_photo_with_its_size(scene: Path) -> None:
    truth = pycolmap.Reconstruction(scene)
    photos = sorted(path.name for path in (scene / "images").iterdir())
    assert 10 <= len(photos) <= 20
    assert sorted(image.name for image in truth.images.values()) == photos
    for image in truth.images.values():
        camera = truth.cameras[image.camera_id]
        height, width = cv2.imread(str(scene / "images" / image.name)).shape[:2]
        assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", width, height)
        assert camera.params[2:].tolist() == [width / 2, height / 2]


@each_scene
def test_ground_truth_points_lie_where_the_photos_see_them(scene: Path) -> None:
    truth = pycolmap.Reconstruction(scene)
    assert truth.num_points3D() > 100
    for point in truth.points3D.values():
        assert point.track.length() >= 3
        for element in point.track.elements:
            image = truth.images[element.image_id]
            seen = image.points2D[element.point2D_idx].xy
            np.testing.assert_allclose(image.project_point(point.xyz), seen, atol=1e-3)


@each_scene
def test_source_tells_origin_licence_and_recipe(scene: Path) -> None:
    source = (scene / "SOURCE.md").read_text(encoding="utf-8")
    for word in ("Apache-2.0", f"sample_scenes/renderer/render.py {scene.name}", "PINHOLE"):
        assert word in source


@each_scene
def test_expected_bands_can_be_met(scene: Path) -> None:
    expected = json.loads((scene / "expected.json").read_text(encoding="utf-8"))
    assert set(expected) == EXPECTED_KEYS
    assert 2 <= expected["registered_photos_min"] <= len(list((scene / "images").iterdir()))
    assert expected["points_min"] > 0
    assert 0 < expected["median_reprojection_error_px_max"] <= 1.5
    assert 0 < expected["camera_position_error_max"] <= 0.05


@each_scene
def test_matches_of_neighbours_obey_the_true_epipolar_geometry(scene: Path) -> None:
    truth = pycolmap.Reconstruction(scene)
    first, second = closest_pair(truth)
    points0, points1 = ratio_mutual_matches(*(scene / "images" / image.name for image in (first, second)))
    assert len(points0) >= 50
    cam1_from_cam0 = second.cam_from_world() * first.cam_from_world().inverse()
    camera = truth.cameras[first.camera_id]
    inverse = np.linalg.inv(camera.calibration_matrix())
    tx, ty, tz = cam1_from_cam0.translation
    cross = np.array([[0.0, -tz, ty], [tz, 0.0, -tx], [-ty, tx, 0.0]])
    fundamental = inverse.T @ cross @ cam1_from_cam0.rotation.matrix() @ inverse
    homogeneous0, homogeneous1 = (np.column_stack([p, np.ones(len(p))]) for p in (points0, points1))
    lines1 = homogeneous0 @ fundamental.T
    residual_px = np.abs((homogeneous1 * lines1).sum(1)) / np.linalg.norm(lines1[:, :2], axis=1)
    assert np.median(residual_px) < 1.0


def closest_pair(truth: pycolmap.Reconstruction) -> tuple[pycolmap.Image, pycolmap.Image]:
    """The two photos, of different viewpoints, that share the most ground-truth points."""
    images = [truth.images[key] for key in sorted(truth.images)]
    seen = [{p.point3D_id for p in image.points2D if p.has_point3D()} for image in images]
    pairs = [(a, b) for a in range(len(images)) for b in range(a + 1, len(images))]
    a, b = max(pairs, key=lambda pair: len(seen[pair[0]] & seen[pair[1]]))
    return images[a], images[b]


def ratio_mutual_matches(path0: Path, path1: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pixel positions (M, 2) and (M, 2), first pixel centre at (0.5, 0.5), of SIFT matches."""
    sift = cv2.SIFT_create(nfeatures=2000, enable_precise_upscale=True)
    found = [
        sift.detectAndCompute(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), None) for path in (path0, path1)
    ]
    (keypoints0, descriptors0), (keypoints1, descriptors1) = found
    matcher = cv2.BFMatcher()
    back = {m.queryIdx: m.trainIdx for m in matcher.match(descriptors1, descriptors0)}
    kept = [
        (best.queryIdx, best.trainIdx)
        for best, other in matcher.knnMatch(descriptors0, descriptors1, k=2)
        if best.distance < 0.8 * other.distance and back[best.trainIdx] == best.queryIdx
    ]
    xy0, xy1 = (np.array([k.pt for k in keypoints]) + 0.5 for keypoints in (keypoints0, keypoints1))
    index = np.array(kept).reshape(-1, 2)
    return xy0[index[:, 0]], xy1[index[:, 1]]
