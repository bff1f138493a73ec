"""Several models of one scene: joined where enough points say how, and the joined model holds.

What may be the same point in both is taken from photos that both hold, from matches between their photos
that pruning kept though the pair was not verified, and from the look of the points themselves. All of them
together decide on one similarity, so that pairs which are too weak alone count. A joined model is kept only
if it explains and predicts what its parts did.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.log import colmap_log
from corrsfm.reconstruction.cache import load_cache
from corrsfm.reconstruction.calibration import (
    DEFAULT_REFINEMENT,
    Refinement,
    adjustment_options,
    has_possible_cameras,
    refine,
)
from corrsfm.reconstruction.folds.unfold import judge_model
from corrsfm.reconstruction.resection import Landmarks
from corrsfm.reconstruction.same_points import Placement, candidates_of, find_placements, registered_images
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.views import views_of
from corrsfm.types import Pair

__all__ = ["FEWEST_POINTS", "Joining", "join_models", "merge_models"]

FEWEST_POINTS = 15
"""Points that must agree with one similarity. By chance up to 8 do."""
_SEES_PX = 4.0
_MAX_ATTEMPTS = 12
# Adjusting the whole moves a few matches over a threshold.
_LEAST_EXPLAINED, _LEAST_PREDICTED = 0.99, 0.97
_LEAST_ACROSS = 0.5
_IMPOSSIBLE = "the joined model has a camera that cannot be"


@dataclass(frozen=True, kw_only=True)
class Joining:
    """An attempt to join two models.

    Attributes
    ----------
    photos0, photos1 : tuple of str
        Of the two models, sorted.
    is_joined : bool
    num_candidates : int
        Pairs of points that may be the same.
    num_points : int
        Those that agree with one similarity.
    reason : str
        Why they were joined, or why not and what is missing, a clause.
    """

    photos0: tuple[str, ...]
    photos1: tuple[str, ...]
    is_joined: bool
    num_candidates: int
    num_points: int
    reason: str

    def __str__(self) -> str:
        models = f"models of {len(self.photos0)} and {len(self.photos1)} photos"
        return f"{models} {'joined' if self.is_joined else 'not joined'}: {self.reason}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "photos0": list(self.photos0),
            "photos1": list(self.photos1),
            "is_joined": self.is_joined,
            "num_candidates": self.num_candidates,
            "num_points": self.num_points,
            "reason": self.reason,
        }


def join_models(
    models: Sequence[pycolmap.Reconstruction],
    database: Path,
    evidence: SceneEvidence,
    *,
    seed: int = 0,
    refinement: Refinement = DEFAULT_REFINEMENT,
    num_threads: int = 1,
) -> tuple[list[pycolmap.Reconstruction], list[Joining]]:
    """Join what can be joined of several models.

    The work is bounded by the number of points and attempts, not by a clock, so that equal arguments give
    equal models; with more than one thread up to rounding.

    Parameters
    ----------
    models : sequence of pycolmap.Reconstruction
        The largest first; not changed.
    database : Path
        That they were mapped from; not changed.
    evidence : SceneEvidence
    seed : int
    refinement : Refinement
        What may change of the cameras when a joined model is adjusted.
    num_threads : int

    Returns
    -------
    models : list of pycolmap.Reconstruction
        Those that are left; a joined model stands in the place of its larger part, or before models that are
        smaller than it.
    attempts : list of Joining
        In the order of trying.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    options = adjustment_options(refinement, num_threads=num_threads)
    left = list(models)
    attempts: list[Joining] = []
    tried: set[tuple[tuple[str, ...], tuple[str, ...]]] = set()
    while len(attempts) < _MAX_ATTEMPTS:
        names = [Landmarks(model).photos for model in left]
        pair = next(
            (
                (i, j)
                for i in range(len(left))
                for j in range(i + 1, len(left))
                if (names[i], names[j]) not in tried
            ),
            None,
        )
        if pair is None:
            break
        i, j = pair
        tried.add((names[i], names[j]))
        joined, attempt = _join(left[i], left[j], database, evidence, options, seed)
        attempts.append(attempt)
        if joined is not None:
            del left[j], left[i]
            smaller = (k for k in range(i) if left[k].num_reg_images() < joined.num_reg_images())
            left.insert(next(smaller, i), joined)
    return left, attempts


