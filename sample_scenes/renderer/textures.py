"""Procedural surfaces for the sample scenes: seeded numpy bitmaps with detail at every scale.

Every maker returns a `Surface` and takes a `numpy.random.Generator` first, so that one seed gives one
surface. Extents are in metres: a surface of extent `(4, 4)` covers four metres by four before it repeats
(all of them tile, unless something unique such as a poster was painted on).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

Rng = np.random.Generator
WORDS = [
    "CONCERTO",
    "GRAND",
    "MARKET",
    "SUNDAY",
    "OPERA",
    "CIRCUS",
    "HARBOUR",
    "MUSEUM",
    "LEMON",
    "NIGHT",
    "VOLTA",
    "JAZZ",
    "THEATRE",
    "EXPRESS",
    "BAKERY",
    "ORIENT",
    "CINEMA",
    "FESTIVAL",
    "PALACE",
    "ROSSO",
    "LUNA",
    "ATELIER",
    "TRAMWAY",
    "COFFEE",
]


@dataclass
class Surface:
    """What a material needs: colour and relief over one period.

    Attributes
    ----------
    albedo
        (H, W, 3) float32, sRGB-encoded reflectance in [0, 1], rows from the top.
    height
        (H, W) float32, relief in metres.
    extent
        width and height of the period in metres.
    """

    albedo: np.ndarray
    height: np.ndarray
    extent: tuple[float, float]


def fractal(
    rng: Rng, size: int, beta: float = 1.1, stretch: tuple[float, float] = (1.0, 1.0), cutoff: float = 0.0
) -> np.ndarray:
    """Tileable noise (size, size), zero mean, unit deviation, amplitude ~ 1 / frequency**beta.

    `stretch` (x, y) elongates the grain; frequencies (cycles a period) below `cutoff` are faded out.
    """
    fx = np.fft.rfftfreq(size, 1.0 / size)[None, :] * stretch[0]
    fy = np.fft.fftfreq(size, 1.0 / size)[:, None] * stretch[1]
    frequency = np.hypot(fx, fy)
    frequency[0, 0] = 1.0
    gain = frequency**-beta
    if cutoff:
        gain *= 1.0 - np.exp(-((frequency / cutoff) ** 2))
    gain[0, 0] = 0.0
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * gain, s=(size, size))
    return (noise / noise.std()).astype(np.float32)


def smoothstep(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """Hermite ramp from 0 at `low` to 1 at `high`."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def colour(rgb: tuple[int, int, int]) -> np.ndarray:
    """An 8-bit sRGB triple as a (3,) float32 in [0, 1]."""
    return np.asarray(rgb, np.float32) / 255.0


def mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Blend images (or one colour) `a` and `b` by a (H, W) weight of `b`."""
    return a + (b - a) * weight[..., None]


def grain(rng: Rng, size: int, strength: float) -> np.ndarray:
    """A (size, size, 1) multiplier around 1 with coarse clouds and fine grit."""
    clouds = fractal(rng, size, 1.4)
    grit = fractal(rng, size, 0.85, cutoff=30.0)
    return np.clip(1.0 + strength * (0.5 * clouds + 0.6 * grit), 0.25, 1.8)[..., None]


def grid_metres(size: int, extent: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Pixel-centre coordinates x, y (size, size) in metres over the period."""
    axis = (np.arange(size, dtype=np.float32) + 0.5) / size
    return np.meshgrid(axis * extent[0], axis * extent[1])


def weather(rng: Rng, surface: Surface, drips: float = 0.5, lichen: float = 0.3) -> Surface:
    """Age a surface: dark vertical drip stains and pale or green lichen spots."""
    size = surface.albedo.shape[0]
    streaks = fractal(rng, size, 1.2, stretch=(0.6, 6.0)) + 0.7 * fractal(rng, size, 1.3)
    albedo = surface.albedo * (1.0 - 0.45 * drips * smoothstep(streaks, 0.4, 2.2)[..., None])
    for rgb in ((168, 170, 128), (92, 98, 62), (214, 208, 190)):
        spots = fractal(rng, size, 0.9, cutoff=12.0) + 0.8 * fractal(rng, size, 1.6)
        albedo = mix(albedo, colour(rgb), lichen * smoothstep(spots, 1.5, 2.1))
    return Surface(albedo, surface.height, surface.extent)


