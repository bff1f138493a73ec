"""Predicted matches: what a right model finds beyond the matches that it was made from.

A model draws an epipolar line through photo 1 for every keypoint of photo 0. If the poses are right, the
keypoint's true partner lies on that line, and its descriptor stands out among the few look-alikes that do,
even where it did not stand out in the whole photo. Wrong poses draw lines through nothing. The number of such
matches over all pairs compares models of one scene with each other; on its own it says little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corrsfm.reconstruction.epipolar import TwoViews
from corrsfm.reconstruction.views import Rays, Views, rays_of
from corrsfm.types import Pair

__all__ = ["NeighbourTables", "Neighbours", "nearest_descriptors", "predict", "predict_pair", "sample_pairs"]

NUM_NEIGHBOURS = 12
MAX_LINE_DISTANCE_PX = 3.0
MAX_RATIO = 0.85
# A pair of 4,096 features takes 0.4 MB at most and 20 ms, twice as long as matching it.
MIN_SAMPLE = 300
PAIRS_PER_PHOTO = 2
_NUM_GROUPS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbours:
    """The nearest descriptors in photo 1 of keypoints of photo 0.

    Attributes
    ----------
    keypoints : (R,) int32
        Keypoints of photo 0, increasing; only those that some model can give a match.
    indices : (R, k) int32
        Keypoints of photo 1, the nearest first; of equal distances the lower index first. k is less than
        asked for if photo 1 has fewer keypoints.
    distances_sq : (R, k) float32
        Squared distances, exact integers.
    """

    keypoints: NDArray[np.int32]
    indices: NDArray[np.int32]
    distances_sq: NDArray[np.float32]


def nearest_descriptors(
    descriptors0: NDArray, descriptors1: NDArray, num: int = NUM_NEIGHBOURS
) -> Neighbours:
    """Nearest descriptors, by exact distances (`corrsfm.distances`): the same on every machine.

    Keypoints whose nearest descriptor fails the ratio against the last of them are left out: no model can
    make a match of them. In most pairs these are most keypoints.

    Parameters
    ----------
    descriptors0 : (N0, D) uint8 or float32
        Bytes, or unit vectors.
    descriptors1 : (N1, D) uint8 or float32
    num : int

    Returns
    -------
    Neighbours
        ``min(num, N1)`` for each keypoint that is left.
    """
    # Imported late because it loads torch.
    from corrsfm.distances import CPU_BLOCK_ROWS, PreparedDescriptors, distances_on_cpu

    photo0, photo1 = PreparedDescriptors(descriptors0), PreparedDescriptors(descriptors1)
    num = min(num, len(photo1))
    keypoints = [np.zeros(0, np.int32)]
    indices = [np.zeros((0, num), np.int32)]
    distances_sq = [np.zeros((0, num), np.float32)]
    for start in range(0, len(photo0) if num > 1 else 0, CPU_BLOCK_ROWS):
        rows = slice(start, min(start + CPU_BLOCK_ROWS, len(photo0)))
        block = distances_on_cpu(photo0, photo1, rows, slice(0, len(photo1)))
        chosen = _smallest(block, num)
        nearest = np.take_along_axis(block, chosen, axis=1)
        useful = np.flatnonzero(nearest[:, 0] < MAX_RATIO**2 * nearest[:, -1])
        keypoints.append((start + useful).astype(np.int32))
        indices.append(chosen[useful].astype(np.int32))
        distances_sq.append(nearest[useful].astype(np.float32))
    return Neighbours(
        keypoints=np.concatenate(keypoints),
        indices=np.concatenate(indices),
        distances_sq=np.concatenate(distances_sq),
    )


def _smallest(values: NDArray, num: int) -> NDArray[np.intp]:
    """Columns of the smallest values of each row in order, (R, num); the lower column among equals."""
    found = np.flatnonzero(values <= _limits(values, num))
    row, column = np.divmod(found, values.shape[1])
    order = np.lexsort((column, values[row, column], row))
    row, column = row[order], column[order]
    counts = np.bincount(row, minlength=len(values))
    rank = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    return column[rank < num].reshape(-1, num)


def _limits(values: NDArray, num: int) -> NDArray:
    """A value that at least ``num`` of each row do not exceed, and not many more, (R, 1).

    As many groups of columns have a smallest value that does not exceed it. numpy's partition would find the
    exact limit, but takes six times as long on processors that compress vectors into memory slowly (Zen 4).
    """
    num_rows, num_columns = values.shape
    size = num_columns // _NUM_GROUPS
    if size < 2 or num > _NUM_GROUPS:
        return np.sort(values, axis=1)[:, num - 1 : num]
    grouped = values[:, : size * _NUM_GROUPS].reshape(num_rows, size, _NUM_GROUPS)
    lowest = np.sort(grouped.min(axis=1), axis=1)
    return lowest[:, num - 1 : num]


class NeighbourTables:
    """Neighbours of pairs, computed when first asked for and kept, since many models are compared.

    Memory grows with the pairs asked for, at most 0.4 MB for one of 4,096 keypoints: bound their number with
    `sample_pairs`.

    Parameters
    ----------
    load : callable
        Photo name → (N, D) descriptors.
    """

    def __init__(self, load: Callable[[str], NDArray]) -> None:
        self._load = load
        self._tables: dict[Pair, Neighbours] = {}

    def __getitem__(self, pair: Pair) -> Neighbours:
        if pair not in self._tables:
            self._tables[pair] = nearest_descriptors(self._load(pair[0]), self._load(pair[1]))
        return self._tables[pair]


def sample_pairs(
    names: Iterable[str], verified: Iterable[Pair], *, max_pairs: int | None = None, seed: int = 0
) -> list[Pair]:
    """The pairs over which predicted matches are counted: all of a small scene, a fair sample of a large one.

    In a large scene most pairs see different things. The sample is drawn from pairs that are verified or
    have a verified neighbour in common, spread over the photos: one that is in few pairs so far goes first.

    Parameters
    ----------
    names : iterable of str
        Photos of the scene.
    verified : iterable of Pair
    max_pairs : int, optional
        Twice the number of photos, but at least 300, if not given.
    seed : int

    Returns
    -------
    list of Pair
        Sorted, each with the smaller name first.
    """
    names = sorted(set(names))
    limit = max(MIN_SAMPLE, PAIRS_PER_PHOTO * len(names)) if max_pairs is None else max_pairs
    if len(names) * (len(names) - 1) // 2 <= limit:
        return [(name0, name1) for i, name0 in enumerate(names) for name1 in names[i + 1 :]]
    number = {name: i for i, name in enumerate(names)}
    linked = np.eye(len(names), dtype=np.float32)
    for name0, name1 in verified:
        linked[number[name0], number[name1]] = linked[number[name1], number[name0]] = 1
    near = np.argwhere(np.triu(linked @ linked > 0, k=1))
    near = near[np.random.default_rng(seed).permutation(len(near))]
    uses = np.zeros(len(names), np.int64)
    chosen: list[tuple[int, int]] = []
    while len(near) and len(chosen) < limit:
        level = uses[near].min()
        left = []
        for i, j in near:
            if min(uses[i], uses[j]) > level:
                left.append((i, j))
            elif len(chosen) < limit:
                chosen.append((i, j))
                uses[[i, j]] += 1
        near = np.array(left, np.int64).reshape(-1, 2)
    return sorted((names[i], names[j]) for i, j in chosen)


def predict_pair(neighbours: Neighbours, two: TwoViews) -> NDArray[np.int32]:
    """Predicted matches of a pair.

    Of a keypoint's neighbours those count that lie on its epipolar line and in front of both photos, or so
    far away that noise decides the side. The nearest is accepted if it is clearly nearer than the next that
    counts, or than the last neighbour where no other counts. Of several that accept the same keypoint of
    photo 1 the nearest stays.

    Parameters
    ----------
    neighbours : Neighbours
        Of all N0 keypoints of photo 0.
    two : TwoViews

    Returns
    -------
    (K, 2) int32
        Keypoint indices, column 0 increasing.
    """
    num0, num = neighbours.indices.shape
    if not num0:
        return np.zeros((0, 2), np.int32)
    everything = np.column_stack([np.repeat(neighbours.keypoints, num), neighbours.indices.ravel()])
    near = np.flatnonzero(two.line_distance_px(everything) < MAX_LINE_DISTANCE_PX)
    counts = np.zeros(num0 * num, bool)
    on_line = everything[near]
    counts[near] = two.in_front(on_line) | (two.far_distance_px(on_line) < MAX_LINE_DISTANCE_PX)
    counts = counts.reshape(num0, num)
    row = np.flatnonzero(counts.any(axis=1))
    first = counts[row].argmax(axis=1)
    others = counts[row]
    others[np.arange(len(row)), first] = False
    second = np.where(others.any(axis=1), others.argmax(axis=1), num - 1)
    distance_sq = neighbours.distances_sq[row, first]
    accepted = distance_sq < MAX_RATIO**2 * neighbours.distances_sq[row, second]
    matches = np.column_stack([neighbours.keypoints[row], neighbours.indices[row, first]])[accepted]
    return _one_to_one(matches, distance_sq[accepted])


def _one_to_one(matches: NDArray[np.int32], distances_sq: NDArray[np.float32]) -> NDArray[np.int32]:
    """The nearest match of every keypoint of photo 1, in the order of photo 0; equals: the first one."""
    order = np.lexsort((matches[:, 0], distances_sq, matches[:, 1]))
    ordered = matches[order]
    is_first = np.ones(len(ordered), bool)
    is_first[1:] = ordered[1:, 1] != ordered[:-1, 1]
    return matches[np.sort(order[is_first])]


def predict(
    views: Views,
    keypoints: Mapping[str, NDArray[np.floating]],
    tables: Mapping[Pair, Neighbours] | NeighbourTables,
    pairs: Sequence[Pair],
) -> dict[Pair, NDArray[np.int32]]:
    """Predicted matches of all pairs of registered photos.

    Parameters
    ----------
    views : mapping of str to View
        Registered photos.
    keypoints : mapping of str to (N, 2) float
        Pixels, COLMAP convention, of every registered photo.
    tables : NeighbourTables
        Or any mapping from pairs to neighbours.
    pairs : sequence of Pair
        Where to count, the same for all models that are compared; pairs with an unregistered photo are
        passed over.

    Returns
    -------
    dict of Pair to (K, 2) int32
        Keypoint indices; the sum of the lengths is what compares models.
    """
    rays: dict[str, Rays] = rays_of(views, keypoints)
    return {
        (name0, name1): predict_pair(
            tables[name0, name1], TwoViews(views[name0], views[name1], rays[name0], rays[name1])
        )
        for name0, name1 in pairs
        if name0 in views and name1 in views
    }