def _join(
    a: pycolmap.Reconstruction,
    b: pycolmap.Reconstruction,
    database: Path,
    evidence: SceneEvidence,
    options: pycolmap.BundleAdjustmentOptions,
    seed: int,
) -> tuple[pycolmap.Reconstruction | None, Joining]:
    candidates = candidates_of(a, b, database, evidence.features)
    placement = next(find_placements(a, b, candidates, num=1, seed=seed), None)
    num_points = 0 if placement is None else len(placement.same_points)

    def outcome(reason: str, joined: bool = False) -> Joining:
        return Joining(
            photos0=Landmarks(a).photos,
            photos1=Landmarks(b).photos,
            is_joined=joined,
            num_candidates=len(candidates.same_points(np.ones(len(candidates.a), np.bool_))),
            num_points=num_points,
            reason=reason,
        )

    if placement is None or num_points < FEWEST_POINTS:
        return None, outcome(
            f"{num_points} points agree on how they lie to one another, {FEWEST_POINTS} are needed: photos "
            "that show what both show would join them"
        )
    joined = merge_models(a, b, placement, database, evidence, options=options, seed=seed)
    objection = _IMPOSSIBLE if joined is None else _objection(a, b, joined, evidence)
    if objection:
        return None, outcome(f"{num_points} points agree on how they lie to one another, but {objection}")
    return joined, outcome(f"{num_points} points agree on how they lie to one another", joined=True)


def merge_models(
    a: pycolmap.Reconstruction,
    b: pycolmap.Reconstruction,
    placement: Placement,
    database: Path,
    evidence: SceneEvidence,
    *,
    options: pycolmap.BundleAdjustmentOptions,
    seed: int = 0,
) -> pycolmap.Reconstruction | None:
    """One adjusted model of two, held together by the same points and by the matches that it predicts.

    Parameters
    ----------
    a, b : pycolmap.Reconstruction
        Not changed.
    placement : Placement
    database : Path
        That they were mapped from; not changed.
    evidence : SceneEvidence
    options : pycolmap.BundleAdjustmentOptions
    seed : int

    Returns
    -------
    pycolmap.Reconstruction or None
        In the frame of a; None if adjusting gave a camera that cannot be.
    """
    merged = _merged(a, b, placement, database, seed)
    refine(merged, options)
    if not has_possible_cameras(merged):
        return None
    if _merge_predicted(merged, _across(a, b, evidence.predicted(views_of(merged)))):
        refine(merged, options)
    return merged if has_possible_cameras(merged) else None


def _merged(
    a: pycolmap.Reconstruction,
    b: pycolmap.Reconstruction,
    placement: Placement,
    database: Path,
    seed: int,
) -> pycolmap.Reconstruction:
    """Model a with the photos and points that only b has, brought into the frame of a."""
    merged = pycolmap.Reconstruction(a)
    in_a, in_b = registered_images(a), registered_images(b)
    moved = pycolmap.Reconstruction(b)
    a_from_b = placement.a_from_b
    moved.transform(
        pycolmap.Sim3d(a_from_b.scale, pycolmap.Rotation3d(a_from_b.rotation), a_from_b.translation)
    )
    used = {image.camera_id for image in in_a.values()}
    cache = load_cache(database, a, b)
    with colmap_log():
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(merged)
        new = sorted(in_b.keys() - in_a.keys())
        for name in new:
            image, source = merged.find_image_with_name(name), moved.find_image_with_name(name)
            if image.camera_id not in used:
                merged.cameras[image.camera_id].params = list(moved.cameras[source.camera_id].params)
            merged.frames[image.frame_id].set_cam_from_world(image.camera_id, source.cam_from_world())
            merged.register_frame(image.frame_id)
        point_in_a = {point_b: point_a for point_a, point_b in placement.same_points}
        _add_points(mapper, merged, moved, set(new), point_in_a)
        options = pycolmap.IncrementalTriangulatorOptions()
        options.random_seed = seed
        mapper.complete_and_merge_tracks(options)
        mapper.end_reconstruction(False)
    return merged


def _add_points(
    mapper: pycolmap.IncrementalMapper,
    merged: pycolmap.Reconstruction,
    moved: pycolmap.Reconstruction,
    new: set[str],
    point_in_a: dict[int, int],
) -> None:
    """Give the merged model the observations of its new photos."""
    observations = mapper.observation_manager
    for point_id, point in sorted(moved.points3D.items()):
        elements = [
            pycolmap.TrackElement(
                merged.find_image_with_name(moved.images[element.image_id].name).image_id,
                element.point2D_idx,
            )
            for element in point.track.elements
            if moved.images[element.image_id].name in new
        ]
        target = point_in_a.get(int(point_id))
        if target is not None and target in merged.points3D:
            for element in elements:
                observations.add_observation(target, element)
        elif len(elements) > 1:
            track = pycolmap.Track()
            for element in elements:
                track.add_element(element)
            observations.add_point3D(point.xyz, track, point.color)


