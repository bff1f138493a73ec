"""Procedural geometry for the sample scenes: triangle meshes whose texture coordinates are metres.

The world is right-handed with z up, in metres. Every maker returns a `Mesh`; moving one keeps its texture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

Rng = np.random.Generator


@dataclass
class Mesh:
    """Triangles with texture coordinates.

    Attributes
    ----------
    vertices
        (N, 3) float, metres in the world frame.
    faces
        (F, 3) int, counter-clockwise seen from outside.
    uv
        (N, 2) float, metres along the surface, v upwards.
    smooth
        shade with vertex normals (round things) or face normals (flat things).
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    smooth: bool = False

    def moved(self, offset: tuple[float, float, float], turn_deg: float = 0.0) -> Mesh:
        """Turn about the vertical axis, then translate by metres."""
        c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turned = self.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, vertices=turned + np.asarray(offset))

    def shifted_uv(self, rng: Rng) -> Mesh:
        """Show another part of the texture, so that two equal shapes do not look equal."""
        return replace(self, uv=self.uv + rng.uniform(0.0, 8.0, 2))

    def write_ply(self, path: Path, period: tuple[float, float]) -> None:
        """Write binary PLY with normals (if smooth) and texture coordinates in periods (metres), v down."""
        columns = [self.vertices]
        names = ["x", "y", "z"]
        if self.smooth:
            columns.append(vertex_normals(self.vertices, self.faces))
            names += ["nx", "ny", "nz"]
        columns.append(self.uv / period * [1.0, -1.0])
        names += ["u", "v"]
        table = np.concatenate(columns, 1).astype("<f4")
        rows = np.empty(len(self.faces), np.dtype([("count", "u1"), ("index", "<i4", 3)]))
        rows["count"], rows["index"] = 3, self.faces
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
        header += [f"property float {name}" for name in names]
        header += [f"element face {len(rows)}", "property list uchar int vertex_indices", "end_header", ""]
        path.write_bytes("\n".join(header).encode() + table.tobytes() + rows.tobytes())


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (N, 3); coincident vertices (a seam) share one normal."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, same = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)
    same = same.reshape(-1)
    total = np.zeros((same.max() + 1, 3))
    for corner in range(3):
        np.add.at(total, same[faces[:, corner]], normal)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-12))[same]


def joined(meshes: list[Mesh]) -> Mesh:
    """One mesh of several; smooth if the first one is."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        meshes[0].smooth,
    )


def grid(points: np.ndarray, uv: np.ndarray, smooth: bool = True) -> Mesh:
    """Triangulate a (rows, columns, 3) lattice; faces the viewer if rows go up and columns to the right."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), smooth)


def quad(corners: np.ndarray) -> Mesh:
    """A flat face from (4, 3) corners, counter-clockwise from the lower left; uv in metres."""
    width = np.linalg.norm(corners[1] - corners[0])
    height = np.linalg.norm(corners[3] - corners[0])
    uv = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    return Mesh(corners.astype(float), np.array([[0, 1, 2], [0, 2, 3]]), uv)


def box(size: tuple[float, float, float]) -> Mesh:
    """A box standing on z = 0, centred in x and y; each face shows the texture from its lower left corner."""
    x, y, z = size[0] / 2, size[1] / 2, size[2]
    p = np.array(
        [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], [-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]],
        float,
    )
    sides = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7), (3, 2, 1, 0)]
    return joined([quad(p[list(side)]) for side in sides])


def lathe(
    profile: list[tuple[float, float]], segments: int = 96, flutes: int = 0, depth: float = 0.06
) -> Mesh:
    """Turn a (radius, height) profile about z; `flutes` hollows of relative `depth` run up the shaft."""
    outline = densified(np.asarray(profile, float))
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    radius = np.repeat(outline[:, :1], segments + 1, 1)
    if flutes:
        radius = radius * (1.0 - depth * np.abs(np.sin(0.5 * flutes * angle))[None, :])
    points = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.repeat(outline[:, 1:], segments + 1, 1)], -1
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    girth = outline[:, 0].max()
    uv = np.stack(np.meshgrid(angle * girth, along), -1)
    return grid(points, uv)


def densified(outline: np.ndarray, step: float = 0.04) -> np.ndarray:
    """Cut an (N, 2) outline into pieces of at most `step` metres; corners become tight bevels."""
    pieces = []
    for a, b in zip(outline[:-1], outline[1:], strict=True):
        count = max(2, int(np.ceil(np.linalg.norm(b - a) / step)))
        inner = np.linspace(0.0, 1.0, count + 1)[:-1]
        inner = np.unique(np.concatenate([inner, [0.03, 0.97]]))
        pieces.append(a + (b - a) * inner[:, None])
    return np.concatenate([*pieces, outline[-1:]])


