"""How the rivals stack their blocks: refine an estimate, or prune and estimate at the end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import torch
from torch import Tensor, nn

from corrsfm.model.network import take_rows
from corrsfm.model.rivals.inputs import Inputs, RivalOutput, keep_best
from corrsfm.model.rivals.layers import (
    ResidualUnit,
    eight_point,
    log_weighted_eight_point,
    positive_part,
)

__all__ = ["PruningBlock", "PruningHead", "prune", "refine", "with_estimate"]

# Larger squared distances come from degenerate estimates only, and their squares would overflow float32.
LARGEST_RESIDUAL = 1e6


def with_estimate(inputs: Inputs, logits: Tensor, essential: Tensor) -> Tensor:
    """Features of the next block: those of the inputs, then residual and weight, without gradient."""
    residuals = inputs.residuals(essential).clamp(max=LARGEST_RESIDUAL)
    more = torch.stack([residuals, positive_part(logits, inputs.mask)], dim=-1)
    return torch.cat([inputs.features, more.detach()], dim=-1)


def refine(blocks: Iterable[nn.Module], inputs: Inputs) -> RivalOutput:
    """Each block weights all correspondences and sees the residuals and weights of the one before (OANet).

    Parameters
    ----------
    blocks : iterable of modules
        Features (B,N,4+S), from the second on (B,N,6+S), and mask to logits (B,N).
    inputs : Inputs
    """
    features = inputs.features
    all_logits, essentials = [], []
    for block in blocks:
        logits = block(features, inputs.mask)
        essential = eight_point(inputs.coordinates, logits, inputs.mask)
        features = with_estimate(inputs, logits, essential)
        all_logits.append(logits)
        essentials.append(essential)
    return inputs.output(all_logits, essentials)


class PruningBlock(Protocol):
    """Features (B,N,.) to new features (B,N,C) and sets of logits (B,N), the deciding set last."""

    def __call__(self, features: Tensor, mask: Tensor | None) -> tuple[Tensor, list[Tensor]]: ...


class PruningHead(Protocol):
    """The layers behind the last pruning, which the published code keeps in the last block."""

    embed_2: ResidualUnit
    linear_2: nn.Linear


def prune(
    blocks: Iterable[PruningBlock], head: PruningHead, inputs: Inputs, *, ratio: float, min_rows: int
) -> RivalOutput:
    """Each block keeps its best; the next one sees their weights; an estimate from the last (CLNet).

    Parameters
    ----------
    blocks : iterable of PruningBlock
    head : PruningHead
    inputs : Inputs
    ratio : float
        Share that a block keeps.
    min_rows : int
        Rows that the neighbour search of a block needs.
    """
    kept, index, mask = inputs.features, inputs.every_row(), inputs.mask  # (B,N,4+S), (B,N)
    features = kept
    logits: list[Tensor] = []
    indices: list[Tensor] = []
    masks: list[Tensor | None] = []
    for block in blocks:
        features, sets = block(features, mask)
        logits += sets
        indices += [index] * len(sets)
        masks += [mask] * len(sets)
        order, mask = keep_best(sets[-1], mask, ratio, min_rows)
        kept, index, weighted = take_rows(kept, order), index.gather(1, order), features
        confidence = torch.stack(sets, dim=-1).detach().tanh().relu()
        features = torch.cat([kept, take_rows(confidence, order)], dim=-1)
    last, log_weight = head.linear_2(head.embed_2(take_rows(weighted, order), mask)).unbind(-1)
    essential = log_weighted_eight_point(kept[..., :4], last, log_weight, mask)
    return inputs.output(
        [*logits, last],
        [essential],
        indices=[*indices, index],
        masks=[*masks, mask],
        residuals_decide=True,
    )
