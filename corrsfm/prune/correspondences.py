"""Putative matches as prune methods see them: points, normalised points and side information.

A part of the prune stage that training shares, so that a network is trained on the very numbers it will see.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.cameras import normalise_points
from corrsfm.geometry import wrap_angles
from corrsfm.types import Camera, Correspondences, Features, Matches

__all__ = ["SIDE_CHANNELS", "make_correspondences", "side_information"]

SIDE_CHANNELS = {0: (), 2: ("ratio", "mutual"), 5: ("ratio", "mutual", "log_scale_ratio", "cos", "sin")}
"""Names of the side channels by their number, the layouts that networks may be made for."""

# Scales differ by e³ ≈ 20 between two photos at most; beyond is a broken keypoint.
_MAX_LOG_SCALE_RATIO = 3.0


def make_correspondences(
    features0: Features, features1: Features, matches: Matches, camera0: Camera, camera1: Camera, name: str
) -> Correspondences:
    """Gather what prune methods may know about the putative matches of one pair.

    Parameters
    ----------
    features0, features1 : Features
        Keypoints of the two images.
    matches : Matches
        Indices into them.
    camera0, camera1 : Camera
        Cameras as known before reconstruction; they normalise the points.
    name : str
        ``"name0 – name1"``, for messages.

    Returns
    -------
    Correspondences
        In the order of ``matches``.
    """
    index0, index1 = matches.indices[:, 0], matches.indices[:, 1]
    points0, points1 = features0.keypoints[index0], features1.keypoints[index1]
    rotations = features1.orientations[index1] - features0.orientations[index0]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scale_ratios = np.log(features1.scales[index1] / features0.scales[index0])
    return Correspondences(
        points0=points0,
        points1=points1,
        normalised=np.hstack(
            [normalise_points(camera0, points0), normalise_points(camera1, points1)], dtype=np.float32
        ),
        ratios=matches.ratios,
        mutual=matches.mutual,
        log_scale_ratios=log_scale_ratios.astype(np.float32),
        rotations=wrap_angles(rotations),
        camera0=camera0,
        camera1=camera1,
        name=name,
    )


def side_information(correspondences: Correspondences, num_channels: int) -> NDArray[np.float32]:
    """Side channels of a network's input, always finite.

    Parameters
    ----------
    correspondences : Correspondences
        M putative matches.
    num_channels : {0, 2, 5}
        0: none; 2: ratio in [0, 1] and mutual as 0 or 1; 5: these and the natural logarithm of the scale
        ratio (clipped to ±3), cosine and sine of the rotation between the keypoints.

    Returns
    -------
    (M, num_channels) float32

    Raises
    ------
    ValueError
        If there is no layout of that many channels.
    """
    if num_channels not in SIDE_CHANNELS:
        raise ValueError(f"no layout of {num_channels} side channels, there are {sorted(SIDE_CHANNELS)}")
    # What is not finite says nothing about the match: the worst ratio, no change of scale or angle.
    ratios = np.clip(np.nan_to_num(correspondences.ratios, nan=1.0, posinf=1.0), 0.0, 1.0)
    log_scale_ratios = np.nan_to_num(correspondences.log_scale_ratios, nan=0.0)
    rotations = np.nan_to_num(correspondences.rotations, nan=0.0, posinf=0.0, neginf=0.0)
    channels = [
        ratios,
        correspondences.mutual,
        np.clip(log_scale_ratios, -_MAX_LOG_SCALE_RATIO, _MAX_LOG_SCALE_RATIO),
        np.cos(rotations),
        np.sin(rotations),
    ]
    return np.ascontiguousarray(np.stack(channels, axis=1)[:, :num_channels], np.float32)
