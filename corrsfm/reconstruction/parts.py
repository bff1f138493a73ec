"""Parts of a model that few matches hold together, taken apart and put together again.

Incremental mapping takes the first pair that carries a part across to the next. Where the scene looks alike
from two sides, that pair may be a false one, and the part then stays where a few dozen false matches put it:
the true pairs across each say where it belongs, but none of them alone is strong enough. So each part is
taken as a model of its own, and all that may be the same point in both, from matches of every pair and from
the look of the points, decides together how they lie to one another.
"""

from __future__ import annotations

import itertools
import math
import random
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.geometry import rotation_angle_deg
from corrsfm.graph import second_strongest
from corrsfm.reconstruction.calibration import DEFAULT_REFINEMENT, Refinement, adjustment_options
from corrsfm.reconstruction.explained import Explained
from corrsfm.reconstruction.folds.unfold import judge_model
from corrsfm.reconstruction.joining import merge_models
from corrsfm.reconstruction.registration import without_photos
from corrsfm.reconstruction.same_points import Placement, candidates_of, find_placements
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.views import Views, views_of
from corrsfm.types import Pair

__all__ = ["WeakLink", "put_together_again", "weak_links"]

# The false links of kitchen_lego, the scene that they were found on, have 0.05 to 0.12.
_WEAK_STRENGTH = 0.3
_FEWEST_PHOTOS = 3
# By chance up to 8 points agree; what is made of them is looked at again.
_FEWEST_POINTS = 10
_MAX_LINKS, _MAX_PLACEMENTS = 4, 3
_LEAST_PHOTOS = 0.5
_SAME_TURN_DEG, _SAME_PLACE = 10.0, 0.1
# A place that explains half of the verified matches across may be right. They were selected by geometries of
# which some are false, so the right place may explain fewer than a wrong one; but it predicts far more.
_ENOUGH_ACROSS = 0.5
_LEAST_EXPLAINED_WITHIN, _LEAST_EXPLAINED_ACROSS, _LEAST_PREDICTED_ACROSS = 0.98, 0.6, 1.5
_FEWEST_MORE_PREDICTED, _MOST_PAIRS_ACROSS = 30, 100


@dataclass(frozen=True, kw_only=True)
class WeakLink:
    """Two parts of a model, and how strongly they are linked.

    Attributes
    ----------
    part0, part1 : tuple of str
        Photos, sorted; the larger part first.
    strength : float
        Explained matches of the strongest pair across, over the verified matches of the second-strongest pair
        of either of its photos, whichever has fewer; 0 if the model explains half of no pair across.
    """

    part0: tuple[str, ...]
    part1: tuple[str, ...]
    strength: float

    def connects(self, name0: str, name1: str) -> bool:
        """Whether one photo is of the one part and one of the other."""
        first, second = ({name0, name1} & set(part) for part in (self.part0, self.part1))
        return len(first) == len(second) == 1


def weak_links(explained: Explained) -> list[WeakLink]:
    """Parts of three photos or more that no pair holds together as its photos are held by others.

    Photos that hang by even less are in neither part.

    Returns
    -------
    list of WeakLink
        The weakest first.
    """
    there = {(one.name0, one.name1): one for one in explained.pairs if one.is_registered and one.num_verified}
    held = {pair: one.num_explained for pair, one in there.items() if not one.is_contradicted}
    second = second_strongest({pair: one.num_verified for pair, one in there.items()})
    strength = {
        pair: num / least if (least := min(second[pair[0]], second[pair[1]])) else np.inf
        for pair, num in held.items()
    }
    parts = {name: [name] for name in second}
    links = []
    # From the strongest pair down, as the greatest spanning tree is built.
    for pair in sorted(held, key=lambda one: (-strength[one], one)):
        part0, part1 = parts[pair[0]], parts[pair[1]]
        if part0 is part1:
            continue
        if strength[pair] < _WEAK_STRENGTH:
            links += _link(part0, part1, strength[pair])
        _unite(parts, part0, part1)
    # What no pair holds together, as every pair across is contradicted.
    apart = sorted({id(part): part for part in parts.values()}.values(), key=lambda part: (-len(part), part))
    for part in apart[1:]:
        links += _link(apart[0], part, 0.0)
        _unite(parts, apart[0], part)
    return links[::-1]


def _link(part0: list[str], part1: list[str], strength: float) -> list[WeakLink]:
    """One link, or none if a part is too small to be a model of its own."""
    if min(len(part0), len(part1)) < _FEWEST_PHOTOS:
        return []
    larger, smaller = sorted((sorted(part0), sorted(part1)), key=lambda part: (-len(part), part))
    return [WeakLink(part0=tuple(larger), part1=tuple(smaller), strength=strength)]


def _unite(parts: dict[str, list[str]], part0: list[str], part1: list[str]) -> None:
    part0 += part1
    for name in part1:
        parts[name] = part0


