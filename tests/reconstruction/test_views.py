"""A model's photos as plain records."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scene_of_points import CAMERA, make_scene

from corrsfm.reconstruction.views import rays_of, views_of


def test_views_are_the_registered_photos_in_order_of_names(tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        model = pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=20
            ),
            database,
        )
    left_out = model.images[model.reg_image_ids()[1]]
    model.deregister_frame(left_out.frame_id)
    views = views_of(model)
    assert list(views) == sorted(i.name for i in model.images.values() if i.name != left_out.name)
    for image in model.images.values():
        if image.name in views:
            view = views[image.name]
            matrix = image.cam_from_world().matrix()
            np.testing.assert_array_equal(np.column_stack([view.rotation, view.translation]), matrix)
            np.testing.assert_allclose(view.centre, image.projection_center(), atol=1e-12)
            assert view.camera.params == tuple(image.camera.params)


def test_rays_point_at_what_was_seen() -> None:
    scene = make_scene(3)
    for name, rays in rays_of(scene.views, scene.keypoints).items():
        view = scene.views[name]
        in_camera = scene.points[scene.order[name]] @ view.rotation.T + view.translation
        np.testing.assert_allclose(rays.points, in_camera[:, :2] / in_camera[:, 2:], atol=1e-9)
        assert rays.focal_px == pytest.approx(CAMERA.params[0])


def test_a_model_without_photos_has_no_views() -> None:
    assert views_of(pycolmap.Reconstruction()) == {}
    assert rays_of({}, {}) == {}
