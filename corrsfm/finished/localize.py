"""Poses of photos that do not join a scene: found from its model, which is only read."""

from __future__ import annotations

import csv
import dataclasses
import io
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm import config as cfg
from corrsfm.colmap.cameras import camera_from_pycolmap, mean_focal_px, with_focal_length
from corrsfm.colmap.log import colmap_log
from corrsfm.errors import InputError
from corrsfm.features import create_extractor, reads_colour
from corrsfm.files import atomic_write_text
from corrsfm.finished.incoming import PhotoPaths, find_photos, refuse_imported, require_readable
from corrsfm.geometry import camera_centre
from corrsfm.images.cameras import PhotoInfo, assign_cameras
from corrsfm.images.photos import read_colour, read_image, read_photo_info
from corrsfm.machine import count_threads, find_device, use_threads
from corrsfm.matches import create_matcher
from corrsfm.pairs.strategies import pairs_of_new_photos
from corrsfm.prune import build_pruner, make_correspondences
from corrsfm.reconstruction.resection import (
    Landmarks,
    Resection,
    camera_in_model,
    find_sightings,
    focal_of_photos,
    resect,
)
from corrsfm.types import Camera, Features, Matches
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import traits_of
from corrsfm.workspace.lists import Index, read_index
from corrsfm.workspace.models import models_of
from corrsfm.workspace.stores import features_of

__all__ = ["CSV_COLUMNS", "LocalizeResult", "LocatedPhoto", "localize"]

logger = logging.getLogger("corrsfm")

CSV_COLUMNS = (
    "name", "model", "qw", "qx", "qy", "qz", "tx", "ty", "tz", "x", "y", "z", "focal_px", "num_inliers",
    "num_candidates", "median_error_px", "why_not",
)  # fmt: skip

# Features of a photo take half a megabyte.
_QUERIES_AT_A_TIME = 64

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class LocatedPhoto:
    """A photo and where it was taken.

    Attributes
    ----------
    name : str
        Its path.
    model : int or None
        Number of the model that its pose is in the frame of; None if it could not be located.
    quaternion : tuple of float or None
        Rotation ``cam_from_world`` as w, x, y, z.
    translation : tuple of float or None
        Of ``cam_from_world``, in units of the model.
    centre : tuple of float or None
        Of the camera, in the frame and units of the model.
    camera : Camera
        That it was located with.
    num_matches : int
        Kept matches with photos of the model.
    num_candidates, num_inliers : int
        Points of the model that these lead to, and those that agree with the pose.
    median_error_px : float or None
        Reprojection error of the latter.
    why_not : str
        Why there is no pose; empty if there is one.
    """

    name: str
    model: int | None
    quaternion: tuple[float, float, float, float] | None
    translation: tuple[float, float, float] | None
    centre: tuple[float, float, float] | None
    camera: Camera
    num_matches: int
    num_candidates: int
    num_inliers: int
    median_error_px: float | None
    why_not: str = ""


