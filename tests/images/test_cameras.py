"""Which photos share a camera, and points normalised by it."""

import dataclasses

import numpy as np
import pycolmap
import pytest

from corrsfm.colmap.cameras import camera_from_pycolmap, normalise_points, to_pycolmap
from corrsfm.config import CameraMode
from corrsfm.errors import ConfigError, InputError
from corrsfm.images.cameras import PhotoInfo, assign_cameras
from corrsfm.types import Camera

PLAIN = PhotoInfo(width=640, height=480)
PHONE = PhotoInfo(width=640, height=480, camera_name="Acme-One", focal_px=500.0)
ZOOMED = PhotoInfo(width=640, height=480, camera_name="Acme-One", focal_px=900.0)
PLAIN_TALL = PhotoInfo(width=480, height=640)
TALL = PhotoInfo(width=480, height=640, camera_name="Acme-One", focal_px=500.0)


def ids_of(infos: list[PhotoInfo], mode: CameraMode, names: list[str] | None = None) -> list[int]:
    names = names or [f"{index}.jpg" for index in range(len(infos))]
    return assign_cameras(names, infos, mode=mode, model="SIMPLE_RADIAL")[1]


def test_auto_shares_a_camera_among_photos_with_the_same_exif() -> None:
    assert ids_of([PHONE, ZOOMED, PHONE, TALL, PHONE], CameraMode.AUTO) == [0, 1, 0, 2, 0]


def test_auto_proposes_one_camera_for_photos_of_a_size_without_exif() -> None:
    assert ids_of([PLAIN, PLAIN, PLAIN], CameraMode.AUTO) == [0, 0, 0]
    assert ids_of([PLAIN, PHONE, PLAIN, PHONE, PLAIN_TALL], CameraMode.AUTO) == [0, 1, 0, 1, 2]


def test_auto_keeps_cameras_of_other_names_apart_where_none_tells_a_focal_length() -> None:
    one, two = (dataclasses.replace(PLAIN, camera_name=name) for name in ("Acme-One", "Acme-Two"))
    assert ids_of([one, two, PLAIN, one], CameraMode.AUTO) == [0, 1, 2, 0]


