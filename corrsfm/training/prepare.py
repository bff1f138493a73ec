"""Photo scenes with cameras → labelled pairs.

A scene is a folder with ``images/`` and a COLMAP model (`corrsfm.colmap.models.find_model` says where), or
the workspace of a reconstruction, which remembers where its photos are. The pairs come from
``covisibility.txt`` (``name0 name1 count``) if there is one, else from the model's points. Features and
matches are those of the stages that inference runs.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap, normalise_by_pinhole, normalise_points
from corrsfm.colmap.models import find_model, poses_of, read_model
from corrsfm.config import FeaturesConfig
from corrsfm.errors import ConfigError, ImageError, InputError, WorkspaceError, first_few
from corrsfm.features import create_extractor, reads_colour
from corrsfm.files import read_text
from corrsfm.geometry import camera_centre
from corrsfm.images.photos import read_colour, read_image
from corrsfm.labelled.compact import NO_NEIGHBOUR, CompactScene, write_scenes
from corrsfm.labelled.oanet import write_pairs
from corrsfm.matches.nearest import match_features
from corrsfm.training.config import PrepareConfig
from corrsfm.types import Camera
from corrsfm.workspace import Workspace

if TYPE_CHECKING:
    import pycolmap

__all__ = [
    "choose_pairs",
    "prepare_file",
    "prepare_oanet",
    "prepare_scene",
    "read_splits",
    "scenes_of_split",
]

# Fewer matches than this determine no essential matrix and teach nothing.
_MIN_KEYPOINTS = 20


@dataclass(frozen=True)
class _SceneModel:
    """What a reconstruction knows about the photos of a scene, sorted by name."""

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    covisible: dict[tuple[int, int], int]


def read_splits(path: Path) -> dict[str, list[str]]:
    """Read scene names by split from JSON and check that no scene is in two splits.

    Raises
    ------
    InputError
        If the file is not such a list or names a scene twice.
    """
    try:
        splits = json.loads(read_text(Path(path)))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON of scene names by split ({error})") from error
    if not isinstance(splits, dict) or not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in splits.values()
    ):
        raise InputError(f"{path}: expected an object with a list of scene names for each split")
    repeated = [
        name for name, count in Counter(n for names in splits.values() for n in names).items() if count > 1
    ]
    if repeated:
        raise InputError(f"{path}: scenes named more than once: {', '.join(sorted(repeated))}")
    return splits


def choose_pairs(covisible: dict[tuple[int, int], int], max_pairs: int, seed: int) -> list[tuple[int, int]]:
    """Choose pairs with a spread of difficulty: equally many from each tenth of the covisibility counts.

    Parameters
    ----------
    covisible : dict
        Shared points by photo indices.
    max_pairs : int
        Largest number of pairs; 0 takes all.
    seed : int

    Returns
    -------
    list of tuple of int
        Sorted.
    """
    ranked = sorted(covisible, key=lambda pair: (covisible[pair], pair))
    if max_pairs == 0 or len(ranked) <= max_pairs:
        return sorted(ranked)
    rng = np.random.default_rng(seed)
    # One pair from each of `max_pairs` equal stretches of the ranking.
    edges = np.linspace(0, len(ranked), max_pairs + 1)
    chosen = [
        ranked[rng.integers(int(low), max(int(high), int(low) + 1))]
        for low, high in zip(edges, edges[1:], strict=False)
    ]
    return sorted(set(chosen))


def scenes_of_split(folder: Path, splits: Path, split: str) -> list[Path]:
    """Folders of the scenes of one split.

    Raises
    ------
    InputError
        If the file has no such split, or a scene of it is not there.
    """
    names = read_splits(splits)
    if split not in names:
        raise InputError(f"{splits}: has no split '{split}', only {', '.join(names)}")
    folders = [Path(folder) / name for name in names[split]]
    if missing := [path.name for path in folders if not _is_folder(path)]:
        raise InputError(f"{splits}: names scenes that are not in {folder}: {first_few(missing)}")
    return folders


def _is_folder(path: Path) -> bool:
    """Whether a folder is there; False also for names that no file can have."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def prepare_file(output: Path, scenes: Iterable[Path], config: PrepareConfig) -> list[tuple[str, int]]:
    """Prepare scenes into one compact file; returns each scene's name and number of pairs."""
    done: list[tuple[str, int]] = []
    write_scenes(output, _prepared(scenes, config, done))
    return done


