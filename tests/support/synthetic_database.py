"""COLMAP databases of exact matches whose true model is known."""

from pathlib import Path

import pycolmap


def synthesize(path: Path, num_images: int = 8) -> pycolmap.Reconstruction:
    """A database of photos of one camera without EXIF, and its true model."""
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(path) as database:
        return pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=num_images, num_points3D=100,
                camera_has_prior_focal_length=False,
            ),
            database,
        )  # fmt: skip