def put_together_again(
    model: pycolmap.Reconstruction,
    explained: Explained,
    database: Path,
    evidence: SceneEvidence,
    *,
    seed: int = 0,
    refinement: Refinement = DEFAULT_REFINEMENT,
    max_runtime_seconds: int = 0,
) -> pycolmap.Reconstruction | None:
    """Take a model apart where it hangs by little, and put the parts where most points say.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Not changed.
    explained : Explained
        What it explains.
    database : Path
        That it was mapped from; not changed.
    evidence : SceneEvidence
    seed : int
    refinement : Refinement
        What may change of the cameras when the new model is adjusted.
    max_runtime_seconds : int
        No other place is tried after so long; 0 for no limit.

    Returns
    -------
    pycolmap.Reconstruction or None
        None if no part hangs by little, or where each is explains half of the verified matches across, or no
        other place that points agree about explains as much, predicts clearly more across, and is no fold.
        Photos that hang by even less are left out, up to half of all.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    options = adjustment_options(refinement, num_threads=1)
    end = time.monotonic() + (max_runtime_seconds or math.inf)
    moved: list[pycolmap.Reconstruction] = []
    # Parts of parts first.
    for link in weak_links(explained)[:_MAX_LINKS][::-1]:
        if time.monotonic() > end:
            break
        a, b = (_moved_or_as_is(part, moved, model) for part in (link.part0, link.part1))
        stayed = not any(one is a or one is b for one in moved)
        if stayed and _across(explained, link).is_enough:
            continue
        candidates = candidates_of(a, b, database, evidence.features)
        # What was moved inside a part that then finds no place is given up.
        moved = [one for one in moved if one is not a and one is not b]
        for placement in find_placements(a, b, candidates, num=_MAX_PLACEMENTS, seed=seed):
            if time.monotonic() > end:
                break
            if len(placement.same_points) < _FEWEST_POINTS or (stayed and _is_as_before(placement, a, b)):
                continue
            again = merge_models(a, b, placement, database, evidence, options=options, seed=seed)
            if again is not None and _is_better(again, model, link, evidence, stayed=stayed):
                moved.append(again)
                break
    largest = max(moved, key=lambda one: one.num_reg_images(), default=None)
    enough = _LEAST_PHOTOS * model.num_reg_images()
    return None if largest is None or largest.num_reg_images() < enough else largest


def _moved_or_as_is(
    names: tuple[str, ...], moved: list[pycolmap.Reconstruction], model: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """The largest model of photos of a part that has been put together again, or the part as it was."""
    inside = [one for one in moved if views_of(one).keys() <= set(names)]
    return max(inside, key=lambda one: one.num_reg_images(), default=None) or _part(model, names)


def _part(model: pycolmap.Reconstruction, names: tuple[str, ...]) -> pycolmap.Reconstruction:
    return without_photos(model, {image.name for image in model.images.values()} - set(names))


def _is_as_before(placement: Placement, a: pycolmap.Reconstruction, b: pycolmap.Reconstruction) -> bool:
    """Whether a placement hardly turns part b, nor moves its photos by much of the extent of both."""
    a_from_b = placement.a_from_b
    turn = rotation_angle_deg(a_from_b.rotation)
    centres = _centres(b)
    distances = np.linalg.norm(a_from_b.apply(centres) - centres, axis=1)
    extent = np.linalg.norm(np.ptp(np.vstack([_centres(a), centres]), axis=0))
    return bool(turn < _SAME_TURN_DEG and distances.max() <= _SAME_PLACE * extent)


def _centres(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    return np.array([image.projection_center() for image in model.images.values() if image.has_pose])


def _is_better(
    again: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    link: WeakLink,
    evidence: SceneEvidence,
    *,
    stayed: bool,
) -> bool:
    """Whether the joined parts explain what they did, predict clearly more across, and are no fold.

    Parts that did not stay as they were need not predict more: the place of the whole may have been right.
    """
    views = views_of(again)
    before = _part(model, tuple(views))
    views_before = views_of(before)
    if views.keys() != views_before.keys():
        return False
    explained, explained_before = (evidence.explain(one) for one in (views, views_before))
    across, across_before = (_across(one, link).num_explained for one in (explained, explained_before))
    within, within_before = explained.num_explained - across, explained_before.num_explained - across_before
    if within < _LEAST_EXPLAINED_WITHIN * within_before or across < _LEAST_EXPLAINED_ACROSS * across_before:
        return False
    predicted, predicted_before = (_predicted_across(one, link, evidence) for one in (views, views_before))
    num, num_before = _num(predicted), _num(predicted_before)
    more = max(_LEAST_PREDICTED_ACROSS * num_before, num_before + _FEWEST_MORE_PREDICTED)
    if num < (more if stayed else num_before):
        return False
    # A fold predicts much across, too: it is betrayed by what photos side by side do not share. That pairs
    # across are not verified is no sign of one; what counts is what the joined model finds.
    folds = judge_model(again, {**predicted, **evidence.verified}).evidence
    if not folds.folded:
        return True
    return folds.value < judge_model(before, {**predicted_before, **evidence.verified}).evidence.value


def _num(matches: Mapping[Pair, NDArray[np.int32]]) -> int:
    return sum(map(len, matches.values()))


@dataclass(frozen=True, kw_only=True)
class _Across:
    """Verified matches between the parts of a link, and those of them that a model explains."""

    num_verified: int
    num_explained: int

    @property
    def is_enough(self) -> bool:
        return 0 < _ENOUGH_ACROSS * self.num_verified <= self.num_explained


def _across(explained: Explained, link: WeakLink) -> _Across:
    pairs = [pair for pair in explained.pairs if pair.is_registered and link.connects(pair.name0, pair.name1)]
    return _Across(
        num_verified=sum(pair.num_verified for pair in pairs),
        num_explained=sum(pair.num_explained for pair in pairs),
    )


def _predicted_across(views: Views, link: WeakLink, evidence: SceneEvidence) -> dict[Pair, NDArray[np.int32]]:
    """Matches that a model predicts across; of large parts, for a sample of the pairs, always the same."""
    pairs = [(min(pair), max(pair)) for pair in itertools.product(link.part0, link.part1)]
    if len(pairs) > _MOST_PAIRS_ACROSS:
        pairs = random.Random(0).sample(pairs, _MOST_PAIRS_ACROSS)
    return evidence.predicted(views, pairs)