def prepare_oanet(output: Path, scenes: Iterable[Path], config: PrepareConfig) -> list[tuple[str, int]]:
    """Prepare scenes into one file in OANet's layout; returns each scene's name and number of pairs.

    Raises
    ------
    ConfigError
        If negatives are wanted: the layout cannot mark them.
    """
    if config.negatives:
        raise ConfigError("negatives: OANet's layout cannot mark them; use --layout compact")
    done: list[tuple[str, int]] = []
    prepared = _prepared(scenes, config, done)
    write_pairs(output, (scene.pair(index) for scene in prepared for index in range(len(scene.pairs))))
    return done


def _prepared(
    scenes: Iterable[Path], config: PrepareConfig, done: list[tuple[str, int]]
) -> Iterator[CompactScene]:
    """Prepare scenes one by one, and note each in ``done``."""
    for folder in scenes:
        scene = prepare_scene(folder, config)
        if scene.name in [name for name, _ in done]:
            raise InputError(f"{folder}: a scene called {scene.name} is in this file already; name each once")
        done.append((scene.name, len(scene.pairs)))
        yield scene


def prepare_scene(folder: Path, config: PrepareConfig) -> CompactScene:
    """Make features, matches and ground truth of one scene.

    Raises
    ------
    InputError
        If the folder holds no model, or no photos overlap.
    """
    folder = Path(folder)
    model = _thinned(_read_model(folder), config.max_photos_per_scene, config.seed)
    images = _images_folder(folder)
    extract = create_extractor(
        FeaturesConfig(
            extractor=config.extractor,
            max_features=config.max_features,
            max_image_size=config.max_image_size,
        )
    )
    read = read_colour if reads_colour(config.extractor) else read_image
    features = [
        extract(_check_size(images / name, read(images / name), camera), None)
        for name, camera in zip(model.names, model.cameras, strict=True)
    ]
    if any(len(each) > NO_NEIGHBOUR for each in features):
        raise InputError(
            f"{folder}: a photo has more than {NO_NEIGHBOUR:,} features, too many for a file of pairs; "
            f"try: --max-features {NO_NEIGHBOUR}"
        )
    matchable = [index for index, each in enumerate(features) if len(each) >= _MIN_KEYPOINTS]
    counts = {pair: model.covisible.get(pair, 0) for pair in combinations(matchable, 2)}
    usable = {
        pair: count
        for pair, count in counts.items()
        if count >= config.min_covisible and _are_apart(model, *pair)
    }
    if not usable:
        raise InputError(
            f"{folder}: no two photos from different places share {config.min_covisible} points; "
            "give more photos"
        )
    pairs = choose_pairs(usable, config.max_pairs_per_scene, config.seed)
    if config.negatives:
        unrelated = {pair: 0 for pair, count in counts.items() if count == 0}
        pairs = sorted(pairs + choose_pairs(unrelated, config.negatives, config.seed))
    neighbours, ratios, mutual = [], [], []
    for index0, index1 in pairs:
        matches = match_features(features[index0].descriptors, features[index1].descriptors)
        row = np.full(len(features[index0]), NO_NEIGHBOUR, np.uint16)
        row[matches.indices[:, 0]] = matches.indices[:, 1]
        ratio, both = np.ones(len(row), np.float32), np.zeros(len(row), bool)
        ratio[matches.indices[:, 0]], both[matches.indices[:, 0]] = matches.ratios, matches.mutual
        neighbours.append(row)
        ratios.append(ratio)
        mutual.append(both)
    corrections = [
        _corrections(camera, each.keypoints) for camera, each in zip(model.cameras, features, strict=True)
    ]
    return CompactScene(
        name=folder.name,
        image_names=model.names,
        cameras=model.cameras,
        rotations=model.rotations,
        translations=model.translations,
        keypoint_offsets=_offsets(features),
        keypoints=np.concatenate([each.keypoints for each in features]),
        corrections=np.concatenate(corrections),
        log_scales=np.log(np.concatenate([_or_nan(each.scales, len(each)) for each in features])),
        orientations=np.concatenate([_or_nan(each.orientations, len(each)) for each in features]),
        pairs=np.array(pairs, np.int64),
        covisible=np.array([counts[pair] for pair in pairs], np.int64),
        match_offsets=_offsets(neighbours),
        neighbours=np.concatenate(neighbours),
        ratios=np.concatenate(ratios),
        mutual=np.concatenate(mutual),
    )


