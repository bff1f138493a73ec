"""The choice among models: how many to try, and which one to take.

One mapping of a weak pair graph is a draw. The first model is taken if what it explains says that it is
right; otherwise further candidates are mapped, in rounds, until the best one has been found a second time by
another way, or enough has been tried. The model with the most predicted matches is chosen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from corrsfm.reconstruction.agreement import agreement
from corrsfm.reconstruction.explained import ENOUGH_UNCONTRADICTED_SHARE, Explained
from corrsfm.reconstruction.views import Views

__all__ = ["Choice", "ChoicePolicy", "Tried", "choose_model", "good_enough"]

C = TypeVar("C")

SAME_MODEL = 0.99
"""Share of relative poses that two models agree about if they are one and the same."""

# Wrong models with a camera for each photo predict up to 0.5 % more than better ones that share theirs.
_MORE_CAMERAS = 0.97


@dataclass(frozen=True, kw_only=True)
class ChoicePolicy:
    """When to stop trying.

    Attributes
    ----------
    min_registered_share : float
        A first model that registers as many of the photos, and explains enough, needs no second.
    max_models : int
        Models tried at most, the first one included.
    max_time_factor : float
        No further round once the candidates have taken this many times the first mapping; 0 for no bound.
        The only part of the choice that depends on the machine.
    round_size : int
        Candidates between two decisions; fixed, so that the choice does not depend on the number of cores.
    min_models : int
        Models tried before the best can be confirmed.
    confirming_share : float
        Relative poses on which a candidate must agree with the best to confirm it. The best must also explain
        enough and misplace no photo: on a weak pair graph many candidates fall into the same wrong model.
    confirming_predicted : float
        Predicted matches it must reach, as a share of the best's.
    patience : int
        Candidates in a row without more predicted matches after which the best stands.
    """

    min_registered_share: float = 1.0
    max_models: int = 24
    max_time_factor: float = 25.0
    round_size: int = 3
    min_models: int = 7
    confirming_share: float = 0.9
    confirming_predicted: float = 0.97
    patience: int = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Tried:
    """A model that has been mapped.

    Attributes
    ----------
    name : str
        Of the candidate.
    way : str
        How it was mapped. Only a model that was mapped in another way confirms it: one more seed of the same
        mapper often gives the same model, right or wrong.
    views : mapping of str to View
        Its registered photos.
    explained : Explained
    seconds : float
        Of the mapping.
    is_open : bool
        It has a camera for each photo, and other candidates share one.
    has_more_cameras : bool
        It has more cameras than other candidates.
    is_put_together : bool
        Parts of it stood elsewhere, and most points of all pairs put them where they are.
    num_predicted : int or None
        None until a choice has to be made.
    """

    name: str
    way: str
    views: Views
    explained: Explained
    seconds: float
    is_open: bool = False
    has_more_cameras: bool = False
    is_put_together: bool = False
    num_predicted: int | None = None

    @property
    def explained_share(self) -> float:
        """Explained over verified matches of the scene."""
        return self.explained.share

    @property
    def num_registered(self) -> int:
        """Number of registered photos."""
        return len(self.views)


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """What was tried and taken.

    Attributes
    ----------
    chosen : Tried
    tried : tuple of Tried
        The first model, what was made of it, and candidates in the order of trying; without those that gave
        no model.
    num_failed : int
        Candidates that gave no model.
    reason : str
        Why no more was tried, as the end of "stopped because …".
    support : float or None
        Best agreement of another candidate with the chosen one, among those that were mapped in another way
        and predict nearly as much: share of relative poses in [0, 1]; 0 if the others predict less. None if
        the chosen model needs no confirmation: a first model that is good enough, or one that was put
        together again and is.
    could_try_more : bool
        Whether a larger `ChoicePolicy.max_models` would have brought another candidate.
    """

    chosen: Tried
    tried: tuple[Tried, ...]
    num_failed: int = 0
    reason: str
    support: float | None = None
    could_try_more: bool = True


def good_enough(model: Tried, num_photos: int, policy: ChoicePolicy) -> bool:
    """Whether a first model needs no second: it explains enough, fixes the photos, misplaces none."""
    explained = model.explained
    return (
        not model.is_open
        and not explained.misplaced
        and explained.explains_enough
        and model.num_registered >= policy.min_registered_share * num_photos
    )


def choose_model(
    first: Tried,
    bank: Sequence[C],
    *,
    num_photos: int,
    map_round: Callable[[Sequence[C]], Sequence[Tried | None]],
    count_predicted: Callable[[Views], int],
    policy: ChoicePolicy,
    mended: Tried | None = None,
    others: Sequence[Tried | None] = (),
    mend: Callable[[Tried], Tried | None] = lambda model: None,
) -> Choice:
    """Try candidates until the best model is confirmed or the budget is spent, and choose.

    Parameters
    ----------
    first : Tried
    bank : sequence
        Candidates in the order of trying.
    num_photos : int
        Photos of the scene.
    map_round : callable
        Maps some candidates, in parallel or not; one `Tried` each, in their order, None for no model.
    count_predicted : callable
        Number of predicted matches of a model.
    policy : ChoicePolicy
    mended : Tried, optional
        The first model with parts put elsewhere; the better of the two may need no second, either.
    others : sequence of Tried or None
        Candidates that have been mapped already.
    mend : callable, optional
        Mends a model (`corrsfm.reconstruction.mending`); None if that gave nothing. Asked once about every
        model that is the best at the end of a round; what it returns is one more model to choose from.

    Returns
    -------
    Choice
        Of equal models the earlier is taken, so the first one stays unless another is better.
    """
    if mended is None and good_enough(first, num_photos, policy):
        return Choice(chosen=first, tried=(first,), reason="the first model is good enough")
    known = [model for model in (first, mended, *others) if model is not None]
    if len(known) == 1 and (not bank or policy.max_models < 2):
        return Choice(chosen=first, tried=(first,), reason="no other candidate was to be tried")

    def counted(model: Tried) -> Tried:
        return dataclasses.replace(model, num_predicted=count_predicted(model.views))

    asked: set[str] = set()

    def mend_best(outcomes: list[Tried | None]) -> None:
        best = _best([model for model in outcomes if model is not None])
        if best.name not in asked:
            asked.add(best.name)
            again = mend(best)
            if again is not None:
                outcomes.append(counted(again))

    outcomes: list[Tried | None] = [*map(counted, known), *([None] * others.count(None))]
    if mended is not None:
        counts = [model for model in outcomes if model is not None]
        best = _best(counts[:2])
        if good_enough(best, num_photos, policy):
            reason = f"the first model{', mended,' if best.name != first.name else ''} is good enough"
            return Choice(chosen=best, tried=tuple(counts), reason=reason)
    mend_best(outcomes)
    affordable = bank[: max(policy.max_models - len(outcomes), 0)]
    reason = "all candidates have been tried"
    if could_try_more := len(affordable) < len(bank):
        reason = "as many as allowed have been tried"
    for candidates in _rounds(affordable, policy.round_size):
        outcomes += [None if model is None else counted(model) for model in map_round(candidates)]
        mend_best(outcomes)
        if why := _why_stop(outcomes, num_photos, policy):
            reason, could_try_more = why, False
            break
    tried = [model for model in outcomes if model is not None]
    best = _best(tried)
    return Choice(
        chosen=best,
        tried=tuple(tried),
        num_failed=len(outcomes) - len(tried),
        reason=reason,
        support=None
        if _needs_no_other(best, num_photos, policy)
        else _support(best, tried, policy.confirming_predicted),
        could_try_more=could_try_more,
    )


def _rounds(bank: Sequence[C], size: int) -> Iterator[Sequence[C]]:
    return (bank[start : start + size] for start in range(0, len(bank), size))


def _needs_no_other(model: Tried, num_photos: int, policy: ChoicePolicy) -> bool:
    """Whether a model that was put together again is as good as a first one must be to need no second."""
    return model.is_put_together and good_enough(model, num_photos, policy)


def _why_stop(outcomes: Sequence[Tried | None], num_photos: int, policy: ChoicePolicy) -> str:
    """Why no further candidate is needed; empty if one is."""
    tried = [model for model in outcomes if model is not None]
    best = _best(tried)
    if _needs_no_other(best, num_photos, policy):
        return "the best model, mended, is good enough"
    support = _support(best, tried, policy.confirming_predicted)
    share = best.explained.share_of_supported
    if not best.explained.misplaced:
        if len(tried) > policy.round_size and support >= SAME_MODEL and share >= ENOUGH_UNCONTRADICTED_SHARE:
            return "another way of mapping gave the same model"
        confirmed = best.explained.is_enough(share) and support >= policy.confirming_share
        if len(tried) >= policy.min_models and confirmed:
            return "another candidate confirmed the best"
    stood = len(outcomes) - 1 - outcomes.index(best)
    if stood >= policy.patience:
        return f"the best stood for {stood} candidates"
    spent = sum(model.seconds for model in tried[1:])
    if policy.max_time_factor and spent > policy.max_time_factor * tried[0].seconds:
        return f"the candidates took {policy.max_time_factor:.3g} times as long as the first model"
    return ""


def _best(tried: Sequence[Tried]) -> Tried:
    """Most predicted matches, then most photos, then most explained, then the earliest.

    Every camera more fits more matches, right or wrong, so a model with more of them must predict clearly
    more.
    """

    def rank(model: Tried) -> tuple[float, int, float]:
        num_predicted = (model.num_predicted or 0) * (_MORE_CAMERAS if model.has_more_cameras else 1.0)
        return num_predicted, model.num_registered, model.explained_share

    return max(tried, key=rank)  # the first of equals


def _support(best: Tried, tried: Sequence[Tried], confirming_predicted: float) -> float:
    """Best agreement with a model mapped in another way that predicts nearly as much, over all its photos."""
    enough = confirming_predicted * (best.num_predicted or 0)
    shares = [0.0]
    for rival in tried:
        if rival.way == best.way or (rival.num_predicted or 0) < enough:
            continue
        common = agreement(best.views, rival.views)
        # A rival with fewer photos confirms only the pairs it has.
        num, num_common = best.num_registered, common.num_photos
        shares.append(common.share * num_common * (num_common - 1) / max(num * (num - 1), 1))
    return max(shares)
