"""A compact file of labelled pairs: keypoints once per photo, two bytes and a bit per match.

Tens of thousands of pairs fit in tens of MB, because a pair stores only the nearest neighbour of every
keypoint, the ratio and the mutual flag; everything else is derived from the photo. One HDF5 group per scene:

==================  ==================  ================================================================
dataset             shape, dtype        content
==================  ==================  ================================================================
image_names         (I,) str            posix paths relative to the scene's image folder
camera_models       (I,) str            COLMAP camera model
camera_params       (I, 12) float64     its parameters, padded with NaN
image_sizes         (I, 2) int32        width, height in pixels
rotations           (I, 3, 3) float64   cam_from_world
translations        (I, 3) float64      cam_from_world
keypoint_offsets    (I+1,) int64        rows of each photo in the next four
keypoints           (K, 2) uint16       pixels (COLMAP convention) in units of the longest side / 65535
corrections         (K, 2) float16      undistorted minus pinhole normalised coordinates
log_scales          (K,) float16        natural logarithm of the keypoint's scale in pixels; NaN for none
orientations        (K,) uint16         orientation in units of a turn / 65536; without meaning where
                                        log_scales is NaN
pairs               (P, 2) uint16       photo indices
covisible           (P,) int32          shared points of the reconstruction; 0 marks a negative: two places,
                                        all matches wrong
match_offsets       (P+1,) int64        rows of each pair in the next two
neighbours          (M,) uint16         for each keypoint of image 0 its nearest in image 1; 65535 for none
ratios              (M,) uint8          ratio of the two nearest descriptor distances in units of 1/255
mutual              (⌈M/8⌉,) uint8      mutual flags, packed bits
==================  ==================  ================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.cameras import normalise_by_pinhole
from corrsfm.errors import InputError
from corrsfm.geometry import essential_from_pose, relative_pose, symmetric_epipolar_distance_sq, wrap_angles
from corrsfm.hdf5 import lies_elsewhere
from corrsfm.labelled.oanet import OANetPair, new_pairs_file, open_pairs, select_per_scene
from corrsfm.types import Camera

__all__ = [
    "NO_NEIGHBOUR",
    "RATIO_STEPS",
    "CompactScene",
    "is_compact",
    "lacks_shapes",
    "quantise_ratios",
    "read_labelled_pairs",
    "read_scenes",
    "write_scenes",
]

NO_NEIGHBOUR = 65535
"""Marks a keypoint without a match, so a photo has at most as many keypoints."""
RATIO_STEPS = 255.0
"""A stored ratio of 1."""
_LARGEST_SCENE_BYTES = 1 << 33
_FORMAT, _VERSION = "corrsfm-pairs", 1
_NUM_PARAMS = 12


@dataclass(frozen=True, kw_only=True)
class CompactScene:
    """The labelled pairs of one scene, with the quantised values decoded.

    I photos, K keypoints, P pairs, M matches.

    Attributes
    ----------
    name : str
    image_names : tuple of str
    cameras : tuple of Camera
        With the full distortion model of the reconstruction.
    rotations : (I, 3, 3) float64
    translations : (I, 3) float64
        cam_from_world, in the units of the scene.
    keypoint_offsets : (I+1,) int64
    keypoints : (K, 2) float32
        Pixels, COLMAP convention.
    corrections : (K, 2) float32
        Undistorted minus pinhole normalised coordinates.
    log_scales : (K,) float32
        NaN for features without scale and orientation.
    orientations : (K,) float32
        Radians in [-π, π); NaN likewise.
    pairs : (P, 2) int64
    covisible : (P,) int64
    match_offsets : (P+1,) int64
    neighbours : (M,) uint16
    ratios : (M,) float32
    mutual : (M,) bool
    """

    name: str
    image_names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    keypoint_offsets: NDArray[np.int64]
    keypoints: NDArray[np.float32]
    corrections: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    orientations: NDArray[np.float32]
    pairs: NDArray[np.int64]
    covisible: NDArray[np.int64]
    match_offsets: NDArray[np.int64]
    neighbours: NDArray[np.uint16]
    ratios: NDArray[np.float32]
    mutual: NDArray[np.bool_]

    def normalised(self, image: int, *, undistorted: bool) -> NDArray[np.float64]:
        """Normalised keypoints (N, 2) of one photo, by the pinhole part of its camera or the full model."""
        rows = slice(*self.keypoint_offsets[image : image + 2])
        points = normalise_by_pinhole(self.cameras[image], self.keypoints[rows])
        return points + self.corrections[rows] if undistorted else points

    def matched(
        self, index: int, *, only_mutual: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Keypoint indices of the matches of a pair, or of the mutual ones, within photo 0 and photo 1."""
        rows = slice(*self.match_offsets[index : index + 2])
        neighbours, mutual = self.neighbours[rows], self.mutual[rows]
        found = np.flatnonzero((neighbours != NO_NEIGHBOUR) & (mutual | (not only_mutual)))
        return found, neighbours[found].astype(np.int64)

    def pair(self, index: int) -> OANetPair:
        """One pair with its label distances.

        The correspondences are normalised by the pinhole part of the cameras, as a user would know them; the
        distances to the true epipolar lines use the full model. Those of a negative are infinite.
        """
        image0, image1 = (int(image) for image in self.pairs[index])
        index0, index1 = self.matched(index)
        rows = self.match_offsets[index] + index0
        rotation, translation = relative_pose(
            self.rotations[image0],
            self.translations[image0],
            self.rotations[image1],
            self.translations[image1],
        )
        true, known = (
            np.hstack(
                [
                    self.normalised(image0, undistorted=undistorted)[index0],
                    self.normalised(image1, undistorted=undistorted)[index1],
                ]
            )
            for undistorted in (True, False)
        )
        key0, key1 = self.keypoint_offsets[image0] + index0, self.keypoint_offsets[image1] + index1
        turn = self.orientations[key1] - self.orientations[key0]
        distances = symmetric_epipolar_distance_sq(essential_from_pose(rotation, translation), true)
        if self.covisible[index] == 0:
            distances = np.full_like(distances, np.inf)
        return OANetPair(
            correspondences=known.astype(np.float32),
            label_distances=distances.astype(np.float32),
            rotation=rotation,
            translation=translation / max(float(np.linalg.norm(translation)), 1e-12),
            ratios=self.ratios[rows],
            mutual=self.mutual[rows],
            camera0=self.cameras[image0],
            camera1=self.cameras[image1],
            scene=self.name,
            log_scale_ratios=self.log_scales[key1] - self.log_scales[key0],
            rotations=wrap_angles(turn),
        )


