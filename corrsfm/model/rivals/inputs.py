"""What goes into a rival network and what comes out, the same for all ten.

Pairs of different sizes share a batch through ``mask (B,N) bool``, as in `corrsfm.model.network`. `Inputs.of`
makes a batch that every network survives: rows that are not finite become padding, and pairs too small for a
neighbour search get more of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from corrsfm.config import NetworkUsage
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.model.network import LARGEST_COORDINATE, last_logits, symmetric_epipolar_squared

if TYPE_CHECKING:
    from corrsfm.model.rivals.build import RivalConfig

__all__ = ["Inputs", "Rival", "RivalOutput", "keep_best"]


class RivalOutput(NamedTuple):
    """What a rival network says about a batch of pairs.

    Padding has the logit minus infinity and an infinite residual, as in `corrsfm.model.PruningOutput`.
    """

    logits: list[Tensor]
    """(B,N_s) each, in the order in which the published loss sees them."""
    indices: list[Tensor]
    """int64, like `logits`: which input each logit belongs to."""
    essential: Tensor
    """(B,3,3), unit norm, x1^T E x0 = 0: the last estimate."""
    residuals: Tensor
    """(B,N), squared symmetric epipolar distance of every input to `essential`."""
    essentials: list[Tensor]
    """(B,3,3) each: the estimates that the published loss sees, one for each set of logits where a network
    refines its estimate, else the last one only."""
    residuals_decide: bool = False
    """Whether the published network judges by `residuals`, as those that prune do, or by the last logits."""

    def last_logits(self) -> Tensor:
        """The verdict (B,N) on each input, above zero for those that the published network calls right.

        The last logits, or ``log(INLIER_THRESHOLD / residual)`` where residuals decide. Minus infinity on
        padding.
        """
        if self.residuals_decide:
            return math.log(INLIER_THRESHOLD) - self.residuals.float().log()
        return last_logits(self.logits, self.indices, self.residuals.shape)


class Rival(nn.Module):
    """What a user of rival networks finds in each of them; the computation is all their own.

    ``forward(correspondences, side_information=None, mask=None)`` takes what `Inputs.of` documents and
    returns a `RivalOutput`. Training needs two pairs a batch where a network normalises pooled features.
    """

    config: RivalConfig | None = None
    """Set by `build_rival`."""
    usage: NetworkUsage = NetworkUsage()
    """Goes with the weights into a checkpoint; by default the published operating point."""
    side_channels: int
    """Columns of side information that it expects."""
    pruning_ratio: float = 1.0
    """Share of the correspondences that a block hands to the next."""


@dataclass(frozen=True)
class Inputs:
    """A batch of pairs that is safe to compute with."""

    coordinates: Tensor
    """(B,N,4), finite, zero on padding."""
    features: Tensor
    """(B,N,4+S): coordinates, then side information."""
    mask: Tensor | None
    """(B,N) bool, False on padding; None if there is none. A pair has at least one row that counts."""
    num_rows: int
    """Rows that the caller handed in; any further ones are padding."""

    @classmethod
    def of(
        cls,
        correspondences: Tensor,
        side_information: Tensor | None,
        mask: Tensor | None,
        *,
        side_channels: int,
        min_rows: int = 1,
    ) -> Self:
        """Check and complete the arguments of a network's ``forward``.

        Parameters
        ----------
        correspondences : Tensor, shape (B,N,4)
            x0 y0 x1 y1, normalised. Rows that are not finite count as padding.
        side_information : Tensor, shape (B,N,S), optional
        mask : Tensor, shape (B,N) bool, optional
        side_channels : int
            The S that the network was built with.
        min_rows : int
            Rows that its neighbour searches need.

        Raises
        ------
        ValueError
            If the side information has another shape.
        """
        batch, num_rows, _ = correspondences.shape
        side = correspondences.new_zeros(batch, num_rows, 0) if side_information is None else side_information
        if side.shape != (batch, num_rows, side_channels):
            raise ValueError(
                f"side information has shape {tuple(side.shape)}, this network expects "
                f"{(batch, num_rows, side_channels)}"
            )
        features = torch.cat([correspondences, side], dim=-1)
        usable = (correspondences.abs() <= LARGEST_COORDINATE).all(-1) & side.isfinite().all(-1)
        missing = max(min_rows - num_rows, 1 - num_rows, 0)
        if mask is not None or missing or not usable.all():
            mask = F.pad(usable if mask is None else usable & mask, (0, missing))
            features = torch.where(mask[..., None], F.pad(features, (0, 0, 0, missing)), 0.0)
            # A pair without any row gets one zero, so that no mean is taken over nothing.
            empty = ~mask.any(1, keepdim=True)
            mask = mask | (empty & (torch.arange(mask.shape[1], device=mask.device) == 0))
        return cls(coordinates=features[..., :4], features=features, mask=mask, num_rows=num_rows)

    def every_row(self) -> Tensor:
        """Index (B,N) of each row of the batch."""
        batch, num_rows = self.coordinates.shape[:2]
        return torch.arange(num_rows, device=self.coordinates.device).expand(batch, -1)

    def residuals(self, essential: Tensor) -> Tensor:
        """Squared symmetric epipolar distance (B,N) of each row to an estimate (B,3,3); zero on padding."""
        distance = symmetric_epipolar_squared(self.coordinates, essential)
        return distance if self.mask is None else distance.masked_fill(~self.mask, 0.0)

    def output(
        self,
        logits: list[Tensor],
        essentials: list[Tensor],
        *,
        indices: list[Tensor] | None = None,
        masks: list[Tensor | None] | None = None,
        residuals_decide: bool = False,
    ) -> RivalOutput:
        """Results without the rows that the caller did not hand in, and padding marked.

        Parameters
        ----------
        logits, essentials, residuals_decide
            As in `RivalOutput`, still with all rows.
        indices, masks : list, optional
            Like `logits`, where a set does not hold all rows in their order.
        """
        indices = indices or [self.every_row()] * len(logits)
        masks = masks or [self.mask] * len(logits)
        sets = [self._trim(*one) for one in zip(logits, indices, masks, strict=True)]
        residuals = self.residuals(essentials[-1])
        if self.mask is not None:
            residuals = residuals.masked_fill(~self.mask, math.inf)
        return RivalOutput(
            logits=[one for one, _ in sets],
            indices=[one for _, one in sets],
            essential=essentials[-1],
            residuals=residuals[:, : self.num_rows],
            essentials=essentials,
            residuals_decide=residuals_decide,
        )

    def _trim(self, logits: Tensor, indices: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        if mask is None:
            return logits, indices
        width = self.num_rows
        if mask is not self.mask:  # a kept set: as wide as its largest pair
            width = min(int(mask.sum(1).max()), width) if mask.shape[0] else width
        return logits.masked_fill(~mask, -math.inf)[:, :width], indices[:, :width]


def keep_best(
    scores: Tensor, mask: Tensor | None, ratio: float, min_rows: int = 1
) -> tuple[Tensor, Tensor | None]:
    """Indices of the best ``floor(n ratio)`` of n rows, at least one, best first.

    Parameters
    ----------
    scores : Tensor, shape (B,N)
    mask : Tensor, shape (B,N) bool, optional
    ratio : float
    min_rows : int
        Smallest number of columns to return, padding included.

    Returns
    -------
    index : Tensor, shape (B,N') int64
    kept_mask : Tensor, shape (B,N') bool, or None
        Which of them count.
    """
    if mask is None:
        order = scores.argsort(dim=1, descending=True, stable=True)
        return order[:, : max(int(scores.shape[1] * ratio), 1)], None
    order = scores.masked_fill(~mask, -math.inf).argsort(dim=1, descending=True, stable=True)
    num_kept = (mask.sum(1).double() * ratio).long().clamp(min=1)
    width = max([*num_kept.tolist(), min_rows])
    row = torch.arange(width, device=order.device)
    return order[:, :width], row < num_kept[:, None]
