"""Photos as files: their pixels, their masks, and what EXIF says of camera and position.

Photos are read as stored: an EXIF orientation is not applied, because COLMAP does not either (pycolmap 4.2.1
reads pixels and keypoints as stored, and takes only the direction of gravity from the flag) and camera, mask
and keypoints must use the same frame. A HEIC photo is turned as its container says, which is part of decoding
it; no flag is left.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import DependencyError, ImageError, InputError
from corrsfm.files import open_file
from corrsfm.images.cameras import PhotoInfo
from corrsfm.images.headers import declared_size

__all__ = [
    "CONVERTED_SUFFIXES",
    "convert_photo",
    "read_colour",
    "read_image",
    "read_mask",
    "read_photo_info",
    "read_small",
    "stored_size",
]

CONVERTED_SUFFIXES = (".avif", ".heic", ".heif")
"""Photos that pycolmap does not read."""

_CONVERTED_QUALITY = 97
_LARGEST_SEGMENT = 65533
# Of the largest sensors there are 200 million.
_MOST_PIXELS = 1 << 28
_LARGEST_BYTES = (1 << 31) - 1
_REDUCED_KINDS = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a photo as grey values, in the orientation in which it is stored.

    Any depth, palette, colour or alpha is accepted; alpha is dropped. Depths above 8 bits are scaled by the
    smallest power of two that holds the photo's brightest pixel, since 10- to 14-bit sensor values are
    commonly stored in 16 bits.

    Returns
    -------
    (H, W) uint8

    Raises
    ------
    ImageError
        If the file cannot be read or decoded completely.
    DependencyError
        If it is HEIC or AVIF and the extra ``heif`` is not installed.
    """
    return _as_bytes(path, _decode(path, "re-export or remove the photo"))


def _as_bytes(path: Path, image: NDArray) -> NDArray[np.uint8]:
    if image.dtype == np.uint16:
        shift = max(0, int(image.max()).bit_length() - 8)
        image = (image >> shift).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ImageError(f"{path}: pixels of type {image.dtype}; convert the photo to 8 or 16 bits")
    return image


