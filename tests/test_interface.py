"""The public names: importing the package costs nothing, each name is there, and the README's lines run."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from two_view_pairs import CAMERA, make_pair

import corrsfm
from corrsfm import Pruner, correspondences_from_points, open_workspace
from corrsfm.errors import InputError, WorkspaceError
from corrsfm.types import Camera


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, corrsfm; print(dir(corrsfm)[:0]); "
        "print(sorted({'numpy', 'torch', 'cv2', 'pycolmap', 'h5py', 'click'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["[]", "[]"]


def test_every_public_name_is_there() -> None:
    assert len(corrsfm.__all__) > 8
    for name in corrsfm.__all__:
        assert getattr(corrsfm, name) is not None
        assert name in dir(corrsfm)
    with pytest.raises(AttributeError, match="no attribute 'run_scenes'"):
        corrsfm.run_scenes  # noqa: B018


def test_points_and_intrinsic_matrices_become_the_same_correspondences_as_cameras() -> None:
    camera = Camera(model="PINHOLE", width=64, height=48, params=(50.0, 51.0, 32.0, 24.0))
    matrix = np.array([[50.0, 0, 32], [0, 51, 24], [0, 0, 1]])
    points0, points1 = np.random.default_rng(0).uniform(0, 48, (2, 9, 2))
    by_camera = correspondences_from_points(points0, points1, camera, camera)
    by_matrix = correspondences_from_points(points0, points1, matrix, matrix)
    np.testing.assert_array_equal(by_camera.normalised, by_matrix.normalised)
    assert by_camera.mutual.all() and len(by_camera) == 9


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"points1": np.zeros((3, 2))}, r"points1 has shape \(3, 2\), expected \(4, 2\)"),
        ({"points0": np.zeros(4)}, r"points0 has shape \(4,\), expected \(4, 2\)"),
        ({"ratios": np.ones(3)}, r"ratios has shape \(3,\), expected \(4,\)"),
        ({"ratios": np.full(4, np.nan)}, "ratios must be between 0 and 1"),
        ({"ratios": np.full(4, 2.0)}, "ratios must be between 0 and 1"),
        ({"mutual": np.ones((4, 1))}, r"mutual has shape \(4, 1\)"),
        ({"camera0": np.zeros((2, 2))}, "intrinsic matrix .* expected"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict, text: str) -> None:
    values = {
        "points0": np.zeros((4, 2)), "points1": np.zeros((4, 2)), "camera0": CAMERA, "camera1": CAMERA,
    } | change  # fmt: skip
    with pytest.raises(InputError, match=text):
        correspondences_from_points(**values)


def test_no_matches_are_kept_of_none() -> None:
    pair = correspondences_from_points(np.zeros((0, 2)), np.zeros((0, 2)), np.eye(3), np.eye(3))
    assert Pruner.load(device="cpu", threads=1)([pair])[0].inlier_mask.shape == (0,)


def test_a_folder_that_is_not_a_workspace_is_not_opened(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="not a corrsfm workspace"):
        open_workspace(tmp_path)


def test_a_workspace_is_read_photo_by_photo(repository: Path, tmp_path: Path) -> None:
    # A workspace of another version is converted, so not the one in the repository.
    folder = shutil.copytree(repository / "tests" / "data" / "workspace_0_1_0", tmp_path / "scene")
    scene = open_workspace(folder)
    assert scene.photos == ("courtyard_01.jpg", "courtyard_02.jpg", "courtyard_03.jpg")
    assert len(scene.pairs) == 3
    name0, name1 = scene.pairs[0]
    matches, kept = scene.matches((name0, name1)), scene.kept((name0, name1))
    assert 0 < len(kept.indices) < len(matches) <= len(scene.features(name0)) == 200
    assert scene.camera(name1).model == "SIMPLE_RADIAL"
    with pytest.raises(WorkspaceError, match="mapping gave no model; why: corrsfm report"):
        scene.models()


def readme_example(repository: Path) -> str:
    block = re.search(
        r"```python\n(.*?)```", (repository / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    assert block is not None
    return block[1]


def test_the_readmes_python_keeps_inliers_and_drops_outliers(repository: Path) -> None:
    code = readme_example(repository)
    assert len(code.strip().splitlines()) <= 10
    pair = make_pair(seed=0, num=400, inlier_ratio=0.5, relief=True)
    # Through the camera of the example: 1920 px focal length, 1600 × 1200 px.
    points = pair.as_correspondences().normalised * 1920.0 + np.tile([800.0, 600.0], 2)
    names = {"points0": points[:, :2], "points1": points[:, 2:], "ratios": pair.ratios, "mutual": pair.mutual}
    exec(compile(code, "README.md", "exec"), names)
    kept, right = names["kept"], pair.label_distances < 1e-9
    assert kept.shape == (400,) and kept.dtype == bool
    assert right.sum() == 200
    assert kept.sum() >= 30 and (kept & right).sum() >= 0.9 * kept.sum()
