"""Descriptors of two photos → putative matches: nearest neighbours by blocked matrix products.

Descriptors are whole numbers (`corrsfm.descriptors`: bytes, or unit vectors in small steps), so all products
and sums that make a squared distance are integers that float32 holds exactly: the result does not depend on
block size, number of threads or device, and equal distances compare equal. (bfloat16 and float16 could hold
the bytes, but not the sums.) Among equal distances the lowest keypoint index wins.

A processor that multiplies bytes exactly (AVX-512 VNNI) gets bytes: 10 ms of one core for a pair of 4,096
SIFT descriptors, 52 ms by float32. On a CPU numpy searches the products, because its `argmin` takes a
tenth of torch's time.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.config import MatchesConfig
from corrsfm.descriptors import as_integers
from corrsfm.types import Matches

__all__ = ["Matcher", "match_features"]

# Rows compared at a time on a CPU: the block then stays in the cache between its reductions.
CPU_BLOCK_ROWS = 256


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
    return _match(_Prepared(descriptors0, target), _Prepared(descriptors1, target), block_size)


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
        self._cache: OrderedDict[str, _Prepared] = OrderedDict()
        self._lock = threading.Lock()

    def match(self, name0: str, name1: str) -> Matches:
        """Putative matches of a pair of images; the same as `match_features` on their descriptors."""
        return _match(self._prepared(name0), self._prepared(name1), self._block_size)

    def _prepared(self, name: str) -> _Prepared:
        with self._lock:
            if name not in self._cache:
                self._cache[name] = _Prepared(self._load(name), self._device)
                if len(self._cache) > self._max_cached:
                    self._cache.popitem(last=False)
            self._cache.move_to_end(name)
            return self._cache[name]


class _Prepared:
    """Descriptors of one image on the device, as bytes less 128 where those are multiplied exactly."""

    def __init__(self, descriptors: NDArray, device: torch.device) -> None:
        if descriptors.dtype == np.uint8 and device.type == "cpu" and _multiplies_bytes():
            # A shift of both sides leaves their distances as they are.
            values = torch.from_numpy((descriptors ^ np.uint8(128)).view(np.int8))
            self.squared = values.int().square().sum(dim=1, dtype=torch.int32)  # (N,)
        else:
            values = torch.from_numpy(np.ascontiguousarray(as_integers(descriptors))).to(device)
            self.squared = values.square().sum(dim=1)
        self.values = values  # (N, D)

    def __len__(self) -> int:
        return len(self.values)


@cache
def _multiplies_bytes() -> bool:
    """Whether torch multiplies signed bytes fast on this processor, and exactly at the extremes.

    Older instructions for bytes saturate at 16 bits, so without the newer ones nobody asks.
    """
    multiply = getattr(torch, "_int_mm", None)
    if multiply is None or not getattr(torch.cpu, "_is_vnni_supported", bool)():
        return False
    signs = torch.tensor([[-128, -128], [127, -128], [127, 127]], dtype=torch.int8).repeat(1, 64)
    exact = signs.int() @ signs.int().T
    return bool(torch.equal(multiply(signs, signs.T), exact))


def _match(image0: _Prepared, image1: _Prepared, block_size: int) -> Matches:
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

_scratch = threading.local()


def _search_on_cpu(image0: _Prepared, image1: _Prepared, block_size: int) -> _Nearest:
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
            distances = _distances_on_cpu(image0, image1, rows, columns)
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


def _distances_on_cpu(image0: _Prepared, image1: _Prepared, rows: slice, columns: slice) -> NDArray:
    """(rows, columns) squared Euclidean distances, exact, in memory that the thread's next block takes.

    Fresh memory for each block would cost more than the product of bytes.
    """
    shape = rows.stop - rows.start, columns.stop - columns.start
    dtype = image0.squared.dtype
    memory = getattr(_scratch, "memory", None)
    if memory is None or memory.dtype != dtype or len(memory) < shape[0] * shape[1]:
        memory = _scratch.memory = torch.empty(shape[0] * shape[1], dtype=dtype)
    block = memory[: shape[0] * shape[1]].view(shape)
    values0, values1, squared1 = image0.values[rows], image1.values[columns].T, image1.squared[columns]
    if dtype == torch.int32:
        torch._int_mm(values0, values1, out=block)
        torch.sub(squared1, block, alpha=2, out=block)
    else:
        torch.addmm(squared1, values0, values1, alpha=-2, out=block)
    return block.add_(image0.squared[rows, None]).numpy()


def _search_on_gpu(image0: _Prepared, image1: _Prepared, block_size: int) -> _Nearest:
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
            distances = _distances_on_gpu(image0, image1, rows, columns)
            best_back[columns] = torch.minimum(best_back[columns], distances.amin(dim=0))
            _update_two_nearest(distances, best[rows], second[rows], index[rows], start1)
    return best.double(), second.double(), index, best_back.double()


def _distances_on_gpu(image0: _Prepared, image1: _Prepared, rows: slice, columns: slice) -> torch.Tensor:
    """(rows, columns) squared Euclidean distances, exact."""
    distances = torch.addmm(image1.squared[columns], image0.values[rows], image1.values[columns].T, alpha=-2)
    return distances.add_(image0.squared[rows, None])


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
