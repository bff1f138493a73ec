"""The size that a photo's file declares, read before anything is decoded: a few kB can ask for many GB."""

from __future__ import annotations

import re
import struct
from typing import BinaryIO

__all__ = ["declared_size"]

_JPEG_WITHOUT_LENGTH = (0x01, *range(0xD0, 0xDA))
# Starts of a frame are C0 to CF but for three other segments.
_JPEG_FRAMES = tuple(code for code in range(0xC0, 0xD0) if code not in (0xC4, 0xC8, 0xCC))
# With room for comments, such as the name of the program that wrote it.
_PNM, _PNM_HEADER = re.compile(rb"P[1-6]\s"), 4096
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SHORT = 256, 257, 3


def declared_size(file: BinaryIO) -> tuple[int, int] | None:
    """Width and height by the header of a BMP, GIF, JPEG, PNG, PNM, TIFF or WebP file.

    Parameters
    ----------
    file : file
        Open for reading bytes; it may be read from anywhere.

    Returns
    -------
    tuple of int or None
        None if it is of none of these kinds, or its header is cut off.
    """
    file.seek(0)
    head = file.read(32)
    try:
        if head.startswith(b"\x89PNG\r\n\x1a\n"):
            return struct.unpack(">II", head[16:24])
        if head.startswith(b"\xff\xd8"):
            return _jpeg_size(file)
        if head.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
            return _tiff_size(file, "<" if head.startswith(b"II") else ">", is_big=b"+" in head[2:4])
        if head.startswith(b"BM"):
            return _bmp_size(head)
        if head.startswith((b"GIF87a", b"GIF89a")):
            return struct.unpack("<HH", head[6:10])
        if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
            return _webp_size(head)
        if _PNM.match(head):
            return _pnm_size(file)
    except struct.error:
        pass
    return None


def _pnm_size(file: BinaryIO) -> tuple[int, int] | None:
    file.seek(0)
    head = re.sub(rb"#[^\n]*\n", b" ", file.read(_PNM_HEADER))
    found = re.match(rb"P[1-6]\s+(\d{1,9})\s+(\d{1,9})\s", head)
    return (int(found[1]), int(found[2])) if found else None


def _jpeg_size(file: BinaryIO) -> tuple[int, int] | None:
    file.seek(2)
    while (marker := file.read(2)) and marker[0] == 0xFF:
        code = marker[1:]
        while code == b"\xff":  # filling
            code = file.read(1)
        if not code:
            return None
        if code[0] in _JPEG_WITHOUT_LENGTH:
            continue
        (length,) = struct.unpack(">H", file.read(2))
        if code[0] in _JPEG_FRAMES:
            height, width = struct.unpack(">xHH", file.read(5))
            return width, height
        file.seek(length - 2, 1)
    return None


def _tiff_size(file: BinaryIO, order: str, *, is_big: bool) -> tuple[int, int] | None:
    """Size of the first picture of a TIFF or BigTIFF file."""
    file.seek(8 if is_big else 4)
    place, count, width_of_entry = ("Q", "Q", 20) if is_big else ("I", "H", 12)
    (offset,) = struct.unpack(order + place, file.read(struct.calcsize(order + place)))
    file.seek(min(offset, 2**62))
    (num,) = struct.unpack(order + count, file.read(struct.calcsize(order + count)))
    sides = {}
    for _ in range(min(num, 4096)):
        entry = file.read(width_of_entry)
        tag, kind = struct.unpack(order + "HH", entry[:4])
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            start = 12 if is_big else 8
            (sides[tag],) = struct.unpack_from(order + ("H" if kind == _TIFF_SHORT else "I"), entry, start)
    return (sides[_TIFF_WIDTH], sides[_TIFF_HEIGHT]) if len(sides) == 2 else None


def _bmp_size(head: bytes) -> tuple[int, int]:
    (size_of_header,) = struct.unpack("<I", head[14:18])
    if size_of_header == 12:
        return struct.unpack("<HH", head[18:22])
    width, height = struct.unpack("<ii", head[18:26])
    return abs(width), abs(height)  # negative if the first line is the upper one


def _webp_size(head: bytes) -> tuple[int, int] | None:
    kind = head[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(head[24:27], "little"), 1 + int.from_bytes(head[27:30], "little")
    if kind == b"VP8L":
        (bits,) = struct.unpack("<I", head[21:25])
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack("<HH", head[26:30])
        return width & 0x3FFF, height & 0x3FFF
    return None
