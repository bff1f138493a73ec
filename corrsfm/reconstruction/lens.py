"""How much better a richer lens model would explain the photos.

Errors that a lens model cannot express do not look like noise: whole regions of the photos are off the same
way, and the model bends to make up for it. Tangential distortion and a principal point away from the centre
are the usual ones, on drones above all. They cost nothing where they are not there, so they are tried, and
the fall of the squared reprojection errors says whether they were missing.
"""

from __future__ import annotations

from collections import Counter

import pycolmap

from corrsfm.reconstruction.calibration import adjusted_cost, thinned

__all__ = ["measure_lens_misfit"]

# Fewer photos fit any lens a little better.
_FEWEST_PHOTOS = 5
_MIN_NUM_POINTS = 20
_MAX_ITERATIONS = 40
# Parameters of these, then zeros, are those of OPENCV: fx fy cx cy k1 k2 p1 p2.
_SIMPLER = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def measure_lens_misfit(model: pycolmap.Reconstruction) -> float | None:
    """The share of the squared reprojection errors that the lens model is to blame for.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Not changed.

    Returns
    -------
    float or None
        By which they fall, in [0, 1], with COLMAP's OPENCV model and free principal points. None if no camera
        with a simpler model took at least five registered photos, or if nothing could be adjusted.
    """
    num_photos = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    shared = [
        camera_id
        for camera_id, camera in model.cameras.items()
        if camera.model_name in _SIMPLER and num_photos[camera_id] >= _FEWEST_PHOTOS
    ]
    if not shared or model.num_points3D() < _MIN_NUM_POINTS:
        return None
    plain = thinned(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.max_num_iterations = _MAX_ITERATIONS
    cost = adjusted_cost(plain, options)
    if not cost:
        return None
    for camera_id in shared:
        _enrich(plain.cameras[camera_id])
    options.refine_principal_point = True
    rich_cost = adjusted_cost(plain, options)
    return None if rich_cost is None else max(0.0, 1 - rich_cost / cost)


def _enrich(camera: pycolmap.Camera) -> None:
    """Give a camera the OPENCV model, its lens unchanged."""
    fx, fy = camera.focal_length_x, camera.focal_length_y
    radial = [float(camera.params[index]) for index in camera.extra_params_idxs()]
    camera_params = [fx, fy, camera.principal_point_x, camera.principal_point_y]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [*camera_params, *radial, *[0.0] * (4 - len(radial))]
