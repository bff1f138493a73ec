"""Features and kept matches → a COLMAP database with verified two-view geometries.

Everything goes through pycolmap's API, so the schema is always the one that pycolmap expects. Verification
is `pycolmap.geometric_verification`, which estimates geometries from the stored matches; its neighbour
`verify_matches` would match descriptors again and bring dropped matches back.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap, to_pycolmap, write_camera
from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.sqlite import LOG_BYTES, copy_database, database_errors, id_of_pair, is_sqlite
from corrsfm.config import DatabaseConfig
from corrsfm.database.record import forget_pairs, image_ids, recorded_pairs, remember_pairs
from corrsfm.database.verification import (
    default_verification_error_px,
    verify_few_pairs,
    verify_pairs,
)
from corrsfm.disk import explain, require_room
from corrsfm.errors import DatabaseError, InputError
from corrsfm.files import atomic_path
from corrsfm.types import Camera, Features, ImageRecord, Pair, check_indices

__all__ = ["add_to_database", "update_database", "write_database"]

# Of the pairs; with more, writing all is as quick and leaves no gaps in the file.
MOST_CHANGED = 0.5


def write_database(
    path: Path,
    *,
    images: Sequence[ImageRecord],
    cameras: Sequence[Camera],
    features: Callable[[str], Features],
    kept: Iterable[tuple[str, str, NDArray[np.int32]]],
    config: DatabaseConfig,
    seed: int = 0,
    num_threads: int = 0,
    log_file: Path | None = None,
    before_changing: Callable[[], None] = lambda: None,
    base: str = "",
    fingerprints: Mapping[Pair, str] | None = None,
) -> None:
    """Write and verify a database; it appears at ``path`` whole or not at all.

    Parameters
    ----------
    path : Path
        An existing database there is replaced.
    images : sequence of ImageRecord
        Written in order of their names; positions from GPS become pose priors.
    cameras : sequence of Camera
        Indexed by the images' ``camera_id``.
    features : callable
        Image name → `Features`; called once for each.
    kept : iterable of (str, str, (K, 2) int32)
        Two image names and the indices of the kept matches; K may be 0, and the pair stays on record.
    config : DatabaseConfig
    seed : int
        Seed of the robust estimation.
    num_threads : int
        Threads of the verification, on which results do not depend; 0 for all cores.
    log_file : Path, optional
        Where pycolmap's messages are appended.
    before_changing : callable, optional
        Called when the new database is on the disk, before it takes the place of the old one.
    base, fingerprints : str and mapping, optional
        What `update_database` will compare with: a fingerprint of all that is the same for every pair, and
        of the kept matches of each.

    Raises
    ------
    InputError
        If a pair names an unknown photo, a photo twice or keypoints that do not exist, or occurs twice.
    DatabaseError
        If the database cannot be written, or the one to be replaced is in use.
    """
    _require_room_for_logs(path)
    _check_not_in_use(path)
    with _written_beside(path, before_changing) as temporary:
        with colmap_log(), database_errors(temporary, path):
            _fill(temporary, images, cameras, features, kept, config.write_descriptors)
        with colmap_log(log_file), database_errors(temporary, path):
            _verify(temporary, cameras, config, seed, num_threads)
        if fingerprints is not None:
            remember_pairs(temporary, base, fingerprints)


def update_database(
    path: Path,
    *,
    base: str,
    fingerprints: Mapping[Pair, str],
    kept: Callable[[Pair], NDArray[np.int32]],
    cameras: Sequence[Camera],
    config: DatabaseConfig,
    seed: int = 0,
    num_threads: int = 0,
    log_file: Path | None = None,
    before_changing: Callable[[], None] = lambda: None,
) -> int | None:
    """Write and verify the pairs of a database that changed, in place; it then equals one written anew.

    Killed on the way, the same call finishes it.

    Parameters
    ----------
    path : Path
    base, fingerprints
        As they would be given to `write_database`.
    kept : callable
        Pair → (K, 2) indices of its kept matches.
    cameras, config, seed, num_threads, log_file
        As for `write_database`.
    before_changing : callable, optional
        Called before the first change.

    Returns
    -------
    int or None
        Number of pairs that changed; None if the database has to be written anew: there is none, it was made
        from other photos or with other options, another program took photos away, or most of it changed.

    Raises
    ------
    InputError, DatabaseError
        As `write_database`.
    """
    if not path.is_file():
        return None
    _require_room_for_logs(path)
    _check_not_in_use(path)
    recorded = recorded_pairs(path, base)
    if not recorded:
        return None
    ids = image_ids(path)
    if not all(ids.keys() >= set(pair) for pair in fingerprints):
        return None
    wanted = {id_of_pair(ids[name0], ids[name1]): (name0, name1) for name0, name1 in fingerprints}
    changed = {number: pair for number, pair in wanted.items() if recorded.get(number) != fingerprints[pair]}
    if len(changed) > len(wanted) * MOST_CHANGED:
        return None
    before_changing()
    forget_pairs(path, (recorded.keys() - wanted.keys()) | changed.keys())
    if changed:
        with colmap_log(), database_errors(path), _transaction(path) as database:
            num_keypoints = {
                name: database.num_keypoints_for_image(ids[name])
                for pair in changed.values()
                for name in pair
            }
            _write_pairs(database, ids, num_keypoints, ((*pair, kept(pair)) for pair in changed.values()))
        with colmap_log(log_file), database_errors(path):
            _verify(path, cameras, config, seed, num_threads, few=changed)
        remember_pairs(path, base, {pair: fingerprints[pair] for pair in changed.values()})
    return len(changed)


def add_to_database(
    path: Path,
    *,
    images: Sequence[ImageRecord],
    cameras: Mapping[str, tuple[int, Camera]],
    features: Callable[[str], Features],
    kept: Iterable[tuple[str, str, NDArray[np.int32]]],
    config: DatabaseConfig,
    seed: int = 0,
    num_threads: int = 0,
    log_file: Path | None = None,
) -> None:
    """Add photos and pairs to a database and verify the pairs; what is there already stays as it is.

    Photos and pairs that the database holds are passed over, so doing it twice is doing it once.

    Parameters
    ----------
    path : Path
        Changed as a whole or not at all.
    images : sequence of ImageRecord
    cameras : mapping of str to (int, Camera)
        Photo → the id of its camera, and the camera to write if the database has none of this id.
    features, kept, config, seed, num_threads, log_file
        As for `write_database`.

    Raises
    ------
    InputError
        As `write_database`.
    DatabaseError
        If the database cannot be read or written, or is in use.
    """
    _require_room_for_logs(path)
    _check_not_in_use(path)
    with _written_beside(path) as temporary:
        copy_database(path, temporary)
        with colmap_log(), database_errors(temporary, path):
            all_cameras = _append(temporary, images, cameras, features, kept, config.write_descriptors)
        with colmap_log(log_file), database_errors(temporary, path):
            # Pairs that were verified before have a geometry, and those are passed over.
            _verify(temporary, all_cameras, config, seed, num_threads)


@contextlib.contextmanager
def _written_beside(path: Path, before_replacing: Callable[[], None] = lambda: None) -> Iterator[Path]:
    """Where a database is written that takes the place of another; no log of it stays, whatever happens."""
    with atomic_path(path, before_replacing=before_replacing) as temporary:
        logs = [temporary.with_name(temporary.name + suffix) for suffix in ("-wal", "-shm", "-journal")]
        try:
            for log in logs:
                log.unlink(missing_ok=True)
            yield temporary
        finally:
            for log in logs:
                log.unlink(missing_ok=True)


def _require_room_for_logs(path: Path) -> None:
    try:
        require_room(path.parent, LOG_BYTES)
    except OSError as error:
        raise DatabaseError(explain(error, path)) from error


def _verify(
    path: Path,
    cameras: Sequence[Camera],
    config: DatabaseConfig,
    seed: int,
    num_threads: int,
    *,
    few: Collection[int] | None = None,
) -> None:
    """Verify the pairs of a database that have no geometry yet, or only a few, by their ids."""
    max_error_px = config.verification_error_px or default_verification_error_px(cameras)
    settings = (config.min_num_inliers, max_error_px, seed, num_threads)
    if few is None:
        verify_pairs(path, *settings)
    else:
        verify_few_pairs(path, few, *settings)


@contextlib.contextmanager
def _transaction(path: Path) -> Iterator[pycolmap.Database]:
    """A database to write into; COLMAP's verification opens it again, so it is closed behind the block."""
    with pycolmap.Database.open(path) as database:
        transaction = pycolmap.DatabaseTransaction(database)
        try:
            yield database
        finally:
            # The transaction ends when its object goes; the database must be open then.
            del transaction