def column(height: float, radius: float, flutes: int = 20) -> Mesh:
    """A column with base, fluted tapering shaft and a round capital."""
    r, h = radius, height
    base = [
        (0.0, 0.0),
        (1.45 * r, 0.0),
        (1.45 * r, 0.22 * r),
        (1.3 * r, 0.3 * r),
        (1.4 * r, 0.45 * r),
        (1.05 * r, 0.7 * r),
    ]
    shaft = [(1.0 * r, 0.75 * r), (0.97 * r, 0.4 * h), (0.84 * r, h - 0.8 * r)]
    capital = [
        (0.84 * r, h - 0.8 * r),
        (0.98 * r, h - 0.7 * r),
        (0.9 * r, h - 0.6 * r),
        (1.3 * r, h - 0.2 * r),
        (1.3 * r, h),
        (0.0, h),
    ]
    return joined([lathe(base), lathe(shaft, 8 * flutes if flutes else 96, flutes), lathe(capital)])


def boulder(rng: Rng, size: float) -> Mesh:
    """A lumpy stone of about `size` metres, half sunk at z = 0."""
    theta, phi = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 97), np.linspace(-np.pi / 2, np.pi / 2, 49))
    ball = np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], -1)
    radius = np.ones(ball.shape[:2])
    for wave in range(24):
        direction = rng.normal(0.0, 1.3 + 0.25 * wave, 3)
        radius += 0.22 / (1.0 + 0.5 * wave) * np.sin(ball @ direction + rng.uniform(0.0, 6.3))
    points = ball * radius[..., None] * size / 2 * np.array([1.0, 0.8, 0.7])
    return grid(points, np.stack([theta, phi], -1) * size / 2)


def bust(rng: Rng, height: float) -> Mesh:
    """Head and shoulders: the outer hull, seen from the axis, of ellipsoids, with hair and cloth waves."""
    parts = np.array(  # centre x, y, z, radii x, y, z (unit height, face towards -y)
        [
            [0.0, 0.0, 0.78, 0.14, 0.17, 0.19],  # skull
            [0.0, -0.15, 0.76, 0.022, 0.06, 0.055],  # nose
            [0.0, -0.13, 0.66, 0.05, 0.06, 0.045],  # chin
            [0.05, -0.14, 0.83, 0.045, 0.045, 0.014],  # brows
            [-0.05, -0.14, 0.83, 0.045, 0.045, 0.014],
            [0.0, -0.145, 0.705, 0.04, 0.04, 0.014],  # lips
            [0.0, 0.05, 0.84, 0.165, 0.165, 0.16],  # hair
            [0.0, 0.02, 0.56, 0.09, 0.09, 0.22],  # neck
            [0.0, 0.0, 0.30, 0.33, 0.18, 0.20],  # shoulders
            [0.16, -0.06, 0.24, 0.17, 0.15, 0.2],  # chest
            [-0.16, -0.06, 0.24, 0.17, 0.15, 0.2],
            [0.0, 0.0, 0.10, 0.22, 0.16, 0.22],  # foot
        ]
    )
    angle, level = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 241), np.linspace(0.0, 0.995, 200))
    dx, dy = np.cos(angle), np.sin(angle)
    reach = np.full(angle.shape, 0.004)
    for cx, cy, cz, rx, ry, rz in parts:
        a = (dx / rx) ** 2 + (dy / ry) ** 2
        b = -(dx * cx / rx**2 + dy * cy / ry**2)
        c = (cx / rx) ** 2 + (cy / ry) ** 2 + ((level - cz) / rz) ** 2 - 1.0
        root = b * b - a * c
        hit = np.where(root > 0.0, (-b + np.sqrt(np.maximum(root, 0.0))) / a, 0.0)
        reach = np.maximum(reach, hit)
    curls = np.sin(46.0 * level + 3.0 * np.sin(9.0 * angle)) * np.sin(17.0 * angle + 20.0 * level)
    hair = (level > 0.72) & ((dy > -0.55) | (level > 0.93))
    folds = np.sin(14.0 * angle + 9.0 * np.sin(5.0 * level + rng.uniform(0.0, 6.0)) + 16.0 * level)
    reach = reach * (1.0 + 0.055 * curls * hair + 0.035 * folds * (level < 0.45))
    points = np.stack([reach * dx, reach * dy, level], -1) * height
    return grid(points, np.stack([angle * 0.2, level], -1) * height)


