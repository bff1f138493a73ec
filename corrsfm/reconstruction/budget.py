"""How much time the search for a better model than the first may take."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from corrsfm.reconstruction.choice import ChoicePolicy

__all__ = ["TimeBudget", "policy_for"]

# A large scene must not take 25 times as long; a small one is not bounded by time, on which its model would
# depend.
_TIMES, _SECONDS = 2.0, 120.0


def policy_for(max_models: int, first_seconds: float) -> ChoicePolicy:
    """The policy within a budget: the time of two first mappings and two minutes."""
    factor = _TIMES + _SECONDS / max(first_seconds, 1e-3)
    return ChoicePolicy(max_models=max_models, max_time_factor=factor)


class TimeBudget:
    """Seconds that several steps share. On a weak pair graph one model may take minutes.

    Parameters
    ----------
    seconds : float
    """

    def __init__(self, seconds: float) -> None:
        self._left = seconds

    @property
    def seconds_left(self) -> int:
        """Whole seconds; 0 if nothing is left, which COLMAP would take for no bound."""
        return max(round(self._left), 0)

    @contextlib.contextmanager
    def spent(self) -> Iterator[Callable[[], float]]:
        """Take the time of what is done within from the budget; gives a function that tells it afterwards."""
        started, seconds = time.monotonic(), 0.0
        try:
            yield lambda: seconds
        finally:
            seconds = time.monotonic() - started
            self._left -= seconds