def _append(
    path: Path,
    images: Sequence[ImageRecord],
    cameras: Mapping[str, tuple[int, Camera]],
    features: Callable[[str], Features],
    kept: Iterable[tuple[str, str, NDArray[np.int32]]],
    write_descriptors: bool,
) -> list[Camera]:
    """Write what is new; all cameras."""
    with _transaction(path) as database:
        image_ids = {image.name: image.image_id for image in database.read_all_images()}
        for image in sorted(images, key=lambda image: image.name):
            if image.name in image_ids:
                continue
            camera_id, camera = cameras[image.name]
            if not database.exists_camera(camera_id):
                write_camera(database, to_pycolmap(camera, camera_id), keep_id=True)
            image_ids[image.name] = _write_image(database, image, camera_id)
            _write_features(
                database, image_ids[image.name], image.name, features(image.name), write_descriptors
            )
        num_keypoints = {
            name: database.num_keypoints_for_image(image_id) for name, image_id in image_ids.items()
        }
        _write_pairs(
            database,
            image_ids,
            num_keypoints,
            (
                (name0, name1, indices)
                for name0, name1, indices in kept
                if not database.exists_matches(image_ids[name0], image_ids[name1])
            ),
        )
        return [camera_from_pycolmap(camera) for camera in database.read_all_cameras()]