def quantise_ratios(ratios: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Quantise ratios as they are stored, in units of 1 / `RATIO_STEPS`."""
    return np.round(np.clip(ratios, 0, 1) * RATIO_STEPS).astype(np.uint8)


def _encode(scene: CompactScene) -> dict[str, NDArray]:
    """Datasets of a scene as they are stored."""
    sizes = np.array([(camera.width, camera.height) for camera in scene.cameras], np.int32).reshape(-1, 2)
    params = np.full((len(scene.cameras), _NUM_PARAMS), np.nan)
    for row, camera in zip(params, scene.cameras, strict=True):
        row[: len(camera.params)] = camera.params
    longest = np.repeat(sizes.max(axis=1, initial=1), np.diff(scene.keypoint_offsets))
    turns = np.round(np.nan_to_num(scene.orientations) / (2.0 * np.pi) * 65536.0).astype(np.int64)
    return {
        "image_sizes": sizes,
        "camera_params": params,
        "rotations": scene.rotations,
        "translations": scene.translations,
        "keypoint_offsets": scene.keypoint_offsets,
        "keypoints": np.round(np.clip(scene.keypoints / longest[:, None], 0, 1) * 65535.0).astype(np.uint16),
        "corrections": scene.corrections.astype(np.float16),
        "log_scales": scene.log_scales.astype(np.float16),
        "orientations": (turns % 65536).astype(np.uint16),
        "pairs": scene.pairs.astype(np.uint16),
        "covisible": scene.covisible.astype(np.int32),
        "match_offsets": scene.match_offsets,
        "neighbours": scene.neighbours,
        "ratios": quantise_ratios(scene.ratios),
        "mutual": np.packbits(scene.mutual),
    }


def write_scenes(path: Path, scenes: Iterable[CompactScene]) -> int:
    """Write scenes to one file, whole or not at all.

    Returns
    -------
    int
        The number of pairs written.
    """
    num_pairs = 0
    with new_pairs_file(Path(path)) as file:
        file.attrs["format"], file.attrs["version"] = _FORMAT, _VERSION
        for scene in scenes:
            group = file.create_group(scene.name)
            group["image_names"] = np.array(scene.image_names, dtype=h5py.string_dtype())
            models = [camera.model for camera in scene.cameras]
            group["camera_models"] = np.array(models, dtype=h5py.string_dtype())
            for name, values in _encode(scene).items():
                compress = {"compression": "gzip", "shuffle": True} if values.size > 64 else {}
                group.create_dataset(name, data=values, **compress)
            num_pairs += len(scene.pairs)
    return num_pairs


def _decode(name: str, group: h5py.Group) -> CompactScene:
    stored = {key: group[key][()] for key in group if key not in ("image_names", "camera_models")}
    for key in ("pairs", "covisible", "keypoint_offsets", "match_offsets", "neighbours"):
        if not np.issubdtype(stored[key].dtype, np.integer):
            raise ValueError(f"{key} holds {stored[key].dtype}, expected whole numbers")
    sizes, offsets = stored["image_sizes"], stored["keypoint_offsets"]
    cameras = tuple(
        Camera(
            model=model,
            width=int(size[0]),
            height=int(size[1]),
            params=tuple(float(value) for value in params[~np.isnan(params)]),
            has_prior_focal_length=True,
        )
        for model, size, params in zip(
            group["camera_models"].asstr()[()], sizes, stored["camera_params"], strict=True
        )
    )
    longest = np.repeat(sizes.max(axis=1, initial=1), np.diff(offsets))
    num_matches = len(stored["neighbours"])
    if len(stored["mutual"]) != -(-num_matches // 8):
        raise ValueError("mutual has not one flag a match")
    log_scales = stored["log_scales"].astype(np.float32)
    # The cast to a signed integer puts the angle in [-π, π).
    angles = (stored["orientations"].astype(np.int16) * (2.0 * np.pi / 65536.0)).astype(np.float32)
    return CompactScene(
        name=name,
        image_names=tuple(group["image_names"].asstr()[()]),
        cameras=cameras,
        rotations=stored["rotations"],
        translations=stored["translations"],
        keypoint_offsets=offsets,
        keypoints=(stored["keypoints"] * (longest[:, None] / 65535.0)).astype(np.float32),
        corrections=stored["corrections"].astype(np.float32),
        log_scales=log_scales,
        orientations=np.where(np.isnan(log_scales), np.float32(np.nan), angles),
        pairs=stored["pairs"].astype(np.int64),
        covisible=stored["covisible"].astype(np.int64),
        match_offsets=stored["match_offsets"],
        neighbours=stored["neighbours"],
        ratios=(stored["ratios"] / RATIO_STEPS).astype(np.float32),
        mutual=np.unpackbits(stored["mutual"], count=num_matches).astype(bool),
    )


def is_compact(path: Path) -> bool:
    """Whether a file is a compact pair file, of any version, rather than of another HDF5 layout."""
    with open_pairs(path) as file:
        return bool(file.attrs.get("format") == _FORMAT)


def lacks_shapes(path: Path) -> bool:
    """Whether the keypoints of a compact file have neither scale nor orientation, so are not SIFT's.

    False for other layouts, which do not tell.

    Raises
    ------
    InputError
        If the file is missing or its first scene damaged.
    """
    with open_pairs(path) as file:
        if file.attrs.get("format") != _FORMAT:
            return False
        return any(np.isnan(_read_scene(path, name, file).log_scales).any() for name in sorted(file)[:1])


def read_scenes(path: Path) -> list[CompactScene]:
    """Read all scenes of a file, sorted by name.

    Raises
    ------
    InputError
        If the file is missing or of another format.
    """
    with open_pairs(path) as file:
        if file.attrs.get("format") != _FORMAT or file.attrs.get("version") != _VERSION:
            raise InputError(
                f"{path}: not a compact pair file of version {_VERSION}; make one with: corrsfm train prepare"
            )
        return [_read_scene(path, name, file) for name in sorted(file)]


def _read_scene(path: Path, name: str, file: h5py.File) -> CompactScene:
    try:
        group = file[name]
        if not isinstance(group, h5py.Group):
            raise ValueError("is no scene")
        if outside := [key for key in group if lies_elsewhere(group[key])]:
            raise ValueError(f"the values of '{outside[0]}' lie in another file")
        if (num_bytes := sum(group[key].nbytes for key in group)) > _LARGEST_SCENE_BYTES:
            raise ValueError(f"declares {num_bytes / 1e9:,.0f} GB")
        scene = _decode(name, group)
        _check_numbers(scene)
    # Whatever damaged bytes or shapes lead to.
    except (InputError, ArithmeticError, AttributeError, LookupError, MemoryError, OSError, RuntimeError,
            TypeError, ValueError) as error:  # fmt: skip
        raise InputError(
            f"{path}: {name}: is damaged ({error}); make the file again with: corrsfm train prepare"
        ) from error
    return scene


def _check_numbers(scene: CompactScene) -> None:
    """Raise `ValueError` where arrays do not fit each other, so that nothing is looked up outside of them."""
    num_images, num_pairs = len(scene.image_names), len(scene.pairs)
    num_keypoints = np.diff(scene.keypoint_offsets)
    fits = (
        len(scene.cameras) == num_images
        and scene.rotations.shape == (num_images, 3, 3)
        and scene.translations.shape == (num_images, 3)
        and scene.pairs.shape == (num_pairs, 2)
        and scene.covisible.shape == (num_pairs,)
        and _are_offsets(scene.keypoint_offsets, num_images, len(scene.keypoints))
        and _are_offsets(scene.match_offsets, num_pairs, len(scene.neighbours))
        and len(scene.ratios) == len(scene.mutual) == len(scene.neighbours)
        and len(scene.corrections) == len(scene.log_scales) == len(scene.orientations) == len(scene.keypoints)
    )
    if not fits:
        raise ValueError("arrays do not fit each other")
    if not (np.isfinite(scene.rotations).all() and np.isfinite(scene.translations).all()):
        raise ValueError("a pose is not finite")
    if not np.allclose(scene.rotations @ scene.rotations.transpose(0, 2, 1), np.eye(3), atol=1e-3):
        raise ValueError("a rotation is none")
    if (scene.pairs[:, 0] == scene.pairs[:, 1]).any():
        raise ValueError("a photo is paired with itself")
    if not np.isfinite(scene.corrections).all() or np.isinf(scene.log_scales).any():
        raise ValueError("a correction or scale of a keypoint is not finite")
    if ((scene.pairs < 0) | (scene.pairs >= num_images)).any():
        raise ValueError("a pair names a photo that is not there")
    if (np.diff(scene.match_offsets) != num_keypoints[scene.pairs[:, 0]]).any():
        raise ValueError("a pair has not one neighbour a keypoint")
    partners = np.repeat(num_keypoints[scene.pairs[:, 1]], np.diff(scene.match_offsets))
    if ((scene.neighbours >= partners) & (scene.neighbours != NO_NEIGHBOUR)).any():
        raise ValueError("a neighbour is not there")


def _are_offsets(offsets: NDArray[np.integer], num: int, end: int) -> bool:
    return (
        offsets.shape == (num + 1,)
        and offsets[0] == 0
        and offsets[-1] == end
        and bool((np.diff(offsets) >= 0).all())
    )


def read_labelled_pairs(
    path: Path, *, num_per_scene: int | None = None, seed: int = 0
) -> Iterator[OANetPair]:
    """Read the pairs of a compact file one by one, but for the negatives, which have no pose to find.

    Parameters
    ----------
    path : Path
    num_per_scene : int, optional
        Random pairs to draw from each scene; all if not given.
    seed : int
        Seed of the draw.
    """
    for scene in read_scenes(path):
        related = np.flatnonzero(scene.covisible > 0)
        chosen: Iterable[int] = range(len(related))
        if num_per_scene is not None:
            chosen = select_per_scene([scene.name] * len(related), num_per_scene, seed)
        for index in chosen:
            yield scene.pair(int(related[index]))
