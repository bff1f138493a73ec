"""Evidence that a model lies folded on itself, from what its photos fail to share.

Repeated structure brings photos of different places together: a mug's back on its front, the two ends of a
street on one another. Such a model agrees with all the matches that it was made from. It is betrayed by what
is missing: two photos that it puts side by side share less than each of them shares with photos farther away.
The idea that missing matches speak is that of Zach, Irschara and Bischof (CVPR 2008); the measures are ours.

For two photos i and j, with the points of tracks of three or more photos:

``E_ij``
    points observed in i that j should see too: inside j's frame, at a similar distance and angle.
``s_ij``
    share of ``E_ij`` and ``E_ji`` that is found in the other photo: observed there, or the keypoint has a
    verified match near the projection.
``a_ij``
    viewing angle between the two: the larger of the medians over ``E_ij`` and over ``E_ji``.
share conflict ``c_ij``
    ``1 - s_ij / m_ij``, where ``m_ij`` is what both photos achieve with others at least as far apart: the
    smaller of the two maxima of ``s_ik`` (``s_jk``) over photos k with ``a_ik`` (``a_jk``) >= ``a_ij``.
hole ``H_ij``
    share of ``E_ij`` (``E_ji``, the smaller) in patches of which j finds next to nothing, although a photo
    at least as far from i finds half of them or more.

All this is counted for *near* pairs, those with ``a_ij`` below 20 degrees, and judged for the *guarded* among
them: cameras that stand far apart for the distance of what they see may well hide things from each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.reconstruction.folds.sightings import PhotoSightings, Sightings, read_sightings
from corrsfm.types import Pair

__all__ = ["FoldEvidence", "NearPair", "find_folds", "fold_evidence"]

_MIN_MATCHES = 15
_FRAME_MARGIN = 0.02
_MAX_DISTANCE_RATIO = 1.5
_MAX_VIEW_ANGLE_DEG = 40.0
_MIN_EXPECTED = 20
_NEAR_ANGLE_DEG = 20.0
_FOUND_PX = 8.0
_NEIGHBOURS = 10
_MIN_IN_PATCH = 5
_HOLE_SHARE = 0.1
_SEEN_SHARE = 0.5
_GUARD_ANGLE_DEG = 40.0
_GUARD_QUANTILE = 0.1
_MAX_SHARE_CONFLICT = 0.5
_MAX_HOLE = 0.1
_MIN_PAIRS_TO_ACCUSE = 10
_MIN_PAIRS_TO_CLEAR = 20
_FOLDED_VALUE = 0.1
_FOLDED_PAIRS = 3
_FOLDED_PAIRS_BESIDES = 2
_ROWS_AT_A_TIME = 512


@dataclass(frozen=True, kw_only=True)
class NearPair:
    """Two photos that a model puts side by side.

    Attributes
    ----------
    name0, name1 : str
        In alphabetical order.
    angle_deg : float
        Viewing angle between the two.
    share : float
        Share of the points that each should see and does, 0 to 1.
    share_conflict : float
        ``c``, at most 1; 0 or below if no photo farther away shares more.
    hole : float
        ``H``, 0 to 1.
    guarded : bool
        Whether the two stand close enough, for the distance of what they see, to be judged.
    """

    name0: str
    name1: str
    angle_deg: float
    share: float
    share_conflict: float
    hole: float
    guarded: bool

    @property
    def conflicts(self) -> bool:
        """Whether the two share too little for where the model puts them."""
        return self.share_conflict > _MAX_SHARE_CONFLICT or self.hole > _MAX_HOLE


@dataclass(frozen=True, kw_only=True)
class FoldEvidence:
    """Evidence for or against a folded model.

    Attributes
    ----------
    near_pairs : tuple of NearPair
        All of them, guarded or not, sorted by names.
    """

    near_pairs: tuple[NearPair, ...]

    @property
    def num_near_pairs(self) -> int:
        """Number of pairs that can be judged: near and guarded."""
        return sum(pair.guarded for pair in self.near_pairs)

    @property
    def num_conflicts(self) -> int:
        """Number of those that share too little."""
        return sum(pair.guarded and pair.conflicts for pair in self.near_pairs)

    @property
    def value(self) -> float:
        """``F``: share of the judged pairs that conflict, 0 to 1; 0 without any."""
        return self.num_conflicts / max(self.num_near_pairs, 1)

    @property
    def num_all_conflicts(self) -> int:
        """Number of near pairs that share too little, unguarded ones included, holes in guarded ones only.

        Sees more than `num_conflicts` and is fooled more often: a reason to look on, not to judge.
        """
        return sum(
            pair.conflicts if pair.guarded else pair.share_conflict > _MAX_SHARE_CONFLICT
            for pair in self.near_pairs
        )

    @property
    def folded(self) -> bool | None:
        """Whether the model is folded; None if the judged pairs are too few to tell.

        Folded are models of which at least three judged pairs, and a tenth of them, conflict, two or more of
        them not about the photo that conflicts most: a blurred photo, or one with something in front, shares
        little with all others. Ten judged pairs are enough to say so; twenty to say that a model is not
        folded.
        """
        num = self.num_near_pairs
        many = self.num_conflicts >= _FOLDED_PAIRS and self.value >= _FOLDED_VALUE
        if num >= _MIN_PAIRS_TO_ACCUSE and many and self._num_besides_worst_photo() >= _FOLDED_PAIRS_BESIDES:
            return True
        return None if num < _MIN_PAIRS_TO_CLEAR else False

    def _num_besides_worst_photo(self) -> int:
        """Judged pairs in conflict without those of the photo that is in most of them."""
        counts: Counter[str] = Counter()
        for pair in self.near_pairs:
            if pair.guarded and pair.conflicts:
                counts.update((pair.name0, pair.name1))
        return self.num_conflicts - max(counts.values(), default=0)

    def worst(self, num: int) -> tuple[NearPair, ...]:
        """The judged pairs that conflict most, worst first."""

        def rank(pair: NearPair) -> tuple[float, str, str]:
            excess = max(pair.share_conflict / _MAX_SHARE_CONFLICT, pair.hole / _MAX_HOLE)
            return -excess, pair.name0, pair.name1

        return tuple(
            sorted((one for one in self.near_pairs if one.guarded and one.conflicts), key=rank)[:num]
        )


def find_folds(model: pycolmap.Reconstruction, verified: Mapping[Pair, NDArray[np.int32]]) -> FoldEvidence:
    """Look for the signs of a folded model.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Keypoints are numbered as in ``verified``. Not changed.
    verified : mapping of Pair to (K, 2) int32
        Keypoint rows in photo 0 and photo 1 of *all* verified matches of the scene: also for a model made
        from some of them only, or the evidence goes with the matches. Pairs of fewer than 15 do not count.

    Returns
    -------
    FoldEvidence
        Little evidence does not prove a model right: of two sides that look the same everywhere, or of
        photos far from one another, nothing can be seen.
    """
    return fold_evidence(read_sightings(model), verified)


def fold_evidence(sightings: Sightings, verified: Mapping[Pair, NDArray[np.int32]]) -> FoldEvidence:
    """As `find_folds`, of a model already read; time grows with photos² × points per photo."""
    views = sightings.views
    partners = _partners(views, verified)
    seen = [_seen_from(index, sightings, partners) for index in range(len(views))]
    shares = _compare(seen)
    near = np.argwhere(np.triu(shares.angle_deg < _NEAR_ANGLE_DEG, 1))
    conflicts = _share_conflicts(shares, near)
    holes = np.minimum(*_hole_shares(views, seen, shares, near))
    guarded = _guarded(sightings, near)
    return FoldEvidence(
        near_pairs=tuple(
            NearPair(
                name0=views[i].name,
                name1=views[j].name,
                angle_deg=float(shares.angle_deg[i, j]),
                share=float(shares.share[i, j]),
                share_conflict=float(conflict),
                hole=float(hole),
                guarded=bool(guard),
            )
            for (i, j), conflict, hole, guard in zip(near, conflicts, holes, guarded, strict=True)
        )
    )


def _partners(
    views: tuple[PhotoSightings, ...], verified: Mapping[Pair, NDArray[np.int32]]
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """For ordered pairs of views: the matched keypoint of the other view for each keypoint, -1 for none."""
    index = {view.name: i for i, view in enumerate(views)}
    partners = {}
    for (name0, name1), matches in verified.items():
        if len(matches) < _MIN_MATCHES or name0 not in index or name1 not in index:
            continue
        for name, other, (own, its) in ((name0, name1, matches.T), (name1, name0, matches.T[::-1])):
            table = np.full(len(views[index[name]].keypoints_px), -1)
            table[own] = its
            partners[index[name], index[other]] = table
    return partners


@dataclass(frozen=True)
class _Seen:
    """What a view i and the others see of i's points.

    others (J,) rows of the views that should see enough of them; expected, found (J, M) bool, found where
    expected; angle_deg (J,) median viewing angles.
    """

    others: NDArray[np.int64]
    expected: NDArray[np.bool_]
    found: NDArray[np.bool_]
    angle_deg: NDArray[np.float64]


def _seen_from(
    index: int, sightings: Sightings, partners: Mapping[tuple[int, int], NDArray[np.int64]]
) -> _Seen:
    view = sightings.views[index]
    positions = sightings.positions[view.point_rows]
    away = view.centre - positions
    distance = np.linalg.norm(away, axis=1)
    others, expected, found, angles = [], [], [], []
    for row, other in enumerate(sightings.views):
        if row == index:
            continue
        is_expected, cosine = _could_see(positions, away, distance, other)
        if np.count_nonzero(is_expected) < _MIN_EXPECTED:
            continue
        projected = other.project(positions)
        is_expected &= _inside(projected, other)
        if np.count_nonzero(is_expected) < _MIN_EXPECTED:
            continue
        is_found = np.isin(view.point_rows, other.point_rows)
        if (table := partners.get((index, row))) is not None:
            matched = table[view.keypoint_rows]
            offset = other.keypoints_px[matched] - projected
            is_found |= (matched >= 0) & (np.hypot(*offset.T) < _FOUND_PX)
        others.append(row)
        expected.append(is_expected)
        found.append(is_found & is_expected)
        angles.append(np.degrees(np.arccos(np.clip(np.median(cosine[is_expected]), -1.0, 1.0))))
    shape = (len(others), len(positions))
    return _Seen(
        np.array(others, np.int64),
        np.array(expected, bool).reshape(shape),
        np.array(found, bool).reshape(shape),
        np.array(angles, np.float64),
    )


def _could_see(
    positions: NDArray[np.float64],
    away: NDArray[np.float64],
    distance: NDArray[np.float64],
    other: PhotoSightings,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which points another camera has at a similar distance and angle, and the cosines of the angles."""
    away_other = other.centre - positions
    distance_other = np.linalg.norm(away_other, axis=1)
    cosine = np.einsum("mk,mk->m", away, away_other) / np.maximum(distance * distance_other, 1e-300)
    similar = (distance_other < _MAX_DISTANCE_RATIO * distance) & (
        distance < _MAX_DISTANCE_RATIO * distance_other
    )
    return similar & (cosine > np.cos(np.radians(_MAX_VIEW_ANGLE_DEG))), cosine


