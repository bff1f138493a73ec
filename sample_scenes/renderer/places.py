"""The places that the sample scenes show, and the photos taken of them: geometry, surfaces, light, cameras.

`courtyard` and `colonnade` are the two bundled scenes; `random_place` makes any number of others from a seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import shapes
import textures
from props import (
    Light,
    Place,
    Shot,
    add_barrel,
    add_crates,
    add_fountain,
    add_pot,
    add_statue,
    add_window,
    stock_surfaces,
)
from shapes import Rng
from textures import Surface

BAY = 2.4
"""Width of one bay of the colonnade in metres."""


def arc_shots(
    rng: Rng,
    count: int,
    target: tuple[float, float, float],
    radius: float,
    spread_deg: float,
    heights: tuple[float, ...],
    wander: float = 0.3,
    roll_deg: float = 2.0,
) -> list[Shot]:
    """Photos on an arc around `target`, `spread_deg` to either side of straight ahead, heights in turn."""
    shots = []
    for index in range(count):
        angle = np.radians(np.interp(index, [0, max(count - 1, 1)], [-spread_deg, spread_deg]))
        distance = radius + rng.uniform(-wander, wander)
        eye = (
            float(target[0] + distance * np.sin(angle)),
            float(target[1] - distance * np.cos(angle)),
            float(heights[index % len(heights)] + rng.uniform(-0.1, 0.1)),
        )
        aim = tuple(float(v) for v in np.asarray(target) + rng.uniform(-wander, wander, 3) * [1.0, 1.0, 0.4])
        shots.append(Shot(eye, aim, float(rng.uniform(-roll_deg, roll_deg))))
    return shots


def courtyard(seed: int = 11, detail: int = 2048) -> Place:
    """The easy scene: a walled yard with a fountain, seen from an arc of close viewpoints in one light."""
    rng = np.random.default_rng(seed)
    place = Place(stock_surfaces(rng, detail // 2))
    paint_courtyard(rng, place, detail)
    build_courtyard(rng, place)
    place.shots = arc_shots(rng, 14, (0.0, 1.8, 1.15), 6.0, 42.0, (1.5, 1.9, 1.65))
    return place


def paint_courtyard(rng: Rng, place: Place, detail: int) -> None:
    """Surfaces of the courtyard's own."""
    t = textures
    back = t.weather(rng, t.plaster(rng, detail, (4.0, 4.0)), 0.6, 0.1)
    place.surfaces |= {
        "back": t.paste_posters(rng, back, [(0.15, 2.05, 0.42), (0.62, 2.12, 0.42), (3.0, 1.95, 0.55)]),
        "brick": t.graffiti(rng, t.weather(rng, t.masonry(rng, detail), 0.6, 0.15), 2),
        "ashlar": t.weather(
            rng,
            t.masonry(
                rng,
                detail,
                (4.0, 4.0),
                (0.5, 0.25),
                0.01,
                ((188, 172, 140), (170, 156, 130), (202, 186, 156), (154, 142, 122)),
                (140, 130, 114),
                "random",
            ),
        ),
        "paving": t.weather(rng, t.flagstones(rng, detail), 0.3, 0.15),
    }


