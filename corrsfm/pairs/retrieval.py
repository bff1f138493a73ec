"""Retrieval of similar photos from the scene's own local descriptors, without a pretrained vocabulary.

Every photo becomes one vector: its descriptors at unit length, rotated to the directions in which those of
this scene vary most, are assigned to the nearest of a few words learned from a sample of the scene, and the
differences to the words are added up (VLAD: Jégou et al., "Aggregating local descriptors into a compact image
representation", CVPR 2010), each word's sum normalised by itself (Arandjelović and Zisserman, "All about
VLAD", CVPR 2013). Similar photos have a large dot product.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corrsfm.descriptors import unit_rows

__all__ = ["Vocabulary", "aggregate", "global_vectors", "most_similar", "train_vocabulary"]

NUM_WORDS = 64
NUM_DIRECTIONS = 32
NUM_SAMPLED_PHOTOS = 256
NUM_SAMPLED_DESCRIPTORS = 400  # of each sampled photo
NUM_ITERATIONS = 12
BLOCK_SIZE = 2048


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """Words of a scene.

    Attributes
    ----------
    mean : (D,) float32
    directions : (D, P) float32
        Orthonormal columns: the P directions of largest variance.
    words : (K, P) float32
        Cluster centres of rotated descriptors.
    """

    mean: NDArray[np.float32]
    directions: NDArray[np.float32]
    words: NDArray[np.float32]


def global_vectors(
    names: Sequence[str], load_descriptors: Callable[[str], NDArray], *, seed: int
) -> NDArray[np.float16]:
    """One vector per photo, from a vocabulary learned on a sample of the photos.

    Parameters
    ----------
    names : sequence of str
    load_descriptors : callable
        Name → (N, D); called at most twice per photo, so that only one photo is in memory at a time.
    seed : int

    Returns
    -------
    (len(names), K·P) float16
        Of unit length; zero for a photo without descriptors. 4 kB each: 100,000 photos take 400 MB.
    """
    vectors = np.zeros((len(names), NUM_WORDS * NUM_DIRECTIONS), np.float16)
    sample = _sample(names, load_descriptors, seed)
    if len(sample) == 0:
        return vectors
    vocabulary = train_vocabulary(sample, seed=seed)
    for index, name in enumerate(names):
        vector = aggregate(load_descriptors(name), vocabulary)
        vectors[index, : len(vector)] = vector
    return vectors


def _sample(names: Sequence[str], load_descriptors: Callable[[str], NDArray], seed: int) -> NDArray:
    """(N, D) descriptors of photos drawn at random."""
    generator = np.random.default_rng(seed)
    chosen = np.sort(generator.choice(len(names), size=min(len(names), NUM_SAMPLED_PHOTOS), replace=False))
    samples = []
    for index in chosen:
        descriptors = load_descriptors(names[index])
        rows = generator.permutation(len(descriptors))[:NUM_SAMPLED_DESCRIPTORS]
        samples.append(descriptors[np.sort(rows)])
    return np.concatenate([sample for sample in samples if len(sample)] or [np.zeros((0, 1), np.uint8)])


def train_vocabulary(descriptors: NDArray, *, seed: int) -> Vocabulary:
    """Learn directions and words by principal components and k-means.

    Parameters
    ----------
    descriptors : (N, D) uint8 or float32
        At least one.
    seed : int

    Returns
    -------
    Vocabulary
        With fewer words than usual if there are fewer distinct descriptors.
    """
    values = unit_rows(descriptors)
    mean = values.mean(axis=0, dtype=np.float32)
    covariance = np.cov(values - mean, rowvar=False, bias=True).astype(np.float64)
    _, vectors = np.linalg.eigh(np.atleast_2d(covariance))
    directions = np.ascontiguousarray(vectors[:, ::-1][:, :NUM_DIRECTIONS], np.float32)
    points = ((values - mean) @ directions).astype(np.float32, copy=False)
    words = np.unique(points, axis=0)
    generator = np.random.default_rng(seed)
    words = words[np.sort(generator.permutation(len(words))[:NUM_WORDS])]
    for _ in range(NUM_ITERATIONS):
        nearest = _nearest(points, words)
        counts = np.bincount(nearest, minlength=len(words))
        sums = _sums(points, nearest, len(words))
        # A word that lost all its descriptors stays where it was.
        centres = (sums / np.maximum(counts, 1)[:, None]).astype(np.float32)
        words = np.where(counts[:, None] > 0, centres, words).astype(np.float32)
    return Vocabulary(mean=mean, directions=directions, words=words)


def aggregate(descriptors: NDArray, vocabulary: Vocabulary) -> NDArray[np.float32]:
    """Vector of one photo.

    Parameters
    ----------
    descriptors : (N, D) uint8 or float32
    vocabulary : Vocabulary

    Returns
    -------
    (K·P,) float32
        Of unit length, or zero for N = 0.
    """
    words = vocabulary.words
    if len(descriptors) == 0:
        return np.zeros(words.size, np.float32)
    centred = unit_rows(descriptors) - vocabulary.mean
    points = (centred @ vocabulary.directions).astype(np.float32, copy=False)
    nearest = _nearest(points, words)
    counts = np.bincount(nearest, minlength=len(words))
    residuals = _sums(points, nearest, len(words)) - counts[:, None] * words
    lengths = np.linalg.norm(residuals, axis=1, keepdims=True)
    vector = (residuals / np.maximum(lengths, 1e-12)).astype(np.float32).ravel()
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def most_similar(
    vectors: NDArray[np.floating], num_neighbours: int, *, block_size: int = BLOCK_SIZE
) -> list[NDArray[np.int64]]:
    """Indices of the vectors with the largest dot product with each vector, best first.

    Parameters
    ----------
    vectors : (N, V) float
        A zero vector has no neighbours and is not returned as one.
    num_neighbours : int
    block_size : int
        Rows compared at a time; the memory is proportional to its square.

    Returns
    -------
    list of (≤ num_neighbours,) int64
        Without the vector itself; ties in order of index.
    """
    usable = np.flatnonzero(np.any(vectors != 0, axis=1))
    result: list[NDArray[np.int64]] = [np.zeros(0, np.int64) for _ in range(len(vectors))]
    for start0 in range(0, len(usable), block_size):
        rows = usable[start0 : start0 + block_size]
        block0 = vectors[rows].astype(np.float32)
        best = np.zeros((len(rows), 0), np.float32)
        index = np.zeros((len(rows), 0), np.int64)
        for start1 in range(0, len(usable), block_size):
            columns = usable[start1 : start1 + block_size]
            similarity = block0 @ vectors[columns].astype(np.float32).T
            similarity[rows[:, None] == columns[None]] = -np.inf
            best = np.concatenate([best, similarity], axis=1)
            index = np.concatenate([index, np.broadcast_to(columns, similarity.shape)], axis=1)
            if best.shape[1] > num_neighbours:
                kept = _largest(best, num_neighbours)
                best, index = best[kept].reshape(len(rows), -1), index[kept].reshape(len(rows), -1)
        order = np.lexsort((index, -best), axis=1)
        best = np.take_along_axis(best, order, axis=1)
        index = np.take_along_axis(index, order, axis=1)
        for row, similarities, neighbours in zip(rows, best, index, strict=True):
            result[row] = neighbours[np.isfinite(similarities)]
    return result


def _largest(values: NDArray[np.float32], num: int) -> NDArray[np.bool_]:
    """(N, M) bool: the ``num`` largest of each row, the first ones among equals.

    `numpy.argpartition` alone takes any of the equals, which ones depends on the processor.
    """
    last = -np.partition(-values, num - 1, axis=1)[:, num - 1 : num]
    above, level = values > last, values == last
    room = num - np.count_nonzero(above, axis=1, keepdims=True)
    return above | (level & (np.cumsum(level, axis=1, dtype=np.int32) <= room))


def _nearest(points: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N,) index of the nearest word."""
    return np.argmin(np.sum(words**2, axis=1) - 2 * points @ words.T, axis=1)


def _sums(points: NDArray[np.float32], labels: NDArray[np.int64], num_labels: int) -> NDArray[np.float32]:
    """(num_labels, P) sum of the points of each label."""
    one_hot = np.zeros((num_labels, len(points)), np.float32)
    one_hot[labels, np.arange(len(points))] = 1.0
    return one_hot @ points