def _check_not_in_use(path: Path) -> None:
    """Refuse to replace a database that another process has open.

    Its write-ahead log would stay beside the new file, and SQLite would replay it there.
    """
    side_files = [path.with_name(path.name + suffix) for suffix in ("-wal", "-shm", "-journal")]
    if path.is_file() and not any(file.exists() for file in side_files):
        if path.stat().st_size and not is_sqlite(path):
            raise DatabaseError(f"{path}: is not a COLMAP database; move it away and try again")
        return
    if not path.exists():
        # Logs of a database that is gone are of no use to anybody, and SQLite would replay them.
        for file in side_files:
            file.unlink(missing_ok=True)
        return
    # Opening and closing merges the log of a killed process.
    with colmap_log(), database_errors(path):
        pycolmap.Database.open(path).close()
    if any(file.exists() for file in side_files):
        raise DatabaseError(
            f"{path}: is in use by another program; close it there (COLMAP, another corrsfm) and try again"
        )


def _fill(
    path: Path,
    images: Sequence[ImageRecord],
    cameras: Sequence[Camera],
    features: Callable[[str], Features],
    kept: Iterable[tuple[str, str, NDArray[np.int32]]],
    write_descriptors: bool,
) -> None:
    """Write all tables but the geometries."""
    with _transaction(path) as database:
        camera_ids = [write_camera(database, to_pycolmap(camera)) for camera in cameras]
        num_keypoints: dict[str, int] = {}
        image_ids: dict[str, int] = {}
        for image in sorted(images, key=lambda image: image.name):
            image_id = _write_image(database, image, camera_ids[image.camera_id])
            image_features = features(image.name)
            _write_features(database, image_id, image.name, image_features, write_descriptors)
            image_ids[image.name] = image_id
            num_keypoints[image.name] = len(image_features)
        _write_pairs(database, image_ids, num_keypoints, kept)


