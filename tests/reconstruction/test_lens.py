"""A lens that the camera model cannot express is noticed, noise is not."""

import numpy as np
import pycolmap
import pytest

from corrsfm.reconstruction.lens import measure_lens_misfit

NUM_PHOTOS = 8


def arc_of_photos(
    lens: str, params: list[float], model_name: str = "SIMPLE_RADIAL"
) -> pycolmap.Reconstruction:
    """Photos on an arc, projected by one lens and described by a simpler one."""
    true = pycolmap.Camera(model=lens, width=1000, height=800, params=params)
    points = np.random.default_rng(1).uniform([-3, -2, -2], [3, 2, 2], (200, 3))
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model_name, 800.0, 1000, 800)
    model.add_camera_with_trivial_rig(camera)
    noise = np.random.default_rng(2)
    point_ids = [model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8)) for point in points]
    for number, angle in enumerate(np.radians(np.linspace(-40, 40, NUM_PHOTOS)), 1):
        rotation = np.array(
            [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        )
        in_camera = points @ rotation.T + [0, 0, 9.0]
        keypoints = np.array([true.img_from_cam(point) for point in in_camera])
        keypoints += noise.normal(0, 0.3, keypoints.shape)
        image = pycolmap.Image(name=f"{number}.jpg", keypoints=keypoints, camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), [0, 0, 9.0])
        model.add_image_with_trivial_frame(image, pose)
        for index, point_id in enumerate(point_ids):
            model.add_observation(point_id, pycolmap.TrackElement(number, index))
    return model


@pytest.mark.parametrize("model_name", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"])
def test_a_decentred_lens_is_noticed_whatever_simpler_model_stands_for_it(model_name: str) -> None:
    model = arc_of_photos("OPENCV", [800, 800, 540, 380, -0.02, 0.01, 0.02, -0.015], model_name)
    before = model.cameras[1].params.copy()
    misfit = measure_lens_misfit(model)
    assert misfit is not None and misfit > 0.5
    np.testing.assert_array_equal(model.cameras[1].params, before)
    assert model.cameras[1].model_name == model_name


def test_noise_is_no_fault_of_the_lens() -> None:
    misfit = measure_lens_misfit(arc_of_photos("SIMPLE_RADIAL", [800, 500, 400, -0.05]))
    assert misfit is not None and 0 <= misfit < 0.03


def test_a_rich_model_or_few_photos_say_nothing() -> None:
    rich = arc_of_photos("SIMPLE_RADIAL", [800, 500, 400, 0.0], "OPENCV")
    assert measure_lens_misfit(rich) is None
    few = arc_of_photos("SIMPLE_RADIAL", [800, 500, 400, 0.0])
    for image_id in sorted(few.images)[4:]:
        few.deregister_frame(few.images[image_id].frame_id)
    assert measure_lens_misfit(few) is None
    assert measure_lens_misfit(pycolmap.Reconstruction()) is None