def build_courtyard(rng: Rng, place: Place) -> None:
    """Walls, openings and furniture of the courtyard."""
    place.add(shapes.box((40, 40, 0.2)), "paving", (0, -10, -0.2))
    place.add(shapes.box((12, 0.4, 3.52)), "back", (0, 4.2, 0))
    place.add(shapes.box((12.6, 0.05, 0.14)), "wood", (0, 3.8, 3.27))
    place.add(shapes.box((0.4, 9.4, 2.9)), "brick", (-6.0, -0.5, 0))
    place.add(shapes.box((0.4, 9.4, 2.9)), "ashlar", (6.0, -0.5, 0))
    for x in (-6.0, 6.0):
        for y in np.arange(-4.6, 3.8, 0.8):
            place.add(shapes.box((0.56, 0.78, 0.12)).shifted_uv(rng), "stone", (x, float(y), 2.9))
    place.add(shapes.tiled_roof(12.6, 2.2, 1.1), "roof", (0, 3.75, 3.38))
    for x in (-3.3, 3.3):
        add_window(place, rng, (x, 4.0, 1.35))
    place.add(shapes.box((1.1, 0.08, 2.2)), "painted", (0.0, 3.98, 0.0))
    for x in (-0.68, 0.68):
        place.add(shapes.box((0.26, 0.24, 2.3)).shifted_uv(rng), "stone", (x, 3.95, 0))
    place.add(shapes.box((1.8, 0.34, 0.28)).shifted_uv(rng), "stone", (0, 3.93, 2.3))
    place.add(shapes.box((1.7, 0.5, 0.14)).shifted_uv(rng), "stone", (0, 3.75, 0))
    add_fountain(place, rng, (0.1, 0.9, 0))
    add_statue(place, rng, (-2.6, 2.3, 0), 25.0)
    add_statue(place, rng, (3.0, 1.9, 0), -30.0, 0.85)
    add_crates(place, rng, (-4.2, 2.9, 0), 3)
    add_barrel(place, rng, (-4.9, 1.6, 0))
    add_barrel(place, rng, (4.75, 2.9, 0))
    for x, y, scale in (
        (1.5, 3.4, 0.9),
        (-1.5, 3.5, 0.75),
        (4.9, 1.2, 1.0),
        (-3.3, 0.7, 0.7),
        (2.1, 0.1, 0.6),
    ):
        add_pot(place, rng, (x, y, 0), scale, "leaf" if x > 0 else "olive")
    place.add(shapes.column(1.5, 0.26), "marble", (4.2, 0.0, 0))
    for _ in range(9):
        at = (float(rng.uniform(-3.5, 3.8)), float(rng.uniform(-1.2, 3.2)), 0.02)
        place.add(shapes.boulder(rng, float(rng.uniform(0.15, 0.4))).shifted_uv(rng), "stone", at)
    place.add(shapes.ivy(rng, 2.6, 3.2, 2600), "leaf", (4.9, 3.98, 0))
    place.add(shapes.ivy(rng, 2.2, 2.7, 1600), "leaf", (-5.78, 2.0, 0), 90.0)


