"""Tiny made-up photos: windows into one random texture, so that neighbours overlap and match."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = (120, 160)


def texture(seed: int = 0) -> NDArray[np.uint8]:
    """A grey texture with detail on several scales, larger than any photo."""
    rng = np.random.default_rng(seed)
    total = np.zeros((300, 600), np.float32)
    for scale in (3, 6, 12, 24):
        noise = rng.standard_normal((300 // scale + 1, 600 // scale + 1)).astype(np.float32)
        total += cv2.resize(noise, (600, 300), interpolation=cv2.INTER_CUBIC)
    return cv2.normalize(total, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def write_photo(path: Path, position: int, seed: int = 0) -> None:
    """Write the window that starts at a column of the texture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    window = texture(seed)[40 : 40 + SIZE[0], position : position + SIZE[1]]
    ok, encoded = cv2.imencode(path.suffix, window)
    assert ok
    path.write_bytes(encoded.tobytes())


def write_photos(folder: Path, num: int) -> list[str]:
    """Write photos `0.png`, `1.png`, … that each overlap the next by three quarters; return their names."""
    names = [f"{number}.png" for number in range(num)]
    for number, name in enumerate(names):
        write_photo(folder / name, 40 * number)
    return names
