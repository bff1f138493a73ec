"""The kinds of items that a workspace keeps: features by photo, putative and kept matches by pair."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from corrsfm.types import Features, Matches, Pair, PruneResult, TwoViewModel, check_array

__all__ = ["FEATURES", "MATCHES", "PRUNED", "Arrays", "Attributes", "K", "Kind", "PrunedMatches", "T"]


K = TypeVar("K", bound=Hashable)
T = TypeVar("T")


Arrays = dict[str, NDArray[Any]]


Attributes = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class PrunedMatches:
    """Matches of a pair that passed pruning.

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

    def __post_init__(self) -> None:
        check_array("indices", self.indices, (len(self.scores), 2), np.int32)
        check_array("scores", self.scores, (len(self.scores),), np.float32)

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
    key : callable
        Key to text.
    encode, decode : callable
        Item to arrays and values for JSON, and back.
    """

    label: str
    key: Callable[[K], str]
    encode: Callable[[T], tuple[Arrays, Attributes]]
    decode: Callable[[Mapping[str, NDArray], Mapping[str, Any]], T]


def _encode_features(features: Features) -> tuple[Arrays, Attributes]:
    arrays: Arrays = {"keypoints": features.keypoints, "scores": features.scores}
    if features.scales is not None:
        arrays["scales"] = features.scales
    if features.orientations is not None:
        arrays["orientations"] = features.orientations
    floats = features.descriptors.dtype != np.uint8
    # `corrsfm.descriptors` says why half the precision is enough.
    arrays["descriptors"] = features.descriptors.astype(np.float16) if floats else features.descriptors
    return arrays, {"image_size": list(features.image_size)}


def _decode_features(arrays: Mapping[str, NDArray], attributes: Mapping[str, Any]) -> Features:
    width, height = attributes["image_size"]
    descriptors = arrays["descriptors"]
    if not np.isfinite(arrays["keypoints"]).all():
        raise ValueError("keypoints that are not finite")
    scales, orientations = arrays.get("scales"), arrays.get("orientations")
    # pycolmap ends the whole process on a scale that is none.
    if scales is not None and not (np.isfinite(scales).all() and (scales > 0).all()):
        raise ValueError("scales that are not finite and above 0")
    if orientations is not None and not np.isfinite(orientations).all():
        raise ValueError("orientations that are not finite")
    return Features(
        keypoints=arrays["keypoints"],
        scales=scales,
        orientations=orientations,
        scores=arrays["scores"],
        descriptors=descriptors if descriptors.dtype == np.uint8 else descriptors.astype(np.float32),
        image_size=(width, height),
    )


def _encode_matches(matches: Matches) -> tuple[Arrays, Attributes]:
    arrays: Arrays = {"indices": _narrow(matches.indices), "mutual": matches.mutual}
    if matches.scores is None:
        arrays["ratios"] = matches.ratios
    else:
        arrays["scores"] = matches.scores
    return arrays, {}


def _decode_matches(arrays: Mapping[str, NDArray], attributes: Mapping[str, Any]) -> Matches:
    indices = _wide(arrays["indices"])
    unknown = np.full(len(indices), np.nan, np.float32)
    return Matches(
        indices=indices,
        ratios=arrays.get("ratios", unknown),
        mutual=arrays["mutual"],
        scores=arrays.get("scores"),
    )


def _encode_pruned(pruned: PrunedMatches) -> tuple[Arrays, Attributes]:
    arrays: Arrays = {"indices": _narrow(pruned.indices), "scores": pruned.scores}
    attributes: Attributes = {
        "num_putative": pruned.num_putative,
        "num_kept": len(pruned.indices),
        "decided_by": pruned.decided_by,
    }
    if pruned.model is not None:
        arrays["model"] = pruned.model.matrix
        attributes["model_kind"] = pruned.model.kind
    return arrays, attributes


def _decode_pruned(arrays: Mapping[str, NDArray], attributes: Mapping[str, Any]) -> PrunedMatches:
    model = None
    if "model" in arrays:
        model = TwoViewModel(kind=attributes["model_kind"], matrix=arrays["model"])
    return PrunedMatches(
        indices=_wide(arrays["indices"]),
        scores=arrays["scores"],
        num_putative=attributes["num_putative"],
        model=model,
        decided_by=attributes["decided_by"],
    )


def _wide(stored: NDArray) -> NDArray[np.int32]:
    """The indices that `_narrow` made smaller."""
    if stored.dtype not in (np.uint16, np.int32):
        raise ValueError(f"indices: expected whole numbers of 16 or 32 bits, got {stored.dtype}")
    return stored.astype(np.int32)


def _narrow(indices: NDArray[np.int32]) -> NDArray:
    """Two bytes a number where they suffice: a scene has millions of pairs."""
    fits = not indices.size or indices.max() <= np.iinfo(np.uint16).max
    return indices.astype(np.uint16) if fits else indices


FEATURES: Kind[str, Features] = Kind("features", str, _encode_features, _decode_features)


# No name of a photo holds a tab.
MATCHES: Kind[Pair, Matches] = Kind("matches", "\t".join, _encode_matches, _decode_matches)


PRUNED: Kind[Pair, PrunedMatches] = Kind("pruned", "\t".join, _encode_pruned, _decode_pruned)
