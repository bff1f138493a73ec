"""Labelled two-view pairs, and the HDF5 layout of OANet that the pruning literature exchanges them in.

The layout has one group per quantity with one dataset per pair, named by a running index::

    xs (1, N, 4)   x0 y0 x1 y1 normalised            Rs (3, 3), ts (3, 1)   cam1_from_cam0
    ys (N, 1)      squared symmetric epipolar        cx0 … : cx1s cy1s f1s of image 0 (called 1 there),
                   distance to the true geometry              cx2s cy2s f2s of image 1, in pixels
    ratios (N,), mutuals (N,)

Principal points there count from the centre of the first pixel, ours from its corner; this module converts.
``f`` is one focal length or two (x, y). Files written here have four more groups, which other readers ignore
and this one does not need: ``log_scale_ratios``, ``rotations`` (N,), ``sizes`` (2, 2) and the string
``scenes``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.cameras import pinhole_parameters
from corrsfm.disk import why_not
from corrsfm.errors import InputError, WorkspaceError
from corrsfm.files import atomic_path, require_file
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.hdf5 import lies_elsewhere, open_hdf5
from corrsfm.types import Camera, Correspondences

__all__ = [
    "OANetPair",
    "new_pairs_file",
    "open_pairs",
    "read_pairs",
    "select_per_scene",
    "write_pairs",
]

F = TypeVar("F", bound=np.floating)

_REQUIRED = ("xs", "ys", "Rs", "ts", "ratios", "mutuals", "cx1s", "cy1s", "cx2s", "cy2s", "f1s", "f2s")


@dataclass(frozen=True, kw_only=True)
class OANetPair:
    """Putative matches of two images and the true geometry between them; N may be 0.

    Attributes
    ----------
    correspondences : (N, 4) float32
        ``x0 y0 x1 y1``, normalised by the cameras below.
    label_distances : (N,) float32
        Squared symmetric epipolar distance to the true geometry, normalised units; see `inliers`.
    rotation : (3, 3) float64
        Of ``cam1_from_cam0``.
    translation : (3,) float64
        Of ``cam1_from_cam0``, any length.
    ratios : (N,) float32
        Distance ratio of the two nearest descriptors.
    mutual : (N,) bool
        Mutual nearest neighbours.
    log_scale_ratios : (N,) float32
        Logarithm of keypoint scale in image 1 over image 0; zeros if unknown.
    rotations : (N,) float32
        Keypoint orientation in image 1 minus image 0, radians; zeros if unknown.
    camera0, camera1 : Camera
        Cameras of any model. Their focal lengths and principal points normalise the coordinates; their
        distortion, if any, is still in them.
    scene : str
        Name of the place, "" if unknown.
    name : str
        Name of the pair for messages.
    """

    correspondences: NDArray[np.float32]
    label_distances: NDArray[np.float32]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    ratios: NDArray[np.float32]
    mutual: NDArray[np.bool_]
    log_scale_ratios: NDArray[np.float32]
    rotations: NDArray[np.float32]
    camera0: Camera
    camera1: Camera
    scene: str = ""
    name: str = ""

    def __post_init__(self) -> None:
        num = len(self.correspondences)
        expected = {
            "correspondences": (num, 4),
            "label_distances": (num,),
            "rotation": (3, 3),
            "translation": (3,),
            "ratios": (num,),
            "mutual": (num,),
            "log_scale_ratios": (num,),
            "rotations": (num,),
        }
        for field, shape in expected.items():
            if getattr(self, field).shape != shape:
                raise ValueError(f"{field}: expected shape {shape}, got {getattr(self, field).shape}")

    def __len__(self) -> int:
        return len(self.correspondences)

    def inliers(self, threshold: float = INLIER_THRESHOLD) -> NDArray[np.bool_]:
        """Matches (N,) whose label distance is below the threshold."""
        return self.label_distances < threshold

    def as_correspondences(self) -> Correspondences:
        """The same matches in the record that prune methods take, without the truth."""
        points = [
            _to_pixels(camera, self.correspondences[:, columns])
            for camera, columns in ((self.camera0, slice(0, 2)), (self.camera1, slice(2, 4)))
        ]
        return Correspondences(
            points0=points[0],
            points1=points[1],
            normalised=self.correspondences,
            ratios=self.ratios,
            mutual=self.mutual,
            log_scale_ratios=self.log_scale_ratios,
            rotations=self.rotations,
            shapes_known=not (len(self) and np.isnan(self.log_scale_ratios).all()),
            camera0=self.camera0,
            camera1=self.camera1,
            name=self.name,
        )


def _to_pixels(camera: Camera, normalised: NDArray[np.float32]) -> NDArray[np.float32]:
    fx, fy, cx, cy = pinhole_parameters(camera)
    return (normalised * np.array([fx, fy]) + np.array([cx, cy])).astype(np.float32)


@contextmanager
def open_pairs(path: Path) -> Iterator[h5py.File]:
    """Open a file of labelled pairs of either layout for reading.

    Raises
    ------
    InputError
        If it cannot be opened, or read inside the block.
    """
    require_file(path)
    try:
        with open_hdf5(path) as handle:
            yield handle
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError) as error:
        raise InputError(
            f"{path}: cannot be read as HDF5 ({error}); expected a file of labelled pairs, "
            "made with: corrsfm train prepare"
        ) from error


def _indices(handle: h5py.File, path: Path) -> list[str]:
    missing = [name for name in _REQUIRED if name not in handle]
    if missing:
        raise InputError(
            f"{path}: lacks the groups {', '.join(missing)} of OANet's layout; "
            "make such a file with: corrsfm train prepare"
        )
    # h5py lists names as text, "10" before "2"; pairs are numbered.
    return sorted(handle["xs"], key=lambda name: (len(name), name))


def _stored(handle: h5py.File, group: str, index: str) -> NDArray[Any]:
    """One quantity of a pair; raises `ValueError` if its values are not in this file."""
    dataset = handle[group][index]
    if lies_elsewhere(dataset):
        raise ValueError(f"the values of '{group}' lie in another file")
    return np.asarray(dataset)


def _camera(handle: h5py.File, index: str, image: int) -> Camera:
    """Camera of image 0 or 1, called 1 and 2 in the file."""
    focal = np.asarray(_stored(handle, f"f{image + 1}s", index), np.float64).ravel()
    centre = [float(_stored(handle, f"c{axis}{image + 1}s", index).ravel()[0]) for axis in "xy"]
    if "sizes" in handle and index in handle["sizes"]:
        width, height = (int(side) for side in _stored(handle, "sizes", index)[image])
    else:
        # The published layout has no size. A centred principal point gives it, and nothing that is
        # computed from a pinhole camera depends on it.
        width, height = (max(1, round(2.0 * c + 1.0)) for c in centre)
    return Camera(
        model="PINHOLE",
        width=width,
        height=height,
        params=(float(focal[0]), float(focal[-1]), centre[0] + 0.5, centre[1] + 0.5),
        has_prior_focal_length=True,
    )


def _scene(handle: h5py.File, index: str) -> str:
    if "scenes" not in handle or index not in handle["scenes"]:
        return ""
    if lies_elsewhere(dataset := handle["scenes"][index]):
        raise ValueError("the values of 'scenes' lie in another file")
    return str(dataset.asstr()[()])


def _read_pair(handle: h5py.File, index: str, path: Path) -> OANetPair:
    try:
        points = _finite(_stored(handle, "xs", index).astype(np.float32).reshape(-1, 4), "xs")

        def column(group: str) -> NDArray[Any]:
            if group not in handle or index not in handle[group]:
                return np.zeros(len(points), np.float32)
            values = _stored(handle, group, index)
            # Some published files keep two label distances per match; the epipolar one comes first.
            return values.reshape(len(points), -1)[:, 0] if len(points) else np.zeros(0, np.float32)

        return OANetPair(
            correspondences=points,
            label_distances=column("ys").astype(np.float32),
            rotation=_finite(_stored(handle, "Rs", index).astype(np.float64).reshape(3, 3), "Rs"),
            translation=_finite(_stored(handle, "ts", index).astype(np.float64).reshape(3), "ts"),
            ratios=column("ratios").astype(np.float32),
            mutual=column("mutuals") > 0.5,
            log_scale_ratios=column("log_scale_ratios").astype(np.float32),
            rotations=column("rotations").astype(np.float32),
            camera0=_camera(handle, index, 0),
            camera1=_camera(handle, index, 1),
            scene=_scene(handle, index),
            name=f"{path.name} pair {index}",
        )
    except (InputError, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: pair {index} is damaged or incomplete ({error})") from error


def _finite(values: NDArray[F], group: str) -> NDArray[F]:
    if not np.isfinite(values).all():
        raise ValueError(f"'{group}' holds what is not a finite number")
    return values


def read_pairs(path: Path, *, max_per_scene: int | None = None, seed: int = 0) -> Iterator[OANetPair]:
    """Read labelled pairs one by one.

    Parameters
    ----------
    path : Path
        File in OANet's layout.
    max_per_scene : int, optional
        Random pairs to read of each scene; all if not given. A file without scene names is one scene.
    seed : int
        Seed of that choice.

    Raises
    ------
    InputError
        If the file or a pair cannot be read.
    """
    with open_pairs(path) as handle:
        indices = _indices(handle, path)
        if max_per_scene is not None:
            scenes = [_scene(handle, index) for index in indices]
            indices = [indices[i] for i in select_per_scene(scenes, max_per_scene, seed)]
        for index in indices:
            yield _read_pair(handle, index, path)


def select_per_scene(scenes: list[str], max_per_scene: int, seed: int) -> list[int]:
    """Choose at most ``max_per_scene`` random entries of each scene; returns their indices, increasing.

    The choice for a scene depends only on its entries and the seed.
    """
    chosen: list[int] = []
    for scene in sorted(set(scenes)):
        members = np.array([i for i, name in enumerate(scenes) if name == scene])
        if len(members) > max_per_scene:
            generator = np.random.default_rng([seed, *scene.encode()])
            members = generator.choice(members, max_per_scene, replace=False)
        chosen.extend(int(i) for i in members)
    return sorted(chosen)


@contextmanager
def new_pairs_file(path: Path) -> Iterator[h5py.File]:
    """A file of labelled pairs to fill in; it is kept in memory, and replaced once it is whole.

    HDF5 itself ends the process, or says something else, where a disk takes no more.

    Raises
    ------
    WorkspaceError
        If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
            yield file
            file.flush()
            content = file.id.get_file_image()
        try:
            temporary.write_bytes(content)
        except OSError as error:
            raise WorkspaceError(why_not(error, path, "written")) from error


