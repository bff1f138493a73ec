"""How features and matches lie in HDF5: hloc's layout, so that its tools read the files, and what we add.

``features.h5``
    Group = photo name; ``keypoints`` (N, 2) float32 with the first pixel's centre at (0, 0), ``scores``
    (N,) float32, ``descriptors`` (D, N) float16, ``image_size`` (2,) int32, and beyond hloc, where the
    features have them, ``scales`` and ``oris`` (N,) float32. SIFT's descriptors are uint8 / 512, which is
    exact; those of networks are unit vectors, and the group says so by ``descriptors`` = "unit".
``matches.h5``, ``pruned.h5``
    Group = ``name0/name1`` with slashes inside a name as dashes; ``matches0`` (N0,) int32 with -1 for none
    and ``matching_scores0`` (N0,) float32. Nearest neighbours score 1 − ratio; other matches carry the score
    of their matcher, and the group says so by ``scored_by`` = "matcher". Both carry ``mutual0`` (N0,) bool.
    Kept matches carry the score of the prune method.

Every group has the attribute ``fingerprint``; the root has ``format`` and ``version``.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import InputError
from corrsfm.types import Features, Matches, Pair, PruneResult, TwoViewModel

__all__ = [
    "FEATURES",
    "MATCHES",
    "PRUNED",
    "Arrays",
    "Attributes",
    "Kind",
    "PrunedMatches",
    "check_hloc_keys",
]


K = TypeVar("K", bound=Hashable)
T = TypeVar("T")

HALF_PIXEL = np.float32(0.5)
UNIT = "unit"
MATCHER = "matcher"


Arrays = dict[str, NDArray[Any]]


Attributes = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class PrunedMatches:
    """Matches of a pair that passed pruning, as `pruned.h5` stores them.

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
    arrays: Arrays = {"keypoints": features.keypoints - HALF_PIXEL, "scores": features.scores}
    if features.scales is not None:
        arrays["scales"] = features.scales
    if features.orientations is not None:
        arrays["oris"] = features.orientations
    descriptors = features.descriptors.astype(np.float16)
    attributes: Attributes = {}
    if features.descriptors.dtype == np.uint8:
        descriptors /= np.float16(512)
    else:
        attributes["descriptors"] = UNIT
    arrays["descriptors"] = np.ascontiguousarray(descriptors.T)
    arrays["image_size"] = np.asarray(features.image_size, np.int32)
    return arrays, attributes


def _decode_features(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> Features:
    """Read our layout, or SIFT in hloc's."""
    keypoints = np.asarray(arrays["keypoints"], np.float32) + HALF_PIXEL
    num = len(keypoints)
    descriptors: NDArray = np.ascontiguousarray(np.asarray(arrays["descriptors"], np.float32).T)
    if attributes.get("descriptors") != UNIT:
        descriptors = _sift_descriptors(descriptors, num)
    width, height = (int(value) for value in np.asarray(arrays["image_size"]))

    def vector(name: str) -> NDArray[np.float32] | None:
        return np.asarray(arrays[name], np.float32) if name in arrays else None

    scores = vector("scores")
    return Features(
        keypoints=keypoints,
        scales=vector("scales"),
        orientations=vector("oris"),
        scores=np.full(num, np.nan, np.float32) if scores is None else scores,
        descriptors=descriptors,
        image_size=(width, height),
    )


def _sift_descriptors(descriptors: NDArray[np.float32], num: int) -> NDArray[np.uint8]:
    """Stored descriptors (N, 128) as bytes; raises `ValueError` if they cannot be SIFT's."""
    if descriptors.shape != (num, 128):
        raise ValueError(
            f"descriptors of shape {descriptors.shape[::-1]}, expected SIFT's (128, {num}); those of other "
            "features come in by corrsfm import"
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
    scores = np.float32(1) - matches.ratios if matches.scores is None else matches.scores
    arrays = _scatter(num, matches.indices, scores)
    arrays["mutual0"] = np.zeros(num, np.bool_)
    arrays["mutual0"][matches.indices[:, 0]] = matches.mutual
    return arrays, {} if matches.scores is None else {"scored_by": MATCHER}


def _decode_matches(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> Matches:
    indices, scores = _gather(arrays)
    # hloc's files do not mark mutual matches; its default matcher keeps no others.
    mutual = (
        np.asarray(arrays["mutual0"], np.bool_)[indices[:, 0]]
        if "mutual0" in arrays
        else np.ones(len(indices), bool)
    )
    if attributes.get("scored_by") == MATCHER:
        unknown = np.full(len(indices), np.nan, np.float32)
        return Matches(indices=indices, ratios=unknown, mutual=mutual, scores=scores)
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
