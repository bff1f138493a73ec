"""Pictures of the page drawn pixel by pixel: matches on photos, thumbnails, the view graph, views of a model.

Pictures are (H, W, 3) uint8 in OpenCV's order of channels, blue first.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import ImageError
from corrsfm.images.photos import read_small
from corrsfm.types import PairStatistics

__all__ = [
    "DROPPED_COLOUR",
    "KEPT_COLOUR",
    "draw_matches",
    "draw_shares",
    "draw_view_graph",
    "draw_views",
    "jpeg_uri",
    "matches_uri",
    "png_uri",
    "read_photo",
    "share_colours",
    "view_graph_scale",
]

# Told apart by everyone, and bright enough to stand on a dark photo (Okabe and Ito's palette).
KEPT_COLOUR = "#56B4E9"
DROPPED_COLOUR = "#D55E00"
# Red and green differ in lightness as well, for readers who cannot tell the hues apart.
_SHARE_COLOURS = ("#B23A0E", "#F6EBCF", "#43B48A")
_MATCHED_GREY = 222
_MAX_MATRIX_SIDE = 500
_DRAWN_SIZE = 560


def _bgr(colour: str) -> tuple[int, int, int]:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def read_photo(path: Path, max_size: int) -> tuple[NDArray[np.uint8], float] | None:
    """Read a photo and scale it down.

    Returns
    -------
    photo : (H, W, 3) uint8
    scale : float
        Size of the result over size of the file, at most 1.

    None if the photo is missing or unreadable; the page then leaves it out.
    """
    try:
        return read_small(path, max_size)
    except ImageError:
        return None


def draw_matches(
    photos: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    scales: tuple[float, float],
    points: tuple[NDArray[np.float32], NDArray[np.float32]],
    kept: NDArray[np.bool_],
    *,
    max_kept: int = 150,
    max_dropped: int = 60,
) -> NDArray[np.uint8]:
    """Two photos side by side with lines between matched keypoints.

    Parameters
    ----------
    photos : pair of (H, W, 3) uint8
    scales : pair of float
        Size of each photo here over its size in the file.
    points : pair of (M, 2) float32
        Matched keypoints in pixels of the files, COLMAP convention.
    kept : (M,) bool
        Matches that pruning kept; they are drawn over the others.
    max_kept, max_dropped : int
        Lines drawn at most, spread evenly over the matches.
    """
    gap = 6
    height = max(photo.shape[0] for photo in photos)
    offset = photos[0].shape[1] + gap
    canvas = np.full((height, offset + photos[1].shape[1], 3), 255, np.uint8)
    for photo, left in zip(photos, (0, offset), strict=True):
        # Paler photos let the lines stand out.
        canvas[: photo.shape[0], left : left + photo.shape[1]] = 64 + 0.75 * photo
    ends0 = points[0] * scales[0]
    ends1 = points[1] * scales[1] + np.array([offset, 0.0])
    for mask, colour, most in ((~kept, DROPPED_COLOUR, max_dropped), (kept, KEPT_COLOUR, max_kept)):
        chosen = np.flatnonzero(mask)
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(int)]
        for index in chosen:
            # In 1/16 pixel; OpenCV's pixel centres are whole numbers.
            start = tuple(int(v) for v in np.round((ends0[index] - 0.5) * 16))
            end = tuple(int(v) for v in np.round((ends1[index] - 0.5) * 16))
            cv2.line(canvas, start, end, _bgr(colour), 1, cv2.LINE_AA, shift=4)
            for centre in (start, end):
                cv2.circle(canvas, centre, 40, _bgr(colour), -1, cv2.LINE_AA, shift=4)
    return canvas


def matches_uri(
    paths: tuple[Path, Path],
    points: tuple[NDArray[np.float32], NDArray[np.float32]],
    kept: NDArray[np.bool_],
    *,
    most: tuple[int, int],
) -> str | None:
    """The matches of two photos drawn on them, as the text of a link; None if a photo cannot be read.

    Parameters
    ----------
    paths : pair of Path
        The photos.
    points : pair of (M, 2) float32
        Matched keypoints in pixels of the files, COLMAP convention.
    kept : (M,) bool
        Matches in `KEPT_COLOUR`; the others are in `DROPPED_COLOUR`, below them.
    most : pair of int
        Lines drawn at most of both kinds.
    """
    photo0, photo1 = (read_photo(path, _DRAWN_SIZE) for path in paths)
    if photo0 is None or photo1 is None:
        return None
    drawn = draw_matches(
        (photo0[0], photo1[0]), (photo0[1], photo1[1]), points, kept, max_kept=most[0], max_dropped=most[1]
    )
    return jpeg_uri(drawn)


def view_graph_scale(pairs: Sequence[PairStatistics]) -> tuple[int, int]:
    """Smallest and largest number of verified matches of a verified pair; (1, 1) without any."""
    counts = [pair.num_verified for pair in pairs if pair.num_verified > 0]
    return (min(counts), max(counts)) if counts else (1, 1)


def draw_view_graph(names: Sequence[str], pairs: Sequence[PairStatistics]) -> NDArray[np.uint8]:
    """The matrix of photos by photos, one pixel a pair.

    White where a pair was not matched, grey where it was but not verified, else from pale to dark with the
    logarithm of the number of verified matches. Scenes of more than 500 photos share pixels; the best pair of
    a pixel shows.
    """
    side = min(len(names), _MAX_MATRIX_SIDE)
    position = {name: index * side // len(names) for index, name in enumerate(names)}
    # -1 not matched, 0 not verified, otherwise the verified matches
    best = np.full((side, side), -1, np.int64)
    for pair in pairs:
        row, column = position[pair.name0], position[pair.name1]
        best[row, column] = best[column, row] = max(best[row, column], pair.num_verified)
    low, high = view_graph_scale(pairs)
    level = np.log(np.maximum(best, low) / low) / max(np.log(high / low), 1e-9)
    matrix = shade(level)
    matrix[best == 0] = _MATCHED_GREY
    matrix[best < 0] = 255
    return matrix


def draw_shares(names: Sequence[str], pairs: Sequence[tuple[str, str, float | None]]) -> NDArray[np.uint8]:
    """The matrix of photos by photos, one pixel a pair, by the share of its matches that a model explains.

    Parameters
    ----------
    names : sequence of str
    pairs : sequence of (name, name, share)
        With a share in [0, 1], or None where the model says nothing about the pair, drawn grey. Other pairs
        stay white.
    """
    position = {name: index for index, name in enumerate(names)}
    matrix = np.full((len(names), len(names), 3), 255, np.uint8)
    for name0, name1, share in pairs:
        row, column = position[name0], position[name1]
        colour = _MATCHED_GREY if share is None else share_colours(np.array(share))
        matrix[row, column] = matrix[column, row] = colour
    return matrix


def share_colours(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours from red (0) over pale (0.5) to green (1), blue first; the red is darker than the green."""
    colours = np.array([_bgr(colour) for colour in _SHARE_COLOURS], np.float64)
    levels = [np.interp(share, (0.0, 0.5, 1.0), colours[:, channel]) for channel in range(3)]
    return np.stack(levels, axis=-1).round().astype(np.uint8)


