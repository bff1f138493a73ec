"""A small scene of labelled pairs for tests: a cloud of points seen from cameras on a line."""

import numpy as np

from corrsfm.labelled.compact import NO_NEIGHBOUR, CompactScene
from corrsfm.types import Camera


def make_scene(
    name: str = "yard", num_images: int = 4, num_keypoints: int = 60, seed: int = 0
) -> CompactScene:
    """Photos of one cloud of points from cameras on a line; half of the matches are right."""
    rng = np.random.default_rng(seed)
    camera = Camera(
        model="SIMPLE_RADIAL",
        width=960,
        height=720,
        params=(800.0, 480.0, 360.0, -0.05),
        has_prior_focal_length=True,
    )
    points = np.stack(
        [
            rng.uniform(-2, 2, num_keypoints),
            rng.uniform(-1.5, 1.5, num_keypoints),
            rng.uniform(4, 8, num_keypoints),
        ],
        1,
    )
    rotations = np.repeat(np.eye(3)[None], num_images, 0)
    translations = np.stack([np.array([-0.3 * i, 0.02 * i, 0.05 * i]) for i in range(num_images)])
    keypoints, corrections = [], []
    for translation in translations:
        moved = points + translation
        ideal = moved[:, :2] / moved[:, 2:]
        distorted = ideal * (1 - 0.05 * np.sum(ideal**2, 1, keepdims=True))
        keypoints.append(distorted * 800.0 + [480.0, 360.0])
        corrections.append(ideal - distorted)
    pairs = np.array([(i, j) for i in range(num_images) for j in range(i + 1, num_images)])
    neighbours = np.tile(np.arange(num_keypoints), (len(pairs), 1))
    neighbours[:, num_keypoints // 2 :] = rng.integers(
        0, num_keypoints, (len(pairs), num_keypoints - num_keypoints // 2)
    )
    neighbours[:, 3] = NO_NEIGHBOUR
    num_matches = neighbours.size
    return CompactScene(
        name=name,
        image_names=tuple(f"{i:03d}.jpg" for i in range(num_images)),
        cameras=(camera,) * num_images,
        rotations=rotations,
        translations=translations,
        keypoint_offsets=np.arange(num_images + 1) * num_keypoints,
        keypoints=np.concatenate(keypoints).astype(np.float32),
        corrections=np.concatenate(corrections).astype(np.float32),
        log_scales=rng.normal(size=num_images * num_keypoints).astype(np.float32),
        orientations=rng.uniform(-np.pi, np.pi, num_images * num_keypoints).astype(np.float32),
        pairs=pairs,
        covisible=rng.integers(10, 300, len(pairs)),
        match_offsets=np.arange(len(pairs) + 1) * num_keypoints,
        neighbours=neighbours.ravel().astype(np.uint16),
        ratios=rng.uniform(0, 1, num_matches).astype(np.float32),
        mutual=rng.uniform(size=num_matches) < 0.3,
    )