def masonry(
    rng: Rng,
    size: int = 2048,
    extent: tuple[float, float] = (4.0, 4.0),
    block: tuple[float, float] = (0.25, 0.08),
    joint: float = 0.006,
    palette: tuple[tuple[int, int, int], ...] = ((150, 78, 58), (172, 96, 70), (124, 62, 50), (186, 118, 88)),
    mortar: tuple[int, int, int] = (176, 166, 150),
    bond: str = "running",
) -> Surface:
    """Courses of bricks or stones, each with its own colour, worn edges and grit.

    `bond` shifts the courses: 'running' by half a block, 'random' by any amount, 'stack' not at all.
    """
    x, y = grid_metres(size, extent)
    warp = 0.35 * joint
    x = x + warp * fractal(rng, size, 1.5, cutoff=8.0)
    y = y + warp * fractal(rng, size, 1.5, cutoff=8.0)
    rows, columns = round(extent[1] / block[1]), round(extent[0] / block[0])
    row = np.floor(y / extent[1] * rows).astype(int)
    shifts = {"running": np.arange(rows) % 2 * 0.5, "stack": np.zeros(rows), "random": rng.random(rows)}[bond]
    along = x / extent[0] * columns + shifts[row % rows]
    column = np.floor(along).astype(int)
    across = y / extent[1] * rows - row
    gap_x = np.abs(along - column - 0.5) * -1.0 + 0.5
    gap_y = np.abs(across - 0.5) * -1.0 + 0.5
    gap = np.minimum(gap_x * extent[0] / columns, gap_y * extent[1] / rows)
    wear = joint * (1.0 + 0.45 * fractal(rng, size, 1.0, cutoff=20.0))
    face = smoothstep(gap - wear, -0.4 * joint, 0.6 * joint)

    choice = rng.integers(len(palette), size=(rows, columns))[row % rows, column % columns]
    tone = rng.normal(1.0, 0.09, (rows, columns)).astype(np.float32)[row % rows, column % columns]
    stone = np.stack([colour(rgb) for rgb in palette])[choice] * tone[..., None] * grain(rng, size, 0.16)
    bed = colour(mortar) * grain(rng, size, 0.14) * 0.85
    pits = smoothstep(fractal(rng, size, 0.5, cutoff=60.0), 2.0, 2.8)
    stone = stone * (1.0 - 0.5 * pits[..., None])
    lift = rng.normal(0.0, 0.002, (rows, columns)).astype(np.float32)[row % rows, column % columns]
    height = face * (joint + lift) + 0.0007 * fractal(rng, size, 1.0, cutoff=16.0) - 0.002 * pits
    return Surface(np.clip(mix(bed, stone, face), 0.02, 0.97), height.astype(np.float32), extent)


def flagstones(
    rng: Rng,
    size: int = 2048,
    extent: tuple[float, float] = (4.0, 4.0),
    cells: int = 9,
    palette: tuple[tuple[int, int, int], ...] = (
        (150, 142, 128),
        (128, 124, 118),
        (168, 156, 134),
        (118, 110, 98),
    ),
) -> Surface:
    """Irregular paving: a jittered Voronoi pattern of `cells` x `cells` stones with moss in the joints."""
    x, y = grid_metres(size, (float(cells), float(cells)))
    x = x + 0.04 * fractal(rng, size, 1.5, cutoff=8.0)
    y = y + 0.04 * fractal(rng, size, 1.5, cutoff=8.0)
    jitter = rng.uniform(0.12, 0.88, (cells, cells, 2)).astype(np.float32)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    nearest = np.full(x.shape, 9.0, np.float32)
    second = nearest.copy()
    owner = np.zeros(x.shape, int)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            r, c = (row + dy) % cells, (column + dx) % cells
            site = jitter[r, c]
            distance = np.hypot(column + dx + site[..., 0] - x, row + dy + site[..., 1] - y)
            closer = distance < nearest
            second = np.where(closer, nearest, np.minimum(second, distance))
            owner = np.where(closer, r * cells + c, owner)
            nearest = np.where(closer, distance, nearest)
    face = smoothstep(second - nearest + 0.02 * fractal(rng, size, 1.0, cutoff=20.0), 0.03, 0.13)
    tone = rng.normal(1.0, 0.1, cells * cells).astype(np.float32)[owner]
    stone = np.stack([colour(rgb) for rgb in palette])[rng.integers(len(palette), size=cells * cells)[owner]]
    stone = stone * tone[..., None] * grain(rng, size, 0.17)
    moss = mix(colour((84, 78, 62)), colour((70, 84, 40)), smoothstep(fractal(rng, size, 1.6), -0.3, 0.8))
    albedo = mix(moss * grain(rng, size, 0.25), stone, face)
    height = face * 0.012 + 0.0009 * fractal(rng, size, 1.0, cutoff=12.0)
    return Surface(np.clip(albedo, 0.02, 0.97), height.astype(np.float32), extent)


