"""What a camera record says without pycolmap: its pinhole part, and the focal length of a pair."""

import numpy as np
import pytest

from corrsfm.colmap.cameras import mean_focal_px, normalise_by_pinhole, normalise_points, pinhole_parameters
from corrsfm.errors import InputError
from corrsfm.types import Camera

ONE_FOCAL = Camera(model="RADIAL", width=640, height=480, params=(500.0, 320.0, 240.0, 0.1, 0.0))
TWO_FOCALS = Camera(model="FISHEYE", width=640, height=480, params=(500.0, 504.0, 320.0, 240.0))


def test_pinhole_part_of_a_camera_is_without_its_distortion() -> None:
    assert pinhole_parameters(ONE_FOCAL) == (500.0, 500.0, 320.0, 240.0)
    assert pinhole_parameters(TWO_FOCALS) == (500.0, 504.0, 320.0, 240.0)
    points = np.array([[820.0, 240.0], [320.0, 240.0]], np.float32)
    np.testing.assert_array_equal(normalise_by_pinhole(ONE_FOCAL, points), [[1.0, 0.0], [0.0, 0.0]])
    # The full model undoes the distortion, which pushes points outward.
    assert normalise_points(ONE_FOCAL, points)[0, 0] < 0.95


def test_focal_length_of_a_pair_is_the_mean_over_its_cameras() -> None:
    assert mean_focal_px(ONE_FOCAL, TWO_FOCALS) == 501.0


def test_a_camera_without_a_focal_length_is_refused() -> None:
    panorama = Camera(model="EQUIRECTANGULAR", width=640, height=320, params=(640.0, 320.0))
    with pytest.raises(InputError, match="EQUIRECTANGULAR: has no focal length"):
        pinhole_parameters(panorama)