def arch(width: float, height: float, radius: float, spring: float, depth: float, steps: int = 32) -> Mesh:
    """A wall bay over a round opening: x within +-width/2, z from `spring` to `height`, y in [0, depth].

    The piers beside the opening reach down to `spring` only; columns carry them.
    """
    angle = np.linspace(np.pi, 0.0, steps + 1)
    low = np.stack([radius * np.cos(angle), np.zeros(steps + 1), spring + radius * np.sin(angle)], 1)
    low = np.concatenate([[[-width / 2, 0.0, spring]], low, [[width / 2, 0.0, spring]]])
    top = np.stack(
        [np.linspace(-width / 2, width / 2, len(low)), np.zeros(len(low)), np.full(len(low), height)], 1
    )
    front = np.stack([low, top])
    back = front + [0.0, depth, 0.0]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(low, axis=0), axis=1))])
    soffit_uv = np.stack(
        [np.stack([arc, np.full_like(arc, depth)], 1), np.stack([arc, np.zeros_like(arc)], 1)]
    )
    return joined(
        [
            grid(front, front[..., [0, 2]], smooth=False),
            grid(back[:, ::-1], back[:, ::-1][..., [0, 2]] * [-1.0, 1.0] + [0.37, 0.0], smooth=False),
            grid(np.stack([back[0], front[0]]), soffit_uv, smooth=False),
        ]
    )


def leaves(rng: Rng, centres: np.ndarray, outward: np.ndarray, size: float) -> Mesh:
    """One folded six-cornered leaf at each of (N, 3) centres, facing roughly (N, 3) `outward`."""
    outline = np.array(
        [
            [0.0, -0.5, 0.0],
            [0.38, -0.15, 0.12],
            [0.3, 0.2, 0.1],
            [0.0, 0.5, -0.05],
            [-0.3, 0.2, 0.1],
            [-0.38, -0.15, 0.12],
        ]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    count = len(centres)
    normal = outward + rng.normal(0.0, 0.45, (count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tip = rng.normal(0.0, 0.6, (count, 3)) - [0.0, 0.0, 0.6]
    tip -= (tip * normal).sum(1, keepdims=True) * normal
    tip /= np.linalg.norm(tip, axis=1, keepdims=True)
    frame = np.stack([np.cross(tip, normal), tip, normal], 1)
    scale = size * rng.uniform(0.6, 1.25, (count, 1, 1))
    vertices = centres[:, None] + scale * np.einsum("kj,nji->nki", outline, frame)
    index = faces[None] + 6 * np.arange(count)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), index.reshape(-1, 3), np.tile(outline[:, :2] + 0.5, (count, 1)))


def ivy(rng: Rng, width: float, height: float, count: int) -> Mesh:
    """A climbing plant on the wall y = 0 (growing towards -y), denser near the ground and along stems."""
    stems = rng.uniform(-0.4, 0.4, (9, 2)) * [width, 1.0]
    pick = rng.integers(len(stems), size=count)
    climb = rng.random(count) ** 1.3
    sway = np.sin(climb * 7.0 + pick) * 0.12 * width
    x = stems[pick, 0] + sway * climb + rng.normal(0.0, 0.05 * width, count) * (1.2 - climb)
    reach = height * (0.55 + 0.45 * np.cos(stems[pick, 1] * 4.0 + pick))
    centres = np.stack([x, -rng.uniform(0.01, 0.12, count), climb * reach + 0.05], 1)
    return leaves(rng, centres, np.tile([0.0, -1.0, 0.25], (count, 1)), 0.10)


def bush(rng: Rng, radius: float, count: int) -> Mesh:
    """A round shrub of leaves about the origin."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lumps = (
        1.0
        + 0.25 * np.sin(direction @ rng.normal(0.0, 4.0, 3))
        + 0.15 * np.sin(direction @ rng.normal(0.0, 7.0, 3))
    )
    centres = direction * (radius * lumps * rng.uniform(0.6, 1.0, count) ** 0.5)[:, None]
    return leaves(rng, centres, direction, 0.28 * radius)


def tiled_roof(length: float, depth: float, rise: float, pitch: float = 0.2) -> Mesh:
    """A slope of pan tiles along x, from the eaves (y = 0, z = 0) up to (y = depth, z = rise)."""
    x, t = np.meshgrid(
        np.linspace(0.0, length, int(length / pitch * 10) + 1), np.linspace(0.0, 1.0, int(depth / 0.04) + 1)
    )
    course = (t * depth / 0.32) % 1.0
    lift = 0.05 * np.abs(np.sin(np.pi * x / pitch)) + 0.03 * (1.0 - course)
    points = np.stack([x - length / 2, t * depth, t * rise + lift], -1)
    return grid(points, np.stack([x, t * np.hypot(depth, rise)], -1))
