"""Features, matches and pruned matches on disk: HDF5 in hloc's layout, with a journal that survives a kill.

Layout (hloc's, so that its tools read these files; differences are noted)
    ``features.h5``: group = image name; ``keypoints`` (N, 2) float32 with the first pixel's centre at (0, 0),
    ``scores`` (N,) float32, ``descriptors`` (D, N) float16 = uint8 / 512, which is exact, ``image_size`` (2,)
    int32, and beyond hloc ``scales`` and ``oris`` (N,) float32.
    ``matches.h5`` and ``pruned.h5``: group = ``name0/name1`` with slashes inside a name as dashes;
    ``matches0`` (N0,) int32 with -1 for none and ``matching_scores0`` (N0,) float32. Putative matches score
    1 − ratio and carry ``mutual0`` (N0,) bool; pruned ones carry the score of the prune method.
    Every group has the attribute ``fingerprint``; the root has ``format`` and ``version``.

Finished items go to a journal next to the file (`corrsfm.journal`); the file itself is written in one go and
renamed into place when its stage is complete.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import InputError, WorkspaceError
from corrsfm.files import atomic_path
from corrsfm.journal import Journal
from corrsfm.types import Features, Matches, Pair, PruneResult, TwoViewModel

__all__ = ["FEATURES", "MATCHES", "PRUNED", "ItemStore", "PrunedMatches", "check_hloc_keys"]

FORMAT_VERSION = 1
HALF_PIXEL = np.float32(0.5)

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
Arrays = dict[str, NDArray[Any]]
Attributes = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class PrunedMatches:
    """What `pruned.h5` keeps of a pair.

    Attributes
    ----------
    indices : (K, 2) int32
        The kept matches, in the order of the putative ones. K may be 0.
    scores : (K,) float32
    num_putative : int
        Number of matches before pruning.
    model : TwoViewModel or None
    decided_by : str
    """

    indices: NDArray[np.int32]
    scores: NDArray[np.float32]
    num_putative: int
    model: TwoViewModel | None = None
    decided_by: str = ""

    @classmethod
    def from_result(cls, matches: Matches, result: PruneResult) -> PrunedMatches:
        """The kept part of a prune method's result."""
        return cls(
            indices=matches.indices[result.inlier_mask],
            scores=result.scores[result.inlier_mask],
            num_putative=len(matches),
            model=result.model,
            decided_by=result.decided_by,
        )


@dataclass(frozen=True)
class Kind(Generic[K, T]):
    """How one kind of item is named and laid out.

    Attributes
    ----------
    label : str
        The root attribute ``format`` is ``corrsfm-<label>``.
    group : callable
        Key to HDF5 group path.
    encode, decode : callable
        Item to datasets and attributes, and back.
    """

    label: str
    group: Callable[[K], str]
    encode: Callable[[T], tuple[Arrays, Attributes]]
    decode: Callable[[Mapping[str, Any], Mapping[str, Any]], T]


def _encode_features(features: Features) -> tuple[Arrays, Attributes]:
    return {
        "keypoints": features.keypoints - HALF_PIXEL,
        "scales": features.scales,
        "oris": features.orientations,
        "scores": features.scores,
        "descriptors": np.ascontiguousarray((features.descriptors.astype(np.float16) / np.float16(512)).T),
        "image_size": np.asarray(features.image_size, np.int32),
    }, {}


