"""The loss that each network was published with: `corrsfm train` uses that of the network it trains.

CorrAdaptor and the networks that prune (CLNet, NCMNet, MGNet) learn by the hybrid loss of
`corrsfm.training.losses`. The others add a plain classification loss and the essential loss over every
estimate that they refine; PointCN compares matrices instead of virtual points. An essential weight of 0.5 is
published for all but PointCN, which has 0.1.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from corrsfm.model import PruningOutput, RivalOutput
from corrsfm.training.losses import (
    balanced_classification_loss,
    classification_loss,
    essential_loss,
    matrix_loss,
    virtual_points,
)

__all__ = ["objective"]

_HYBRID = ("corradaptor", "clnet", "ncmnet", "mgnet")


def objective(
    architecture: str,
    output: PruningOutput | RivalOutput,
    distances: Tensor,
    mask: Tensor | None,
    *,
    threshold: float,
    related: Tensor,
    matrix: Tensor | None,
) -> dict[str, Tensor]:
    """Terms of the published loss of a network.

    Parameters
    ----------
    architecture : str
        ``corradaptor`` or one of `corrsfm.model.rivals.ARCHITECTURES`.
    output : PruningOutput or RivalOutput
        Of the network for the batch.
    distances : (B, N) tensor
        Squared symmetric epipolar distances of the inputs to the true geometry.
    mask : (B, N) bool tensor, optional
        False for padding.
    threshold : float
        Largest distance of an inlier.
    related : (B,) bool tensor
        Pairs that have a true matrix.
    matrix : (B, 3, 3) tensor, optional
        True matrices; without them there is no ``essential`` term.

    Returns
    -------
    dict of () tensors
        ``classification``, and ``essential`` if it is wanted and any pair has a matrix; not weighted.
    """
    logits = [values.float() for values in output.logits]
    found = [distances.gather(1, indices) for indices in output.indices]
    masks = None if mask is None else [values.isfinite() for values in logits]
    classify = classification_loss if architecture in _HYBRID else balanced_classification_loss
    terms = {"classification": classify(logits, found, masks, threshold)}
    if matrix is None or not bool(related.any()):
        # Photos of two places have no matrix to find.
        return terms
    estimates = output.essentials if isinstance(output, RivalOutput) else [output.essential]
    compare: Callable[[Tensor, Tensor], Tensor] = essential_loss
    truth = matrix[related]
    if architecture == "pointcn":
        compare = matrix_loss
    else:
        truth = virtual_points(truth)
    per_estimate = [compare(estimate.float()[related], truth) for estimate in estimates]
    return terms | {"essential": sum(per_estimate[1:], per_estimate[0])}
