"""What a model explains: the share of the verified matches that agree with its poses.

A match is explained if both photos are registered, it lies within 4 px of the epipolar geometry of the
model's two poses, and in front of both photos; where its two rays are parallel to within 4 px, noise
decides the side, so those count in any case, as do photos of one standpoint that agree by rotation alone. A
pair is contradicted if both photos are registered and less than half of its matches are explained: one of
the two photos is in the wrong place, or the verified geometry was wrong.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corrsfm.reconstruction.epipolar import TwoViews
from corrsfm.reconstruction.views import Views, rays_of
from corrsfm.types import Pair

__all__ = ["Explained", "ExplainedPair", "explain", "is_explained"]

MAX_DISTANCE_PX = 4.0
CONTRADICTED_BELOW = 0.5
# Right models of the training and validation scenes explain 94.3 % and more. Where texture repeats, verified
# geometries hold false matches that no model explains: the exact cameras of the sample scene courtyard
# explain 88 %. Then no pair is contradicted, while a photo in the wrong place contradicts several.
ENOUGH_SHARE, ENOUGH_UNCONTRADICTED_SHARE = 0.94, 0.85
# Photos that share nothing make false pairs, which every right model contradicts. Of the models of 20
# training, validation and sample scenes with three methods of pruning, right ones explain 95.6 % and more
# of the pairs that they do not contradict, those of repeating texture left aside, and wrong ones 94.0 %.
ENOUGH_SUPPORTED_SHARE, MOST_CONTRADICTED = 0.955, 0.12
MISPLACED_BELOW = 0.6


@dataclass(frozen=True, kw_only=True)
class ExplainedPair:
    """How many verified matches of a pair a model explains.

    Attributes
    ----------
    name0, name1 : str
    num_verified, num_explained : int
    is_registered : bool
        Both photos are in the model.
    angle_deg : float
        Median angle between the two rays of an explained match; 0 without one.
    """

    name0: str
    name1: str
    num_verified: int
    num_explained: int
    is_registered: bool
    angle_deg: float = 0.0

    @property
    def share(self) -> float:
        """Explained over verified matches; 0 without matches."""
        return self.num_explained / self.num_verified if self.num_verified else 0.0

    @property
    def is_contradicted(self) -> bool:
        """Both photos are registered, and less than half of the matches are explained."""
        return self.is_registered and self.num_verified > 0 and self.share < CONTRADICTED_BELOW


@dataclass(frozen=True, kw_only=True)
class Explained:
    """What a model explains of a scene.

    Attributes
    ----------
    pairs : tuple of ExplainedPair
        Every verified pair, sorted by names.
    registered : tuple of str
        Photos of the model, sorted.
    """

    pairs: tuple[ExplainedPair, ...]
    registered: tuple[str, ...]

    @property
    def num_verified(self) -> int:
        """Verified matches of the scene."""
        return sum(pair.num_verified for pair in self.pairs)

    @property
    def num_explained(self) -> int:
        """Those of them that the model explains."""
        return sum(pair.num_explained for pair in self.pairs)

    @property
    def share(self) -> float:
        """Explained over verified matches of the scene, in [0, 1]; 0 for a scene without any."""
        return self.num_explained / self.num_verified if self.num_verified else 0.0

    @property
    def share_of_registered(self) -> float:
        """The same over the pairs of registered photos only."""
        inside = [pair for pair in self.pairs if pair.is_registered]
        num_verified = sum(pair.num_verified for pair in inside)
        return sum(pair.num_explained for pair in inside) / num_verified if num_verified else 0.0

    def is_enough(self, share: float) -> bool:
        """Whether a share of explained matches is enough; a lower one is if no pair is contradicted."""
        return share >= (ENOUGH_SHARE if self.contradicted else ENOUGH_UNCONTRADICTED_SHARE)

    @property
    def is_enough_of_supported(self) -> bool:
        """Whether so much of the other pairs is explained that the contradicted ones, if few, must be false.

        Few are those that hold 12 % of the verified matches of registered photos at most: parts of a scene
        that are put together wrongly contradict more.
        """
        few = self.are_contradicted_within(MOST_CONTRADICTED)
        return few and self.share_of_supported >= ENOUGH_SUPPORTED_SHARE

    @property
    def explains_enough(self) -> bool:
        """Whether enough of all pairs is explained, or of those that are not contradicted."""
        return self.is_enough(self.share) or self.is_enough_of_supported

    def are_contradicted_within(self, share: float) -> bool:
        """Whether contradicted pairs hold at most this share of the verified matches of registered photos."""
        num_verified = sum(pair.num_verified for pair in self.pairs if pair.is_registered)
        return sum(pair.num_verified for pair in self.contradicted) <= share * num_verified

    @property
    def contradicted(self) -> tuple[ExplainedPair, ...]:
        """Contradicted pairs, the least explained first."""
        pairs = [pair for pair in self.pairs if pair.is_contradicted]
        return tuple(sorted(pairs, key=lambda pair: (pair.share, -pair.num_verified, pair.name0, pair.name1)))

    @property
    def share_of_supported(self) -> float:
        """The same over the pairs of registered photos that are not contradicted; 0 without one.

        A verified pair that is false is contradicted as a whole and says nothing about the model, while a
        bent model explains a part of every pair: so this stays near 1 for right models of scenes that repeat
        themselves, and falls for bent ones.
        """
        supported = [pair for pair in self.pairs if pair.is_registered and not pair.is_contradicted]
        num_verified = sum(pair.num_verified for pair in supported)
        return sum(pair.num_explained for pair in supported) / num_verified if num_verified else 0.0

    @property
    def photo_shares(self) -> dict[str, float]:
        """Explained share of the verified matches of each registered photo with others; 0 without any."""
        verified, explained = Counter[str](), Counter[str]()
        for pair in self.pairs:
            if pair.is_registered:
                for name in (pair.name0, pair.name1):
                    verified[name] += pair.num_verified
                    explained[name] += pair.num_explained
        return {name: explained[name] / verified[name] if verified[name] else 0.0 for name in self.registered}

    @property
    def misplaced(self) -> tuple[str, ...]:
        """Photos of which less than 60 % is explained, sorted: they probably stand in the wrong place."""
        return tuple(name for name, share in self.photo_shares.items() if share < MISPLACED_BELOW)

    @property
    def widest_angle_deg(self) -> float:
        """Largest median angle of the pairs that are not contradicted; near 0 if the camera only turned."""
        return max((pair.angle_deg for pair in self.pairs if not pair.is_contradicted), default=0.0)

    @property
    def loose_ends(self) -> tuple[str, ...]:
        """Registered photos held by one pair at most, sorted; contradicted pairs hold nothing."""
        held = Counter(
            name
            for pair in self.pairs
            if pair.is_registered and pair.num_verified and not pair.is_contradicted
            for name in (pair.name0, pair.name1)
        )
        return tuple(name for name in self.registered if held[name] < 2)


def explain(
    views: Views,
    keypoints: Mapping[str, NDArray[np.floating]],
    verified: Mapping[Pair, NDArray[np.integer]],
    *,
    max_distance_px: float = MAX_DISTANCE_PX,
) -> Explained:
    """Count the verified matches that a model explains.

    Parameters
    ----------
    views : mapping of str to View
        Registered photos.
    keypoints : mapping of str to (N, 2) float
        Pixels, COLMAP convention, of every registered photo.
    verified : mapping of Pair to (K, 2) int
        Verified matches as keypoint indices; K may be 0.
    max_distance_px : float
        Largest Sampson distance of an explained match.

    Returns
    -------
    Explained
    """
    rays = rays_of(views, keypoints)
    pairs = []
    for (name0, name1), matches in sorted(verified.items()):
        is_registered = name0 in views and name1 in views
        num_explained, angle_deg = 0, 0.0
        if is_registered and len(matches):
            two = TwoViews(views[name0], views[name1], rays[name0], rays[name1])
            explained = is_explained(two, matches, max_distance_px=max_distance_px)
            num_explained = int(explained.sum())
            if num_explained:
                angle_deg = float(np.median(two.ray_angles_deg(matches[explained])))
        pairs.append(
            ExplainedPair(
                name0=name0,
                name1=name1,
                num_verified=len(matches),
                num_explained=num_explained,
                is_registered=is_registered,
                angle_deg=angle_deg,
            )
        )
    return Explained(pairs=tuple(pairs), registered=tuple(sorted(views)))


def is_explained(
    two: TwoViews, matches: NDArray[np.integer], *, max_distance_px: float = MAX_DISTANCE_PX
) -> NDArray[np.bool_]:
    """Which matches of two registered photos a model explains.

    Parameters
    ----------
    two : TwoViews
    matches : (K, 2) int
        Keypoint indices.
    max_distance_px : float
        Largest Sampson distance of an explained match.

    Returns
    -------
    (K,) bool
    """
    between = (two.sampson_distance_px(matches) < max_distance_px) & two.in_front(matches)
    return between | (two.far_distance_px(matches) < max_distance_px)
