"""How corrsfm talks to pycolmap: a quiet log, failures in plain words, and models in numbers.

pycolmap's log is one per process (glog), so `colmap_log` is not for use from several threads at once.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.errors import DatabaseError, WorkspaceError
from corrsfm.types import ModelSummary

__all__ = [
    "colmap_log",
    "database_errors",
    "is_sqlite",
    "is_truncated",
    "observation_errors",
    "pycolmap_version",
    "read_models",
    "summarise_model",
]

# Importing pycolmap makes SIGTERM print a stack trace of native code, as if something had crashed; this gives
# the signal back the meaning that it had. Only the main thread may.
with contextlib.suppress(ValueError):
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))

_SILENT = 3
_SMALLEST_DISK_BYTES = 1 << 20
_MAGIC = b"SQLite format 3\0"
_HEADER_BYTES = 100


def pycolmap_version() -> str:
    """Major and minor version, between which results may differ; for fingerprints."""
    return ".".join(pycolmap.__version__.split(".")[:2])


@contextlib.contextmanager
def colmap_log(log_file: Path | None = None) -> Iterator[None]:
    """Keep pycolmap quiet; collect what it has to say in a file.

    Parameters
    ----------
    log_file : Path, optional
        The messages are appended to it when the block ends, also when it fails. Without it they are dropped;
        pycolmap's own default would be the terminal and files in the temporary folder of the machine.
    """
    log = pycolmap.logging
    before = (log.minloglevel, log.alsologtostderr, log.logtostderr)
    log.alsologtostderr = log.logtostderr = False
    log.minloglevel = _SILENT if log_file is None else 0
    try:
        if log_file is None:
            yield
        else:
            with tempfile.TemporaryDirectory(prefix="corrsfm-log-") as folder:
                # One file for all levels: messages of a level go to the files of all lower levels, too.
                log.set_log_destination(log.INFO, str(Path(folder) / "colmap."))
                for level in (log.WARNING, log.ERROR, log.FATAL):
                    log.set_log_destination(level, "")
                try:
                    yield
                finally:
                    # Closing the destination flushes it.
                    log.set_log_destination(log.INFO, "")
                    _append(sorted(Path(folder).iterdir()), log_file)
    finally:
        log.minloglevel, log.alsologtostderr, log.logtostderr = before


def _append(sources: list[Path], target: Path) -> None:
    # glog also leaves a link named after the program beside its file.
    texts = [source.read_bytes() for source in sources if source.is_file() and not source.is_symlink()]
    # A log that cannot be written, on a full disk say, must not hide the error that is being logged.
    with contextlib.suppress(OSError), open(target, "ab") as file:
        file.write(b"".join(texts))


@contextlib.contextmanager
def database_errors(path: Path, shown: Path | None = None) -> Iterator[None]:
    """Translate what pycolmap says about a database into a `DatabaseError` with what to try.

    Parameters
    ----------
    path : Path
        The database that the block works on.
    shown : Path, optional
        What to call it in the message, if it has another name while it is made.
    """
    try:
        yield
    except RuntimeError as error:
        explanation = _explain(path, str(error))
        if explanation is None:
            raise
        raise DatabaseError(f"{shown or path}: {explanation}") from error


def _explain(path: Path, message: str) -> str | None:
    """Cause and remedy of a message of pycolmap's database; None if it is about something else."""
    if "disk is full" in message or "disk I/O error" in message:
        return _FULL
    if "database is locked" in message:
        return _HELD
    if "readonly database" in message:
        return "cannot be written; check the permissions of the file and its folder"
    if "No registered database factory" in message:
        return _explain_unopened(path)
    if "SQLite error" in message:
        return f"{message.rpartition('SQLite error: ')[2]}; delete the file and make it again"
    return None


_FULL = "the disk is full or failing; free some space and run the same command again"
_HELD = "is in use by another program; close it there (COLMAP, another corrsfm) and try again"


