"""Descriptors as whole numbers, so that distances between them are exact and the same on every machine.

SIFT's are bytes already. Descriptors of learned features are unit vectors of floats, whose products depend in
the last bits on the order of summation, and with them nearest neighbours that almost tie. In steps of 1/2048
every partial sum of a product of two unit vectors, of any length, stays below 2²⁴, which float32 holds
exactly. A step is that of half-precision numbers near one, as hloc stores them; rounding to it moves the
distance between two descriptors of 128 numbers by 0.002 on average.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["as_integers", "half_precision", "unit_rows"]

STEPS = 2048
MAX_EXACT_BYTES = 128


def as_integers(descriptors: NDArray) -> NDArray[np.floating]:
    """Descriptors as floats that hold whole numbers, and whose products and squared distances are exact.

    Parameters
    ----------
    descriptors : (N, D) uint8 or float32
        Bytes, or rows of unit length.

    Returns
    -------
    (N, D) float32 or float64
        The latter for more than 128 bytes. Unit vectors are in steps of 1/2048.
    """
    if descriptors.dtype == np.uint8:
        exact = np.float32 if descriptors.shape[1] <= MAX_EXACT_BYTES else np.float64
        return descriptors.astype(exact)
    return np.rint(descriptors * np.float32(STEPS)).astype(np.float32)


def unit_rows(descriptors: NDArray) -> NDArray[np.float32]:
    """Rows (N, D) scaled to unit length; zero rows stay zero."""
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)


def half_precision(descriptors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Descriptors (N, D) rounded to what a workspace holds of them."""
    return descriptors.astype(np.float16).astype(np.float32)
