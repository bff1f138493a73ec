"""Readers that follow the reading rules of the tools we export to, written from their documentation.

Each says whose rules it follows; none uses corrsfm or pycolmap.
"""

from __future__ import annotations

import json
import sqlite3
import struct
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

MODEL_NAMES = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
)  # fmt: skip
NUM_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)
PAIR_BASE = 2**31 - 1


@dataclass
class View:
    """``x_in_cam = rotation · x + translation``; the camera as its tool knows it."""

    camera: tuple[str, int, int, NDArray[np.float64]]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    path: Path | None = None
    keypoints: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    point_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def project_pinhole(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        model, _, _, (fx, fy, cx, cy) = self.camera
        assert model == "PINHOLE"
        x = points @ self.rotation.T + self.translation
        return x[:, :2] / x[:, 2:] * [fx, fy] + [cx, cy]


def rotation_of(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a unit quaternion, scalar first."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Bytes:
    """Little-endian values one after the other."""

    def __init__(self, path: Path) -> None:
        self.content, self.at = path.read_bytes(), 0

    def take(self, kinds: str) -> tuple:
        values = struct.unpack_from("<" + kinds, self.content, self.at)
        self.at += struct.calcsize("<" + kinds)
        return values

    def text(self) -> str:
        end = self.content.index(b"\0", self.at)
        value, self.at = self.content[self.at : end].decode(), end + 1
        return value

    def is_done(self) -> bool:
        return self.at == len(self.content)


def read_colmap3_model(folder: Path) -> tuple[dict[str, View], dict[int, NDArray], dict[int, NDArray]]:
    """COLMAP 3.8's binary model: views by name, positions and colours of points by id."""
    assert sorted(path.name for path in folder.iterdir()) == ["cameras.bin", "images.bin", "points3D.bin"]
    cameras = {}
    stream = Bytes(folder / "cameras.bin")
    for _ in range(*stream.take("Q")):
        camera_id, model, width, height = stream.take("iiQQ")
        cameras[camera_id] = (
            MODEL_NAMES[model],
            width,
            height,
            np.array(stream.take(f"{NUM_PARAMS[model]}d")),
        )
    assert stream.is_done()
    views = {}
    stream = Bytes(folder / "images.bin")
    for _ in range(*stream.take("Q")):
        _, *pose, camera_id = stream.take("i7di")
        name = stream.text()
        (num,) = stream.take("Q")
        rows = np.array([stream.take("ddq") for _ in range(num)]).reshape(num, 3)
        views[name] = View(
            camera=cameras[camera_id],
            rotation=rotation_of(np.array(pose[:4])),
            translation=np.array(pose[4:]),
            keypoints=rows[:, :2],
            point_ids=rows[:, 2].astype(np.int64),
        )
    assert stream.is_done()
    positions, colours = {}, {}
    stream = Bytes(folder / "points3D.bin")
    for _ in range(*stream.take("Q")):
        point_id, x, y, z, red, green, blue, _, length = stream.take("Q3d3BdQ")
        positions[point_id], colours[point_id] = np.array([x, y, z]), np.array([red, green, blue])
        stream.take(f"{2 * length}i")
    assert stream.is_done()
    return views, positions, colours


def read_gaussian_splatting(folder: Path) -> tuple[dict[str, View], dict[int, NDArray]]:
    """graphdeco's gaussian-splatting: pinholes only, principal point ignored, photos by the last name."""
    views, positions, _ = read_colmap3_model(folder / "sparse" / "0")
    assert positions
    for name, view in views.items():
        model, width, height, _ = view.camera
        assert model in ("PINHOLE", "SIMPLE_PINHOLE"), model
        view.path = folder / "images" / name.rsplit("/", 1)[-1]
        photo = cv2.imread(str(view.path))
        assert photo is not None and photo.shape == (height, width, 3), view.path
    return views, positions


def read_gsplat(folder: Path) -> list[Path]:
    """gsplat: every file under ``images`` has its entry in the model, in order of names."""
    views, _, _ = read_colmap3_model(folder / "sparse" / "0")
    files = sorted(path.relative_to(folder / "images").as_posix() for path in folder.glob("images/**/*.*"))
    assert files == sorted(views)
    return [folder / "images" / name for name in sorted(views)]


@dataclass
class Nerfstudio:
    """What nerfstudio's dataparser takes from a ``transforms.json``, before it centres and scales."""

    camera_model: str
    paths: list[Path]
    camera_to_worlds: NDArray[np.float64]
    intrinsics: list[dict[str, float]]
    applied_transform: NDArray[np.float64]
    points: NDArray[np.float32]
    colours: NDArray[np.uint8]

    def original_poses(self) -> NDArray[np.float64]:
        """Camera-to-world (N, 4, 4), OpenGL's axes, in the world before ``applied_transform``."""
        inverse = np.linalg.inv(np.vstack([self.applied_transform, [0, 0, 0, 1]]))
        return inverse @ self.camera_to_worlds


def read_nerfstudio(folder: Path) -> Nerfstudio:
    """nerfstudio: frames sorted by path; intrinsics of each frame unless they stand at the top."""
    values = json.loads((folder / "transforms.json").read_text())
    assert values["camera_model"] in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")
    # At the top they would hide those of the frames.
    assert not {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2"} & values.keys()
    frames = sorted(values["frames"], key=lambda frame: folder / frame["file_path"])
    for frame in frames:
        assert {"fl_x", "fl_y", "cx", "cy", "w", "h"} <= frame.keys()
        photo = cv2.imread(str(folder / frame["file_path"]))
        assert photo is not None and photo.shape[:2] == (frame["h"], frame["w"])
    points, colours = read_ply(folder / values["ply_file_path"])
    return Nerfstudio(
        camera_model=values["camera_model"],
        paths=[folder / frame["file_path"] for frame in frames],
        camera_to_worlds=np.array([frame["transform_matrix"] for frame in frames]),
        intrinsics=frames,
        applied_transform=np.array(values["applied_transform"]),
        points=points,
        colours=colours,
    )


def read_ply(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Binary little-endian vertices with float positions and byte colours."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line.split()[1:] for line in lines if line.startswith("property")] == [
        *(["float", axis] for axis in "xyz"), *(["uchar", name] for name in ("red", "green", "blue")),
    ]  # fmt: skip
    num = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    rows = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    assert len(rows) == num
    return rows["xyz"], rows["rgb"]


def read_hloc(folder: Path) -> tuple[dict[str, NDArray], dict[tuple[str, str], NDArray]]:
    """hloc: keypoints in COLMAP's pixels (half a pixel added), and matches of every pair of the list."""
    pairs = [tuple(line.split()) for line in (folder / "pairs.txt").read_text().rstrip("\n").split("\n")]
    keypoints, matches = {}, {}
    with h5py.File(folder / "features.h5") as features, h5py.File(folder / "matches.h5") as file:
        for name in {name for pair in pairs for name in pair}:
            group = features[name]
            keypoints[name] = group["keypoints"][()].astype(np.float64) + 0.5
            assert group["descriptors"].shape == (128, len(keypoints[name]))
            assert group["scores"].shape == (len(keypoints[name]),) and group["image_size"].shape == (2,)
        for name0, name1 in pairs:
            group = file[f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"]
            matches0 = group["matches0"][()]
            assert matches0.shape == group["matching_scores0"].shape == (len(keypoints[name0]),)
            rows = np.flatnonzero(matches0 != -1)
            matches[name0, name1] = np.column_stack([rows, matches0[rows]])
    return keypoints, matches


def read_openmvs(folder: Path) -> tuple[dict[str, View], dict[int, NDArray]]:
    """OpenMVS's InterfaceCOLMAP: text, PINHOLE alone, names without spaces, points with tracks."""

    def lines(name: str) -> list[str]:
        text = (folder / "sparse" / name).read_text().rstrip("\n").split("\n")
        return [line for line in text if not line.startswith("#")]

    cameras = {}
    for line in lines("cameras.txt"):
        camera_id, model, width, height, *params = line.split()
        assert model == "PINHOLE" and len(params) == 4
        cameras[camera_id] = (model, int(width), int(height), np.array(params, float))
    views = {}
    rows = lines("images.txt")
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        _, *pose, camera_id, name = first.split()
        numbers = np.array(pose, float)
        observed = np.array(second.split(), float).reshape(-1, 3)
        views[name] = View(
            camera=cameras[camera_id],
            rotation=rotation_of(numbers[:4]),
            translation=numbers[4:],
            path=folder / "images" / name,
            keypoints=observed[:, :2],
            point_ids=observed[:, 2].astype(np.int64),
        )
    points = {}
    for line in lines("points3D.txt"):
        point_id, x, y, z, _, _, _, _, *track = line.split()
        assert track and len(track) % 2 == 0
        points[int(point_id)] = np.array([x, y, z], float)
    return views, points


@dataclass
class Tracks:
    """Cameras in a list and points with the places where each is seen, from the middle of the photo."""

    paths: list[Path]
    focals: list[float]
    rotations: list[NDArray[np.float64]]
    translations: list[NDArray[np.float64]]
    points: list[tuple[NDArray[np.float64], list[tuple[int, float, float]]]]


def read_bundler(folder: Path) -> Tracks:
    """Bundler 0.3: cameras look along −z, y is up."""
    paths = [folder / line for line in (folder / "list.txt").read_text().split()]
    first, counts, *rows = (folder / "bundle.out").read_text().splitlines()
    assert first == "# Bundle file v0.3"
    num_cameras, num_points = map(int, counts.split())
    assert num_cameras == len(paths) and len(rows) == 5 * num_cameras + 3 * num_points
    found = Tracks(paths=paths, focals=[], rotations=[], translations=[], points=[])
    for i in range(num_cameras):
        block = [np.array(row.split(), float) for row in rows[5 * i : 5 * i + 5]]
        assert list(block[0][1:]) == [0, 0]
        found.focals.append(block[0][0])
        found.rotations.append(np.array(block[1:4]))
        found.translations.append(block[4])
    for i in range(5 * num_cameras, len(rows), 3):
        num, *values = rows[i + 2].split()
        assert len(values) == 4 * int(num) and len(rows[i + 1].split()) == 3
        views = [(int(c), float(x), float(y)) for c, _, x, y in _by_four(values)]
        found.points.append((np.array(rows[i].split(), float), views))
    return found


def read_nvm(folder: Path) -> Tracks:
    """NVM 3: camera centres, y down, no distortion."""
    rows = [row for row in (folder / "model.nvm").read_text().splitlines() if row.strip()]
    assert rows[0] == "NVM_V3" and rows[-1] == "0"
    num_cameras = int(rows[1])
    found = Tracks(paths=[], focals=[], rotations=[], translations=[], points=[])
    for row in rows[2 : 2 + num_cameras]:
        name, *values = row.split()
        numbers = np.array(values, float)
        assert list(numbers[8:]) == [0, 0]
        rotation = rotation_of(numbers[1:5])
        found.paths.append(folder / name)
        found.focals.append(numbers[0])
        found.rotations.append(rotation)
        found.translations.append(-rotation @ numbers[5:8])
    assert int(rows[2 + num_cameras]) == len(rows) - num_cameras - 4
    for row in rows[3 + num_cameras : -1]:
        x, y, z, _, _, _, num, *values = row.split()
        assert len(values) == 4 * int(num)
        views = [(int(c), float(u), float(v)) for c, _, u, v in _by_four(values)]
        found.points.append((np.array([x, y, z], float), views))
    return found


def _by_four(values: list[str]) -> list[tuple[str, ...]]:
    return [tuple(values[i : i + 4]) for i in range(0, len(values), 4)]


@dataclass
class OldDatabase:
    """What COLMAP 3.8 takes from its database, by names."""

    cameras: dict[int, tuple[str, NDArray[np.float64]]]
    keypoints: dict[str, NDArray[np.float32]]
    descriptors: dict[str, NDArray[np.uint8]]
    priors: dict[str, tuple]
    matches: dict[tuple[str, str], NDArray[np.uint32]]
    inliers: dict[tuple[str, str], NDArray[np.uint32]]


def read_database_3_8(path: Path) -> OldDatabase:
    """COLMAP 3.8: columns in the order in which its statements bind them."""
    columns = {
        "cameras": "camera_id model width height params prior_focal_length",
        "images": "image_id name camera_id prior_qw prior_qx prior_qy prior_qz prior_tx prior_ty prior_tz",
        "keypoints": "image_id rows cols data",
        "descriptors": "image_id rows cols data",
        "matches": "pair_id rows cols data",
        "two_view_geometries": "pair_id rows cols data config F E H qvec tvec",
    }
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        assert tables - {"sqlite_sequence"} == columns.keys()
        for table, wanted in columns.items():
            assert [row[1] for row in connection.execute(f"PRAGMA table_info({table})")] == wanted.split()
        rows = {table: connection.execute(f"SELECT * FROM {table}").fetchall() for table in columns}
    finally:
        connection.close()
    names = {row[0]: row[1] for row in rows["images"]}

    def pair(pair_id: int) -> tuple[str, str]:
        return names[pair_id // PAIR_BASE], names[pair_id % PAIR_BASE]

    for row in rows["two_view_geometries"]:
        assert 2 <= row[4] <= 8 and all(len(blob or b"") in (0, 72) for blob in row[5:8])
    return OldDatabase(
        cameras={row[0]: (MODEL_NAMES[row[1]], np.frombuffer(row[4], "<f8")) for row in rows["cameras"]},
        keypoints={names[i]: np.frombuffer(b, "<f4").reshape(r, c) for i, r, c, b in rows["keypoints"]},
        descriptors={names[i]: np.frombuffer(b, "u1").reshape(r, c) for i, r, c, b in rows["descriptors"]},
        priors={row[1]: row[3:] for row in rows["images"]},
        matches={pair(i): np.frombuffer(b, "<u4").reshape(r, c) for i, r, c, b in rows["matches"]},
        inliers={
            pair(i): np.frombuffer(b, "<u4").reshape(r, c) for i, r, c, b, *_ in rows["two_view_geometries"]
        },
    )
