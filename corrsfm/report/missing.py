"""Why photos are missing from the first model of a scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from corrsfm.types import ModelSummary, PairStatistics

__all__ = ["MissingPhoto", "MissingReason", "missing_photos"]


class MissingReason(StrEnum):
    """Why a photo is not in the first model: the first stage that lost it."""

    LEFT_OUT = "unreadable, left out"
    NO_PAIR = "no pair"
    NO_MATCH = "no putative match"
    PRUNED = "pruned to nothing"
    NOT_VERIFIED = "too few verified matches"
    OTHER_MODEL = "in another model"
    NOT_MAPPED = "not mapped yet"
    OTHER_COMPONENT = "in another component"
    NOT_PLACED = "mapper could not place it"


@dataclass(frozen=True, kw_only=True)
class MissingPhoto:
    """A photo that is not in the first model.

    Attributes
    ----------
    name : str
    reason : MissingReason
    detail : str
        A sentence without its full stop: the numbers behind the reason.
    next_step : str
        What to try so that it joins the others, likewise.
    """

    name: str
    reason: MissingReason
    detail: str
    next_step: str


# What to try: {0} is the photo, {1} it and the one that it matches best, {2} a way to more matches.
_NEXT_STEPS = {
    MissingReason.LEFT_OUT: "replace the file and run again",
    MissingReason.NO_PAIR: "match it with more photos: --pairing exhaustive, or a larger --num-retrieved",
    MissingReason.NO_MATCH: "look at the photo: a dark, blurred or plain one has hardly any keypoints",
    MissingReason.PRUNED: "take a photo between {1}, or try --method ratio",
    MissingReason.NOT_VERIFIED: "take a photo between {1}, or try {2}",
    MissingReason.OTHER_MODEL: "take photos that show both models, or try {2}",
    MissingReason.NOT_MAPPED: "run corrsfm reconstruct",
    MissingReason.OTHER_COMPONENT: "take a photo between {0} and the model, or try {2}",
    MissingReason.NOT_PLACED: "take a photo between {1}, or try {2}",
}
_MORE_PAIRS, _MORE_FEATURES = "--pairing exhaustive", "a larger --max-features"


def missing_photos(
    names: Sequence[str],
    pairs: Sequence[PairStatistics],
    components: Sequence[tuple[str, ...]],
    models: Sequence[ModelSummary],
    left_out: Collection[str],
    mapped: bool,
) -> tuple[MissingPhoto, ...]:
    pairs_of: dict[str, list[PairStatistics]] = {name: [] for name in names}
    for pair in pairs:
        pairs_of[pair.name0].append(pair)
        pairs_of[pair.name1].append(pair)
    model_of = {
        name: number for number, model in reversed(list(enumerate(models))) for name in model.image_names
    }
    component_of = {name: component for component in components for name in component}
    main = _main_component(components, models)
    all_matched = 2 * len(pairs) >= len(names) * (len(names) - 1)
    missing = []
    for name in names:
        if model_of.get(name) == 0:
            continue
        component = component_of.get(name, ())
        if name in left_out:
            reason = MissingReason.LEFT_OUT
            detail = "it cannot be read"
        elif name in model_of:
            reason = MissingReason.OTHER_MODEL
            size = models[model_of[name]].num_images
            connected = (
                "verified pairs connect them" if component == main else "no verified pairs connect them"
            )
            detail = f"one of {size} photos of model {model_of[name]}; {connected} with model 0"
        elif component and not mapped:
            reason, detail = MissingReason.NOT_MAPPED, _verified_pairs(name, pairs_of[name])
        else:
            reason, detail = _lost_at(name, pairs_of[name], component, main)
        next_step = _NEXT_STEPS[reason].format(
            name,
            _with_best_partner(name, pairs_of[name], model_of),
            _MORE_FEATURES if all_matched else _MORE_PAIRS,
        )
        missing.append(MissingPhoto(name=name, reason=reason, detail=detail, next_step=next_step))
    return tuple(missing)


def _main_component(components: Sequence[tuple[str, ...]], models: Sequence[ModelSummary]) -> tuple[str, ...]:
    """The component that the first model was made from; the largest one if there is no model."""
    if not components:
        return ()
    registered = set(models[0].image_names) if models else set()
    return max(components, key=lambda component: (len(registered.intersection(component)), len(component)))


def _lost_at(
    name: str, pairs: Sequence[PairStatistics], component: tuple[str, ...], main: tuple[str, ...]
) -> tuple[MissingReason, str]:
    """The first stage that left a photo without matches, and the numbers behind it."""
    if not pairs:
        return MissingReason.NO_PAIR, "it was not matched with any photo"
    among = f"{len(pairs)} pair" + ("s" if len(pairs) > 1 else "")
    if not any(pair.num_putative for pair in pairs):
        return MissingReason.NO_MATCH, f"no match in {among}; it may have no keypoints"
    if not any(pair.num_kept for pair in pairs):
        return (
            MissingReason.PRUNED,
            f"no match kept in {among}; most putative ones: {_best(name, pairs, 'num_putative')}",
        )
    if not component:
        return (
            MissingReason.NOT_VERIFIED,
            f"none of {among} verified; most kept: {_best(name, pairs, 'num_kept')}",
        )
    if component != main:
        others = len(component) - 1
        return (
            MissingReason.OTHER_COMPONENT,
            f"verified pairs connect it with {others} other photo{'s' if others > 1 else ''} only",
        )
    return MissingReason.NOT_PLACED, _verified_pairs(name, pairs)


def _verified_pairs(name: str, pairs: Sequence[PairStatistics]) -> str:
    """How many of a photo's pairs are verified, and the best of them."""
    num_verified = sum(pair.num_verified > 0 for pair in pairs)
    plural = "s" if num_verified > 1 else ""
    return f"{num_verified} verified pair{plural}; most matches: {_best(name, pairs, 'num_verified')}"


def _with_best_partner(name: str, pairs: Sequence[PairStatistics], model_of: Mapping[str, int]) -> str:
    """A photo and the one that it matches best, if possible one of the first model."""

    def partner(pair: PairStatistics) -> str:
        return pair.name1 if pair.name0 == name else pair.name0

    def rank(pair: PairStatistics) -> tuple[bool, int, int, int]:
        joins = pair.num_kept > 0 and model_of.get(partner(pair)) == 0
        return joins, pair.num_verified, pair.num_kept, pair.num_putative

    return " and ".join(sorted([name, partner(max(pairs, key=rank))])) if pairs else name


def _best(name: str, pairs: Sequence[PairStatistics], count: str) -> str:
    """The largest of some count of a photo's pairs, and with which photo."""
    pair = max(pairs, key=lambda pair: getattr(pair, count))
    other = pair.name1 if pair.name0 == name else pair.name0
    return f"{getattr(pair, count)} with {other}"
