"""JPEG files with EXIF made byte by byte, to know exactly what is in them."""

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

ASCII, SHORT, LONG, RATIONAL = 2, 3, 4, 5


def _entry(tag: int, kind: int, values: tuple[int, ...] | bytes, data_offset: int) -> tuple[bytes, bytes]:
    """An entry of an image file directory and the bytes that do not fit into it."""
    if isinstance(values, bytes):
        payload, count = values, len(values)
    elif kind == RATIONAL:
        payload, count = struct.pack(f"<{len(values)}I", *values), len(values) // 2
    else:
        payload, count = struct.pack(f"<{len(values)}{'H' if kind == SHORT else 'I'}", *values), len(values)
    if len(payload) <= 4:
        return struct.pack("<HHI", tag, kind, count) + payload.ljust(4, b"\0"), b""
    return struct.pack("<HHII", tag, kind, count, data_offset), payload + b"\0" * (len(payload) % 2)


def _directory(entries: list[tuple[int, int, tuple[int, ...] | bytes]], offset: int) -> bytes:
    """A directory that starts at an offset of the TIFF part, with its data behind it."""
    data_offset = offset + 2 + 12 * len(entries) + 4
    head, tail = b"", b""
    for tag, kind, values in sorted(entries):
        entry, data = _entry(tag, kind, values, data_offset + len(tail))
        head, tail = head + entry, tail + data
    return struct.pack("<H", len(entries)) + head + b"\0\0\0\0" + tail


def write_jpeg_with_exif(
    path: Path,
    image: NDArray[np.uint8],
    *,
    make: str = "",
    model: str = "",
    focal_35mm: int = 0,
    orientation: int = 1,
    gps: tuple[int, int, int] | None = None,
    gps_denominators: tuple[int, int] = (1, 1),
) -> None:
    """Write a JPEG.

    Parameters
    ----------
    path : Path
    image : (H, W) uint8
    make, model : str
    focal_35mm : int
        Equivalent focal length on 35 mm film, in millimetres.
    orientation : int
        EXIF orientation; 6 means "turn clockwise to look at it".
    gps : tuple of int, optional
        Degrees south and west, metres of altitude; numerators of the rationals that EXIF holds.
    gps_denominators : tuple of int
        Of the degrees and of the metres.
    """
    main: list[tuple[int, int, tuple[int, ...] | bytes]] = [(0x0112, SHORT, (orientation,))]
    if make:
        main.append((0x010F, ASCII, make.encode() + b"\0"))
    if model:
        main.append((0x0110, ASCII, model.encode() + b"\0"))
    exif: list[tuple[int, int, tuple[int, ...] | bytes]] = [(0xA405, SHORT, (focal_35mm,))]
    main += [(0x8769, LONG, (0,))] + ([(0x8825, LONG, (0,))] if gps else [])
    exif_offset = 8 + len(_directory(main, 8))
    exif_directory = _directory(exif, exif_offset)
    gps_offset = exif_offset + len(exif_directory)
    offsets = {0x8769: exif_offset, 0x8825: gps_offset}
    main = [(tag, kind, (offsets[tag],) if tag in offsets else values) for tag, kind, values in main]
    gps_directory = b""
    if gps:
        south, west, metres = gps
        of_degrees, of_metres = gps_denominators
        gps_directory = _directory(
            [
                (1, ASCII, b"S\0"),
                (2, RATIONAL, (south, of_degrees, 0, 1, 0, 1)),
                (3, ASCII, b"W\0"),
                (4, RATIONAL, (west, of_degrees, 0, 1, 0, 1)),
                (6, RATIONAL, (metres, of_metres)),
            ],
            gps_offset,
        )
    tiff = b"II*\0" + struct.pack("<I", 8) + _directory(main, 8) + exif_directory + gps_directory
    segment = b"Exif\0\0" + tiff
    ok, encoded = cv2.imencode(".jpg", image)
    assert ok
    jpeg = encoded.tobytes()
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:])
