"""Records refuse what they cannot mean."""

import math
from typing import Any

import numpy as np
import pycolmap
import pytest

from corrsfm.camera import CAMERA_PARAMETERS, Camera
from corrsfm.colmap.cameras import normalise_points
from corrsfm.errors import InputError


def test_camera_models_and_their_parameters_are_those_of_colmap() -> None:
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    assert set(CAMERA_PARAMETERS) == known
    for model, names in CAMERA_PARAMETERS.items():
        theirs = pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).params_info
        assert [name.strip() for name in theirs.split(",")] == names.split()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"model": "SIMPLE_RADIUS"}, "'SIMPLE_RADIUS' is unknown; use one of SIMPLE_PINHOLE, PINHOLE"),
        ({"params": (500.0, 320.0, 240.0)}, "3 parameters, expected 4: f, cx, cy, k"),
        ({"model": "RADIAL"}, "4 parameters, expected 5: f, cx, cy, k1, k2"),
        ({"width": 0}, "0×480 pixels: expected a positive size"),
        ({"height": -1}, "640×-1 pixels"),
        ({"params": (0.0, 320.0, 240.0, 0.0)}, "f is 0.0; expected a finite number, and focal"),
        ({"params": (-500.0, 320.0, 240.0, 0.0)}, "f is -500.0"),
        ({"params": (500.0, math.nan, 240.0, 0.0)}, "cx is nan"),
        ({"params": (500.0, 320.0, 240.0, math.inf)}, "k is inf"),
    ],
)
def test_a_camera_that_is_not_possible_is_refused(change: dict[str, Any], text: str) -> None:
    values = {"model": "SIMPLE_RADIAL", "width": 640, "height": 480, "params": (500.0, 320.0, 240.0, 0.0)}
    with pytest.raises(InputError, match=text):
        Camera(**(values | change))


def test_a_camera_from_its_matrix_normalises_as_the_matrix_does() -> None:
    k = np.array([[800.0, 0, 330], [0, 810, 250], [0, 0, 1]])
    camera = Camera.from_matrix(k, 640, 480)
    assert (camera.model, camera.params) == ("PINHOLE", (800.0, 810.0, 330.0, 250.0))
    assert camera.has_prior_focal_length
    points = np.array([[330.0, 250.0], [0.5, 479.0]])
    rays = np.linalg.solve(k, np.hstack([points, np.ones((2, 1))]).T).T
    np.testing.assert_allclose(normalise_points(camera, points), rays[:, :2], atol=1e-12)


@pytest.mark.parametrize(
    "matrix",
    [np.eye(4), np.array([[800.0, 2, 330], [0, 810, 250], [0, 0, 1]]), 2 * np.eye(3), np.eye(3)[:2]],
    ids=["size", "skew", "scale", "rows"],
)
def test_a_matrix_that_is_not_intrinsic_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"expected \[\[fx, 0, cx\]"):
        Camera.from_matrix(matrix, 640, 480)
