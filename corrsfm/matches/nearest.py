"""Descriptors of two photos → putative matches: nearest neighbours, by exact distances (`corrsfm.distances`).

Among equal distances the lowest keypoint index wins. A pair of 4,096 SIFT descriptors takes 10 ms of one core
where bytes are multiplied, and 52 ms by float32. On a CPU numpy searches the distances, because its `argmin`
takes a tenth of torch's time.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.config import MatchesConfig
from corrsfm.distances import CPU_BLOCK_ROWS, PreparedDescriptors, distances_on_cpu, distances_on_gpu
from corrsfm.types import Matches

__all__ = ["Matcher", "match_features"]


def match_features(
    descriptors0: NDArray,
    descriptors1: NDArray,
    *,
    block_size: int = MatchesConfig.block_size,
    device: str = "cpu",
) -> Matches:
    """Nearest neighbour in image 1 of every keypoint of image 0.

    Parameters
    ----------
    descriptors0 : (N0, D) uint8 or float32
        Bytes, or unit vectors.
    descriptors1 : (N1, D) uint8 or float32
    block_size : int
        Descriptors of either image compared at a time; the memory is proportional to its square.
    device : str
        A torch device.

    Returns
    -------
    Matches
        N0 matches, or none if image 1 has no keypoint. The ratio of distances is 1 where image 1 has a single
        keypoint or both distances are zero.
    """
    target = torch.device(device)
    return _match(
        PreparedDescriptors(descriptors0, target), PreparedDescriptors(descriptors1, target), block_size
    )


class Matcher:
    """Matches pairs of a scene, keeping recently used descriptors on the device; threads may share it.

    Parameters
    ----------
    load : callable
        Image name → (N, D) descriptors.
    device : str
        A torch device.
    block_size : int
        See `match_features`.
    max_cached_images : int
        Images whose descriptors stay on the device; the least recently used one goes first. One image of
        4096 keypoints takes 2 MB.
    """

    def __init__(
        self,
        load: Callable[[str], NDArray],
        *,
        device: str = "cpu",
        block_size: int = MatchesConfig.block_size,
        max_cached_images: int = 256,
    ) -> None:
        self._load = load
        self._device = torch.device(device)
        self._block_size = block_size
        self._max_cached = max(2, max_cached_images)
        self._cache: OrderedDict[str, PreparedDescriptors] = OrderedDict()
        self._lock = threading.Lock()

    def match(self, name0: str, name1: str) -> Matches:
        """Putative matches of a pair of images; the same as `match_features` on their descriptors."""
        return _match(self._prepared(name0), self._prepared(name1), self._block_size)

    def _prepared(self, name: str) -> PreparedDescriptors:
        with self._lock:
            if name not in self._cache:
                self._cache[name] = PreparedDescriptors(self._load(name), self._device)
                if len(self._cache) > self._max_cached:
                    self._cache.popitem(last=False)
            self._cache.move_to_end(name)
            return self._cache[name]


def _match(image0: PreparedDescriptors, image1: PreparedDescriptors, block_size: int) -> Matches:
    if len(image0) == 0 or len(image1) == 0:
        return Matches(
            indices=np.zeros((0, 2), np.int32), ratios=np.zeros(0, np.float32), mutual=np.zeros(0, np.bool_)
        )
    search = _search_on_cpu if image0.values.device.type == "cpu" else _search_on_gpu
    best, second, index, best_back = search(image0, image1, block_size)
    mutual = _mutual(best, index, best_back)
    ratios = torch.where((second > 0) & torch.isfinite(second), (best / second).sqrt(), 1.0)
    return Matches(
        indices=np.stack([np.arange(len(image0)), index.cpu().numpy()], axis=1).astype(np.int32),
        ratios=ratios.cpu().numpy().astype(np.float32),
        mutual=mutual.cpu().numpy(),
    )


_Nearest = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Of each keypoint of image 0 the squared distances (N0,) to its two nearest in image 1, float64 and infinite
for none, and the index of the nearest; of each of image 1 the squared distance (N1,) to its nearest."""