def limestone(
    rng: Rng,
    size: int = 1024,
    extent: tuple[float, float] = (2.0, 2.0),
    rgb: tuple[int, int, int] = (206, 196, 174),
) -> Surface:
    """Cut stone or marble: clouds, thin veins, pores and chipped grit."""
    clouds = fractal(rng, size, 1.6)
    veins = np.exp(-((fractal(rng, size, 1.5) / 0.035) ** 2)) * smoothstep(clouds, -0.8, 0.8)
    pores = smoothstep(fractal(rng, size, 0.4, cutoff=50.0), 2.1, 2.9)
    albedo = colour(rgb) * grain(rng, size, 0.11)
    albedo = mix(albedo, colour((122, 106, 88)), 0.45 * veins)
    albedo = mix(albedo, colour((70, 62, 54)), 0.6 * pores)
    height = 0.0008 * fractal(rng, size, 1.0, cutoff=10.0) - 0.002 * pores - 0.001 * veins
    return Surface(np.clip(albedo, 0.02, 0.97), height.astype(np.float32), extent)


def planks(
    rng: Rng,
    size: int = 1024,
    extent: tuple[float, float] = (1.0, 1.0),
    boards: int = 6,
    rgb: tuple[int, int, int] = (148, 112, 74),
) -> Surface:
    """Upright wooden boards with grain, knots, nails and gaps."""
    x, y = grid_metres(size, (float(boards), 1.0))
    board = np.floor(x).astype(int) % boards
    rings = fractal(rng, size, 1.1, stretch=(0.35, 9.0))
    rings = np.sin(5.0 * rings + 40.0 * rng.random(boards)[board])
    fibres = fractal(rng, size, 0.5, stretch=(0.15, 6.0))
    tone = rng.normal(1.0, 0.14, boards).astype(np.float32)[board]
    albedo = colour(rgb) * (tone * (1.0 + 0.13 * rings + 0.10 * fibres))[..., None] * grain(rng, size, 0.1)
    gap = smoothstep(0.5 - np.abs(x - np.floor(x) - 0.5), 0.012, 0.04)
    nails = np.zeros(x.shape, np.float32)
    for index in range(boards):
        for level in (0.06, 0.5, 0.94):
            centre = (
                (index + 0.5 + rng.uniform(-0.2, 0.2)) * size / boards,
                (level + rng.uniform(-0.01, 0.01)) * size,
            )
            cv2.circle(nails, (int(centre[0]), int(centre[1])), max(2, size // 220), 1.0, -1, cv2.LINE_AA)
    albedo = mix(albedo, colour((48, 40, 36)), 0.85 * nails) * (0.25 + 0.75 * gap[..., None])
    height = 0.006 * gap + 0.0005 * (rings + fibres)
    return Surface(np.clip(albedo, 0.02, 0.97), height.astype(np.float32), extent)


def plaster(
    rng: Rng,
    size: int = 2048,
    extent: tuple[float, float] = (4.0, 4.0),
    rgb: tuple[int, int, int] = (214, 180, 128),
    peeled: float = 0.9,
) -> Surface:
    """Old render coat with cracks and dirt, fallen off in places so that bricks show through."""
    under = masonry(rng, size, extent)
    sheet = fractal(rng, size, 1.7) + 0.25 * fractal(rng, size, 1.0, cutoff=15.0)
    coat = 1.0 - smoothstep(sheet, 2.0 - peeled, 2.06 - peeled)
    rim = np.exp(-(((sheet - 2.0 + peeled) / 0.12) ** 2))
    cracks = np.exp(-((fractal(rng, size, 1.35) / 0.012) ** 2)) * smoothstep(
        fractal(rng, size, 1.8), 0.0, 1.0
    )
    paint = colour(rgb) * grain(rng, size, 0.10)
    faded = smoothstep(fractal(rng, size, 1.5), -0.2, 1.6)
    paint = mix(paint, colour(rgb) * 0.55 + 0.38, 0.6 * faded)
    paint = mix(paint, colour((96, 84, 72)), 0.75 * cracks)
    paint = mix(paint, colour((222, 214, 200)), 0.6 * rim)
    height = under.height * (1.0 - coat) + coat * (0.016 + 0.0012 * fractal(rng, size, 1.1, cutoff=6.0))
    return Surface(np.clip(mix(under.albedo, paint, coat), 0.02, 0.97), height.astype(np.float32), extent)


def poster(rng: Rng, width: int, height: int) -> np.ndarray:
    """A printed bill (height, width, 3): blocks of colour, a picture of shapes, headlines and small print."""
    inks = rng.integers(20, 245, (4, 3))
    page = np.empty((height, width, 3), np.uint8)
    page[:] = 190 + inks[0] // 5
    cv2.rectangle(page, (0, 0), (width, int(height * rng.uniform(0.15, 0.3))), inks[1].tolist(), -1)
    for _ in range(14):
        centre = (int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.3, 0.75) * height))
        ink = inks[int(rng.integers(4))].tolist()
        if rng.random() < 0.5:
            axes = (int(rng.uniform(0.03, 0.25) * width), int(rng.uniform(0.03, 0.2) * width))
            cv2.ellipse(page, centre, axes, float(rng.uniform(0, 180)), 0, 360, ink, -1, cv2.LINE_AA)
        else:
            corners = np.int32(centre + rng.normal(0.0, 0.12 * width, (3, 2)))
            cv2.fillPoly(page, [corners], ink, cv2.LINE_AA)
    line = 0.02
    while line < 0.96:
        headline = line < 0.15 or 0.74 < line < 0.84
        text = " ".join(rng.choice(WORDS, 1 if headline else 5))
        (wide, tall), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_TRIPLEX, 1.0, 2)
        scale = 0.9 * width / wide
        line += (tall * scale * 1.6) / height
        if line < 0.33 or line > 0.74:
            cv2.putText(
                page, text, (int(0.05 * width), int(line * height)), cv2.FONT_HERSHEY_TRIPLEX, scale,
                inks[2].tolist() if headline else (30, 30, 30), max(1, int(2.4 * scale)), cv2.LINE_AA,
            )  # fmt: skip
        elif line < 0.74:
            line = max(line, 0.70)
    return (
        page
        / np.float32(255.0)
        * (1.0 - 0.10 * np.abs(rng.standard_normal((height, width, 1)).astype(np.float32)))
    )