def read_mask(path: Path, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Read a mask.

    Parameters
    ----------
    path : Path
    shape : tuple of int
        Height and width of the photo.

    Returns
    -------
    (H, W) bool
        False where the photo is to be ignored (the mask is zero).

    Raises
    ------
    ImageError
        If the mask cannot be read or is not as large as the photo.
    """
    mask = _decode(path, "re-export or remove the mask")
    if mask.shape != tuple(shape[:2]):
        raise ImageError(
            f"{path}: the mask has {mask.shape[1]}×{mask.shape[0]} pixels, its photo {shape[1]}×{shape[0]} as"
            " stored (EXIF orientation not applied); re-export the mask in that size"
        )
    return mask > 0


def read_colour(path: Path) -> NDArray[np.uint8]:
    """Read a photo in colour, in the orientation in which it is stored; depths are scaled as in `read_image`.

    Returns
    -------
    (H, W, 3) uint8
        OpenCV's order of channels, blue first.

    Raises
    ------
    ImageError, DependencyError
        As `read_image`.
    """
    advice = "re-export or remove the photo"
    return _as_bytes(path, _decode(path, advice, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH))


def read_small(path: Path, max_size: int) -> tuple[NDArray[np.uint8], float]:
    """Read a photo in colour and scale it down, as `read_colour` and in less time.

    Returns
    -------
    photo : (H, W, 3) uint8
        OpenCV's order of channels, blue first.
    scale : float
        Size of the result over size of the file, at most 1.

    Raises
    ------
    ImageError, DependencyError
        As `read_image`.
    """
    advice, kind = "re-export or remove the photo", cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
    reduced = 1
    if path.suffix.lower() in (".jpg", ".jpeg"):
        longest = max(stored_size(path) or (0, 0))
        # libjpeg leaves out what a smaller picture does not need.
        for factor, reduced_kind in _REDUCED_KINDS.items():
            if longest >= factor * max_size:
                reduced, kind = factor, reduced_kind
                break
    photo = _as_bytes(path, _decode(path, advice, kind))
    scale = min(1.0, max_size / max(photo.shape[:2]))
    size = (max(1, round(photo.shape[1] * scale)), max(1, round(photo.shape[0] * scale)))
    by = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(photo, size, interpolation=by), np.uint8), scale / reduced


def _decode(path: Path, advice: str, kind: int = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) -> NDArray:
    """(H, W) grey values in the depth of the file, or (H, W, 3) in colour.

    Reads the bytes first, because OpenCV's own reader does not open names of every alphabet.
    """
    with _opened(path, advice) as file:
        try:
            content = np.fromfile(file, np.uint8)
        except OSError as error:
            raise ImageError(f"{path}: cannot be read ({error.strerror}); {advice}") from error
    if path.suffix.lower() in CONVERTED_SUFFIXES:
        colour, _ = _decode_modern(path, content.tobytes(), advice)
        return colour if kind & cv2.IMREAD_COLOR else cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    try:
        image = cv2.imdecode(content, kind | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(f"{path}: cannot be decoded ({error.err}); {advice}") from error
    if image is None:
        raise ImageError(f"{path}: is damaged, cut off or no photo; {advice}")
    return np.asarray(image)


@contextlib.contextmanager
def _opened(path: Path, advice: str) -> Iterator[BinaryIO]:
    """A photo's file, if it is one and does not ask for more memory than any photo needs."""
    try:
        file = open_file(path)
    except InputError as error:
        raise ImageError(f"{error}; {advice}") from error
    with file:
        num_bytes = os.fstat(file.fileno()).st_size
        if num_bytes == 0:
            raise ImageError(f"{path}: the file is empty; {advice}")
        if num_bytes > _LARGEST_BYTES:
            raise ImageError(f"{path}: has {num_bytes / 1e6:,.0f} MB, more than any photo; {advice}")
        if path.suffix.lower() not in CONVERTED_SUFFIXES:
            size = declared_size(file)
            if size is None or 0 in size:
                raise ImageError(f"{path}: is damaged, cut off or no photo; {advice}")
            if size[0] * size[1] > _MOST_PIXELS:
                raise ImageError(
                    f"{path}: {size[0]}×{size[1]} pixels are more than the {_MOST_PIXELS / 1e6:.0f} million"
                    " that are decoded; save it smaller"
                )
        file.seek(0)
        yield file


def _decode_modern(path: Path, content: bytes, advice: str) -> tuple[NDArray[np.uint8], bytes]:
    """Colours (H, W, 3) of a HEIC or AVIF photo, blue first, and its EXIF data, empty if it has none."""
    # Pillow goes by content, and for some formats it starts other programs. Photos with a wrong suffix are
    # common.
    formats = ["AVIF", "JPEG", "PNG"]
    try:
        from PIL import AvifImagePlugin, Image  # noqa: F401

        if path.suffix.lower() != ".avif":
            from pillow_heif import register_heif_opener

            register_heif_opener()
            formats.append("HEIF")
    except ImportError as error:
        raise DependencyError("pillow-heif", f"reading {path}", "heif") from error
    try:
        with Image.open(io.BytesIO(content), formats=formats) as photo:
            colours = np.asarray(photo.convert("RGB"), np.uint8)
            exif = photo.info.get("exif") or b""
    except Image.DecompressionBombError as error:
        raise ImageError(f"{path}: has too many pixels to be decoded safely; save it smaller") from error
    except (OSError, ValueError, RuntimeError, SyntaxError) as error:
        raise ImageError(f"{path}: is damaged, cut off or no photo; {advice}") from error
    return np.ascontiguousarray(colours[:, :, ::-1]), exif


def convert_photo(path: Path, target: Path) -> None:
    """Write a photo as JPEG with its EXIF data, for programs that do not read its format.

    Raises
    ------
    ImageError, DependencyError
        As `read_image`.
    """
    advice = "re-export or remove the photo"
    with _opened(path, advice) as file:
        colours, exif = _decode_modern(path, file.read(), advice)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _CONVERTED_QUALITY]
    _, encoded = cv2.imencode(".jpg", colours, quality)
    jpeg = encoded.tobytes()
    exif = exif if exif.startswith(b"Exif\0\0") else b"Exif\0\0" + exif
    # An application segment right after the start marker; its length counts its own two bytes.
    if len(b"Exif\0\0") < len(exif) <= _LARGEST_SEGMENT:
        jpeg = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    target.write_bytes(jpeg)


def read_photo_info(path: Path) -> PhotoInfo:
    """Size, camera and position of a photo.

    Raises
    ------
    ImageError, DependencyError
        If the photo cannot be read.
    """
    import pycolmap

    if path.suffix.lower() in CONVERTED_SUFFIXES and path.is_file():
        with tempfile.TemporaryDirectory() as folder:
            converted = Path(folder) / "photo.jpg"
            convert_photo(path, converted)
            return read_photo_info(converted)
    with _opened(path, "re-export or remove the photo"):
        bitmap = pycolmap.Bitmap.read(path, False)
    if bitmap is None:
        # pycolmap does not know the format (WebP), or the file is unreadable.
        height, width = read_image(path).shape
        return PhotoInfo(width=width, height=height)
    return PhotoInfo(
        width=int(bitmap.width),
        height=int(bitmap.height),
        camera_name=bitmap.exif_camera_model() or None,
        focal_px=bitmap.exif_focal_length() or None,
        orientation=bitmap.exif_orientation() or 1,
        gps=_position(bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()),
    )


def stored_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a photo by its header alone; None for a format whose header is not known here.

    Raises
    ------
    ImageError
        If it is no file, or asks for more memory than any photo needs.
    """
    with _opened(path, "re-export or remove the photo") as file:
        file.seek(0)
        return declared_size(file)


def _position(
    latitude: float | None, longitude: float | None, altitude: float | None
) -> tuple[float, float, float] | None:
    """Position from EXIF if it is a place on earth; an altitude that is missing or NaN becomes 0."""
    # Receivers without a fix write 0, or 0/0, which is read as NaN.
    if latitude is None or longitude is None or (latitude, longitude) == (0.0, 0.0):
        return None
    # Comparisons with NaN are false.
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return None
    metres = float(altitude or 0.0)
    return float(latitude), float(longitude), metres if math.isfinite(metres) else 0.0