def write_pairs(path: Path, pairs: Iterable[OANetPair]) -> int:
    """Write labelled pairs in OANet's layout, which has no place for a camera's distortion.

    Parameters
    ----------
    path : Path
        Replaced when all pairs are written.
    pairs : iterable of OANetPair

    Returns
    -------
    int
        Number of pairs written.
    """
    count = 0
    with new_pairs_file(path) as handle:
        for name in (*_REQUIRED, "log_scale_ratios", "rotations", "sizes", "scenes"):
            handle.create_group(name)
        for count, pair in enumerate(pairs, start=1):
            _write_pair(handle, str(count - 1), pair)
    return count


def _write_pair(handle: h5py.File, index: str, pair: OANetPair) -> None:
    arrays: dict[str, Any] = {
        "xs": pair.correspondences[None],
        "ys": pair.label_distances[:, None].astype(np.float32),
        "Rs": pair.rotation,
        "ts": pair.translation[:, None],
        "ratios": pair.ratios,
        "mutuals": pair.mutual.astype(np.float32),
        "log_scale_ratios": pair.log_scale_ratios,
        "rotations": pair.rotations,
        "sizes": np.array([[c.width, c.height] for c in (pair.camera0, pair.camera1)], np.int32),
    }
    for number, camera in ((1, pair.camera0), (2, pair.camera1)):
        fx, fy, cx, cy = pinhole_parameters(camera)
        arrays |= {
            f"cx{number}s": np.float64(cx - 0.5),
            f"cy{number}s": np.float64(cy - 0.5),
            f"f{number}s": np.array([fx, fy]),
        }
    for name, values in arrays.items():
        handle[name].create_dataset(index, data=values)
    handle["scenes"].create_dataset(index, data=pair.scene, dtype=h5py.string_dtype())