def _explain_unopened(path: Path) -> str:
    if not path.parent.is_dir():
        return "its folder does not exist"
    if path.is_dir():
        return "is a folder, expected a COLMAP database"
    if path.exists() and path.stat().st_size:
        try:
            is_database = is_sqlite(path)
        except OSError as error:
            return f"cannot be read ({error.strerror})"
        if not is_database:
            return "is not a COLMAP database; move it away and make it again"
    if shutil.disk_usage(path.parent).free < _SMALLEST_DISK_BYTES:
        return _FULL
    try:
        if _is_locked(path):
            return _HELD
    except sqlite3.DatabaseError as error:
        return f"damaged ({error}); delete the file and make it again"
    return "cannot be opened; check the free space of the disk and the permissions of the file and its folder"


def is_sqlite(path: Path) -> bool:
    """Whether a file begins like an SQLite database."""
    with open(path, "rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def is_truncated(path: Path) -> bool:
    """Whether an SQLite database lacks bytes that its header promises; also so of an empty file.

    Quick whatever the size of the file, because only the header is read; what was damaged in its place is not
    found. False for a file that is no SQLite database at all.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        return _MAGIC.startswith(header[: len(_MAGIC)])
    page_size, num_pages = (int.from_bytes(header[start:end]) for start, end in ((16, 18), (28, 32)))
    # The number of pages counts only if whoever wrote last wrote it, too.
    counted = header[24:28] == header[92:96]
    return (
        header.startswith(_MAGIC) and counted and size < num_pages * (65536 if page_size == 1 else page_size)
    )


def _is_locked(path: Path) -> bool:
    """Whether another process holds a lock; only asked once pycolmap has given up on the file.

    Raises
    ------
    sqlite3.DatabaseError
        If the file is damaged.
    """
    try:
        with contextlib.closing(sqlite3.connect(f"file:{path}?mode=rw", uri=True, timeout=0)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.rollback()
    except sqlite3.OperationalError as error:
        return "locked" in str(error)
    return False


def read_models(folder: Path) -> list[pycolmap.Reconstruction]:
    """Read the models ``folder/0``, ``folder/1`` … in this order.

    Raises
    ------
    WorkspaceError
        If there is none, or one cannot be read.
    """
    models: list[pycolmap.Reconstruction] = []
    while (path := folder / str(len(models))).is_dir():
        try:
            with colmap_log():
                models.append(pycolmap.Reconstruction(path))
        except (RuntimeError, ValueError) as error:
            raise WorkspaceError(
                f"{path}: is not a readable COLMAP model; try: corrsfm reconstruct --overwrite"
            ) from error
    if not models:
        raise WorkspaceError(f"{folder}: holds no model; try: corrsfm reconstruct")
    return models


def observation_errors(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """Reprojection error of every observation of a model.

    Returns
    -------
    (O,) float64
        Distances in pixels between keypoint and projected point, images in order of their names. Infinite
        for a point behind its camera.
    """
    errors = [np.zeros(0)]
    # One pass over the points: asking pycolmap for the point of each observation takes twice as long.
    point_ids = np.array(sorted(model.points3D), np.uint64)
    positions = np.array([model.points3D[int(point_id)].xyz for point_id in point_ids]).reshape(-1, 3)
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        observed = image.get_observation_points2D()
        if not observed:
            continue
        keypoints = np.array([point.xy for point in observed])
        observed_ids = np.array([point.point3D_id for point in observed], np.uint64)
        in_camera = image.cam_from_world() * positions[np.searchsorted(point_ids, observed_ids)]
        projected = np.full_like(keypoints, np.inf)
        front = in_camera[:, 2] > 0
        projected[front] = image.camera.img_from_cam(in_camera[front])
        errors.append(np.linalg.norm(projected - keypoints, axis=1))
    return np.concatenate(errors)


def summarise_model(model: pycolmap.Reconstruction) -> ModelSummary:
    """A model in numbers."""
    errors = observation_errors(model)
    num_images = model.num_reg_images()
    # Without points all of them are undefined.
    mean, median, p95 = (
        (errors.mean(), *np.percentile(errors, [50, 95])) if len(errors) else (np.nan, np.nan, np.nan)
    )
    num_observations = model.compute_num_observations()
    return ModelSummary(
        image_names=tuple(sorted(image.name for image in model.images.values() if image.has_pose)),
        num_points=model.num_points3D(),
        num_observations=num_observations,
        mean_track_length=num_observations / max(model.num_points3D(), 1),
        mean_observations_per_image=num_observations / max(num_images, 1),
        mean_error_px=float(mean),
        median_error_px=float(median),
        p95_error_px=float(p95),
    )
