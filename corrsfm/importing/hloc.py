"""hloc's files: features by photo, matches by pair.

Its keypoints count from the centre of the first pixel; half a pixel is added, as hloc does for COLMAP. Its
descriptors are (D, N). A pair's group is ``name0/name1`` with slashes inside a name as dashes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import InputError, first_few
from corrsfm.files import require_file
from corrsfm.hdf5 import lies_elsewhere, open_hdf5
from corrsfm.importing.checks import features_from, matches_from, single_precision
from corrsfm.types import Features, Matches, Pair
from corrsfm.workspace.hloc import HALF_PIXEL, check_hloc_keys

__all__ = ["HlocSource", "open_hloc"]

# Of the distance between a point and its nearest neighbour on a square grid, for a grid of 1.
MEAN_ROUNDING = 0.38
# Of one photo or pair.
_LARGEST_BYTES = 1 << 31


@contextlib.contextmanager
def open_hloc(features: Path, matches: Path | None) -> Iterator[HlocSource]:
    """Open hloc's files for reading.

    Raises
    ------
    InputError
        If a file is missing, not HDF5, or holds nothing that hloc writes.
    """
    with _open(features) as feature_file, contextlib.ExitStack() as stack:
        match_file = stack.enter_context(_open(matches)) if matches is not None else None
        yield HlocSource(features, feature_file, matches, match_file)


@contextlib.contextmanager
def _open(path: Path) -> Iterator[h5py.File]:
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected features or matches as hloc writes them")
    require_file(path)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open_hdf5(path))
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as HDF5 ({error}); write it again") from error
        yield file


class HlocSource:
    """Features, and matches if there are any; see `corrsfm.importing.Source`."""

    def __init__(
        self, features: Path, feature_file: h5py.File, matches: Path | None, match_file: h5py.File | None
    ) -> None:
        self._features, self._matches, self._match_file = features, matches, match_file
        self.label = str(features) if matches is None else f"{features} and {matches}"
        self._groups = _groups_with(feature_file, "keypoints")
        self.names = sorted(self._groups)
        if not self.names:
            raise InputError(
                f"{features}: holds no 'keypoints' of any photo; expected hloc's layout, a group a photo"
            )
        self._rounded: dict[str, float] = {}
        self._pair_groups: dict[Pair, tuple[h5py.Group, bool]] = {}
        if match_file is not None:
            self._pair_groups = self._find_pairs(match_file)
        self.pairs = sorted(self._pair_groups)

    def features(self, name: str, image_size: tuple[int, int]) -> Features:
        """See `corrsfm.importing.Source`."""
        group, where = self._groups[name], f"{self._features}: {name}"
        stored = self._read(where, group, "keypoints")
        if stored.ndim != 2:
            raise InputError(f"{where}: keypoints have shape {stored.shape}, expected (N, 2)")
        if stored.dtype.kind not in "fiu":
            raise InputError(f"{where}: keypoints are {stored.dtype}, expected numbers")
        size = self._optional(where, group, "image_size")
        if size is not None and not (size.size >= 2 and np.isfinite(size.ravel()[:2]).all()):
            raise InputError(f"{where}: image_size is {size.ravel()[:2]}, expected width and height")
        if size is not None and tuple(int(value) for value in size.ravel()[:2]) != image_size:
            width, height = (float(value) for value in size.ravel()[:2])
            raise InputError(
                f"{where}: features of a photo of {width:g} × {height:g} pixels, "
                f"this one has {image_size[0]} × {image_size[1]}; give the photos that they are of"
            )
        descriptors = self._optional(where, group, "descriptors")
        if descriptors is None and self._matches is None:
            raise InputError(
                f"{where}: has no 'descriptors', only {', '.join(sorted(group))}; give --matches, too"
            )
        if descriptors is not None:
            if descriptors.ndim != 2 or descriptors.shape[1] != len(stored):
                raise InputError(
                    f"{where}: descriptors have shape {descriptors.shape}, expected (D, {len(stored)}): one "
                    "column for each keypoint"
                )
            descriptors = single_precision(descriptors.T)
        scores = self._optional(where, group, "scores")
        features = features_from(
            where,
            single_precision(stored) + HALF_PIXEL,
            descriptors,
            image_size,
            scores=None if scores is None else scores.ravel(),
            scales=self._optional(where, group, "scales"),
            orientations=self._optional(where, group, "oris"),
        )
        if stored.dtype == np.float16 and len(stored):
            spacing = np.spacing(np.abs(stored).astype(np.float16)).astype(np.float64)
            self._rounded[name] = MEAN_ROUNDING * float(np.mean(spacing))
        return features

    def matches(self, pair: Pair, num0: int, num1: int) -> Matches:
        """See `corrsfm.importing.Source`."""
        group, swapped = self._pair_groups[pair]
        where = f"{self._matches}: {' – '.join(pair)}"
        stored = self._read(where, group, "matches0").ravel()
        if swapped:
            num0, num1 = num1, num0
        if stored.dtype.kind not in "iu":
            raise InputError(f"{where}: matches0 is {stored.dtype}, expected integers, -1 for no match")
        if len(stored) > num0:
            raise InputError(
                f"{where}: matches of {len(stored)} keypoints, but the first photo has {num0}; the matches "
                "belong to other features"
            )
        scores = self._optional(where, group, "matching_scores0")
        if scores is not None and scores.size != stored.size:
            raise InputError(f"{where}: {stored.size} matches, but {scores.size} scores")
        rows = np.flatnonzero(stored != -1)
        indices = np.column_stack([rows, stored[rows].astype(np.int64)])
        chosen = None if scores is None else scores.ravel()[rows]
        if not swapped:
            return matches_from(where, indices, num0, num1, chosen)
        # Of keypoints of the other photo that share a partner the surest stays.
        if chosen is not None:
            indices, chosen = _surest(indices, np.asarray(chosen))
        return matches_from(where, indices[:, ::-1], num1, num0, chosen)

    def remarks(self) -> list[str]:
        """See `corrsfm.importing.Source`."""
        if not self._rounded:
            return []
        return [
            f"{self._features}: keypoints of {len(self._rounded)} photos are half-precision numbers, which "
            f"moved them by {np.mean(list(self._rounded.values())):.2f} px on average; in hloc, "
            "extract_features.main(..., as_half=False) keeps them exact"
        ]

    def _find_pairs(self, file: h5py.File) -> dict[Pair, tuple[h5py.Group, bool]]:
        check_hloc_keys(self.names)
        photo_of = {name.replace("/", "-"): name for name in self.names}
        found: dict[Pair, tuple[h5py.Group, bool]] = {}
        groups = _groups_with(file, "matches0")
        if not groups:
            raise InputError(
                f"{self._matches}: holds no 'matches0' of any pair; expected hloc's layout, a group "
                "name0/name1 for each pair"
            )
        for path, group in groups.items():
            keys = path.split("/")
            unknown = [key for key in keys if key not in photo_of]
            if len(keys) != 2 or unknown:
                raise InputError(
                    f"{self._matches}: {path}: expected two photos of {self._features}, with '-' in place of "
                    f"'/'; not there: {first_few(unknown or [path])}"
                )
            name0, name1 = (photo_of[key] for key in keys)
            pair = (min(name0, name1), max(name0, name1))
            if name0 == name1 or pair in found:
                what = "a photo is matched with itself" if name0 == name1 else "the pair is there twice"
                raise InputError(f"{self._matches}: {path}: {what}; remove it")
            found[pair] = group, name0 > name1
        return found

    def _read(self, where: str, group: h5py.Group, key: str) -> NDArray[Any]:
        try:
            item = group.get(key)
            if not isinstance(item, h5py.Dataset):
                raise InputError(f"{where}: has no '{key}', only {', '.join(sorted(group))}")
            if lies_elsewhere(item):
                raise InputError(
                    f"{where}: the values of '{key}' lie in another file; copy them into this one"
                )
            if item.shape is None or item.dtype.kind not in "biuf":
                raise InputError(f"{where}: '{key}' is {item.dtype}, expected real numbers")
            if item.nbytes > _LARGEST_BYTES:
                raise InputError(
                    f"{where}: '{key}' declares {item.nbytes / 1e9:,.0f} GB; write the file again"
                )
            return np.asarray(item[()])
        except (OSError, RuntimeError, LookupError, TypeError, ValueError) as error:
            raise InputError(f"{where}: '{key}' cannot be read ({error}); write the file again") from error

    def _optional(self, where: str, group: h5py.Group, key: str) -> NDArray[Any] | None:
        return self._read(where, group, key) if key in group else None


def _surest(
    indices: NDArray[np.int64], scores: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.floating]]:
    """The match of largest score of every keypoint in column 1."""
    order = np.lexsort((indices[:, 0], -np.nan_to_num(scores), indices[:, 1]))
    _, first = np.unique(indices[order, 1], return_index=True)
    return indices[order[first]], scores[order[first]]


def _groups_with(file: h5py.File, key: str) -> dict[str, h5py.Group]:
    """Groups at any depth that hold a data set of this name, by path."""
    found: dict[str, h5py.Group] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Group) and key in item:
            found[name] = item

    try:
        file.visititems(visit)
    except (OSError, RuntimeError, LookupError) as error:
        raise InputError(f"{file.filename}: is damaged ({error}); write the file again") from error
    return found
