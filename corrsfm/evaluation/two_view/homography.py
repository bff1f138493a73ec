"""Filters measured by the homography they lead to, on folders in the layout of HPatches.

The protocol of the paper: 108 sequences (those with photos beyond 1600 × 1200 are left out), 2,000 SIFT
keypoints, nearest neighbours, OpenCV's RANSAC at 3 pixels of a photo 480 high, and the mean error of the
four corners, scaled to that size, as AUC@3/5/10.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.config import FeaturesConfig, config_hash, hash_of_content, to_dict
from corrsfm.errors import InputError
from corrsfm.evaluation.metrics import homography_corner_error, pose_auc
from corrsfm.evaluation.records import (
    auc_intervals,
    by_threshold,
    finite_or_none,
    kept_methods,
    provenance,
    save_results,
)
from corrsfm.evaluation.two_view.filters import PairFilter, parse_filter
from corrsfm.files import read_text
from corrsfm.labelled.oanet import OANetPair
from corrsfm.types import Camera, Features, PruneResult

__all__ = ["HOMOGRAPHY_FEATURES", "HomographyPair", "evaluate_homography", "list_sequences", "load_sequence"]

CORNER_THRESHOLDS_PX = (3.0, 5.0, 10.0)
_KEYS = tuple(f"{threshold:g}" for threshold in CORNER_THRESHOLDS_PX)
REFERENCE_SIDE_PX = 480.0
RANSAC_THRESHOLD_PX = 3.0
_CONFIDENCE = 0.99999
# A match this close to the true homography is an inlier.
_INLIER_PX = 3.0

HOMOGRAPHY_FEATURES = FeaturesConfig(max_features=2000, root_sift=False)
"""SIFT as the paper uses it."""

EXCLUDED_SEQUENCES = (
    "i_contruction", "i_crownnight", "i_dc", "i_pencils", "i_whitebuilding",
    "v_artisans", "v_astronautis", "v_talent",
)  # fmt: skip
"""The eight sequences of HPatches with photos larger than 1600 × 1200, which the literature leaves out."""


@dataclass(frozen=True, kw_only=True)
class HomographyPair:
    """Two photos of a plane.

    Attributes
    ----------
    name : str
        ``SEQUENCE 1-N``.
    matches : OANetPair
        Nearest neighbours, normalised by the photo size as on uncalibrated photos. A label distance is 0 for
        an inlier and 1 for an outlier; the pose means nothing.
    homography : (3, 3) float64
        True homography, from pixels of image 0 to image 1, first pixel's centre at (0, 0).
    size0, size1 : tuple of int
        Width and height in pixels.
    """

    name: str
    matches: OANetPair
    homography: NDArray[np.float64]
    size0: tuple[int, int]
    size1: tuple[int, int]


def list_sequences(folder: Path) -> list[Path]:
    """List the sequences of a folder in HPatches' layout, sorted, without those the literature leaves out.

    Raises
    ------
    InputError
        If there is none.
    """
    found = sorted(path.parent for path in folder.glob("*/H_1_2"))
    sequences = [path for path in found if path.name not in EXCLUDED_SEQUENCES]
    if not sequences:
        raise InputError(
            f"{folder}: no sequences found; expected HPatches' layout, folders with 1.ppm … 6.ppm and "
            "H_1_2 … H_1_6"
        )
    return sequences


def _image_path(sequence: Path, number: int) -> Path:
    for suffix in (".ppm", ".png", ".jpg"):
        if (path := sequence / f"{number}{suffix}").exists():
            return path
    raise InputError(f"{sequence}: no photo {number}.ppm (or .png, .jpg)")


def _read_homography(path: Path) -> NDArray[np.float64]:
    try:
        text = read_text(path)
        homography = np.array(text.split(), np.float64).reshape(3, 3)
    except ValueError as error:
        raise InputError(f"{path}: not a homography ({error}); expected 3 × 3 numbers") from error
    if not np.isfinite(homography).all() or np.linalg.matrix_rank(homography) < 3:
        raise InputError(f"{path}: not a homography; expected 3 × 3 finite numbers that can be inverted")
    return homography


def _unit_camera(size: tuple[int, int]) -> Camera:
    """Camera that maps a photo to [-1, 1]², as learned filters expect where intrinsics mean nothing."""
    width, height = size
    half = (width / 2.0, height / 2.0)
    return Camera(model="PINHOLE", width=width, height=height, params=(*half, *half))


def load_sequence(sequence: Path, features: FeaturesConfig = HOMOGRAPHY_FEATURES) -> list[HomographyPair]:
    """Match the first photo of a sequence with the others.

    Raises
    ------
    InputError
        If a photo or a homography cannot be read.
    """
    from corrsfm.features.sift import create_extractor
    from corrsfm.images.photos import read_image

    extract = create_extractor(features)
    numbers = sorted(
        int(path.name.removeprefix("H_1_"))
        for path in sequence.glob("H_1_*")
        if path.name.removeprefix("H_1_").isdecimal()
    )
    first = extract(read_image(_image_path(sequence, 1)), None)
    pairs = []
    for number in numbers:
        other = extract(read_image(_image_path(sequence, number)), None)
        homography = _read_homography(sequence / f"H_1_{number}")
        pairs.append(_match(f"{sequence.name} 1-{number}", first, other, homography))
    return pairs


def _match(
    name: str, features0: Features, features1: Features, homography: NDArray[np.float64]
) -> HomographyPair:
    from corrsfm.matches.nearest import match_features
    from corrsfm.prune import make_correspondences

    matches = match_features(features0.descriptors, features1.descriptors)
    seen = make_correspondences(
        features0,
        features1,
        matches,
        _unit_camera(features0.image_size),
        _unit_camera(features1.image_size),
        name,
    )
    # Files of homographies count from the centre of the first pixel.
    error = _transfer_error(homography, seen.points0 - 0.5, seen.points1 - 0.5)
    labelled = OANetPair(
        correspondences=seen.normalised,
        label_distances=(error > _INLIER_PX * min(features1.image_size) / REFERENCE_SIDE_PX).astype(
            np.float32
        ),
        rotation=np.eye(3),
        translation=np.zeros(3),
        ratios=seen.ratios,
        mutual=seen.mutual,
        log_scale_ratios=seen.log_scale_ratios,
        rotations=seen.rotations,
        camera0=seen.camera0,
        camera1=seen.camera1,
        scene=name.partition(" ")[0],
        name=name,
    )
    return HomographyPair(
        name=name,
        matches=labelled,
        homography=homography,
        size0=features0.image_size,
        size1=features1.image_size,
    )


def _transfer_error(
    homography: NDArray[np.float64], points0: NDArray[np.floating], points1: NDArray[np.floating]
) -> NDArray[np.float64]:
    warped = np.column_stack([points0, np.ones(len(points0))]) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(warped[:, :2] / warped[:, 2:] - points1, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def _corner_error(pair: HomographyPair, result: PruneResult) -> float:
    """Mean corner error of the homography from the kept matches, in pixels of a photo 480 high."""
    import cv2

    seen = pair.matches.as_correspondences()
    kept = result.inlier_mask
    scale = min(pair.size1) / REFERENCE_SIDE_PX
    estimate = None
    if kept.sum() >= 4:
        estimate, _ = cv2.findHomography(
            seen.points0[kept] - 0.5,
            seen.points1[kept] - 0.5,
            cv2.RANSAC,
            RANSAC_THRESHOLD_PX * scale,
            confidence=_CONFIDENCE,
        )
    if estimate is None:
        return float("inf")
    return homography_corner_error(estimate, pair.homography, *pair.size0) / scale


def evaluate_homography(
    folder: Path,
    filters: Sequence[str],
    *,
    results: Path | None = None,
    features: FeaturesConfig = HOMOGRAPHY_FEATURES,
    seed: int = 0,
    device: str = "cpu",
    threads: int = 0,
    overwrite: bool = False,
    command: str = "",
    on_sequence: Callable[[str, int], None] = lambda name, total: None,
) -> dict[str, Any]:
    """Measure filters on a folder in HPatches' layout.

    Parameters
    ----------
    folder : Path
    filters : sequence of str
        See `corrsfm.evaluation.two_view.filters.parse_filter`.
    results : Path, optional
        Result file; filters that it already holds are not measured again.
    features : FeaturesConfig
    seed, device, threads
        For methods of `corrsfm prune`.
    overwrite : bool
        Measure again what the result file holds.
    command : str
        Recorded in the result file.
    on_sequence : callable
        Called before each sequence with its name and the number of sequences.

    Returns
    -------
    dict
        The content of the result file.

    Raises
    ------
    InputError, ConfigError
    """
    built = [parse_filter(name, device=device, seed=seed, threads=threads) for name in filters]
    sequences = list_sequences(folder)
    subject = {
        "name": folder.name,
        "sequences": [sequence.name for sequence in sequences],
        "sha256": config_hash([[sequence.name, hash_of_content(sequence)] for sequence in sequences]),
        "features": to_dict(features),
    }

    def read(entry: dict[str, Any]) -> None:
        summary = entry["summary"]
        numbers = [summary["num_failed"], summary["num_kept"], *map(summary["auc"].__getitem__, _KEYS)]
        for name in _KEYS:
            mean, low, high = summary["auc_interval"][name]
            numbers += [mean, low, high]
        if not all(type(number) in (int, float) for number in numbers):
            raise ValueError("a score is no number")

    entries = kept_methods(results, "homography", subject, read, overwrite=overwrite)
    missing = [f for f in built if entries.get(f.name, {}).get("fingerprint") != f.fingerprint]
    measured = _measure(missing, sequences, features, on_sequence) if missing else {}
    for pair_filter in missing:
        errors, kept = measured[pair_filter.name]
        entries[pair_filter.name] = {
            "fingerprint": pair_filter.fingerprint,
            "measured": provenance(seed=seed, command=command, device=device),
            "summary": _summarise(errors, kept, seed),
            "pairs": {"corner_error_px": {n: finite_or_none(e, 4) for n, e in errors.items()}},
        }
    values = {
        "provenance": provenance(seed=seed, command=command, device=device),
        "subject": subject,
        "methods": entries,
    }
    if results is not None:
        save_results(results, "homography", values)
    return values


def _measure(
    filters: Sequence[PairFilter],
    sequences: Sequence[Path],
    features: FeaturesConfig,
    on_sequence: Callable[[str, int], None],
) -> dict[str, tuple[dict[str, float], list[int]]]:
    """Corner errors by pair name, and numbers of kept matches, of every filter."""
    measured: dict[str, tuple[dict[str, float], list[int]]] = {f.name: ({}, []) for f in filters}
    for sequence in sequences:
        on_sequence(sequence.name, len(sequences))
        pairs = load_sequence(sequence, features)
        for pair_filter in filters:
            errors, kept = measured[pair_filter.name]
            results = pair_filter([pair.matches for pair in pairs])
            for pair, result in zip(pairs, results, strict=True):
                errors[pair.name] = _corner_error(pair, result)
                kept.append(int(result.inlier_mask.sum()))
    return measured


def _summarise(errors: dict[str, float], kept: list[int], seed: int) -> dict[str, Any]:
    values = np.array(list(errors.values()))
    kinds = np.array([name[:2] for name in errors])
    summary: dict[str, Any] = {
        "num_pairs": len(values),
        "num_failed": int(np.sum(~np.isfinite(values))),
        "num_kept": round(float(np.mean(kept)), 2),
        "auc": _aucs(values),
        "auc_interval": auc_intervals(values, CORNER_THRESHOLDS_PX, seed),
    }
    for prefix, label in (("i_", "illumination"), ("v_", "viewpoint")):
        if (kinds == prefix).any():
            summary[f"auc_{label}"] = _aucs(values[kinds == prefix])
    return summary


def _aucs(errors: NDArray[np.float64]) -> dict[str, float]:
    return by_threshold(pose_auc(errors, CORNER_THRESHOLDS_PX), CORNER_THRESHOLDS_PX)
