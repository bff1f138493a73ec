"""The graph behind LMCNet: its smoothest functions say which motions are coherent (Liu et al., CVPR 2021)."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["NUM_EIGENPAIRS", "coherence_spectrum", "graph_laplacian"]

NUM_EIGENPAIRS = 32
NUM_NEIGHBORS = 8
DISTANCE_SCALE = 0.1
SMALLEST_WEIGHT = 0.05


def graph_laplacian(points: Tensor) -> Tensor:
    """Laplacian (N,N) of the normalised graph that joins each correspondence (N,4) to its nearest others.

    With weights w = max(exp(-d^2 / 0.1^2), 0.05) to the 8 nearest others, symmetrised, and A the matrix
    D^-1/2 W D^-1/2, it is diag(A 1) - A.
    """
    num_rows = len(points)
    num_neighbors = min(NUM_NEIGHBORS, num_rows - 1)
    distance = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    distance.fill_diagonal_(torch.inf)
    nearest, index = distance.topk(num_neighbors, largest=False)
    weights = (-((nearest / DISTANCE_SCALE) ** 2)).exp().clamp(min=SMALLEST_WEIGHT)
    graph = torch.zeros_like(distance).scatter_(1, index, weights)
    graph = (graph + graph.mT) / 2
    scale = graph.sum(1).clamp(min=torch.finfo(graph.dtype).tiny).rsqrt()
    adjacency = scale[:, None] * graph * scale
    return adjacency.sum(1).diag() - adjacency


@torch.no_grad()
def coherence_spectrum(points: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The 32 smallest eigenpairs of each pair's graph Laplacian.

    A dense decomposition in float64: exact, but its time grows with the cube of N. The result is rounded to
    float32, which is what the published network was given in training and in tests.

    Parameters
    ----------
    points : Tensor, shape (B,N,4)
        Correspondences, normalised.
    mask : Tensor, shape (B,N) bool, optional

    Returns
    -------
    eig_val : Tensor, shape (B,32)
        Ascending; zero where a pair has fewer rows.
    eig_vec : Tensor, shape (B,N,32)
        Signs undetermined; zero on padding and where a pair has fewer rows.
    """
    values = points.new_zeros(len(points), NUM_EIGENPAIRS)
    vectors = points.new_zeros(*points.shape[:2], NUM_EIGENPAIRS)
    for pair, rows in enumerate(points):
        used = torch.arange(len(rows), device=rows.device) if mask is None else mask[pair].nonzero()[:, 0]
        found, basis = torch.linalg.eigh(graph_laplacian(rows[used].double()))
        num_found = min(len(used), NUM_EIGENPAIRS)
        values[pair, :num_found] = found[:num_found].float().to(values)
        vectors[pair, used, :num_found] = basis[:, :num_found].float().to(vectors)
    return values, vectors
