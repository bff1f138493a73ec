"""hloc: features, matches and pairs as its tools read them, and a reconstruction in ``sfm``."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.databases import copy_photos_of
from corrsfm.colmap.models import write_model
from corrsfm.files import atomic_write_text
from corrsfm.types import Features, check_indices
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import HALF_PIXEL, check_hloc_keys, pair_group
from corrsfm.workspace.lists import read_pairs
from corrsfm.workspace.stores import features_of, pruned_of

__all__ = ["write_hloc"]


def write_hloc(model: pycolmap.Reconstruction, workspace: Workspace, folder: Path) -> None:
    """``features.h5``, ``matches.h5``, ``pairs.txt`` and ``sfm`` of the photos of a model.

    The matches are the kept ones, with an entry for each keypoint. Keypoints are float32 with the first
    pixel's centre at (0, 0): hloc adds half a pixel when it writes a database.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    workspace : Workspace
    folder : Path

    Raises
    ------
    InputError
        If hloc's layout cannot tell two photos apart.
    """
    names = sorted(image.name for image in model.images.values())
    check_hloc_keys(names)
    num_keypoints = {}
    with (
        features_of(workspace).reader() as read,
        _writing(folder / "features.h5") as put,
    ):
        for name in names:
            features = read(name)
            num_keypoints[name] = len(features.keypoints)
            for key, value in _arrays(features).items():
                put(f"{name}/{key}", value)
    held = set(names)
    pairs = [pair for pair in read_pairs(workspace).pairs if held >= set(pair)]
    with (
        pruned_of(workspace).reader() as read_kept,
        _writing(folder / "matches.h5") as put,
    ):
        for pair in pairs:
            kept, num = read_kept(pair), num_keypoints[pair[0]]
            check_indices(pair, kept.indices, (num, num_keypoints[pair[1]]))
            matches, scores = np.full(num, -1, np.int32), np.zeros(num, np.float32)
            matches[kept.indices[:, 0]] = kept.indices[:, 1]
            scores[kept.indices[:, 0]] = kept.scores
            put(f"{pair_group(pair)}/matches0", matches)
            put(f"{pair_group(pair)}/matching_scores0", scores)
    atomic_write_text(folder / "pairs.txt", "".join(f"{name0} {name1}\n" for name0, name1 in pairs))
    write_model(model, folder / "sfm")
    copy_photos_of(workspace.database, folder / "sfm" / "database.db", names)


class _CarefulFile(io.FileIO):
    """Keeps an error of the disk instead of raising it: met as it closes, HDF5 ends the process."""

    error: OSError | None = None

    def flush(self) -> None:
        """Nothing is held back; HDF5 looks for this on the class itself."""

    def write(self, content: Any, /) -> int:
        """Write all of it, unless something was lost before."""
        left = memoryview(content).cast("B")
        size = left.nbytes
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return size

    def check(self) -> None:
        """Raise the first error of writing, if there was one."""
        if self.error is not None:
            raise self.error


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[Callable[[str, NDArray], None]]:
    """A function that puts an array under a name into a new HDF5 file."""
    with _CarefulFile(path, "w+") as raw:
        with h5py.File(raw, "w") as file:

            def put(name: str, values: NDArray) -> None:
                file[name] = values
                raw.check()

            yield put
        raw.check()


def _arrays(features: Features) -> dict[str, NDArray]:
    """Features in hloc's layout; SIFT's descriptors as vectors of unit length."""
    descriptors = features.descriptors.astype(np.float16)
    if features.descriptors.dtype == np.uint8:
        descriptors /= np.float16(512)
    arrays = {
        "keypoints": features.keypoints - HALF_PIXEL,
        "scores": features.scores,
        "descriptors": np.ascontiguousarray(descriptors.T),
        "image_size": np.asarray(features.image_size, np.int32),
    }
    shapes = {"scales": features.scales, "oris": features.orientations}
    return arrays | {name: values for name, values in shapes.items() if values is not None}