def test_a_proposed_camera_is_announced_with_the_way_out_of_it(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    ids_of([PLAIN, PHONE, PLAIN], CameraMode.AUTO)
    (text,) = caplog.messages
    assert text.startswith(
        "2 photos of 640×480 pixels have no focal length in EXIF and are taken to be of one camera"
    )
    assert text.endswith("--camera-mode per-image gives each its own")


def test_upright_and_turned_photos_are_named_as_one_camera(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    ids_of([PLAIN, PLAIN_TALL, TALL, PLAIN_TALL], CameraMode.AUTO)
    assert caplog.messages[-1].startswith(
        "photos of 640×480 pixels (1) and of 480×640 (2) look like one camera"
    )
    caplog.clear()
    ids_of([PHONE, TALL, ZOOMED], CameraMode.AUTO)
    assert len(caplog.messages) == 1
    caplog.clear()
    ids_of([PLAIN, TALL], CameraMode.AUTO)
    assert not caplog.messages
    # COLMAP puts the size into the name.
    upright = dataclasses.replace(PHONE, width=PHONE.height, height=PHONE.width)
    ids_of(
        [
            dataclasses.replace(info, camera_name=f"Acme-One-28.0-{info.width}x{info.height}")
            for info in (PHONE, upright)
        ],
        CameraMode.AUTO,
    )
    assert len(caplog.messages) == 1


def test_nothing_is_said_of_sharing_where_it_was_decided_or_cannot_be(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    ids_of([PLAIN, PHONE], CameraMode.AUTO)
    ids_of([PLAIN, PLAIN], CameraMode.PER_IMAGE)
    ids_of([PLAIN, PLAIN], CameraMode.SINGLE)
    known = "500,320,240,0"
    assign_cameras(["a", "b"], [PLAIN, PLAIN], mode=CameraMode.AUTO, model="SIMPLE_RADIAL", params=known)
    assert not caplog.messages


def test_single_shares_one_camera_and_per_image_none() -> None:
    assert ids_of([PLAIN, PHONE, PLAIN], CameraMode.SINGLE) == [0, 0, 0]
    assert ids_of([PHONE, PHONE, PHONE], CameraMode.PER_IMAGE) == [0, 1, 2]


def test_per_folder_shares_a_camera_inside_each_folder() -> None:
    names = ["a/1.jpg", "a/2.jpg", "b/1.jpg", "c.jpg", "a/deep/1.jpg"]
    assert ids_of([PLAIN] * 5, CameraMode.PER_FOLDER, names) == [0, 0, 1, 2, 3]


def test_one_camera_for_photos_of_two_sizes_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"1\.jpg: has 480×640 pixels, but '0\.jpg'.*camera-mode auto"):
        ids_of([PHONE, TALL], CameraMode.SINGLE)


def test_the_focal_length_comes_from_exif_or_is_guessed() -> None:
    cameras, _ = assign_cameras(["a", "b"], [PHONE, PLAIN], mode=CameraMode.AUTO, model="SIMPLE_RADIAL")
    assert cameras[0].params == (500.0, 320.0, 240.0, 0.0)
    assert cameras[0].has_prior_focal_length
    assert cameras[1].params == (1.2 * 640, 320.0, 240.0, 0.0)
    assert not cameras[1].has_prior_focal_length


@pytest.mark.parametrize("mode", [CameraMode.SINGLE, CameraMode.PER_FOLDER])
def test_a_shared_camera_has_the_median_of_the_known_focal_lengths(mode: CameraMode) -> None:
    infos = [PLAIN, PHONE, dataclasses.replace(PHONE, focal_px=510.0), PLAIN, PHONE]
    cameras, ids = assign_cameras([*"abcde"], infos, mode=mode, model="SIMPLE_RADIAL")
    assert ids == [0] * 5
    assert cameras[0].params == (500.0, 320.0, 240.0, 0.0)
    assert cameras[0].has_prior_focal_length


def test_zoomed_photos_that_share_a_camera_are_named(caplog: pytest.LogCaptureFixture) -> None:
    names = ["a/1", "a/2", "b/1", "b/2"]
    nearly = dataclasses.replace(PHONE, focal_px=510.0)
    ids_of([PHONE, ZOOMED, PHONE, nearly], CameraMode.PER_FOLDER, names)
    (text,) = caplog.messages
    assert text.startswith("2 photos share a camera (a/1, a/2), but")
    assert "500 px ('a/1') to 900 px ('a/2')" in text


def test_known_parameters_are_taken_as_they_are() -> None:
    cameras, ids = assign_cameras(
        ["a", "b"], [PLAIN, PLAIN], mode=CameraMode.SINGLE, model="PINHOLE", params="510, 511,320.5,239"
    )
    assert ids == [0, 0]
    assert cameras == [
        Camera(
            model="PINHOLE", width=640, height=480, params=(510, 511, 320.5, 239), has_prior_focal_length=True
        )
    ]


@pytest.mark.parametrize("params", ["1,2,3", "1,2,3,4,5", "f,cx,cy,k", "1,2,3,nan", ","])
def test_wrong_parameters_are_refused_with_the_right_ones(params: str) -> None:
    with pytest.raises(ConfigError, match="expected the numbers f, cx, cy, k for SIMPLE_RADIAL"):
        assign_cameras(["a"], [PLAIN], mode=CameraMode.AUTO, model="SIMPLE_RADIAL", params=params)


def test_known_parameters_do_not_fit_photos_of_two_sizes() -> None:
    with pytest.raises(InputError, match=r"beside 640×480 pixels.*'c'"):
        assign_cameras(
            ["a", "b", "c"],
            [PLAIN, PLAIN, TALL],
            mode=CameraMode.AUTO,
            model="SIMPLE_PINHOLE",
            params="1,2,3",
        )


def test_an_unknown_model_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'SIMPLE'.*SIMPLE_RADIAL"):
        assign_cameras(["a"], [PLAIN], mode=CameraMode.AUTO, model="SIMPLE")


def test_every_model_of_pycolmap_survives_the_way_there_and_back() -> None:
    models = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID"})
    assert len(models) > 10
    for model in models:
        cameras, _ = assign_cameras(["a"], [PHONE], mode=CameraMode.AUTO, model=model)
        assert cameras[0].model == model
        assert camera_from_pycolmap(to_pycolmap(cameras[0])) == cameras[0]


def test_normalised_points_invert_the_projection() -> None:
    camera = Camera(
        model="OPENCV", width=640, height=480, params=(500, 510, 321, 239, -0.1, 0.02, 1e-3, -2e-3)
    )
    rays = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.4, 0.4, 1.0]])
    pixels = to_pycolmap(camera).img_from_cam(rays).astype(np.float32)
    normalised = normalise_points(camera, pixels)
    assert normalised.dtype == np.float64
    np.testing.assert_allclose(normalised, rays[:, :2], atol=1e-6)


def test_the_principal_point_is_in_colmaps_pixel_convention() -> None:
    camera = Camera(model="SIMPLE_PINHOLE", width=4, height=2, params=(8.0, 2.0, 1.0))
    first_pixel_centre = np.array([[0.5, 0.5]])
    np.testing.assert_allclose(normalise_points(camera, first_pixel_centre), [[-1.5 / 8, -0.5 / 8]])


def test_no_points_are_normalised_to_no_points() -> None:
    camera = Camera(model="SIMPLE_PINHOLE", width=4, height=2, params=(8.0, 2.0, 1.0))
    assert normalise_points(camera, np.zeros((0, 2), np.float32)).shape == (0, 2)


def test_a_pixel_without_a_ray_is_nan() -> None:
    camera = Camera(model="SIMPLE_RADIAL", width=960, height=540, params=(1152.0, 480.0, 270.0, -0.3))
    assert np.isnan(normalise_points(camera, np.array([[1e6, 1e6]]))).all()
