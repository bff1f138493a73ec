"""Arrays of another tool → features and matches, or an error that names the file, the photo and the row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from corrsfm.descriptors import half_precision, unit_rows
from corrsfm.errors import InputError
from corrsfm.geometry import wrap_angles
from corrsfm.types import Features, Matches

__all__ = ["features_from", "matches_from", "single_precision"]

# Resizing and rounding move a keypoint of the margin out of the photo by as much.
MAX_OUTSIDE_PX = 1.0


def single_precision(values: NDArray) -> NDArray[np.float32]:
    """Numbers as a workspace holds them; those too large for it become infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


def features_from(
    where: str,
    keypoints: NDArray[np.floating],
    descriptors: NDArray | None,
    image_size: tuple[int, int],
    *,
    scores: NDArray[np.floating] | None = None,
    scales: NDArray[np.floating] | None = None,
    orientations: NDArray[np.floating] | None = None,
) -> Features:
    """Check the features of a photo.

    Parameters
    ----------
    where : str
        File and photo, for messages.
    keypoints : (N, 2) float
        Pixels, COLMAP's convention.
    descriptors : (N, D) or None
        Bytes of SIFT, or floats of any length; None where only matches are wanted.
    image_size : tuple of int
    scores, scales, orientations : (N,) float, optional
        NaN is a score that nobody gave. Scales and orientations are used only together.

    Raises
    ------
    InputError
        If a shape does not fit, a number is not finite, a scale is not above zero, or a keypoint lies outside
        of the photo.
    """
    if keypoints.ndim != 2 or keypoints.shape[1] != 2:
        raise InputError(f"{where}: keypoints have shape {keypoints.shape}, expected (N, 2)")
    num = len(keypoints)
    _check_finite(where, "keypoint", keypoints)
    outside = (keypoints < -MAX_OUTSIDE_PX) | (keypoints > np.array(image_size) + MAX_OUTSIDE_PX)
    if outside.any():
        row = int(np.flatnonzero(outside.any(axis=1))[0])
        raise InputError(
            f"{where}: keypoint {row} at ({keypoints[row, 0]:.1f}, {keypoints[row, 1]:.1f}) lies outside of "
            f"the photo of {image_size[0]} × {image_size[1]} pixels; give keypoints of the photo as it is "
            "stored, not of a resized or turned copy"
        )
    if descriptors is None:
        descriptors = np.zeros((num, 0), np.float32)
    if descriptors.ndim != 2 or len(descriptors) != num:
        raise InputError(f"{where}: {num} keypoints, but descriptors for {len(descriptors)}")
    if descriptors.dtype != np.uint8:
        _check_finite(where, "descriptor", descriptors)
        with np.errstate(over="ignore"):
            _check_finite(where, "length of descriptor", np.linalg.norm(descriptors, axis=1))
        descriptors = half_precision(unit_rows(descriptors))
    vectors = {"scores": scores, "scales": scales, "orientations": orientations}
    for label, values in vectors.items():
        if values is not None and values.shape != (num,):
            raise InputError(f"{where}: {label} have shape {values.shape}, expected ({num},)")
    if scores is not None:
        scores = single_precision(scores)
        _check_finite(where, "score of keypoint", np.where(np.isnan(scores), 0, scores))
    if scales is None or orientations is None:
        scales = orientations = None
    else:
        scales = single_precision(scales)
        wrong = np.flatnonzero(~((scales > 0) & np.isfinite(scales)))
        if len(wrong):
            raise InputError(
                f"{where}: the scale of keypoint {wrong[0]} is {scales[wrong[0]]:g}, expected a finite "
                f"number above 0; {_REMEDY_FOR_SHAPES}"
            )
        _check_finite(where, "orientation of keypoint", orientations, _REMEDY_FOR_SHAPES)
        orientations = wrap_angles(orientations.astype(np.float64))
    return Features(
        keypoints=keypoints.astype(np.float32),
        scales=scales,
        orientations=orientations,
        scores=np.full(num, np.nan, np.float32) if scores is None else scores,
        descriptors=descriptors,
        image_size=image_size,
    )


_REMEDY = "extract the features again"
_REMEDY_FOR_SHAPES = f"{_REMEDY}, or give them without scales and orientations"


def _check_finite(where: str, label: str, values: NDArray, remedy: str = _REMEDY) -> None:
    """Refuse what is not finite in a row (N,) or (N, D)."""
    wrong = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
    if len(wrong):
        raise InputError(f"{where}: {label} {wrong[0]} is not a finite number; {remedy}")


def matches_from(
    where: str, indices: NDArray[np.integer], num0: int, num1: int, scores: NDArray[np.floating] | None
) -> Matches:
    """Check the matches of a pair.

    Parameters
    ----------
    where : str
        File and pair, for messages.
    indices : (M, 2) int
        In any order.
    num0, num1 : int
        Keypoints of the photos.
    scores : (M,) float, optional

    Returns
    -------
    Matches
        Sorted, without ratios; those count as mutual that share no keypoint.

    Raises
    ------
    InputError
        If an index is out of range, a score is infinite, or a keypoint of the first photo is matched twice.
    """
    if scores is not None:
        scores = single_precision(scores)
        if len(wrong := np.flatnonzero(np.isinf(scores))):
            raise InputError(
                f"{where}: the score of match {wrong[0]} is infinite; match again, or leave the scores out"
            )
    for side, num in enumerate((num0, num1)):
        wrong = np.flatnonzero((indices[:, side] < 0) | (indices[:, side] >= num))
        if len(wrong):
            raise InputError(
                f"{where}: match {wrong[0]} names keypoint {indices[wrong[0], side]} of the "
                f"{('first', 'second')[side]} photo, which has {num}; the matches belong to other features"
            )
    order = np.argsort(indices[:, 0], kind="stable")
    ordered = indices[order].astype(np.int32)
    repeated = ordered[1:, 0][np.diff(ordered[:, 0]) == 0]
    if len(repeated):
        raise InputError(
            f"{where}: keypoint {repeated[0]} of the first photo is matched more than once; keep the best"
        )
    partners, counts = np.unique(ordered[:, 1], return_counts=True)
    return Matches(
        indices=ordered,
        ratios=np.full(len(indices), np.nan, np.float32),
        mutual=np.isin(ordered[:, 1], partners[counts == 1]),
        scores=np.full(len(indices), np.nan, np.float32) if scores is None else scores[order],
    )