def shade(level: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours from pale (0) to dark (1), in an order that survives any colour vision."""
    values = np.clip(235 - 225 * level, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(values, cv2.COLORMAP_VIRIDIS), np.uint8)


def draw_views(
    points: NDArray[np.float64],
    colours: NDArray[np.uint8],
    centres: NDArray[np.float64],
    frame: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    side: int = 480,
) -> NDArray[np.uint8]:
    """A model from above and from the side, beside each other.

    Parameters
    ----------
    points : (N, 3) float64
        In any frame with z up.
    colours : (N, 3) uint8
        Red first.
    centres : (C, 3) float64
        Camera centres, in the same frame.
    frame : pair of (3,) float64
        Lowest and highest corner of what is shown; what lies outside is left out.
    side : int
        Pixels of a view.
    """
    low, high = frame
    inside = np.all((points >= low) & (points <= high), axis=1)
    points, colours = points[inside], colours[inside]
    centres = centres[np.all((centres >= low) & (centres <= high), axis=1)]
    scale = side / max(float((high - low).max()), 1e-9)
    views = []
    for axes in ((0, 1), (0, 2)):
        view = np.full((side, side, 3), 255, np.uint8)
        middle = (low + high)[list(axes)] / 2

        def pixels(
            world: NDArray[np.float64], axes: tuple[int, int] = axes, middle: NDArray = middle
        ) -> NDArray[np.int64]:
            flat = (world[:, list(axes)] - middle) * [scale, -scale] + side / 2
            return np.clip(np.round(flat), 0, side - 1).astype(np.int64)

        columns, rows = pixels(points).T
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            view[np.minimum(rows + down, side - 1), np.minimum(columns + right, side - 1)] = colours[:, ::-1]
        for column, row in pixels(centres):
            cv2.circle(view, (int(column), int(row)), 4, _bgr(DROPPED_COLOUR), -1, cv2.LINE_AA)
        views.append(view)
    return np.hstack(views)


def png_uri(picture: NDArray[np.uint8]) -> str:
    """A picture as the text of a link, without loss."""
    return _uri(picture, ".png", "image/png", [])


def jpeg_uri(picture: NDArray[np.uint8]) -> str:
    """A picture as the text of a link, small."""
    return _uri(picture, ".jpg", "image/jpeg", [cv2.IMWRITE_JPEG_QUALITY, 80])


def _uri(picture: NDArray[np.uint8], suffix: str, kind: str, options: list[int]) -> str:
    _, encoded = cv2.imencode(suffix, picture, options)
    return f"data:{kind};base64,{base64.b64encode(encoded.tobytes()).decode()}"