def colonnade(seed: int = 23, detail: int = 2048) -> Place:
    """The hard scene: seven equal bays, far-apart viewpoints, three times of day and a restless exposure."""
    rng = np.random.default_rng(seed)
    place = Place(stock_surfaces(rng, detail // 2))
    paint_colonnade(rng, place, detail)
    build_colonnade(rng, place)
    furnish_colonnade(rng, place)
    place.shots = hard_shots(rng)
    return place


def paint_colonnade(rng: Rng, place: Place, detail: int) -> None:
    """Surfaces of the colonnade's own."""
    t, bay = textures, BAY
    place.surfaces |= {
        # Facade and floor repeat every second bay, the arches every fourth.
        "facade": t.weather(rng, t.plaster(rng, detail, (2 * bay, 2 * bay), (206, 150, 104), 0.5), 0.5, 0.05),
        "ashlar": t.weather(
            rng,
            t.masonry(
                rng,
                detail,
                (4 * bay, 4 * bay),
                (0.6, 0.3),
                0.01,
                ((196, 182, 154), (182, 168, 142), (206, 194, 168)),
                (150, 140, 124),
                "running",
            ),
            0.6,
        ),
        "tiles": t.weather(
            rng,
            t.masonry(
                rng,
                detail,
                (2 * bay, 2 * bay),
                (0.4, 0.4),
                0.004,
                ((178, 104, 74), (160, 94, 70), (196, 182, 156)),
                (110, 100, 90),
                "stack",
            ),
            0.4,
            0.1,
        ),
        "paving": t.weather(rng, t.flagstones(rng, detail, (12.0, 12.0), 26), 0.5, 0.25),
        "bills": t.paste_posters(
            rng, t.limestone(rng, detail // 2, (2.0, 2.0)), [(0.1, 0.2, 0.75), (1.05, 0.3, 0.8)]
        ),
        "brick": t.graffiti(rng, t.weather(rng, t.masonry(rng, detail), 0.6, 0.15), 3),
    }


def build_colonnade(rng: Rng, place: Place) -> None:
    """The hall itself: seven bays of equal shape and equal windows."""
    bay, bays, gallery = BAY, 7, 3.0
    length = bay * bays
    place.add(shapes.box((60, 60, 0.2)), "paving", (0, -20, -0.35))
    place.add(shapes.box((length + 0.8, gallery + 0.8, 0.15)), "tiles", (0, gallery / 2, -0.15))
    place.add(shapes.box((length, 0.4, 4.4)), "facade", (0, gallery + 0.2, 0))
    place.add(shapes.box((length + 0.8, gallery + 0.6, 0.12)), "wood", (0, gallery / 2, 4.4))
    place.add(shapes.box((length + 0.8, 0.5, 0.3)), "stone", (0, 0.0, 4.4))
    place.add(shapes.tiled_roof(length + 1.0, 3.2, 1.3), "roof", (0, -0.4, 4.68))
    for index in range(bays + 1):
        place.add(shapes.column(2.7, 0.2, 16).shifted_uv(rng), "marble", ((index - bays / 2) * bay, 0.0, 0))
    for index in range(bays):
        x = (index - bays / 2 + 0.5) * bay
        arch = shapes.arch(bay, 4.4, bay / 2 - 0.22, 2.7, 0.4)
        place.add(replace(arch, uv=arch.uv + [x, 0.0]), "ashlar", (x, -0.2, 0))
        add_window(place, rng, (x, gallery, 1.2), same=True)
    for side in (-1, 1):
        place.add(
            shapes.box((0.5, 14.0, 5.2)),
            "ashlar" if side < 0 else "brick",
            (side * (length / 2 + 0.7), -3.5, -0.3),
        )


def furnish_colonnade(rng: Rng, place: Place) -> None:
    """The things that tell one bay from another."""
    add_statue(place, rng, (-3.6, -1.6, -0.15), 15.0, 1.05)
    add_statue(place, rng, (3.2, 1.6, 0), -10.0, 1.0)
    add_fountain(place, rng, (1.6, -2.9, -0.15))
    add_crates(place, rng, (-6.6, 1.7, 0), 3)
    add_barrel(place, rng, (6.2, -1.0, -0.15))
    place.add(shapes.box((1.9, 0.12, 1.9)), "bills", (-1.2, 2.3, 0), 12.0)
    for x, y, scale in (
        (-5.6, -0.9, 0.9),
        (0.0, -0.8, 0.8),
        (4.9, -0.8, 1.1),
        (-7.4, -2.4, 1.2),
        (7.2, -3.4, 1.2),
    ):
        add_pot(place, rng, (x, y, -0.15), scale, "leaf" if x > 0 else "olive")
    for _ in range(14):
        at = (float(rng.uniform(-7, 7)), float(rng.uniform(-4.0, -0.8)), -0.13)
        place.add(shapes.boulder(rng, float(rng.uniform(0.15, 0.5))).shifted_uv(rng), "stone", at)
    place.add(shapes.ivy(rng, 3.0, 4.6, 3200), "leaf", (8.82, -2.0, -0.1), -90.0)


def hard_shots(rng: Rng) -> list[Shot]:
    """Sixteen far-apart photos from two rows of viewpoints, light and camera settings changing throughout."""
    lights = (Light(-135.0, 38.0, 0.25, 0.75), Light(-90.0, 55.0, 0.95, 0.0), Light(-55.0, 24.0, 0.4, 0.6))
    casts = ((1.0, 1.0, 1.0), (0.94, 1.0, 1.10), (1.12, 1.0, 0.84))
    near = arc_shots(rng, 8, (0.0, 1.0, 1.7), 7.2, 44.0, (1.5, 2.3), 0.6, 5.0)
    far = arc_shots(rng, 8, (0.0, 1.0, 1.9), 10.0, 36.0, (1.7, 2.8, 1.3), 0.6, 5.0)
    order = [shot for pair in zip(near, far, strict=True) for shot in pair]
    shots = []
    for index, shot in enumerate(order):
        group = int(rng.integers(3)) if index else 0
        exposure = float(rng.uniform(-0.9, 0.7))
        shots.append(Shot(shot.eye, shot.target, shot.roll_deg, lights[group], exposure, casts[group]))
    return shots


def random_place(seed: int, num_photos: int = 8, detail: int = 1024) -> Place:
    """A new place for every seed: walls, columns and objects drawn at random, with any baseline and light."""
    rng = np.random.default_rng(seed)
    place = Place(stock_surfaces(rng, detail // 2))
    paint_random(rng, place, detail)
    half = float(rng.uniform(4.5, 8.0))
    build_random(rng, place, half)
    furnish_random(rng, place, half)
    place.shots = random_shots(rng, num_photos, half)
    return place


def paint_random(rng: Rng, place: Place, detail: int) -> None:
    """Wall and ground surfaces drawn at random."""
    t = textures
    paint = tuple(int(v) for v in rng.integers((150, 130, 100), (235, 215, 195)))
    makers: list[Callable[[], Surface]] = [
        lambda: t.plaster(rng, detail, rgb=paint, peeled=float(rng.uniform(0.3, 1.3))),
        lambda: t.masonry(rng, detail),
        lambda: t.masonry(
            rng,
            detail,
            (4.0, 4.0),
            (0.5, 0.25),
            0.01,
            ((188, 172, 140), (170, 156, 130), (202, 186, 156)),
            bond="random",
        ),
    ]
    for name in ("back", "left", "right"):
        wall = t.weather(
            rng,
            makers[int(rng.integers(len(makers)))](),
            float(rng.uniform(0.2, 0.8)),
            float(rng.uniform(0.0, 0.3)),
        )
        if rng.random() < 0.5:
            spots = [
                (float(rng.uniform(0.1, 3.3)), float(rng.uniform(1.2, 2.6)), float(rng.uniform(0.3, 0.6)))
                for _ in range(3)
            ]
            wall = t.paste_posters(rng, wall, spots)
        place.surfaces[name] = t.graffiti(rng, wall, int(rng.integers(3)))
    place.surfaces["paving"] = t.weather(rng, t.flagstones(rng, detail, cells=int(rng.integers(6, 16))))


def build_random(rng: Rng, place: Place, half: float) -> None:
    """Three walls, `half` metres to either side, with windows and perhaps a roof and columns."""
    height = float(rng.uniform(2.8, 4.5))
    place.add(shapes.box((60, 60, 0.2)), "paving", (0, -20, -0.2))
    place.add(shapes.box((2 * half, 0.4, height)).shifted_uv(rng), "back", (0, 4.2, 0))
    for side, name in ((-1, "left"), (1, "right")):
        place.add(shapes.box((0.4, 12.0, height)).shifted_uv(rng), name, (side * half, -1.8, 0))
    if rng.random() < 0.6:
        place.add(shapes.tiled_roof(2 * half + 0.4, 2.2, 1.1), "roof", (0, 3.75, height))
    for x in np.arange(-half + 1.5, half - 1.4, float(rng.uniform(1.9, 3.5))):
        add_window(place, rng, (float(x), 4.0, 1.2), same=bool(rng.random() < 0.5))
    if rng.random() < 0.6:
        spacing = float(rng.uniform(1.4, 2.6))
        for x in np.arange(-half + 0.8, half - 0.7, spacing):
            place.add(
                shapes.column(height - 0.3, 0.2, int(rng.integers(12, 22))), "marble", (float(x), 2.6, 0)
            )
        place.add(shapes.box((2 * half - 0.5, 0.6, 0.35)), "stone", (0, 2.6, height - 0.3))


def furnish_random(rng: Rng, place: Place, half: float) -> None:
    """Some objects in random spots of the yard."""
    slots = rng.permutation([(x, y) for x in np.linspace(-half + 1.2, half - 1.2, 5) for y in (-0.4, 1.5)])
    for x, y in slots[: int(rng.integers(4, 9))]:
        at, kind = (
            (float(x + rng.uniform(-0.3, 0.3)), float(y + rng.uniform(-0.3, 0.3)), 0.0),
            int(rng.integers(6)),
        )
        if kind == 0:
            add_statue(place, rng, at, float(rng.uniform(-40, 40)), float(rng.uniform(0.8, 1.2)))
        elif kind == 1:
            add_crates(place, rng, at, int(rng.integers(2, 4)))
        elif kind == 2:
            add_barrel(place, rng, at)
        elif kind == 3:
            add_fountain(place, rng, at)
        elif kind == 4:
            add_pot(place, rng, at, float(rng.uniform(0.7, 1.2)))
        else:
            place.add(shapes.boulder(rng, float(rng.uniform(0.4, 1.0))).shifted_uv(rng), "stone", at)


def random_shots(rng: Rng, num_photos: int, half: float) -> list[Shot]:
    """Photos on an arc of random width and distance; in every other place the light and exposure change."""
    lights = [
        Light(
            float(rng.uniform(-160, -20)),
            float(rng.uniform(20, 65)),
            float(rng.uniform(0.05, 0.9)),
            float(rng.random() > 0.25),
        )
        for _ in range(3)
    ]
    changing = rng.random() < 0.5
    radius, spread_deg = float(rng.uniform(4.5, 6.5)), min(float(rng.uniform(15, 50)), 7.0 * half)
    shots = []
    for shot in arc_shots(rng, num_photos, (0.0, 1.8, 1.3), radius, spread_deg, (1.4, 2.1, 1.7)):
        light = lights[int(rng.integers(3)) if changing else 0]
        exposure_ev = float(rng.uniform(-0.6, 0.5)) if changing else 0.0
        shots.append(replace(shot, light=light, exposure_ev=exposure_ev))
    return shots
