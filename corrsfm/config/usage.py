"""What a network reads and what its scores mean: it belongs to the weights and lies in their checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from corrsfm.config.fields import option

__all__ = ["LIGHTGLUE_KINDS", "FeatureKind", "MatchInput", "MatchTraits", "NetworkUsage"]


class FeatureKind(StrEnum):
    """What keypoints and descriptors are, whoever made them."""

    SIFT = "sift"
    ALIKED = "aliked"
    DISK = "disk"
    SUPERPOINT = "superpoint"
    OTHER = "other"


LIGHTGLUE_KINDS = (FeatureKind.ALIKED, FeatureKind.DISK)
"""Features that LightGlue's package has weights for."""


@dataclass(frozen=True, kw_only=True)
class MatchTraits:
    """What the putative matches of a scene carry.

    Attributes
    ----------
    features : FeatureKind
        What they match.
    has_shapes : bool
        Whether keypoints have scale and orientation.
    has_ratios : bool
        Whether matches have the ratio of the two nearest descriptor distances.
    """

    features: FeatureKind = FeatureKind.SIFT
    has_shapes: bool = True
    has_ratios: bool = True


class MatchInput(StrEnum):
    """Putative matches that a network reads."""

    ALL = "all"
    MUTUAL = "mutual"


@dataclass(frozen=True, kw_only=True)
class NetworkUsage:
    """What the network reads, and which of its scores keep a match.

    The defaults are those of the first bundled checkpoint, and of every file that says nothing.
    """

    features: FeatureKind = option(
        FeatureKind.SIFT, "Features whose matches the network was trained on", affects_result=False
    )
    input: MatchInput = option(
        MatchInput.ALL, "Matches that the network reads: all nearest neighbours, or only the mutual ones"
    )
    pose_min_score: float = option(
        0.5, "Operating point pose keeps matches with a score above this", minimum=0, maximum=1
    )
    sfm_min_score: float = option(
        0.3, "Operating point sfm keeps mutual matches with a score above this", minimum=0, maximum=1
    )
    confident_score: float = option(0.7, "A match is confident above this", minimum=0, maximum=1)
    min_num_confident: int = option(
        20, "A pair with fewer confident matches is doubtful: sfm keeps only those", minimum=0
    )
    min_confident_share: float = option(
        0.0,
        "A pair is doubtful, too, if they are a smaller share of the matches that the network read",
        minimum=0,
        maximum=1,
    )