def paste_posters(rng: Rng, surface: Surface, spots: list[tuple[float, float, float]]) -> Surface:
    """Glue torn posters on a surface; each spot is (left, top, width) in metres from the top left corner."""
    size = surface.albedo.shape[0]
    albedo, height = surface.albedo.copy(), surface.height.copy()
    scale_x, scale_y = size / surface.extent[0], size / surface.extent[1]
    for left, top, wide in spots:
        w, h = int(wide * scale_x), int(1.4 * wide * scale_y)
        page = poster(rng, w, h)
        edge = np.minimum.reduce(
            np.broadcast_arrays(
                np.arange(w)[None, :],
                np.arange(w)[None, ::-1],
                np.arange(h)[:, None],
                np.arange(h)[::-1, None],
            )
        )
        side = 1 << int(max(w, h) - 1).bit_length()
        tear = fractal(rng, side, 1.6)[:h, :w]
        present = smoothstep(edge / max(w, h) - 0.035 * (tear - 0.9), 0.0, 0.004)
        present = present * (1.0 - smoothstep(tear, 2.0, 2.02))
        x, y = int(left * scale_x), int(top * scale_y)
        window = np.s_[y : y + h, x : x + w]
        fitted = present[: albedo[window].shape[0], : albedo[window].shape[1]]
        albedo[window] = mix(albedo[window], page[: fitted.shape[0], : fitted.shape[1]], 0.95 * fitted)
        height[window] += 0.002 * fitted
    return Surface(albedo, height, surface.extent)


def graffiti(rng: Rng, surface: Surface, strokes: int = 3) -> Surface:
    """Spray a few smooth looping strokes over a surface."""
    size = surface.albedo.shape[0]
    albedo = surface.albedo.copy()
    for _ in range(strokes):
        turns = np.cumsum(rng.normal(0.0, 0.22, 160))
        steps = np.stack([np.cos(turns), np.sin(turns)], 1) * size * 0.006
        path = np.cumsum(steps, 0) + rng.uniform(0.25, 0.75, 2) * size
        coat = np.zeros((size, size), np.float32)
        cv2.polylines(coat, [np.int32(path)], False, 1.0, max(3, size // 130), cv2.LINE_AA)
        coat = cv2.GaussianBlur(coat, (0, 0), size / 700)
        ink = colour(tuple(int(v) for v in rng.integers(10, 220, 3)))
        albedo = mix(albedo, ink, 0.85 * coat * (0.8 + 0.2 * np.clip(fractal(rng, size, 0.8), -1, 1)))
    return Surface(albedo, surface.height, surface.extent)


def foliage(rng: Rng, size: int = 512, rgb: tuple[int, int, int] = (74, 104, 44)) -> Surface:
    """Leaf skin: a midrib, side veins and blotches; one leaf fills the period."""
    x, y = grid_metres(size, (2.0, 1.0))
    side = np.abs(x - 1.0)
    veins = np.exp(-((side / 0.03) ** 2)) + 0.5 * np.exp(-((np.sin(22.0 * (y + 0.6 * side)) / 0.25) ** 2))
    albedo = colour(rgb) * grain(rng, size, 0.2)
    albedo = mix(albedo, colour((150, 168, 96)), 0.4 * np.clip(veins, 0.0, 1.0))
    return Surface(np.clip(albedo, 0.02, 0.97), 0.0 * veins, (1.0, 1.0))
