"""Render the sample scenes: photo-like pictures of procedural places with exactly known cameras.

A development tool, needed only to make new pictures. In an environment of its own:
`pip install mitsuba opencv-python-headless pillow` (tried with mitsuba 3.9.1, which on a CPU needs LLVM 17 or
newer; where several are installed, `DRJIT_LIBLLVM_PATH` names the library). A photo takes 10 to 30 s.

    python sample_scenes/renderer/render.py courtyard --output sample_scenes/courtyard
    python sample_scenes/renderer/render.py colonnade --spp 20 --output sample_scenes/colonnade
    python sample_scenes/renderer/render.py random --seed 7 --num-photos 8 --output /tmp/place7

The output folder receives `images/*.jpg` and a COLMAP text model (`cameras.txt`, `images.txt`,
`points3D.txt`): one PINHOLE camera, world-to-camera poses in metres, pixel centres at +0.5, and surface
points found by ray casting, each with the exact pixels at which the photos see it. `photograph` gives the
same, and depth maps, to a program.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import places
import textures
from PIL import Image

FOCAL_35MM = 28.0
"""35-mm equivalent focal length, also written into the EXIF data."""


@dataclass
class Photo:
    """One rendered photo and its camera.

    Attributes
    ----------
    image
        (H, W, 3) uint8, RGB.
    intrinsics
        (3, 3) float64 K in pixels; the centre of the first pixel is (0.5, 0.5).
    cam_from_world
        (3, 4) float64 [R | t] in metres; camera x right, y down, z forward.
    depth
        (H, W) float32, metres along the camera's z axis at each pixel centre; 0 where there is only sky.
    """

    image: np.ndarray
    intrinsics: np.ndarray
    cam_from_world: np.ndarray
    depth: np.ndarray


def intrinsic_matrix(width: int, height: int) -> np.ndarray:
    """K (3, 3) of a lens of `FOCAL_35MM`: its diagonal angle of view is that on 36 x 24 mm film."""
    focal = FOCAL_35MM * np.hypot(width, height) / np.hypot(36.0, 24.0)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def look_at(shot: places.Shot) -> np.ndarray:
    """cam_from_world (3, 4) of a camera at `shot.eye` that looks at `shot.target`, upright up to the roll."""
    eye = np.asarray(shot.eye)
    forward = np.asarray(shot.target) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.radians(shot.roll_deg)), np.sin(np.radians(shot.roll_deg))
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    return np.concatenate([rotation, (-rotation @ eye)[:, None]], 1)


def load_shapes(place: places.Place) -> dict[str, Any]:
    """Hand the meshes and materials of a place to the renderer, once for all its photos."""
    materials = {}
    for name, surface in place.surfaces.items():
        albedo = mi.Bitmap(np.round(255.0 * surface.albedo).astype(np.uint8))
        relief = mi.Bitmap(np.ascontiguousarray(surface.height[..., None], dtype=np.float32))
        diffuse = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": albedo}}
        bump = {
            "type": "bumpmap",
            "relief": {"type": "bitmap", "bitmap": relief, "raw": True},
            "bsdf": diffuse,
        }
        materials[name] = mi.load_dict({"type": "twosided", "bsdf": bump})
    loaded = {}
    with tempfile.TemporaryDirectory() as folder:
        for index, (mesh, name) in enumerate(place.items):
            path = Path(folder) / f"{index}.ply"
            mesh.write_ply(path, place.surfaces[name].extent)
            loaded[f"shape{index}"] = mi.load_dict(
                {
                    "type": "ply",
                    "filename": str(path),
                    "face_normals": not mesh.smooth,
                    "bsdf": materials[name],
                }
            )
    return loaded


def daylight(light: places.Light) -> dict[str, Any]:
    """Sun and sky as a panorama at infinity: clouds over blue, and a sun disc that gives soft shadows."""
    rows, columns = 512, 1024
    azimuth, elevation = np.radians(light.azimuth_deg), np.radians(light.elevation_deg)
    towards_sun = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    polar, around = np.meshgrid(
        (np.arange(rows) + 0.5) / rows * np.pi,
        (np.arange(columns) + 0.5) / columns * 2.0 * np.pi,
        indexing="ij",
    )
    # Row 0 is the zenith; column 0 looks along +y once the panorama's own y axis is turned up.
    way = np.stack([np.sin(polar) * np.sin(around), np.sin(polar) * np.cos(around), np.cos(polar)], -1)
    up = np.clip(way[..., 2], 0.0, 1.0)
    haze = light.haze + (1.0 - light.haze) * np.exp(-5.0 * up)
    sky = (
        np.array([0.16, 0.36, 0.82])
        + (np.array([0.80, 0.87, 0.95]) - np.array([0.16, 0.36, 0.82])) * haze[..., None]
    )
    size = 1024
    noise = textures.fractal(np.random.default_rng(5), size, 1.45)
    plane = way[..., :2] / np.maximum(up, 0.06)[..., None] * 0.05 * size
    clouds = noise[plane[..., 1].astype(int) % size, plane[..., 0].astype(int) % size] + 2.0 * light.haze
    cover = textures.smoothstep(clouds, 0.3, 1.6) * textures.smoothstep(way[..., 2], 0.02, 0.25)
    sky = textures.mix(sky, np.array([1.05, 1.05, 1.06]), 0.85 * cover)
    cosine = way @ towards_sun
    sky += 0.8 * np.exp((cosine - 1.0) / 0.02)[..., None] * light.sun
    sky[way[..., 2] < 0.0] = (0.12, 0.11, 0.10)
    disc = cosine > np.cos(np.radians(1.2))
    # Noon sun lights a surface that faces it five times as much as the whole sky does.
    warm = np.array([1.0, 0.88, 0.70]) ** (1.0 / max(np.sin(elevation), 0.2) / 1.6)
    if light.sun:
        solid_angle = (np.sin(polar) * disc).sum() * (np.pi / rows) * (2.0 * np.pi / columns)
        sky[disc] += light.sun * 9.0 * warm / solid_angle
    panorama = mi.Bitmap(np.ascontiguousarray(sky, dtype=np.float32))
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": panorama, "to_world": to_world}


def sensor(intrinsics: np.ndarray, cam_from_world: np.ndarray, width: int, height: int) -> Any:
    """The renderer's camera; its axes are x left, y up, z forward."""
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = cam_from_world[:, :3].T @ np.diag([-1.0, -1.0, 1.0])
    world_from_cam[:3, 3] = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "gaussian", "stddev": 0.5},
    }
    return mi.load_dict(
        {
            "type": "perspective", "fov_axis": "x", "near_clip": 0.05, "far_clip": 500.0, "film": film,
            "fov": float(np.degrees(2.0 * np.arctan(width / 2 / intrinsics[0, 0]))),
            "to_world": mi.ScalarTransform4f(world_from_cam),
        }
    )  # fmt: skip


