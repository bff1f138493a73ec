"""Float64 as the judge of float32: what a run of a network chose, and how far rounding may lead from it.

A network chooses: the nearest neighbours of each match in feature space, and the matches that a pruning
keeps. Where two candidates almost tie, rounding decides, and another processor decides otherwise. Tests of
float32 therefore let float64 choose and judge what float32 makes of the same choices, or let float32 choose
and accept every choice that rounding explains.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from unittest.mock import patch

import torch
from torch import Tensor, nn

from corrsfm.model import CorrAdaptor, PruningOutput, network
from corrsfm.model.network import Attention, BatchNorm

UNIT_ROUNDOFF = 2.0**-24
"""Largest relative error of one rounding to float32."""


@dataclass(frozen=True)
class Choices:
    """What a run of a network chose, round by round, and the eight-point weights that followed."""

    neighbors: list[Tensor] = field(default_factory=list)
    """(B,N,k) int64."""
    orders: list[Tensor] = field(default_factory=list)
    """(B,N') int64, best first."""
    eight_point: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    """Correspondences (B,N'',4) and weights (B,N'')."""


@contextmanager
def watched(follow: Choices | None = None, pairs: slice = slice(None)) -> Iterator[Choices]:
    """Note what networks choose within the context; with ``follow`` they choose as an earlier run did.

    ``pairs`` says which pairs of the earlier run come now.
    """
    noted = Choices()
    search, best, solve = network.nearest_neighbors, CorrAdaptor._best, network.weighted_eight_point

    def neighbors(features: Tensor, k: int, mask: Tensor | None) -> Tensor:
        index = search(features, k, mask)
        if follow is not None:
            index = follow.neighbors[len(noted.neighbors)][pairs, : index.shape[1]]
        noted.neighbors.append(index)
        return index

    def order(self: CorrAdaptor, logits: Tensor, mask: Tensor | None, min_rows: int):
        index, kept = best(self, logits, mask, min_rows)
        if follow is not None:
            index = follow.orders[len(noted.orders)][pairs, : index.shape[1]]
        noted.orders.append(index)
        return index, kept

    def eight_point(correspondences: Tensor, weights: Tensor, **options) -> Tensor:
        noted.eight_point.append((correspondences, weights))
        return solve(correspondences, weights, **options)

    with (
        patch.object(network, "nearest_neighbors", neighbors),
        patch.object(CorrAdaptor, "_best", order),
        patch.object(network, "weighted_eight_point", eight_point),
    ):
        yield noted


def rounding_share(judged: nn.Module, num_rows: int) -> float:
    """Share of the logits' scale by which float32 may miss them, whatever the processor.

    A sum of K products, in any order and with or without fused multiply-add, misses by at most λ √K u of its
    terms, but for a chance of 2 K exp(−λ² / 2) (Higham and Mary, "A new approach to probabilistic rounding
    error analysis", SIAM J. Sci. Comput. 2019). Normalisations hand relative errors on about as they are, so
    the sums on the way to a logit add up as one: K counts the inner sizes of all linear layers, two sums over
    the rows for each normalisation and four for each attention. λ is 10, u is 2⁻²⁴. Among 432 pairs in eight
    orders of summation the largest miss was a fifth of this, the median a twenty-fifth.
    """
    modules = list(judged.modules())
    num_row_sums = 2 * sum(isinstance(m, BatchNorm) for m in modules)
    num_row_sums += 4 * sum(isinstance(m, Attention) for m in modules)
    num_products = sum(m.in_features for m in modules if isinstance(m, nn.Linear))
    return 10 * (num_products + num_rows * num_row_sums) ** 0.5 * UNIT_ROUNDOFF


def essential_tolerance(judge: Choices, judged: Choices, pair: int, pair_of_judged: int) -> float:
    """How far the matrix of a pair may move because its eight-point weights are not those of the judge.

    Davis and Kahan: an eigenvector turns by at most the change of the matrix over the gap to the other
    eigenvalues. Two times, because the unit vector moves by √2 of the sine and the gap shrinks meanwhile; and
    the result is rounded to float32.
    """
    exact = _scatter(*(x[pair].double() for x in judge.eight_point[0]))
    other = _scatter(*(x[pair_of_judged].double() for x in judged.eight_point[0]))
    smallest, second = torch.linalg.eigvalsh(exact)[:2]
    return float(2 * torch.linalg.matrix_norm(exact - other) / (second - smallest)) + UNIT_ROUNDOFF


def _scatter(correspondences: Tensor, weights: Tensor) -> Tensor:
    """(9,9) of trace one."""
    x, y, u, v = correspondences.unbind(-1)
    rows = torch.stack([u * x, u * y, u, v * x, v * y, v, x, y, torch.ones_like(x)], dim=-1)
    scatter = rows.mT @ (rows * weights[:, None])
    return scatter / scatter.trace()


def in_float64(judged: CorrAdaptor) -> Callable[..., PruningOutput]:
    """A network as a pruner calls it, computing in float64, where no near-tie is left to rounding."""
    exact = CorrAdaptor.from_config(judged.config).double().eval()
    exact.load_state_dict(judged.state_dict())

    def call(correspondences: Tensor, side: Tensor | None, mask: Tensor | None) -> PruningOutput:
        return exact(correspondences.double(), None if side is None else side.double(), mask)

    return call