def _are_apart(model: _SceneModel, index0: int, index1: int) -> bool:
    """Whether two photos have an epipolar geometry: their centres are not one and the same."""
    centre0, centre1 = (
        camera_centre((model.rotations[index], model.translations[index])) for index in (index0, index1)
    )
    return not np.allclose(centre0, centre1, rtol=1e-9, atol=1e-9)


def _or_nan(values: NDArray[np.float32] | None, num: int) -> NDArray[np.float32]:
    return np.full(num, np.nan, np.float32) if values is None else values


def _thinned(model: _SceneModel, max_photos: int, seed: int) -> _SceneModel:
    """The model with photos drawn at random."""
    if max_photos == 0 or len(model.names) <= max_photos:
        return model
    chosen = np.sort(np.random.default_rng(seed).choice(len(model.names), max_photos, replace=False))
    number = {int(old): new for new, old in enumerate(chosen)}
    return _SceneModel(
        names=tuple(model.names[index] for index in chosen),
        cameras=tuple(model.cameras[index] for index in chosen),
        rotations=model.rotations[chosen],
        translations=model.translations[chosen],
        covisible={
            (number[index0], number[index1]): count
            for (index0, index1), count in model.covisible.items()
            if index0 in number and index1 in number
        },
    )


def _offsets(parts: list) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def _images_folder(folder: Path) -> Path:
    """Folder with the photos of a scene."""
    if (folder / "images").is_dir():
        return folder / "images"
    try:
        return Workspace(folder).images_dir
    except WorkspaceError as error:
        raise InputError(f"{folder}: has no images/ and is not the workspace of a reconstruction") from error


def _check_size(path: Path, image: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """The photo, if it is as large as its camera says."""
    if image.shape[:2] != (camera.height, camera.width):
        raise ImageError(
            f"{path}: is {image.shape[1]} × {image.shape[0]} pixels, "
            f"its camera says {camera.width} × {camera.height}"
        )
    return image


def _corrections(camera: Camera, keypoints: NDArray[np.float32]) -> NDArray[np.float32]:
    """Undistorted minus pinhole normalised coordinates (N, 2)."""
    # A model of strong distortion may have no ray for a corner of the photo. Such a point keeps its pinhole
    # ray; its label is then "far from the line", as it looks in inference too.
    corrections = normalise_points(camera, keypoints) - normalise_by_pinhole(camera, keypoints)
    return np.nan_to_num(corrections, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)


def _read_model(folder: Path) -> _SceneModel:
    path = find_model(folder)
    reconstruction = read_model(path)
    poses = poses_of(reconstruction)
    names = tuple(poses)
    images = {image.name: image for image in reconstruction.images.values()}
    try:
        known = {number: camera_from_pycolmap(camera) for number, camera in reconstruction.cameras.items()}
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    cameras = tuple(replace(known[images[name].camera_id], has_prior_focal_length=True) for name in names)
    return _SceneModel(
        names=names,
        cameras=cameras,
        rotations=np.array([rotation for rotation, _ in poses.values()]).reshape(-1, 3, 3),
        translations=np.array([translation for _, translation in poses.values()]).reshape(-1, 3),
        covisible=_covisible(folder / "covisibility.txt", names, reconstruction),
    )


def _covisible(
    path: Path, names: tuple[str, ...], reconstruction: pycolmap.Reconstruction
) -> dict[tuple[int, int], int]:
    """Shared points by photo indices, smaller index first."""
    number = {name: index for index, name in enumerate(names)}
    counts: Counter[tuple[int, int]] = Counter()
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            fields = line.rsplit(maxsplit=2)
            if not line.startswith("#") and len(fields) == 3 and fields[0] in number and fields[1] in number:
                index0, index1 = sorted((number[fields[0]], number[fields[1]]))
                counts[index0, index1] = int(fields[2])
        return dict(counts)
    for point in reconstruction.points3D.values():
        seen = sorted(
            {number[reconstruction.images[element.image_id].name] for element in point.track.elements}
        )
        counts.update(combinations(seen, 2))
    return dict(counts)
