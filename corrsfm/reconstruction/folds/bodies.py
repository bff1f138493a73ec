"""Rigid parts of a model that few matches hold together, and a vote on how they lie to one another.

A body is a set of photos linked by pairs that the model explains. Where bodies touch by chance only, each
verified pair between them says, by its own two-view geometry, how the one is turned against the other. True
pairs say the same; confused ones each say something else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.graph import connected_components
from corrsfm.reconstruction.folds.sightings import PhotoSightings, Sightings
from corrsfm.types import Pair

__all__ = ["RotationVote", "outvoted_pairs", "photo_bodies", "rotation_votes"]

_MIN_EXPLAINED = 0.5
_MIN_EXPLAINED_MATCHES = 15
_MAX_ERROR_PX = 2.0
_AGREE_DEG = 15.0
_CLEAR_LEAD = 1.5


@dataclass(frozen=True, kw_only=True)
class RotationVote:
    """What one verified pair says about how two bodies are turned against one another.

    Attributes
    ----------
    pair : Pair
        As verified.
    bodies : (int, int)
        Rows of the two bodies, the smaller first.
    num_inliers : int
        Matches that agree with the pair's own geometry.
    rotation : (3, 3) float64
        How far the model has turned the second body, in the world frame, from where the pair wants it; the
        identity if the pair agrees with the model.
    """

    pair: Pair
    bodies: tuple[int, int]
    num_inliers: int
    rotation: NDArray[np.float64]


def photo_bodies(
    explained: Mapping[Pair, float], verified: Mapping[Pair, NDArray[np.int32]]
) -> tuple[tuple[str, ...], ...]:
    """Photos linked by pairs of which the model explains half, and 15 matches at least; the names sorted.

    Photos without such a pair are bodies of their own.
    """
    names = sorted({name for pair in explained for name in pair})
    links = [
        pair
        for pair, share in explained.items()
        if share >= _MIN_EXPLAINED and share * len(verified[pair]) >= _MIN_EXPLAINED_MATCHES
    ]
    return tuple(sorted(tuple(body) for body in connected_components(names, links)))


def rotation_votes(
    sightings: Sightings,
    verified: Mapping[Pair, NDArray[np.int32]],
    explained: Mapping[Pair, float],
    *,
    seed: int = 0,
) -> list[RotationVote]:
    """Ask every verified pair between two bodies, by an essential matrix with the cameras of the model.

    Returns
    -------
    list of RotationVote
        In the order of ``explained``; pairs without a geometry of their own have no vote.
    """
    views = {view.name: view for view in sightings.views}
    bodies = photo_bodies(explained, verified)
    body_of = {name: row for row, body in enumerate(bodies) for name in body}
    votes = []
    for pair in explained:
        body0, body1 = body_of[pair[0]], body_of[pair[1]]
        if body0 == body1:
            continue
        estimate = _cam1_from_cam0(views[pair[0]], views[pair[1]], verified[pair], seed)
        if estimate is None:
            continue
        cam1_from_cam0, num_inliers = estimate
        rotation0, rotation1 = (views[name].cam_from_world[:, :3] for name in pair)
        turn = rotation1.T @ cam1_from_cam0 @ rotation0
        votes.append(
            RotationVote(
                pair=pair,
                bodies=(min(body0, body1), max(body0, body1)),
                num_inliers=num_inliers,
                rotation=turn if body0 < body1 else turn.T,
            )
        )
    return votes


def _cam1_from_cam0(
    view0: PhotoSightings, view1: PhotoSightings, matches: NDArray[np.int32], seed: int
) -> tuple[NDArray[np.float64], int] | None:
    options = pycolmap.RANSACOptions(max_error=_MAX_ERROR_PX, random_seed=seed)
    estimate = pycolmap.estimate_essential_matrix(
        view0.keypoints_px[matches[:, 0]],
        view1.keypoints_px[matches[:, 1]],
        view0.camera,
        view1.camera,
        options,
    )
    if estimate is None:
        return None
    return estimate["cam2_from_cam1"].rotation.matrix(), int(estimate["num_inliers"])


def outvoted_pairs(votes: list[RotationVote]) -> tuple[Pair, ...]:
    """The pairs that contradict a clear majority about their two bodies, sorted.

    A majority is two pairs or more within 15 degrees of one of them, with 1.5 times the inliers of any other
    opinion. None are named between bodies that lie as the majority says.
    """
    outvoted: list[Pair] = []
    for bodies in sorted({vote.bodies for vote in votes}):
        ours = [vote for vote in votes if vote.bodies == bodies]
        rotations = np.array([vote.rotation for vote in ours])
        inliers = np.array([vote.num_inliers for vote in ours])
        apart = _angles_deg(np.einsum("nji,mjk->nmik", rotations, rotations))
        support = (inliers * (apart < _AGREE_DEG)).sum(axis=1)
        winner = int(support.argmax())
        agrees = apart[winner] < _AGREE_DEG
        # An opinion that overlaps with the winner's does not count as a rival.
        rivals = support[apart[winner] >= 2 * _AGREE_DEG]
        clear = agrees.sum() >= 2 and support[winner] >= _CLEAR_LEAD * rivals.max(initial=0)
        if clear and _angles_deg(rotations[winner]) >= _AGREE_DEG:
            outvoted += [vote.pair for vote, agree in zip(ours, agrees, strict=True) if not agree]
    return tuple(sorted(outvoted))


def _angles_deg(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (...) of rotations (..., 3, 3)."""
    trace = np.trace(rotations, axis1=-2, axis2=-1)
    return np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