def _inside(projected: NDArray[np.float64], view: PhotoSightings) -> NDArray[np.bool_]:
    size = np.array([view.camera.width, view.camera.height])
    # A comparison with NaN, a point behind the camera, is False.
    return np.all((projected > _FRAME_MARGIN * size) & (projected < (1 - _FRAME_MARGIN) * size), axis=1)


@dataclass(frozen=True)
class _Shares:
    """``s_ij`` and ``a_ij`` of all views, (V, V) float64, symmetric; infinite angles where there is none."""

    share: NDArray[np.float64]
    angle_deg: NDArray[np.float64]


def _compare(seen: list[_Seen]) -> _Shares:
    num = len(seen)
    num_expected, num_found = np.zeros((num, num)), np.zeros((num, num))
    angle = np.full((num, num), np.inf)
    for i, one in enumerate(seen):
        num_expected[i, one.others] = one.expected.sum(axis=1)
        num_found[i, one.others] = one.found.sum(axis=1)
        angle[i, one.others] = one.angle_deg
    return _Shares(
        (num_found + num_found.T) / np.maximum(num_expected + num_expected.T, 1),
        np.maximum(angle, angle.T),
    )


def _share_conflicts(shares: _Shares, near: NDArray[np.int64]) -> NDArray[np.float64]:
    """``c`` of near pairs (P, 2); 0 where one of the two shares nothing with anything farther away."""
    conflicts = np.zeros(len(near))
    for row, (i, j) in enumerate(near):
        farther = (shares.angle_deg[[i, j]] >= shares.angle_deg[i, j]) & np.isfinite(shares.angle_deg[[i, j]])
        farther[:, [i, j]] = False
        standard = np.where(farther, shares.share[[i, j]], 0.0).max(axis=1).min()
        if standard > 0:
            conflicts[row] = 1.0 - shares.share[i, j] / standard
    return conflicts