def _across(
    a: pycolmap.Reconstruction, b: pycolmap.Reconstruction, matches: Mapping[Pair, NDArray[np.int32]]
) -> dict[Pair, NDArray[np.int32]]:
    """Those matches that are of pairs which neither model holds."""
    in_a, in_b = registered_images(a).keys(), registered_images(b).keys()
    return {pair: m for pair, m in matches.items() if not (in_a >= set(pair) or in_b >= set(pair))}


def _merge_predicted(joined: pycolmap.Reconstruction, across: Mapping[Pair, NDArray[np.int32]]) -> int:
    """Make one of two points that a predicted match says are the same, where their photos agree; how many.

    The first points that joined the parts may be few; these hold them together more firmly.
    """
    num_merged = 0
    for (name0, name1), matches in sorted(across.items()):
        image0, image1 = joined.find_image_with_name(name0), joined.find_image_with_name(name1)
        for keypoint0, keypoint1 in matches:
            seen0, seen1 = image0.points2D[int(keypoint0)], image1.points2D[int(keypoint1)]
            if not (seen0.has_point3D() and seen1.has_point3D()) or seen0.point3D_id == seen1.point3D_id:
                continue
            point0, point1 = joined.points3D[seen0.point3D_id], joined.points3D[seen1.point3D_id]
            common = {e.image_id for e in point0.track.elements} & {e.image_id for e in point1.track.elements}
            if common or not (_sees(image0, point1, seen0.xy) and _sees(image1, point0, seen1.xy)):
                continue
            joined.merge_points3D(seen0.point3D_id, seen1.point3D_id)
            num_merged += 1
    return num_merged


def _sees(image: pycolmap.Image, point: pycolmap.Point3D, pixel: NDArray[np.float64]) -> bool:
    """Whether a photo would see a point near a pixel."""
    projected = image.project_point(point.xyz)
    return projected is not None and bool(np.linalg.norm(projected - pixel) <= _SEES_PX)


def _objection(
    a: pycolmap.Reconstruction,
    b: pycolmap.Reconstruction,
    joined: pycolmap.Reconstruction,
    evidence: SceneEvidence,
) -> str:
    """What speaks against a joined model, a clause; empty if nothing does."""
    views_a, views_b, views = views_of(a), views_of(b), views_of(joined)
    if views.keys() < views_a.keys() | views_b.keys():
        return "the joined model lost photos"
    explained = {(p.name0, p.name1): p for p in evidence.explain(views).pairs}
    parts: dict[Pair, int] = defaultdict(int)
    for own in (views_a, views_b):
        for pair in evidence.explain(own).pairs:
            key = (pair.name0, pair.name1)
            parts[key] = max(parts[key], pair.num_explained)
    before, after = sum(parts.values()), sum(explained[key].num_explained for key in parts)
    if after < _LEAST_EXPLAINED * before:
        return f"the joined model explains {after} matches, its parts {before}"
    across = [
        pair
        for key, pair in explained.items()
        if not (views_a.keys() >= set(key) or views_b.keys() >= set(key)) and pair.is_registered
    ]
    num_across = sum(pair.num_verified for pair in across)
    if num_across and sum(pair.num_explained for pair in across) < _LEAST_ACROSS * num_across:
        return "most verified matches between them contradict it"
    predicted = evidence.predicted(views)
    separate: dict[Pair, int] = defaultdict(int)
    for own in (views_a, views_b):
        for key, matches in evidence.predicted(own).items():
            separate[key] = max(separate[key], len(matches))
    before, after = sum(separate.values()), sum(len(predicted[key]) for key in separate)
    if after < _LEAST_PREDICTED * before:
        return f"the joined model predicts {after} matches where its parts predict {before}"
    was_folded = any(judge_model(model, evidence.verified).evidence.folded for model in (a, b))
    # That no pair across is verified is why they are parts; what counts is what the joined model finds.
    shared = {**_across(a, b, predicted), **evidence.verified}
    if not was_folded and judge_model(joined, shared).evidence.folded:
        return "the joined model would be folded: photos side by side do not share what both should see"
    return ""
