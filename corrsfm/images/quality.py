"""What can be told of a photo before any matching: how sharp, how bright, and like which others."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["brightness_stops", "hash_distances", "perceptual_hash", "sharp_detail"]

# Side to which photos are reduced, which also averages noise away.
_SIDE_PX = 1000
_NUM_TILES = 8
# Share of the tiles that may be out of focus or empty in a sharp photo.
_BLURRED_SHARE = 0.75
_HASH_SIDE = 16


def _reduced(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    factor = min(1.0, _SIDE_PX / max(grey.shape))
    size = (max(1, round(grey.shape[1] * factor)), max(1, round(grey.shape[0] * factor)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def sharp_detail(grey: NDArray[np.uint8]) -> float:
    """How much fine detail a photo has for its coarse detail; low if it is blurred.

    The energy of the band between blurs of 0 and 1 px over that between 1 and 2 px, in the sharpest quarter
    of the tiles that have any texture: neither a background out of focus nor what the photo shows counts.

    Parameters
    ----------
    grey : (H, W) uint8

    Returns
    -------
    float
        0 for a photo without texture.
    """
    reduced = _reduced(grey)
    one, two = (cv2.GaussianBlur(reduced, (0, 0), sigma) for sigma in (1.0, 2.0))
    fine, coarse = ((reduced - one) ** 2, (one - two) ** 2)
    ratios = []
    for fine_row, coarse_row in zip(
        np.array_split(fine, _NUM_TILES), np.array_split(coarse, _NUM_TILES), strict=True
    ):
        for fine_tile, coarse_tile in zip(
            np.array_split(fine_row, _NUM_TILES, axis=1),
            np.array_split(coarse_row, _NUM_TILES, axis=1),
            strict=True,
        ):
            # A grey level of texture; below it the ratio is one of noise.
            if coarse_tile.size and coarse_tile.mean() > 1.0:
                ratios.append(float(fine_tile.mean() / coarse_tile.mean()))
    return float(np.quantile(ratios, _BLURRED_SHARE)) if ratios else 0.0


def brightness_stops(grey: NDArray[np.uint8]) -> float:
    """Mean light of a photo in stops below white; a photo of half the light has one stop less."""
    linear = (np.asarray(grey, np.float32) / 255.0) ** 2.2
    return float(np.log2(max(float(linear.mean()), 1e-6)))


def perceptual_hash(grey: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether brightness rises to the right, on a 16 × 16 grid; (256,) bool."""
    small = cv2.resize(grey, (_HASH_SIDE + 1, _HASH_SIDE), interpolation=cv2.INTER_AREA).astype(np.int16)
    return (np.diff(small, axis=1) > 0).ravel()


def hash_distances(hashes: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of bits (N, N) in which hashes (N, 256) differ."""
    ones = hashes.astype(np.int64)
    return ones @ (1 - ones).T + (1 - ones) @ ones.T