def _hole_shares(
    views: tuple[PhotoSightings, ...], seen: list[_Seen], shares: _Shares, near: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``h_ij`` and ``h_ji`` of near pairs (P, 2)."""
    holes = np.zeros((len(views), len(views)))
    for i in np.unique(near):
        one = seen[i]
        patches = _nearest(views[i].keypoints_px[views[i].keypoint_rows])
        angles = shares.angle_deg[i, one.others]
        # From the farthest view inwards, remembering the patches that one of them has seen.
        was_seen = np.zeros(len(patches), bool)
        for row in np.argsort(-angles, kind="stable"):
            if not np.isfinite(angles[row]):
                continue
            in_patch = one.expected[row][patches].sum(axis=1)
            local = one.found[row][patches].sum(axis=1) / np.maximum(in_patch, 1)
            known = one.expected[row] & (in_patch >= _MIN_IN_PATCH)
            is_hole = known & (local <= _HOLE_SHARE) & was_seen
            holes[i, one.others[row]] = np.count_nonzero(is_hole) / np.count_nonzero(one.expected[row])
            was_seen |= known & (local >= _SEEN_SHARE)
    return holes[near[:, 0], near[:, 1]], holes[near[:, 1], near[:, 0]]


def _nearest(positions_px: NDArray[np.float64]) -> NDArray[np.int64]:
    """Each of (M, 2) points and its ten nearest others, as rows (M, <= 11)."""
    num = min(_NEIGHBOURS + 1, len(positions_px))
    squares = np.sum(positions_px**2, axis=1)
    nearest = np.empty((len(positions_px), num), np.int64)
    for start in range(0, len(positions_px), _ROWS_AT_A_TIME):
        block = slice(start, start + _ROWS_AT_A_TIME)
        distance_sq = squares - 2 * positions_px[block] @ positions_px.T
        nearest[block] = np.argpartition(distance_sq, num - 1, axis=1)[:, :num]
    return nearest


def _guarded(sightings: Sightings, near: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether near pairs (P, 2) stand closer together than 40 degrees, seen from what is close to them."""
    centres = np.array([view.centre for view in sightings.views]).reshape(-1, 3)
    closest = np.array(
        [
            np.quantile(
                np.linalg.norm(sightings.positions[view.point_rows] - view.centre, axis=1), _GUARD_QUANTILE
            )
            if len(view.point_rows)
            else np.inf
            for view in sightings.views
        ]
    )
    baseline = np.linalg.norm(centres[near[:, 0]] - centres[near[:, 1]], axis=1)
    return baseline < 2 * np.tan(np.radians(_GUARD_ANGLE_DEG) / 2) * closest[near].min(axis=1)