def pixel_rays(
    intrinsics: np.ndarray, cam_from_world: np.ndarray, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Camera centre (3,) and unit directions (N, 3) in the world frame through (N, 2) pixel positions."""
    rays = (
        np.concatenate([pixels, np.ones((len(pixels), 1))], 1)
        @ np.linalg.inv(intrinsics).T
        @ cam_from_world[:, :3]
    )
    return -cam_from_world[:, :3].T @ cam_from_world[:, 3], rays / np.linalg.norm(rays, axis=1, keepdims=True)


def cast(scene: Any, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) in metres to the first surface along each ray; infinite in the sky."""
    count = len(directions)
    start = mi.Point3f(*(mi.Float(np.full(count, v, np.float32)) for v in origin))
    way = mi.Vector3f(*(mi.Float(np.ascontiguousarray(directions[:, k], np.float32)) for k in range(3)))
    return np.array(scene.ray_intersect_preliminary(mi.Ray3f(start, way)).t, dtype=np.float64)


def develop(rng: np.random.Generator, radiance: np.ndarray, exposure: float, shot: places.Shot) -> np.ndarray:
    """What a camera makes of linear radiance (H, W, 3): vignette, shot and read noise, tone curve, 8 bits."""
    height, width = radiance.shape[:2]
    y, x = np.mgrid[0.5:height, 0.5:width]
    falloff = 1.0 / (1.0 + 0.28 * ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2) ** 2
    light = radiance * exposure * 2.0**shot.exposure_ev * falloff[..., None] * np.asarray(shot.white_balance)
    light = light + rng.standard_normal(light.shape) * np.sqrt(1.2e-4 * light + 2e-6)
    light = np.clip(light, 0.0, None)
    film = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    film = np.clip(film, 0.0, 1.0)
    encoded = np.where(film < 0.0031308, 12.92 * film, 1.055 * film ** (1 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)


def photograph(
    place: places.Place, width: int = 640, height: int = 480, spp: int = 32, seed: int = 0
) -> Iterator[Photo]:
    """Take all photos of a place; the same arguments give the same cameras, and pictures up to rounding."""
    rng = np.random.default_rng(seed)
    loaded = load_shapes(place)
    intrinsics = intrinsic_matrix(width, height)
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    scenes: dict[places.Light, tuple[Any, float]] = {}
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    for index, shot in enumerate(place.shots):
        cam_from_world = look_at(shot)
        camera = sensor(intrinsics, cam_from_world, width, height)
        if shot.light not in scenes:
            scene = mi.load_dict({"type": "scene", "light": daylight(shot.light), **loaded})
            # The meter reads the first photo in each light; later ones keep its setting.
            glance = np.array(mi.render(scene, sensor=camera, integrator=integrator, spp=4, seed=seed))[
                ..., :3
            ]
            scenes[shot.light] = scene, 0.17 / float(np.median(glance.mean(-1)))
        scene, exposure = scenes[shot.light]
        radiance = np.array(
            mi.render(scene, sensor=camera, integrator=integrator, spp=spp, seed=seed + index)
        )
        origin, directions = pixel_rays(intrinsics, cam_from_world, pixels)
        distance = cast(scene, origin, directions)
        depth = np.where(np.isfinite(distance), distance * (directions @ cam_from_world[2, :3]), 0.0)
        image = develop(rng, radiance[..., :3], exposure, shot)
        yield Photo(image, intrinsics, cam_from_world, depth.reshape(height, width).astype(np.float32))


def surface_points(
    photos: list[Photo], per_photo: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]]:
    """Points (3,), colours (3,), tracks {photo: pixel (2,)} of random pixels seen in at least three photos.

    A photo sees a point if its depth map holds the point's depth to 1 % at the four pixels around, which
    leaves out the rims of things.
    """
    rng = np.random.default_rng(seed)
    found = []
    for photo in photos:
        height, width = photo.depth.shape
        for column, row in zip(
            rng.integers(width, size=per_photo), rng.integers(height, size=per_photo), strict=True
        ):
            depth = float(photo.depth[row, column])
            if depth == 0.0:
                continue
            rotation, shift = photo.cam_from_world[:, :3], photo.cam_from_world[:, 3]
            ray = np.linalg.inv(photo.intrinsics) @ [column + 0.5, row + 0.5, 1.0]
            point = rotation.T @ (depth * ray - shift)
            track = {}
            for index, other in enumerate(photos):
                seen = other.intrinsics @ (other.cam_from_world[:, :3] @ point + other.cam_from_world[:, 3])
                x, y = seen[:2] / seen[2]
                if seen[2] < 0.1 or not (1.0 < x < width - 1.0 and 1.0 < y < height - 1.0):
                    continue
                left, top = int(x - 0.5), int(y - 0.5)
                around = other.depth[top : top + 2, left : left + 2]
                if np.all(np.abs(around - seen[2]) < 0.01 * seen[2]):
                    track[index] = np.array([x, y])
            if len(track) >= 3:
                found.append((point, photo.image[row, column], track))
    return found


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (3, 3), as Bar-Itzhack's eigenvector."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return q if q[0] >= 0.0 else -q


def write_model(folder: Path, names: list[str], photos: list[Photo], per_photo: int = 80) -> None:
    """Write the COLMAP text model of the exact cameras and some exact points."""
    height, width = photos[0].depth.shape
    k = photos[0].intrinsics
    (folder / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 PINHOLE {width} {height} {k[0, 0]:.17g} {k[1, 1]:.17g} {k[0, 2]:.17g} {k[1, 2]:.17g}\n"
    )
    seen: list[list[str]] = [[] for _ in photos]
    point_lines = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    for number, (point, rgb, track) in enumerate(surface_points(photos, per_photo, seed=0), 1):
        views = []
        for index, (x, y) in track.items():
            views.append(f"{index + 1} {len(seen[index])}")
            seen[index].append(f"{x:.6f} {y:.6f} {number}")
        x, y, z = point
        point_lines.append(f"{number} {x:.9f} {y:.9f} {z:.9f} {rgb[0]} {rgb[1]} {rgb[2]} 0 {' '.join(views)}")
    (folder / "points3D.txt").write_text("\n".join(point_lines) + "\n")
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for index, (name, photo) in enumerate(zip(names, photos, strict=True)):
        pose = [*quaternion(photo.cam_from_world[:, :3]), *photo.cam_from_world[:, 3]]
        lines += [f"{index + 1} {' '.join(f'{v:.17g}' for v in pose)} 1 {name}", " ".join(seen[index])]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def save_photo(path: Path, image: np.ndarray, quality: int) -> None:
    """Write a JPEG with the EXIF data a camera would leave."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "corrsfm", "rendered pinhole camera"
    exif.get_ifd(0x8769)[0xA405] = int(FOCAL_35MM)
    Image.fromarray(image).save(path, quality=quality, exif=exif)


def contact_sheet(photos: list[Photo], columns: int = 4) -> np.ndarray:
    """All photos at half size side by side, to look at."""
    halves = [cv2.resize(photo.image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for photo in photos]
    halves += [np.zeros_like(halves[0])] * (-len(halves) % columns)
    return np.vstack([np.hstack(halves[i : i + columns]) for i in range(0, len(halves), columns)])


def cli() -> None:
    """Parse the command line and render."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("place", choices=("courtyard", "colonnade", "random"))
    parser.add_argument(
        "--output", type=Path, required=True, help="folder for images/ and the COLMAP text model"
    )
    parser.add_argument(
        "--width", type=int, default=640, help="picture width in pixels; the height is 3/4 of it"
    )
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel; fewer is faster and noisier")
    parser.add_argument("--quality", type=int, default=88, help="JPEG quality")
    parser.add_argument("--seed", type=int, default=0, help="which random place")
    parser.add_argument("--num-photos", type=int, default=8, help="photos of a random place")
    parser.add_argument(
        "--variant", default="llvm_ad_rgb", help="Mitsuba variant: llvm_ad_rgb or cuda_ad_rgb"
    )
    parser.add_argument("--sheet", type=Path, help="also write a contact sheet here (PNG)")
    parser.add_argument("--every", type=int, default=1, help="take only every n-th photo, for a quick look")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    makers = {"courtyard": places.courtyard, "colonnade": places.colonnade}
    place = (
        makers[options.place]()
        if options.place in makers
        else places.random_place(options.seed, options.num_photos)
    )
    place.shots = place.shots[:: options.every]
    (options.output / "images").mkdir(parents=True, exist_ok=True)
    names, photos = [], []
    for index, photo in enumerate(photograph(place, options.width, options.width * 3 // 4, options.spp)):
        names.append(f"{options.place}_{index + 1:02d}.jpg")
        photos.append(photo)
        save_photo(options.output / "images" / names[-1], photo.image, options.quality)
        print(f"{names[-1]}: {index + 1} of {len(place.shots)}", flush=True)
    write_model(options.output, names, photos)
    if options.sheet:
        cv2.imwrite(str(options.sheet), contact_sheet(photos)[..., ::-1])


if __name__ == "__main__":
    cli()
