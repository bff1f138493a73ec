"""Features and matches as other tools write them, of photos and keypoints made up here."""

import sqlite3
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

NUM = 40
SIZE = 64


def unit_vectors(num: int, seed: int, size: int = SIZE) -> NDArray[np.float32]:
    """Random rows (num, size) of unit length."""
    values = np.random.default_rng(seed).normal(size=(num, size)).astype(np.float32)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def write_features(path: Path, names: list[str], *, half: bool = False, num: int = NUM) -> None:
    """hloc's features.h5: keypoint i of every photo is at (i, i / 2) and looks alike in all of them."""
    with h5py.File(path, "w") as file:
        for name in names:
            group = file.create_group(name)
            keypoints = np.column_stack([np.arange(num), np.arange(num) / 2]).astype(np.float32)
            group["keypoints"] = keypoints.astype(np.float16) if half else keypoints
            group["descriptors"] = unit_vectors(num, 0).T
            group["scores"] = np.linspace(1, 0.1, num).astype(np.float32)


def write_matches(path: Path, pairs: list[tuple[str, str]], *, num: int = NUM) -> None:
    """hloc's matches.h5: every second keypoint matches the one of the same number."""
    with h5py.File(path, "w") as file:
        for name0, name1 in pairs:
            group = file.create_group("/".join(name.replace("/", "-") for name in (name0, name1)))
            matches = np.where(np.arange(num) % 2, -1, np.arange(num)).astype(np.int32)
            group["matches0"] = matches
            group["matching_scores0"] = np.where(matches >= 0, 0.75, 0).astype(np.float16)


def write_old_database(path: Path, names: list[str], *, columns: int = 4, num: int = NUM) -> None:
    """A database of COLMAP 3.8 with SIFT's bytes, and matches of the first two photos in falling order."""
    keypoints = np.zeros((num, columns), np.float32)
    keypoints[:, 0] = np.arange(num) + 0.5
    keypoints[:, 1] = np.arange(num) / 2 + 0.5
    if columns == 4:
        keypoints[:, 2:] = [2, 0.5]
    if columns == 6:  # a shape twice as large, turned by a quarter
        keypoints[:, 2:] = [0, -2, 2, 0]
    descriptors = np.random.default_rng(0).integers(0, 256, (num, 128)).astype(np.uint8)
    matches = np.column_stack([np.arange(num), np.arange(num)])[::-2].astype(np.uint32)
    with sqlite3.connect(path) as database:
        database.executescript(
            "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);"
            "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"
            "CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"
            "CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"
        )
        for image_id, name in enumerate(names, 1):
            database.execute("INSERT INTO images VALUES (?, ?, 1)", (image_id, name))
            for table, values in (("keypoints", keypoints), ("descriptors", descriptors)):
                row = (image_id, *values.shape, np.ascontiguousarray(values).tobytes())
                database.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", row)
        pair_id = 1 * (2**31 - 1) + 2
        database.execute(
            "INSERT INTO matches VALUES (?, ?, 2, ?)",
            (pair_id, len(matches), np.ascontiguousarray(matches).tobytes()),
        )
    database.close()