def _search_on_cpu(image0: PreparedDescriptors, image1: PreparedDescriptors, block_size: int) -> _Nearest:
    num0, num1 = len(image0), len(image1)
    dtype = image0.squared.numpy().dtype
    none = np.iinfo(dtype).max if dtype == np.int32 else np.inf
    best, second, best_back = (np.full(num, none, dtype) for num in (num0, num0, num1))
    index = np.zeros(num0, np.int64)
    num_rows = min(block_size, CPU_BLOCK_ROWS)
    for start1 in range(0, num1, block_size):
        columns = slice(start1, min(start1 + block_size, num1))
        for start0 in range(0, num0, num_rows):
            rows = slice(start0, min(start0 + num_rows, num0))
            distances = distances_on_cpu(image0, image1, rows, columns)
            np.minimum(best_back[columns], distances.min(axis=0), out=best_back[columns])
            found = distances.argmin(axis=1)  # the first of equals
            each = np.arange(len(distances))
            block_best = distances[each, found]
            distances[each, found] = none
            # Strict: an earlier block has the lower index and keeps a tie.
            index[rows] = np.where(block_best < best[rows], found + start1, index[rows])
            loser = np.maximum(best[rows], block_best)
            second[rows] = np.minimum(np.minimum(second[rows], distances.min(axis=1)), loser)
            best[rows] = np.minimum(best[rows], block_best)
    first, runner_up, back = (
        torch.from_numpy(np.where(values == none, np.inf, values)).double()
        for values in (best, second, best_back)
    )
    return first, runner_up, torch.from_numpy(index), back


def _search_on_gpu(image0: PreparedDescriptors, image1: PreparedDescriptors, block_size: int) -> _Nearest:
    num0, num1 = len(image0), len(image1)
    device = image0.values.device
    best = torch.full((num0,), torch.inf, dtype=image0.squared.dtype, device=device)
    second = best.clone()
    index = torch.zeros(num0, dtype=torch.int64, device=device)
    best_back = torch.full((num1,), torch.inf, dtype=image0.squared.dtype, device=device)
    for start1 in range(0, num1, block_size):
        columns = slice(start1, min(start1 + block_size, num1))
        for start0 in range(0, num0, block_size):
            rows = slice(start0, min(start0 + block_size, num0))
            distances = distances_on_gpu(image0, image1, rows, columns)
            best_back[columns] = torch.minimum(best_back[columns], distances.amin(dim=0))
            _update_two_nearest(distances, best[rows], second[rows], index[rows], start1)
    return best.double(), second.double(), index, best_back.double()


def _update_two_nearest(
    distances: torch.Tensor, best: torch.Tensor, second: torch.Tensor, index: torch.Tensor, start1: int
) -> None:
    """Merge a block into the running two smallest distances of its rows, in place; overwrites the block."""
    block_index = distances.argmin(dim=1, keepdim=True)  # the first of equals, unlike min(dim=1)
    block_best = distances.gather(1, block_index)[:, 0]
    distances.scatter_(1, block_index, torch.inf)
    block_second = distances.amin(dim=1)
    # Strict: an earlier block has the lower index and keeps a tie.
    closer = block_best < best
    second.copy_(torch.minimum(torch.minimum(second, block_second), torch.maximum(best, block_best)))
    index.copy_(torch.where(closer, block_index[:, 0] + start1, index))
    best.copy_(torch.minimum(best, block_best))


def _mutual(best: torch.Tensor, index: torch.Tensor, best_back: torch.Tensor) -> torch.Tensor:
    """(N0,) bool: whether no keypoint of image 0 is closer to the match, or as close with a lower index.

    Comparing distances avoids searching column indices, which would take longer than the products.
    """
    closest = best == best_back[index]
    own = torch.arange(len(best), device=best.device)
    claims = torch.where(closest, own, len(best))
    first = torch.full_like(best_back, len(best), dtype=torch.int64)
    first.scatter_reduce_(0, index, claims, "amin")
    return closest & (first[index] == own)
