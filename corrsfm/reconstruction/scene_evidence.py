"""What the models of one scene are judged by: its verified matches and the neighbours of its features."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from corrsfm.reconstruction.epipolar import TwoViews
from corrsfm.reconstruction.explained import Explained, explain, is_explained
from corrsfm.reconstruction.predicted import NeighbourTables, predict, sample_pairs
from corrsfm.reconstruction.views import Views, rays_of
from corrsfm.types import Features, Pair

__all__ = ["SceneEvidence"]


class SceneEvidence:
    """What models of one scene are judged by: its verified matches and its features.

    Parameters
    ----------
    names : sequence of str
        All photos of the scene.
    verified : mapping of Pair to (K, 2) int
        Verified matches.
    load : callable
        Photo name → `Features`.
    seed : int
        Of the sample of pairs over which predicted matches of large scenes are counted.
    """

    def __init__(
        self,
        names: Sequence[str],
        verified: Mapping[Pair, NDArray[np.int32]],
        load: Callable[[str], Features],
        *,
        seed: int = 0,
    ) -> None:
        self.names = sorted(names)
        self.verified = verified
        self._load = load
        self._seed = seed
        self._tables = NeighbourTables(lambda name: load(name).descriptors)

    @cached_property
    def keypoints(self) -> dict[str, NDArray[np.float32]]:
        """Keypoints of every photo that is in a verified pair."""
        paired = sorted({name for pair in self.verified for name in pair})
        return {name: self._load(name).keypoints for name in paired}

    @cached_property
    def _pairs(self) -> list[Pair]:
        return sample_pairs(self.keypoints, self.verified, seed=self._seed)

    def explain(self, views: Views) -> Explained:
        """What a model explains of the verified matches."""
        return explain(views, self.keypoints, self.verified)

    def explained_matches(self, views: Views, pair: Pair) -> NDArray[np.bool_]:
        """Which verified matches of a pair of registered photos a model explains; (K,) bool."""
        name0, name1 = pair
        rays = rays_of({name: views[name] for name in pair}, self.keypoints)
        two = TwoViews(views[name0], views[name1], rays[name0], rays[name1])
        return is_explained(two, self.verified[pair])

    def count_predicted(self, views: Views) -> int:
        """Matches that a model predicts; the neighbours of features are computed when first needed."""
        return sum(len(matches) for matches in self.predicted(views).values())

    def predicted(self, views: Views, pairs: Sequence[Pair] | None = None) -> dict[Pair, NDArray[np.int32]]:
        """The same matches, (K, 2) keypoint indices for each pair of registered photos that is counted.

        Those are the pairs that `count_predicted` sums over, unless others are given.
        """
        return predict(views, self.keypoints, self._tables, self._pairs if pairs is None else pairs)

    def features(self, photo: str) -> Features:
        """Keypoints and descriptors of a photo."""
        return self._load(photo)