@dataclass(frozen=True, kw_only=True)
class LocalizeResult:
    """The photos that were sought.

    Attributes
    ----------
    photos : tuple of LocatedPhoto
        Sorted by name.
    """

    photos: tuple[LocatedPhoto, ...]

    @property
    def num_located(self) -> int:
        """Photos with a pose."""
        return sum(photo.model is not None for photo in self.photos)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"num_located": self.num_located, "photos": [dataclasses.asdict(one) for one in self.photos]}

    def write_csv(self, path: Path) -> None:
        """Write a line a photo, with the columns `CSV_COLUMNS`; cells without a value are empty.

        Raises
        ------
        WorkspaceError
            If the file cannot be written.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        for photo in self.photos:
            nothing = (None,) * 3
            pose = (
                *(photo.quaternion or (None, *nothing)),
                *(photo.translation or nothing),
                *(photo.centre or nothing),
            )
            focal_px = mean_focal_px(photo.camera, photo.camera) if photo.model is not None else None
            writer.writerow(
                [
                    photo.name,
                    photo.model,
                    *pose,
                    focal_px,
                    photo.num_inliers,
                    photo.num_candidates,
                    photo.median_error_px,
                    photo.why_not,
                ]
            )
        atomic_write_text(path, text.getvalue())


def localize(
    workspace: Path | str,
    photos: PhotoPaths,
    *,
    camera_params: str = "",
    camera_model: str = "",
    run: cfg.RunConfig | None = None,
) -> LocalizeResult:
    """Find where photos were taken in a finished scene, which is only read.

    Parameters
    ----------
    workspace : path
    photos : path or sequence of paths
        Photos and folders of photos.
    camera_params : str
        Known intrinsics of all these photos, comma-separated in COLMAP's order. Without them the camera is
        that of the scene's photos of the same size and EXIF, if those share one; else the focal length is
        that of EXIF, or is found with the pose.
    camera_model : str
        Of ``camera_params``; that of the scene if empty.
    run : RunConfig, optional

    Returns
    -------
    LocalizeResult

    Raises
    ------
    InputError
        If a photo cannot be read.
    WorkspaceError
        If the scene has no current model, or another process works there.
    """
    scene, run = Workspace(Path(workspace)), run or cfg.RunConfig()
    with scene.reading():
        refuse_imported(scene)
        scene.require("models")
        find_device(run.device)
        found = find_photos(photos, None)
        if not found:
            raise InputError(f"{scene.root}: no photos to locate were named")
        require_readable(found)
        located = []
        with _Locator(scene, camera_model, camera_params, run).ready() as locate:
            for start in range(0, len(found), _QUERIES_AT_A_TIME):
                block = found[start : start + _QUERIES_AT_A_TIME]
                located += locate([(photo.name, photo.path) for photo in block])
    return LocalizeResult(photos=tuple(located))


class _Locator:
    """Everything about a scene that locating photos needs."""

    def __init__(
        self, workspace: Workspace, camera_model: str, camera_params: str, run: cfg.RunConfig
    ) -> None:
        self._workspace = workspace
        self._index = read_index(workspace)
        self._models = models_of(workspace)
        self._landmarks = [Landmarks(model) for model in self._models]
        self._images = self._options("images", cfg.ImagesConfig)
        self._camera_model = camera_model or self._images.camera_model
        self._camera_params = camera_params
        self._run = run
        self._device = find_device(run.device)
        features = self._options("features", cfg.FeaturesConfig)
        self._extract = create_extractor(features, self._device)
        self._read = read_colour if reads_colour(features.extractor) else read_image
        self._prune = build_pruner(
            self._options("pruned matches", cfg.PruneConfig),
            traits=traits_of(workspace),
            device=self._device,
            seed=run.seed,
            threads=count_threads(run.threads),
        )

    def _options(self, stage: str, options: type[T]) -> T:
        where = f"{self._workspace.manifest}: {stage}"
        return cfg.from_dict(options, self._workspace.require(stage).config, where)

    @contextmanager
    def ready(self) -> Iterator[Callable[[Sequence[tuple[str, Path]]], list[LocatedPhoto]]]:
        """Open the features of the scene; yields what locates photos, given as names and paths."""
        use_threads(count_threads(self._run.threads))
        with features_of(self._workspace).reader() as read_features:
            yield lambda photos: self._locate(photos, read_features)

    def _locate(
        self, photos: Sequence[tuple[str, Path]], read_features: Callable[[str], Features]
    ) -> list[LocatedPhoto]:
        # No photo of a scene has a line break in its name.
        keys = [f"{name}\n" for name, _ in photos]
        with colmap_log():
            own = {
                key: self._extract(self._read(path), None)
                for key, (_, path) in zip(keys, photos, strict=True)
            }

        def load(name: str) -> Features:
            return own[name] if name in own else read_features(name)

        registered = sorted({name for landmarks in self._landmarks for name in landmarks.photos})
        pairs = pairs_of_new_photos(
            registered,
            keys,
            self._options("pairs", cfg.PairsConfig).num_retrieved,
            load_features=load,
            seed=self._run.seed,
        )
        partners: dict[str, list[str]] = {key: [] for key in keys}
        for pair in sorted(pairs):
            inside = [name for name in pair if name not in own]
            if len(inside) == 1:
                partners[pair[0] if pair[1] == inside[0] else pair[1]].append(inside[0])
        options, kind = self._options("matches", cfg.MatchesConfig), traits_of(self._workspace).features
        match = create_matcher(options, load, kind, device=self._device)
        located = []
        for key, (name, path) in zip(keys, photos, strict=True):
            info = read_photo_info(path)
            matches = self._matches(key, partners[key], match, load, self._proposed(info))
            located.append(self._best(name, own[key], info, matches))
        return located

    def _matches(
        self,
        key: str,
        partners: Sequence[str],
        match: Callable[[str, str], Matches],
        load: Callable[[str], Features],
        camera: Camera,
    ) -> dict[str, NDArray[np.int32]]:
        """Photo of the scene → kept matches, the keypoints of the new photo first."""
        cameras = {record.name: self._index.camera_of(record) for record in self._index.records}
        putative = [match(key, name) for name in partners]
        results = self._prune(
            [
                make_correspondences(load(key), load(name), matched, camera, cameras[name], name)
                for name, matched in zip(partners, putative, strict=True)
            ]
        )
        return {
            name: matched.indices[result.inlier_mask]
            for name, matched, result in zip(partners, putative, results, strict=True)
        }

    def _best(
        self, name: str, features: Features, info: PhotoInfo, matches: dict[str, NDArray[np.int32]]
    ) -> LocatedPhoto:
        """The pose in the first model that gives one; without any, what the first model says."""
        attempts = []
        for number, (model, landmarks) in enumerate(zip(self._models, self._landmarks, strict=True)):
            camera, focal_is_open = self._camera(info, model)
            found = resect(
                features.keypoints,
                find_sightings(matches, landmarks),
                landmarks,
                camera,
                focal_is_open=focal_is_open,
                seed=self._run.seed,
            )
            attempts.append((number, found))
            if found.pose is not None:
                return _located(name, number, found)
        return _located(name, *attempts[0])

    def _proposed(self, info: PhotoInfo) -> Camera:
        """What is known of a photo's camera without the model."""
        params = self._camera_params or self._images.camera_params
        known = {(camera.width, camera.height) for camera in self._index.cameras}
        if not self._camera_params and (info.width, info.height) not in known:
            params = ""
        (camera,), _ = assign_cameras(
            [""], [info], mode=cfg.CameraMode.PER_IMAGE, model=self._camera_model, params=params
        )
        return camera

    def _camera(self, info: PhotoInfo, model: pycolmap.Reconstruction) -> tuple[Camera, bool]:
        """The camera to locate a photo with, and whether its focal length is to be found."""
        proposed = self._proposed(info)
        if self._camera_params:
            return proposed, False
        companions = _companions(self._index, proposed, self._images.camera_mode)
        shared = camera_in_model(model, companions)
        if shared is not None:
            return camera_from_pycolmap(model.cameras[shared]), False
        if proposed.has_prior_focal_length:
            return proposed, False
        focal_px = focal_of_photos(model, companions)
        return proposed if focal_px is None else with_focal_length(proposed, focal_px), True


