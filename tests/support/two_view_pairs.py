"""Labelled two-view pairs of known pose for tests: points in front of two cameras, and wrong matches."""

import numpy as np

from corrsfm.geometry import essential_from_pose, symmetric_epipolar_distance_sq
from corrsfm.labelled.oanet import OANetPair
from corrsfm.types import Camera

CAMERA = Camera(
    model="PINHOLE",
    width=640,
    height=480,
    params=(500.0, 500.0, 320.0, 240.0),
    has_prior_focal_length=True,
)


def make_pair(
    *,
    seed: int,
    num: int,
    inlier_ratio: float = 0.5,
    noise_px: float = 0.0,
    relief: bool = False,
    scene: str = "",
) -> OANetPair:
    """A pair with ``round(num · inlier_ratio)`` right matches in random places among wrong ones.

    Right matches have small ratios and are mutual; wrong ones mostly neither. The points are a cloud without
    structure, or lie on a relief: a network that learned from photos expects a surface.
    """
    generator = np.random.default_rng(seed)
    angle = np.radians(generator.uniform(5, 20))
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    translation = np.array([-1.0, generator.uniform(-0.3, 0.3), generator.uniform(-0.3, 0.3)])
    points = np.column_stack(
        [generator.uniform(-2, 2, num), generator.uniform(-1.5, 1.5, num), generator.uniform(4, 9, num)]
    )
    if relief:
        points[:, 2] = 6 + np.sin(points[:, 0]) + 0.5 * np.cos(2 * points[:, 1])
    moved = points @ rotation.T + translation
    matches = np.hstack([points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]])
    matches += generator.normal(0, 1, (num, 4)) * noise_px / 500.0
    right = generator.permutation(num) < round(num * inlier_ratio)
    matches[~right, 2:] = generator.uniform([-0.64, -0.48], [0.64, 0.48], (int(np.sum(~right)), 2))
    correspondences = matches.astype(np.float32)
    distances = symmetric_epipolar_distance_sq(essential_from_pose(rotation, translation), correspondences)
    return OANetPair(
        correspondences=correspondences,
        label_distances=distances.astype(np.float32),
        rotation=rotation,
        translation=translation,
        ratios=np.where(right, generator.uniform(0.3, 0.75, num), generator.uniform(0.7, 1.0, num)).astype(
            np.float32
        ),
        mutual=right | (generator.random(num) < 0.2),
        log_scale_ratios=generator.normal(0, 0.1, num).astype(np.float32),
        rotations=generator.normal(0, 0.1, num).astype(np.float32),
        camera0=CAMERA,
        camera1=CAMERA,
        scene=scene,
        name=f"made-up pair {seed}",
    )
