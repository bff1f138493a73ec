"""The declared size of a photo is read without decoding it, and a photo that asks for too much is refused."""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from corrsfm.errors import ImageError
from corrsfm.images.headers import declared_size
from corrsfm.images.photos import read_image, read_photo_info


@pytest.mark.parametrize("suffix", [".bmp", ".jpg", ".png", ".ppm", ".tif", ".webp"])
def test_declared_size_is_that_of_the_pixels(suffix: str) -> None:
    _, encoded = cv2.imencode(suffix, np.zeros((37, 301, 3), np.uint8))
    assert declared_size(io.BytesIO(encoded.tobytes())) == (301, 37)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_tiff_may_be_of_either_order_and_size(order: str) -> None:
    mark = b"II" if order == "<" else b"MM"
    small = struct.pack(f"{order}HHI", 256, 3, 1) + struct.pack(f"{order}HH", 301, 0)
    small += struct.pack(f"{order}HHII", 257, 4, 1, 37)
    old = mark + struct.pack(f"{order}HIH", 42, 8, 2) + small
    assert declared_size(io.BytesIO(old)) == (301, 37)
    large = struct.pack(f"{order}HHQI4x", 256, 4, 1, 301) + struct.pack(f"{order}HHQI4x", 257, 4, 1, 37)
    big = mark + struct.pack(f"{order}HHHQQ", 43, 8, 0, 16, 2) + large
    assert declared_size(io.BytesIO(big)) == (301, 37)


@pytest.mark.parametrize("content", [b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"II*\0", b"%PDF-1.7", b"BM"])
def test_what_is_cut_off_or_no_photo_has_no_size(content: bytes) -> None:
    assert declared_size(io.BytesIO(content)) is None


def test_a_photo_that_asks_for_too_much_memory_is_refused_by_name(tmp_path: Path) -> None:
    head = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + head + struct.pack(">I", zlib.crc32(b"IHDR" + head))
    path = tmp_path / "bomb.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    for read in (read_image, read_photo_info):
        with pytest.raises(
            ImageError, match=r"bomb\.png: 30000×30000 pixels are more than .* save it smaller"
        ):
            read(path)
