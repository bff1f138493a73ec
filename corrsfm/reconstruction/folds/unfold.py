"""What may unfold a folded model: verified pairs to leave out, and the choice among the new models.

Nothing here maps: the caller maps the pairs that stay, by a function that it hands in. The evidence of every
new model is counted on the verified matches of the whole scene, not on those that stayed; otherwise it would
go with the matches, and the fold would stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.graph import second_strongest
from corrsfm.reconstruction.folds.bodies import outvoted_pairs, rotation_votes
from corrsfm.reconstruction.folds.evidence import FoldEvidence, NearPair, fold_evidence
from corrsfm.reconstruction.folds.sightings import Sightings, explained_shares, read_sightings
from corrsfm.types import Pair

__all__ = [
    "Attempt",
    "PhotoGroups",
    "UnfoldRule",
    "best_unfolding",
    "judge_model",
    "pairs_to_leave_out",
    "photo_groups",
    "try_unfolding",
    "weak_pairs",
]

_GROUP_CONFLICT = 0.25
_CONFLICT = 0.5
_HOLE_WEIGHT = 5.0
"""Makes the bound of a hole, 0.1, the bound of a share conflict, 0.5."""
_MIN_EXPLAINED = 0.5
_STRENGTH = 0.5
_MAX_ROUNDS = 4
_MIN_PHOTOS_KEPT = 0.9


class UnfoldRule(StrEnum):
    """How the verified pairs to leave out are found."""

    STRONG = "strong"
    """Pairs that are weak beside the other pairs of both photos."""
    SHARES = "shares"
    """Pairs that hold together groups of photos in conflict by their shares."""
    HOLES = "holes"
    """The same, groups and conflicts by shares and by holes."""
    VOTES = "votes"
    """Pairs outvoted on how parts lie to one another that no pair of the model really holds together."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """A model made from some or all of the verified pairs, and what speaks against it.

    Attributes
    ----------
    rules : tuple of UnfoldRule
        What was applied, in order; empty for the model of all pairs.
    removed : tuple of Pair
        Verified pairs that were left out, sorted.
    model : pycolmap.Reconstruction
    sightings : Sightings
        Its registered photos and what they observe.
    evidence : FoldEvidence
        Counted on all verified matches of the scene.
    explained : mapping of Pair to float
        Share of each verified pair's matches that the model explains; pairs of registered photos only.
    explained_share : float
        Share of all verified matches of the scene that the model explains.
    """

    rules: tuple[UnfoldRule, ...]
    removed: tuple[Pair, ...]
    model: pycolmap.Reconstruction
    sightings: Sightings
    evidence: FoldEvidence
    explained: Mapping[Pair, float]
    explained_share: float

    @property
    def num_photos(self) -> int:
        """Number of registered photos."""
        return len(self.sightings.views)


@dataclass(frozen=True, kw_only=True)
class PhotoGroups:
    """Photos that a model puts side by side and that do share what they should.

    Attributes
    ----------
    groups : tuple of tuple of str
        Names, sorted; photos without any near pair are in none.
    at_odds : tuple of (int, int)
        Groups, the smaller number first, that lie side by side and share too little.
    """

    groups: tuple[tuple[str, ...], ...]
    at_odds: tuple[tuple[int, int], ...]


def judge_model(
    model: pycolmap.Reconstruction,
    verified: Mapping[Pair, NDArray[np.int32]],
    *,
    rules: tuple[UnfoldRule, ...] = (),
    removed: Iterable[Pair] = (),
) -> Attempt:
    """Count what speaks against a model, on *all* verified matches of its scene, also those left out."""
    sightings = read_sightings(model)
    explained = explained_shares(sightings, verified)
    num_explained = sum(share * len(verified[pair]) for pair, share in explained.items())
    return Attempt(
        rules=rules,
        removed=tuple(sorted(removed)),
        model=model,
        sightings=sightings,
        evidence=fold_evidence(sightings, verified),
        explained=explained,
        explained_share=num_explained / max(sum(map(len, verified.values())), 1),
    )


def photo_groups(evidence: FoldEvidence, *, use_holes: bool = False) -> PhotoGroups:
    """Group photos by average linkage over near pairs, weight ``1 - 2 c``; time grows with photos³.

    Two groups join if their near pairs weigh more than zero on average and fewer than a quarter of them
    conflict; the heaviest first, ties by name.

    Parameters
    ----------
    evidence : FoldEvidence
    use_holes : bool
        Let holes count like share conflicts, in guarded pairs.
    """
    names = sorted({name for pair in evidence.near_pairs for name in (pair.name0, pair.name1)})
    rows = {name: row for row, name in enumerate(names)}
    weight, count, conflicts = np.zeros((3, len(names), len(names)))
    for pair in evidence.near_pairs:
        conflict = _conflict(pair, use_holes)
        for cell in ((rows[pair.name0], rows[pair.name1]), (rows[pair.name1], rows[pair.name0])):
            weight[cell], count[cell], conflicts[cell] = 1.0 - 2.0 * conflict, 1.0, conflict > _CONFLICT
    members = [[name] for name in names]
    while (joined := _heaviest(weight, count, conflicts)) is not None:
        kept, gone = joined
        members[kept] += members[gone]
        members[gone] = []
        for table in (weight, count, conflicts):
            table[kept] += table[gone]
            table[:, kept] = table[kept]
            table[gone] = table[:, gone] = table[kept, kept] = 0.0
    order = [row for row, group in enumerate(members) if group]
    at_odds = ((count > 0) & (conflicts >= _GROUP_CONFLICT * count))[np.ix_(order, order)]
    return PhotoGroups(
        groups=tuple(tuple(sorted(members[row])) for row in order),
        at_odds=tuple((int(a), int(b)) for a, b in np.argwhere(np.triu(at_odds, 1))),
    )


def _conflict(pair: NearPair, use_holes: bool) -> float:
    hole = _HOLE_WEIGHT * pair.hole if use_holes and pair.guarded else 0.0
    return min(max(pair.share_conflict, hole, 0.0), 1.0)


def _heaviest(weight: NDArray, count: NDArray, conflicts: NDArray) -> tuple[int, int] | None:
    """The two groups to join next, the one that comes first first."""
    may_join = np.triu((count > 0) & (conflicts < _GROUP_CONFLICT * count), 1)
    mean = np.where(may_join, weight / np.maximum(count, 1.0), -np.inf)
    if not mean.size or not mean.max() > 0:
        return None
    kept, gone = np.unravel_index(int(mean.argmax()), mean.shape)
    return int(kept), int(gone)


def weak_pairs(
    verified: Mapping[Pair, NDArray[np.int32]], *, strength: float = _STRENGTH
) -> tuple[Pair, ...]:
    """Verified pairs with fewer matches than ``strength`` × the second-strongest pair of either photo.

    Whichever of the two second-strongest pairs is weaker counts; a photo's only pair always stays. Sorted.
    """
    second = second_strongest({pair: len(matches) for pair, matches in verified.items()})
    return tuple(
        sorted(
            pair
            for pair, matches in verified.items()
            if len(matches) < strength * min(second[pair[0]], second[pair[1]])
        )
    )


def pairs_to_leave_out(
    rule: UnfoldRule, attempt: Attempt, verified: Mapping[Pair, NDArray[np.int32]]
) -> tuple[Pair, ...]:
    """The verified pairs that a rule wants to leave out next, sorted; none that are left out already.

    Pairs that a folded model contradicts always stay: the true links between its parts are among them.
    """
    if rule is UnfoldRule.STRONG:
        found: Iterable[Pair] = weak_pairs(verified)
    elif rule is UnfoldRule.VOTES:
        kept = {pair: share for pair, share in attempt.explained.items() if pair not in attempt.removed}
        found = outvoted_pairs(rotation_votes(attempt.sightings, verified, kept))
    else:
        groups = photo_groups(attempt.evidence, use_holes=rule is UnfoldRule.HOLES)
        group_of = {name: row for row, group in enumerate(groups.groups) for name in group}
        at_odds = set(groups.at_odds)
        found = (
            pair
            for pair, share in attempt.explained.items()
            if share >= _MIN_EXPLAINED
            and pair[0] in group_of
            and pair[1] in group_of
            and tuple(sorted((group_of[pair[0]], group_of[pair[1]]))) in at_odds
        )
    return tuple(sorted(set(found) - set(attempt.removed)))


def try_unfolding(
    first: Attempt,
    verified: Mapping[Pair, NDArray[np.int32]],
    map_without: Callable[[Sequence[Pair]], pycolmap.Reconstruction | None],
    *,
    rules: Sequence[UnfoldRule] = tuple(UnfoldRule),
    max_rounds: int = _MAX_ROUNDS,
) -> list[Attempt]:
    """Map again without the pairs that each rule names, in rounds while the new model still shows conflicts.

    Parameters
    ----------
    first : Attempt
        The folded model.
    verified : mapping of Pair to (K, 2) int32
        All verified matches of the scene.
    map_without : callable
        Maps the scene without the given pairs, sorted; returns the largest model, or None if there is none.
    rules : sequence of UnfoldRule
        Each starts from the first model.
    max_rounds : int
        Of each rule. A set of pairs that was left out before is not mapped again.

    Returns
    -------
    list of Attempt
        Without ``first``; empty if no rule names a pair.
    """
    attempts: list[Attempt] = []
    tried: set[tuple[Pair, ...]] = {first.removed}
    for rule in rules:
        attempt = first
        for _ in range(max_rounds):
            found = pairs_to_leave_out(rule, attempt, verified)
            removed = tuple(sorted({*attempt.removed, *found}))
            if not found or removed in tried:
                break
            tried.add(removed)
            model = map_without(removed)
            if model is None:
                break
            attempt = judge_model(model, verified, rules=(*attempt.rules, rule), removed=removed)
            attempts.append(attempt)
            if attempt.evidence.num_all_conflicts == 0:
                break
    return attempts


def best_unfolding(first: Attempt, attempts: Iterable[Attempt]) -> Attempt:
    """The model with the smallest `FoldEvidence.value`; `first` unless another is better.

    Only models with at least 90 % of the photos of the first count. Equal evidence is decided by the
    explained share, and by order. A lower value proves no model right: it is a comparison of models.
    """
    enough = _MIN_PHOTOS_KEPT * first.num_photos
    able = [first, *(attempt for attempt in attempts if attempt.num_photos >= enough)]
    # Python's min returns the first of equals.
    return min(able, key=lambda attempt: (attempt.evidence.value, -attempt.explained_share))