def _decode_features(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> Features:
    """Ours or hloc's: what hloc does not write gets a neutral value."""
    keypoints = np.asarray(arrays["keypoints"], np.float32) + HALF_PIXEL
    num = len(keypoints)
    descriptors = _sift_descriptors(np.asarray(arrays["descriptors"], np.float32).T, num)
    width, height = (int(value) for value in np.asarray(arrays["image_size"]))

    def vector(name: str, default: float) -> NDArray[np.float32]:
        return np.asarray(arrays[name], np.float32) if name in arrays else np.full(num, default, np.float32)

    return Features(
        keypoints=keypoints,
        scales=vector("scales", 1.0),
        orientations=vector("oris", 0.0),
        scores=vector("scores", 1.0),
        descriptors=descriptors,
        image_size=(width, height),
    )


def _sift_descriptors(descriptors: NDArray[np.float32], num: int) -> NDArray[np.uint8]:
    """Stored descriptors (N, 128) as bytes; raises `ValueError` if they cannot be SIFT's."""
    if descriptors.shape != (num, 128):
        raise ValueError(
            f"descriptors of shape {descriptors.shape[::-1]}, expected (128, {num}): only SIFT can be matched"
        )
    # Also false for NaN.
    if not ((descriptors >= 0) & (descriptors <= 1)).all():
        raise ValueError(
            f"descriptors from {descriptors.min():g} to {descriptors.max():g}, expected SIFT's, of length 1 "
            "and so from 0 to 1"
        )
    # The few entries above one half are clipped, as COLMAP does.
    return np.clip(np.rint(descriptors * 512), 0, 255).astype(np.uint8)


def _scatter(num: int, indices: NDArray[np.int32], scores: NDArray[np.float32]) -> Arrays:
    """hloc's one-entry-per-keypoint layout."""
    matches0 = np.full(num, -1, np.int32)
    scores0 = np.zeros(num, np.float32)
    matches0[indices[:, 0]] = indices[:, 1]
    scores0[indices[:, 0]] = scores
    return {"matches0": matches0, "matching_scores0": scores0}


def _gather(arrays: Mapping[str, Any]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    matches0 = np.asarray(arrays["matches0"], np.int32)
    kept = np.flatnonzero(matches0 >= 0)
    indices = np.column_stack([kept, matches0[kept]]).astype(np.int32)
    return indices, np.asarray(arrays["matching_scores0"], np.float32)[kept]


def _num_rows(indices: NDArray[np.int32]) -> int:
    return int(indices[-1, 0]) + 1 if len(indices) else 0


def _encode_matches(matches: Matches) -> tuple[Arrays, Attributes]:
    num = _num_rows(matches.indices)
    arrays = _scatter(num, matches.indices, np.float32(1) - matches.ratios)
    arrays["mutual0"] = np.zeros(num, np.bool_)
    arrays["mutual0"][matches.indices[:, 0]] = matches.mutual
    return arrays, {}


def _decode_matches(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> Matches:
    indices, scores = _gather(arrays)
    # hloc's own matchers do not say which matches are mutual; its default matcher keeps only mutual ones.
    mutual = (
        np.asarray(arrays["mutual0"], np.bool_)[indices[:, 0]]
        if "mutual0" in arrays
        else np.ones(len(indices), bool)
    )
    return Matches(indices=indices, ratios=np.clip(np.float32(1) - scores, 0, 1), mutual=mutual)


def _encode_pruned(pruned: PrunedMatches) -> tuple[Arrays, Attributes]:
    arrays = _scatter(_num_rows(pruned.indices), pruned.indices, pruned.scores)
    attributes: Attributes = {
        "num_putative": pruned.num_putative,
        "num_kept": len(pruned.indices),
        "decided_by": pruned.decided_by,
    }
    if pruned.model is not None:
        arrays["model"] = pruned.model.matrix
        attributes["model_kind"] = pruned.model.kind
    return arrays, attributes


def _decode_pruned(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> PrunedMatches:
    indices, scores = _gather(arrays)
    model = None
    if "model" in arrays:
        model = TwoViewModel(kind=attributes["model_kind"], matrix=np.asarray(arrays["model"], np.float64))
    return PrunedMatches(
        indices=indices,
        scores=scores,
        num_putative=int(attributes["num_putative"]),
        model=model,
        decided_by=str(attributes["decided_by"]),
    )


def _pair_group(pair: Pair) -> str:
    return "/".join(name.replace("/", "-") for name in pair)


FEATURES: Kind[str, Features] = Kind("features", str, _encode_features, _decode_features)
MATCHES: Kind[Pair, Matches] = Kind("matches", _pair_group, _encode_matches, _decode_matches)
PRUNED: Kind[Pair, PrunedMatches] = Kind("pruned", _pair_group, _encode_pruned, _decode_pruned)


def check_hloc_keys(names: Iterable[str]) -> None:
    """Refuse names that hloc's layout cannot tell apart.

    Raises
    ------
    InputError
        Naming the two photos.
    """
    seen: dict[str, str] = {}
    for name in names:
        key = name.replace("/", "-")
        if key in seen:
            raise InputError(
                f"the photos '{seen[key]}' and '{name}' would share the key '{key}' in the match files; "
                "rename one"
            )
        seen[key] = name


def _why_unreadable(error: OSError) -> str:
    """What to tell of a file that HDF5 could not read, so that nobody deletes what is whole."""
    if error.errno is None:
        # What HDF5 itself says about the content: no signature, truncated, a wrong byte.
        return f"not a readable HDF5 file ({error}); delete it and run again"
    if "unable to lock" in str(error):
        if error.errno in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES):
            cause = "in use by another program; close it there and run again"
        else:
            cause = "cannot be locked; run again"
        return f"{cause}, on a file system without locks with HDF5_USE_FILE_LOCKING=FALSE in the environment"
    if isinstance(error, PermissionError):
        return "may not be read; check the permissions of the file and its folder"
    return f"cannot be read ({error}); check the disk and run again"


class ItemStore(Generic[K, T]):
    """Items of one kind in an HDF5 file, with a journal of those finished since it was written.

    Parameters
    ----------
    path : Path
        The HDF5 file; the journal lies beside it with the suffix ``.journal``.
    kind : Kind
    """

    def __init__(self, path: Path, kind: Kind[K, T]) -> None:
        self.path = path
        self.kind = kind
        self.journal = Journal(path.with_suffix(path.suffix + ".journal"))

    # reading ------------------------------------------------------------------------------------------------

    @contextmanager
    def _open(self) -> Iterator[h5py.File]:
        try:
            file = h5py.File(self.path, "r")
        except FileNotFoundError as error:
            raise WorkspaceError(f"{self.path}: missing; run the step that makes it") from error
        except OSError as error:
            raise WorkspaceError(f"{self.path}: {_why_unreadable(error)}") from error
        with file:
            version = file.attrs.get("version", FORMAT_VERSION)
            if version != FORMAT_VERSION:
                raise WorkspaceError(
                    f"{self.path}: format version {version}, this corrsfm reads {FORMAT_VERSION}"
                )
            yield file

    @contextmanager
    def reader(self) -> Iterator[Callable[[K], T]]:
        """Open the file once and yield a function that reads an item by key.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or (from the function) if it holds no such item.
        """
        with self._open() as file:

            def read(key: K) -> T:
                group = self._group(file, key)
                try:
                    return self.kind.decode(
                        {name: value[()] for name, value in group.items() if isinstance(value, h5py.Dataset)},
                        group.attrs,
                    )
                except OSError as error:
                    raise WorkspaceError(f"{self.path}: {key}: {_why_unreadable(error)}") from error
                except KeyError as error:
                    raise WorkspaceError(
                        f"{self.path}: {key} lacks {error}; move the file away and run again"
                    ) from error
                except ValueError as error:
                    raise WorkspaceError(
                        f"{self.path}: {key}: {error}; move the file away and run again"
                    ) from error

            yield read

    def read(self, key: K) -> T:
        """Read one item; see `reader`."""
        with self.reader() as read:
            return read(key)

    def fingerprints(self, keys: Iterable[K]) -> dict[K, str]:
        """Fingerprints of items in the file; of items that another tool wrote, a hash of what they hold.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or holds no such item.
        """
        with self._open() as file:
            return {key: self._fingerprint(file, key) for key in keys}

    def attributes(self, keys: Iterable[K]) -> Iterator[tuple[K, Attributes]]:
        """Attributes of items, read without their datasets.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or holds no such item.
        """
        with self._open() as file:
            for key in keys:
                yield key, dict(self._group(file, key).attrs)

    def _group(self, file: h5py.File, key: K) -> h5py.Group:
        group = file.get(self.kind.group(key))
        if group is None:
            raise WorkspaceError(f"{self.path}: holds nothing for {key}; run the step that makes it again")
        return group

    def _fingerprint(self, file: h5py.File, key: K) -> str:
        group = self._group(file, key)
        if "fingerprint" in group.attrs:
            return str(group.attrs["fingerprint"])
        digest = hashlib.sha256()
        for name in sorted(group):
            if isinstance(group[name], h5py.Dataset):
                digest.update(name.encode())
                digest.update(np.ascontiguousarray(group[name][()]).tobytes())
        return digest.hexdigest()

    def finished(self, wanted: Mapping[K, str]) -> set[K]:
        """Keys whose item is already there with the wanted fingerprint, in the file or the journal."""
        found: set[K] = set()
        if self.path.exists():
            with self._open() as file:
                for key, fingerprint in wanted.items():
                    if self.kind.group(key) in file and self._fingerprint(file, key) == fingerprint:
                        found.add(key)
        waiting = self.journal.fingerprints()
        found |= {
            key for key, fingerprint in wanted.items() if waiting.get(self.kind.group(key)) == fingerprint
        }
        return found

    # writing ------------------------------------------------------------------------------------------------

    def add(self, key: K, fingerprint: str, item: T) -> None:
        """Put an item into the journal; it is safe when this returns.

        Raises
        ------
        WorkspaceError
            If the disk is full or the journal cannot be written.
        """
        self.journal.add(self.kind.group(key), fingerprint, *self.kind.encode(item))

    def commit(self, wanted: Mapping[K, str], progress: Callable[[Iterable[K]], Iterable[K]] = iter) -> None:
        """Make the HDF5 file hold exactly the wanted items, from itself and the journal; all or nothing.

        Parameters
        ----------
        wanted : mapping
            Key → fingerprint.
        progress : callable
            The keys, passed on one by one as they are written; for a progress bar.

        Raises
        ------
        WorkspaceError
            If an item is in neither, or the disk is full.
        """
        self._require_space()
        try:
            with atomic_path(self.path) as temporary, h5py.File(temporary, "w") as target:
                target.attrs["format"] = f"corrsfm-{self.kind.label}"
                target.attrs["version"] = FORMAT_VERSION
                self._fill(target, wanted, progress)
        # HDF5 notices some failures of writing only when it closes the file, which is a RuntimeError.
        except (OSError, RuntimeError) as error:
            raise WorkspaceError(
                f"{self.path}: cannot be written ({error}); free some disk space and run again, "
                "finished work is kept"
            ) from error
        self.discard_journal()

    def _require_space(self) -> None:
        # HDF5 may crash the process when a disk fills up while it writes. The file grows no larger than what
        # it is made from.
        needed = self.journal.num_bytes() + (self.path.stat().st_size if self.path.exists() else 0)
        free = shutil.disk_usage(self.path.parent).free
        if free < needed:
            raise WorkspaceError(
                f"{self.path}: writing it needs {needed / 1e6:.0f} MB, {free / 1e6:.0f} MB are free; "
                "free some disk space and run again, finished work is kept"
            )

    def _fill(
        self,
        target: h5py.File,
        wanted: Mapping[K, str],
        progress: Callable[[Iterable[K]], Iterable[K]],
    ) -> None:
        with self._open() if self.path.exists() else nullcontext() as source:
            for key in progress(wanted):
                name, fingerprint = self.kind.group(key), wanted[key]
                item = self.journal.read(name, fingerprint)
                if item is not None:
                    self._write_group(target, name, fingerprint, *item)
                elif source is not None and name in source and self._fingerprint(source, key) == fingerprint:
                    source.copy(source[name], target, name=name, shallow=False)
                else:
                    raise WorkspaceError(f"{self.path}: {key} was never finished; run again")

    @staticmethod
    def _write_group(
        target: h5py.File, name: str, fingerprint: str, arrays: Arrays, attributes: Attributes
    ) -> None:
        group = target.create_group(name)
        group.attrs["fingerprint"] = fingerprint
        group.attrs.update(attributes)
        for entry, values in arrays.items():
            group.create_dataset(entry, data=values)

    def discard_journal(self) -> None:
        """Forget everything that is only in the journal."""
        self.journal.discard()

    def close(self) -> None:
        """Close the journal; its items stay for the next run."""
        self.journal.close()
