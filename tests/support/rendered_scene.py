"""Rendered photos of a made-up scene with exact cameras, small enough to be mapped many times."""

from pathlib import Path

import pycolmap

from corrsfm import config as cfg

CONFIG = cfg.PipelineConfig(
    images=cfg.ImagesConfig(camera_model="SIMPLE_PINHOLE", camera_params="1280,512,384"),
    features=cfg.FeaturesConfig(max_features=700),
    run=cfg.RunConfig(threads=1, device="cpu"),
)


def render_scene(folder: Path, num_photos: int = 4) -> tuple[Path, Path]:
    """Write photos to ``images`` and their cameras to ``truth``; return both folders."""
    images, truth = folder / "images", folder / "truth"
    images.mkdir()
    truth.mkdir()
    pycolmap.set_random_seed(3)
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_frames_per_rig=num_photos, num_points3D=300, camera_width=1024, camera_height=768,
            camera_model_id=pycolmap.CameraModelId.SIMPLE_PINHOLE, camera_params=[1280, 512, 384],
        )
    )  # fmt: skip
    pycolmap.synthesize_images(pycolmap.SyntheticImageOptions(feature_patch_radius=15), model, str(images))
    model.write_text(str(truth))
    return images, truth
