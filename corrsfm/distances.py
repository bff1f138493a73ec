"""Exact squared distances between the descriptors of two photos, a block at a time.

Descriptors are whole numbers (`corrsfm.descriptors`: bytes, or unit vectors in small steps), so all products
and sums that make a squared distance are integers that their type holds exactly: a distance does not depend
on block size, number of threads or device, and equal distances compare equal. (bfloat16 and float16 could
hold the bytes, but not the sums.)

A processor that multiplies bytes exactly (AVX-512 VNNI) gets bytes: matching then takes a fifth of its time.
"""

from __future__ import annotations

import threading
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.descriptors import as_integers

__all__ = ["CPU_BLOCK_ROWS", "PreparedDescriptors", "distances_on_cpu", "distances_on_gpu"]

CPU_BLOCK_ROWS = 256
"""Rows compared at a time on a CPU: the block then stays in the cache between its reductions."""

_CPU = torch.device("cpu")
_scratch = threading.local()


class PreparedDescriptors:
    """Descriptors of one photo on the device, as bytes less 128 where those are multiplied exactly.

    Parameters
    ----------
    descriptors : (N, D) uint8 or float32
        Bytes, or unit vectors.
    device : torch.device

    Attributes
    ----------
    values : (N, D) Tensor
        int8, or floats that hold whole numbers.
    squared : (N,) Tensor
        Squared lengths of ``values``, int32 or floats.
    """

    def __init__(self, descriptors: NDArray, device: torch.device = _CPU) -> None:
        if descriptors.dtype == np.uint8 and device.type == "cpu" and _multiplies_bytes():
            # A shift of both sides leaves their distances as they are.
            self.values = torch.from_numpy((descriptors ^ np.uint8(128)).view(np.int8))
            self.squared = self.values.int().square().sum(dim=1, dtype=torch.int32)
        else:
            self.values = torch.from_numpy(np.ascontiguousarray(as_integers(descriptors))).to(device)
            self.squared = self.values.square().sum(dim=1)

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


def distances_on_cpu(
    photo0: PreparedDescriptors, photo1: PreparedDescriptors, rows: slice, columns: slice
) -> NDArray:
    """(rows, columns) squared Euclidean distances, exact, in memory that the thread's next block takes.

    Fresh memory for each block would cost more than the product of bytes.
    """
    shape = rows.stop - rows.start, columns.stop - columns.start
    dtype = photo0.squared.dtype
    memory = getattr(_scratch, "memory", None)
    if memory is None or memory.dtype != dtype or len(memory) < shape[0] * shape[1]:
        memory = _scratch.memory = torch.empty(shape[0] * shape[1], dtype=dtype)
    block = memory[: shape[0] * shape[1]].view(shape)
    values0, values1, squared1 = photo0.values[rows], photo1.values[columns].T, photo1.squared[columns]
    if dtype == torch.int32:
        torch._int_mm(values0, values1, out=block)
        torch.sub(squared1, block, alpha=2, out=block)
    else:
        torch.addmm(squared1, values0, values1, alpha=-2, out=block)
    return block.add_(photo0.squared[rows, None]).numpy()


def distances_on_gpu(
    photo0: PreparedDescriptors, photo1: PreparedDescriptors, rows: slice, columns: slice
) -> torch.Tensor:
    """(rows, columns) squared Euclidean distances, exact."""
    distances = torch.addmm(photo1.squared[columns], photo0.values[rows], photo1.values[columns].T, alpha=-2)
    return distances.add_(photo0.squared[rows, None])