def _write_image(database: pycolmap.Database, image: ImageRecord, camera_id: int) -> int:
    """Write an image, its frame and its GPS position; its id."""
    written = pycolmap.Image(name=image.name, camera_id=camera_id)
    written.image_id = database.write_image(written)
    frame = pycolmap.Frame()
    frame.rig_id = camera_id
    frame.add_data_id(written.data_id)
    database.write_frame(frame)
    if image.gps is not None:
        prior = pycolmap.PosePrior(
            corr_data_id=written.data_id,
            position=np.array(image.gps, np.float64),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
        )
        database.write_pose_prior(prior)
    return written.image_id


def _write_features(
    database: pycolmap.Database, image_id: int, name: str, features: Features, write_descriptors: bool
) -> None:
    if not np.isfinite(features.keypoints).all():
        raise InputError(f"{name}: a keypoint is not a finite number; extract its features again")
    keypoints = features.keypoints
    if features.scales is not None and features.orientations is not None:
        # pycolmap ends the whole process on a scale that is none.
        if not (np.isfinite(features.scales).all() and (features.scales > 0).all()):
            raise InputError(
                f"{name}: the scale of a keypoint is not a finite number above 0; extract its features again"
            )
        keypoints = np.column_stack([keypoints, features.scales, features.orientations])
    database.write_keypoints(image_id, np.ascontiguousarray(keypoints, np.float32))
    if write_descriptors and features.descriptors.shape[1]:
        database.write_descriptors(image_id, _colmap_descriptors(features.descriptors))


def _colmap_descriptors(descriptors: NDArray) -> pycolmap.FeatureDescriptors:
    """COLMAP's record of descriptors: the bytes of floats for all but SIFT, of no kind that it knows."""
    kinds = pycolmap.FeatureExtractorType
    if descriptors.dtype == np.uint8:
        return pycolmap.FeatureDescriptors(type=kinds.SIFT, data=descriptors)
    floats = np.ascontiguousarray(descriptors, np.float32).view(np.uint8)
    return pycolmap.FeatureDescriptors(type=kinds.UNDEFINED, data=floats)


def _write_pairs(
    database: pycolmap.Database,
    image_ids: dict[str, int],
    num_keypoints: dict[str, int],
    kept: Iterable[tuple[str, str, NDArray[np.int32]]],
) -> None:
    """Write the matches of all pairs."""
    for name0, name1, indices in kept:
        _check_pair(database, image_ids, num_keypoints, name0, name1, indices)
        # COLMAP would drop a repeated row later, with a warning for each.
        _, first = np.unique(indices, axis=0, return_index=True)
        unique = indices[np.sort(first)]
        database.write_matches(image_ids[name0], image_ids[name1], unique.astype(np.uint32))


def _check_pair(
    database: pycolmap.Database,
    image_ids: dict[str, int],
    num_keypoints: dict[str, int],
    name0: str,
    name1: str,
    indices: NDArray[np.int32],
) -> None:
    """Refuse pairs that pycolmap would accept silently, or answer with "constraint failed"."""
    pair = f"pair {name0} – {name1}"
    for name in (name0, name1):
        if name not in image_ids:
            raise InputError(f"{pair}: {name} is not among the photos; make the pairs and matches again")
    if name0 == name1:
        raise InputError(f"{pair}: a photo is paired with itself; remove the pair from the list")
    if indices.ndim != 2 or indices.shape[1] != 2 or indices.dtype.kind not in "iu":
        raise InputError(
            f"{pair}: matches are {indices.dtype} of shape {indices.shape}, expected integers (K, 2)"
        )
    check_indices((name0, name1), indices, (num_keypoints[name0], num_keypoints[name1]))
    if database.exists_matches(image_ids[name0], image_ids[name1]):
        raise InputError(f"{pair}: occurs twice; remove one of them from the list of pairs")
