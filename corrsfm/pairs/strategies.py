"""Names → pairs of photos worth matching, by one strategy or the union of several.

Every strategy returns index pairs; `make_pairs` merges them, drops repetitions in either orientation and
records which strategies proposed each pair.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import re
import shlex
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from corrsfm.config import PairsConfig, PairStrategy
from corrsfm.errors import ConfigError, InputError, first_few
from corrsfm.files import read_lines
from corrsfm.geometry import earth_fixed
from corrsfm.pairs.retrieval import global_vectors, most_similar
from corrsfm.types import Features, ImageRecord, PairList

__all__ = [
    "covisible_pairs",
    "exhaustive_pairs",
    "make_pairs",
    "natural_order",
    "num_pairs_expected",
    "pairs_of_new_photos",
    "read_pairs_file",
    "retrieval_pairs",
    "sequential_pairs",
    "spatial_pairs",
]

logger = logging.getLogger("corrsfm")

IndexPairs = set[tuple[int, int]]
"""Pairs of photo indices, the smaller first."""

MAX_EXHAUSTIVE_PHOTOS = 200
BLOCK_SIZE = 2048
LOOP_CLOSURE = "loop-closure"
# Similar frames paired with each frame of a video; most of them are neighbours in time.
MAX_LOOPS = 10


def make_pairs(
    records: Sequence[ImageRecord],
    config: PairsConfig,
    *,
    load_features: Callable[[str], Features] | None = None,
    seed: int = 0,
    is_sequence: bool = False,
) -> PairList:
    """Choose the pairs to match.

    Parameters
    ----------
    records : sequence of ImageRecord
        The photos of the scene.
    config : PairsConfig
        ``auto`` means the strategies file and covisibility if there is a pairs file or a model for them, else
        neighbours in a sequence and its loops, else exhaustive up to 200 photos and retrieval above. With
        several strategies the result is their union.
    load_features : callable, optional
        Name → features; needed by retrieval and loop closure only.
    seed : int
        Decides which photos the vocabulary of the retrieval is learned from.
    is_sequence : bool
        The photos are frames of a video, named in the order of time.

    Returns
    -------
    PairList
        Sorted, each pair with its smaller name first.

    Raises
    ------
    ConfigError
        If an option that a strategy needs is missing.
    InputError
        If a pairs file or model does not fit the photos, or no photo has a GPS position.
    """
    names = sorted(record.name for record in records)
    if (
        is_sequence
        and config.pairing == (PairStrategy.AUTO,)
        and not (config.pairs_file or config.covisible_model)
    ):
        config = _of_sequence(config)
    strategies = _resolve(config, len(names))
    retrieved: IndexPairs | None = None
    loop_closure = config.loop_closure and PairStrategy.SEQUENTIAL in strategies
    if config.loop_closure and not loop_closure:
        logger.warning(
            "--loop-closure adds to --pairing sequential only, which is not chosen: %s", ", ".join(strategies)
        )
    if loop_closure or PairStrategy.RETRIEVAL in strategies:
        retrieved = retrieval_pairs(names, config.num_retrieved, load_features=load_features, seed=seed)
    proposals: dict[str, IndexPairs] = {}
    for strategy in strategies:
        match strategy:
            case PairStrategy.EXHAUSTIVE:
                found = exhaustive_pairs(len(names))
            case PairStrategy.SEQUENTIAL:
                found = sequential_pairs(
                    names, config.sequential_overlap, quadratic=config.sequential_quadratic
                )
            case PairStrategy.RETRIEVAL:
                found = retrieved or set()
            case PairStrategy.SPATIAL:
                found = spatial_pairs(records, config.num_spatial, config.max_distance_m)
            case PairStrategy.FILE:
                found = read_pairs_file(_needed(config.pairs_file, "--pairs-file", strategy), names)
            case _:
                model = _needed(config.covisible_model, "--covisible-model", strategy)
                found = covisible_pairs(model, names, config.num_covisible)
        proposals[str(strategy)] = found
    if loop_closure:
        proposals[LOOP_CLOSURE] = retrieved or set()
    return _merged(names, proposals)


def check_files(config: PairsConfig) -> None:
    """Check that the files of the strategies are named and there, before any work is done.

    Raises
    ------
    ConfigError
        If an option that a strategy needs is missing.
    InputError
        If there is no such file.
    """
    for strategy, path, flag in (
        (PairStrategy.FILE, config.pairs_file, "--pairs-file"),
        (PairStrategy.COVISIBILITY, config.covisible_model, "--covisible-model"),
    ):
        if strategy in config.pairing:
            _needed(path, flag, strategy)
        if path is not None and not path.exists():
            raise InputError(f"{path}: no such file; expected what {flag} names")


def num_pairs_expected(num_photos: int, config: PairsConfig) -> int:
    """Pairs that ``auto`` makes of photos; an upper bound where they are chosen by similarity."""
    every = num_photos * (num_photos - 1) // 2
    few = num_photos <= MAX_EXHAUSTIVE_PHOTOS
    return every if few else min(every, num_photos * config.num_retrieved)


def _of_sequence(config: PairsConfig) -> PairsConfig:
    """Options for the frames of a video: neighbours in time, near and far, and loops."""
    return dataclasses.replace(
        config,
        pairing=(PairStrategy.SEQUENTIAL,),
        sequential_quadratic=True,
        loop_closure=True,
        num_retrieved=min(config.num_retrieved, MAX_LOOPS),
    )


def _resolve(config: PairsConfig, num_photos: int) -> list[PairStrategy]:
    """Resolve ``auto`` and drop repetitions."""
    strategies = set(config.pairing)
    if PairStrategy.AUTO in strategies:
        strategies.remove(PairStrategy.AUTO)
        if config.pairs_file is not None:
            strategies.add(PairStrategy.FILE)
        if config.covisible_model is not None:
            strategies.add(PairStrategy.COVISIBILITY)
        if config.pairs_file is None and config.covisible_model is None:
            few = num_photos <= MAX_EXHAUSTIVE_PHOTOS
            strategies.add(PairStrategy.EXHAUSTIVE if few else PairStrategy.RETRIEVAL)
    return sorted(strategies)


def _needed(path: Path | None, flag: str, strategy: PairStrategy) -> Path:
    if path is None:
        raise ConfigError(f"--pairing {strategy} needs {flag}")
    return path


def _merged(names: Sequence[str], proposals: dict[str, IndexPairs]) -> PairList:
    origins: dict[tuple[int, int], list[str]] = defaultdict(list)
    for origin in sorted(proposals):
        for pair in proposals[origin]:
            origins[pair].append(origin)
    # The names are sorted, so sorted indices are sorted names.
    order = sorted(origins)
    return PairList(
        pairs=tuple((names[i], names[j]) for i, j in order),
        origins=tuple(tuple(origins[pair]) for pair in order),
    )


def _ordered(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)


def exhaustive_pairs(num_photos: int) -> IndexPairs:
    """All pairs."""
    return {(i, j) for i in range(num_photos) for j in range(i + 1, num_photos)}


def natural_order(names: Sequence[str]) -> list[int]:
    """Indices that sort names the way people count: img2 before img10, folder by folder."""

    def key(index: int) -> tuple:
        # Splitting by a group alternates text and digits, so that text meets text in comparisons.
        parts = [re.split(r"([0-9]+)", part) for part in names[index].split("/")]
        return (
            [[int(p) if i % 2 else p.casefold() for i, p in enumerate(pieces)] for pieces in parts],
            names[index],
        )

    return sorted(range(len(names)), key=key)


def sequential_pairs(names: Sequence[str], overlap: int, *, quadratic: bool = False) -> IndexPairs:
    """Pairs of neighbours in natural name order.

    Parameters
    ----------
    names : sequence of str
    overlap : int
        Neighbours on each side.
    quadratic : bool
        Also pair photos 2, 4, 8 … apart.
    """
    order = natural_order(names)
    distances = set(range(1, min(overlap, len(names)) + 1))
    if quadratic:
        distances.update(1 << power for power in range(len(names).bit_length()))
    return {
        _ordered(order[position], order[position + distance])
        for distance in sorted(distances)
        for position in range(len(order) - distance)
    }


def retrieval_pairs(
    names: Sequence[str],
    num_retrieved: int,
    *,
    load_features: Callable[[str], Features] | None,
    seed: int,
) -> IndexPairs:
    """Each photo with the photos that look most like it; a photo without features gets no pair."""
    if load_features is None:
        raise ValueError("retrieval needs load_features")
    vectors = global_vectors(names, lambda name: load_features(name).descriptors, seed=seed)
    neighbours = most_similar(vectors, num_retrieved)
    return {_ordered(i, int(j)) for i, found in enumerate(neighbours) for j in found}


def pairs_of_new_photos(
    known: Sequence[str],
    new: Sequence[str],
    num_retrieved: int,
    *,
    load_features: Callable[[str], Features],
    seed: int,
) -> set[tuple[str, str]]:
    """Photos that come later with those that are there, and with each other.

    Parameters
    ----------
    known, new : sequence of str
        Names without repetition.
    num_retrieved : int
        Most similar photos paired with each new photo, where there are more than 200 photos; else all.
    load_features : callable
        Name → features, of all photos.
    seed : int

    Returns
    -------
    set of Pair
        Each with its smaller name first.
    """
    names = sorted({*known, *new})
    if len(names) <= MAX_EXHAUSTIVE_PHOTOS:
        proposed = {_ordered_names(one, other) for one in new for other in names if one != other}
    else:
        indices = retrieval_pairs(names, num_retrieved, load_features=load_features, seed=seed)
        proposed = {(names[i], names[j]) for i, j in indices}
    fresh = set(new)
    return {pair for pair in proposed if not fresh.isdisjoint(pair)}


def _ordered_names(one: str, other: str) -> tuple[str, str]:
    return (one, other) if one < other else (other, one)


def spatial_pairs(records: Sequence[ImageRecord], num_neighbours: int, max_distance_m: float) -> IndexPairs:
    """Each photo with the nearest photos by GPS, as indices into the sorted names.

    Distances are straight lines between points on the ellipsoid: altitudes in EXIF are too often missing,
    or relative to the start of a drone, to be compared.
    """
    ordered = sorted(records, key=lambda record: record.name)
    located = np.array([index for index, record in enumerate(ordered) if record.gps is not None], np.int64)
    if len(located) < 2:
        raise InputError(
            f"{len(located)} of {len(ordered)} photos have a GPS position in EXIF, at least two are needed;"
            " choose another --pairing"
        )
    points = earth_fixed(np.array([(*record.gps[:2], 0.0) for record in ordered if record.gps is not None]))
    pairs = set()
    for start in range(0, len(points), BLOCK_SIZE):
        block = points[start : start + BLOCK_SIZE]
        squared = np.zeros((len(block), len(points)))
        for axis in range(3):
            squared += (block[:, axis, None] - points[None, :, axis]) ** 2
        rows = np.arange(len(block))
        squared[rows, start + rows] = np.inf
        nearest = np.argsort(squared, axis=1, kind="stable")[:, :num_neighbours]
        near = np.take_along_axis(squared, nearest, axis=1) <= max_distance_m**2
        for row, column in np.argwhere(near):
            pairs.add(_ordered(int(located[start + row]), int(located[nearest[row, column]])))
    return pairs


def read_pairs_file(path: Path, names: Sequence[str]) -> IndexPairs:
    """Pairs from a text file with ``name0 name1`` per line.

    Names that contain spaces may be separated by a tab or quoted; plain spaces work if only one split of
    the line gives two known names. Lines that begin with ``#`` are comments.

    Raises
    ------
    InputError
        If the file cannot be read, or listing every line that does not name two different known photos.
    """
    position = {name: index for index, name in enumerate(names)}
    pairs: IndexPairs = set()
    problems = []
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        pair = _parse_pair(line, position)
        if pair is None:
            problems.append(f"line {number}: {line.strip()!r}")
        else:
            pairs.add(pair)
    if problems:
        raise InputError(
            f"{path}: {len(problems)} lines do not name two different photos of the scene:"
            f" {first_few(problems)};"
            ' names are relative to the image folder; part or quote names with spaces by tabs or "'
        )
    if not pairs:
        raise InputError(f"{path}: names no pair")
    return pairs


def _parse_pair(line: str, position: dict[str, int]) -> tuple[int, int] | None:
    words = line.split()
    if len(words) == 2 and words[0] != words[1] and words[0] in position and words[1] in position:
        return _ordered(position[words[0]], position[words[1]])
    candidates: list[Sequence[str]] = [[part.strip() for part in line.split("\t")]]
    if '"' in line or "'" in line:
        with contextlib.suppress(ValueError):  # an apostrophe in a name is not a quote
            candidates.append(shlex.split(line))
    text = line.strip()
    spaces = [match.span() for match in re.finditer(r"\s+", text)]
    splits = [(text[:start], text[end:]) for start, end in spaces]
    known = [split for split in splits if split[0] in position and split[1] in position]
    if len(known) == 1:
        candidates.extend(known)
    for candidate in candidates:
        if (
            len(candidate) == 2
            and candidate[0] != candidate[1]
            and all(name in position for name in candidate)
        ):
            return _ordered(position[candidate[0]], position[candidate[1]])
    return None


def covisible_pairs(model: Path, names: Sequence[str], num_covisible: int) -> IndexPairs:
    """Each photo with the photos that see most of the same points of a COLMAP model.

    Photos are found by name; those of the model that are not in the scene are ignored.

    Raises
    ------
    InputError
        If the model cannot be read, has none of the photos, or no two of them share a point.
    """
    from corrsfm.colmap.models import read_model

    reconstruction = read_model(model)
    position = {name: index for index, name in enumerate(names)}
    observed = {
        position[image.name]: [point.point3D_id for point in image.points2D if point.has_point3D()]
        for image in reconstruction.images.values()
        if image.name in position
    }
    if not observed:
        raise InputError(f"{model}: none of its images is among the photos; names must be the same")
    pairs = _most_shared(observed, num_covisible)
    if not pairs:
        raise InputError(f"{model}: no two photos share a point of the model; is it a model without points?")
    return pairs


def _most_shared(observed: dict[int, list[int]], num_neighbours: int) -> IndexPairs:
    """Pairs of the photos that share most points, from the point ids each photo observes."""
    images = np.concatenate([np.full(len(ids), image) for image, ids in sorted(observed.items())])
    points = np.concatenate([np.asarray(ids, np.int64) for _, ids in sorted(observed.items())])
    # One row per distinct (point, image), grouped by point.
    rows = np.unique(np.stack([points, images], axis=1).astype(np.int64), axis=0)
    _, group, sizes = np.unique(rows[:, 0], return_inverse=True, return_counts=True)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    pairs: IndexPairs = set()
    for image in sorted(observed):
        groups = group[rows[:, 1] == image]
        seen_by = [rows[starts[g] : starts[g + 1], 1] for g in groups]
        counts = np.bincount(np.concatenate([*seen_by, np.zeros(0, np.int64)]))
        if image < len(counts):
            counts[image] = 0
        best = np.argsort(-counts, kind="stable")[:num_neighbours]
        pairs.update(_ordered(image, int(other)) for other in best if counts[other] > 0)
    return pairs
