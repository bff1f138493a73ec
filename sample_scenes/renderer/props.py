"""Furniture of the sample scenes, and the place that holds it: pots, statues, fountains, windows.

World frame: metres, z up. Facades look towards -y, where the photographer stands.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapes
import textures
from shapes import Mesh, Rng
from textures import Surface


@dataclass(frozen=True)
class Light:
    """Daylight: where the sun stands, the haze (0 clear, 1 grey) and the sun's strength (0 overcast)."""

    azimuth_deg: float = -120.0
    elevation_deg: float = 42.0
    haze: float = 0.25
    sun: float = 1.0


@dataclass(frozen=True)
class Shot:
    """One photo to take: where from, what at (metres), camera roll, light, and how the camera was set."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    roll_deg: float = 0.0
    light: Light = Light()
    exposure_ev: float = 0.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass
class Place:
    """Everything the renderer needs to take the photos."""

    surfaces: dict[str, Surface]
    items: list[tuple[Mesh, str]] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)

    def add(
        self, mesh: Mesh, surface: str, at: tuple[float, float, float] = (0, 0, 0), turn_deg: float = 0.0
    ) -> None:
        """Put a mesh somewhere, dressed in the named surface."""
        self.items.append((mesh.moved(at, turn_deg), surface))


def stock_surfaces(rng: Rng, size: int) -> dict[str, Surface]:
    """The materials that all places share; `size` is the bitmap side of the small ones in pixels."""
    t = textures
    return {
        "stone": t.weather(rng, t.limestone(rng, size)),
        "marble": t.weather(rng, t.limestone(rng, size, (1.5, 1.5), (222, 216, 204)), 0.7, 0.25),
        "wood": t.planks(rng, size),
        "painted": t.weather(rng, t.planks(rng, size, (0.9, 0.9), 7, (70, 108, 112)), 0.6, 0.12),
        "terracotta": t.weather(rng, t.limestone(rng, size, (1.0, 1.0), (188, 106, 70)), 0.4, 0.5),
        "roof": t.weather(
            rng,
            t.masonry(
                rng,
                size,
                (3.2, 3.2),
                (0.2, 0.32),
                0.004,
                ((176, 98, 66), (150, 82, 60), (196, 128, 92)),
                (84, 60, 48),
                "stack",
            ),
            0.4,
            0.4,
        ),
        "leaf": t.foliage(rng),
        "olive": t.foliage(rng, rgb=(112, 122, 78)),
        "glass": t.Surface(
            np.full((64, 64, 3), 0.06, np.float32), np.zeros((64, 64), np.float32), (1.0, 1.0)
        ),
    }


def add_pot(
    place: Place, rng: Rng, at: tuple[float, float, float], scale: float, plant: str = "leaf"
) -> None:
    """A terracotta pot with a shrub in it."""
    profile = [
        (0.0, 0.0),
        (0.2, 0.0),
        (0.23, 0.03),
        (0.3, 0.38),
        (0.36, 0.4),
        (0.36, 0.5),
        (0.3, 0.5),
        (0.28, 0.44),
        (0.0, 0.44),
    ]
    pot = shapes.lathe([(r * scale, z * scale) for r, z in profile])
    place.add(pot.shifted_uv(rng), "terracotta", at)
    crown = shapes.bush(rng, 0.5 * scale, 420)
    place.add(crown, plant, (at[0], at[1], at[2] + 0.85 * scale))


def add_statue(
    place: Place, rng: Rng, at: tuple[float, float, float], turn_deg: float, scale: float = 1.0
) -> None:
    """A marble bust on a stone pedestal."""
    s = scale
    place.add(shapes.box((0.8 * s, 0.8 * s, 0.18 * s)).shifted_uv(rng), "stone", at, turn_deg)
    place.add(
        shapes.box((0.56 * s, 0.56 * s, 0.85 * s)).shifted_uv(rng),
        "stone",
        (at[0], at[1], at[2] + 0.18 * s),
        turn_deg,
    )
    place.add(
        shapes.box((0.7 * s, 0.7 * s, 0.1 * s)).shifted_uv(rng),
        "stone",
        (at[0], at[1], at[2] + 1.03 * s),
        turn_deg,
    )
    place.add(shapes.bust(rng, 1.0 * s).shifted_uv(rng), "marble", (at[0], at[1], at[2] + 1.12 * s), turn_deg)


def add_crates(place: Place, rng: Rng, at: tuple[float, float, float], count: int) -> None:
    """A small heap of wooden boxes: two below, the others on top."""
    for index in range(count):
        side = float(rng.uniform(0.5, 0.7))
        level, slot = divmod(index, 2)
        x = at[0] + (slot - 0.5) * 0.85 + float(rng.uniform(-0.05, 0.05)) + 0.3 * level
        place.add(
            shapes.box((side, side, 0.6)).shifted_uv(rng),
            "wood",
            (x, at[1], at[2] + 0.6 * level),
            float(rng.uniform(-25, 25)),
        )


def add_barrel(place: Place, rng: Rng, at: tuple[float, float, float]) -> None:
    """A wooden barrel with two hoops."""
    belly = [
        (0.0, 0.0),
        (0.26, 0.0),
        (0.31, 0.2),
        (0.335, 0.42),
        (0.31, 0.65),
        (0.27, 0.85),
        (0.25, 0.85),
        (0.24, 0.8),
        (0.0, 0.8),
    ]
    place.add(shapes.lathe(belly).shifted_uv(rng), "wood", at)
    for level in (0.2, 0.62):
        hoop = shapes.lathe([(0.31, level), (0.325, level), (0.325, level + 0.05), (0.31, level + 0.05)])
        place.add(hoop, "glass", at)


def add_fountain(place: Place, rng: Rng, at: tuple[float, float, float]) -> None:
    """A round basin with a baluster and an urn."""
    basin = [
        (1.15, 0.0),
        (1.15, 0.12),
        (1.05, 0.16),
        (1.05, 0.42),
        (1.15, 0.46),
        (1.15, 0.56),
        (0.95, 0.56),
        (0.95, 0.2),
        (0.0, 0.2),
    ]
    place.add(shapes.lathe(basin, 160), "stone", at)
    baluster = [
        (0.34, 0.2),
        (0.34, 0.3),
        (0.2, 0.4),
        (0.14, 0.6),
        (0.24, 0.85),
        (0.13, 1.1),
        (0.2, 1.16),
        (0.5, 1.28),
        (0.6, 1.42),
        (0.54, 1.42),
        (0.0, 1.32),
    ]
    place.add(shapes.lathe(baluster, 160, 16, 0.08), "marble", at)
    urn = [
        (0.0, 1.34),
        (0.14, 1.34),
        (0.08, 1.46),
        (0.22, 1.62),
        (0.26, 1.8),
        (0.14, 1.98),
        (0.2, 2.06),
        (0.0, 2.02),
    ]
    place.add(shapes.lathe(urn, 96, 14, 0.06).shifted_uv(rng), "marble", at)


def add_window(
    place: Place, rng: Rng, at: tuple[float, float, float], turn_deg: float = 0.0, same: bool = False
) -> None:
    """A shuttered window standing out of a facade at y = `at[1]`; `same` shows the same wood on each."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))

    def put(mesh: Mesh, surface: str, x: float, y: float, z: float) -> None:
        place.add(
            mesh if same else mesh.shifted_uv(rng),
            surface,
            (at[0] + c * x - s * y, at[1] + s * x + c * y, at[2] + z),
            turn_deg,
        )

    put(shapes.box((0.8, 0.04, 1.2)), "glass", 0.0, -0.01, 0.0)
    for x in (-0.45, 0.45):
        put(shapes.box((0.12, 0.16, 1.2)), "stone", x, -0.04, 0.0)
        put(shapes.box((0.44, 0.05, 1.24)), "painted", 1.62 * x, -0.07, -0.02)
    put(shapes.box((0.05, 0.06, 1.2)), "painted", 0.0, -0.03, 0.0)
    put(shapes.box((0.8, 0.06, 0.05)), "painted", 0.0, -0.03, 0.62)
    put(shapes.box((1.2, 0.26, 0.12)), "stone", 0.0, -0.06, -0.12)
    put(shapes.box((1.1, 0.2, 0.18)), "stone", 0.0, -0.06, 1.2)