def _companions(index: Index, camera: Camera, mode: cfg.CameraMode) -> list[str]:
    """Photos of a scene that a camera could be that of, by the rule that grouped them."""
    if mode is cfg.CameraMode.PER_IMAGE:
        return []
    if mode is cfg.CameraMode.SINGLE:
        size = (camera.width, camera.height)
        return [r.name for r in index.records if _size(index.camera_of(r)) == size]
    return [record.name for record in index.records if index.camera_of(record) == camera]


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _located(name: str, number: int, found: Resection) -> LocatedPhoto:
    quaternion = translation = centre = None
    if found.pose is not None:
        rotation = pycolmap.Rotation3d(found.pose[0])
        x, y, z, w = (float(value) for value in rotation.quat)
        quaternion = (w, x, y, z)
        translation = _triple(found.pose[1])
        centre = _triple(camera_centre(found.pose))
    return LocatedPhoto(
        name=name,
        model=number if found.pose is not None else None,
        quaternion=quaternion,
        translation=translation,
        centre=centre,
        camera=found.camera,
        num_matches=found.num_matches,
        num_candidates=found.num_candidates,
        num_inliers=found.num_inliers,
        median_error_px=found.median_error_px if np.isfinite(found.median_error_px) else None,
        why_not=found.why_not,
    )


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
