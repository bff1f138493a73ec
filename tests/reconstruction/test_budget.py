"""The search for a better model has a bound in time, and its steps share it."""

import itertools
from types import SimpleNamespace

import pytest

from corrsfm.reconstruction import budget
from corrsfm.reconstruction.budget import TimeBudget, policy_for


def test_a_large_scene_spends_less_on_other_models_than_a_small_one() -> None:
    assert policy_for(24, 2.0).max_time_factor == 62.0
    assert policy_for(24, 60.0).max_time_factor == 4.0
    assert policy_for(24, 36000.0).max_time_factor == pytest.approx(2.0, abs=0.01)


def test_steps_share_a_budget_until_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count(start=100, step=7)
    monkeypatch.setattr(budget, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    shared = TimeBudget(10.4)
    assert shared.seconds_left == 10
    with shared.spent() as spent:
        assert spent() == 0
    assert (spent(), shared.seconds_left) == (7, 3)
    with pytest.raises(KeyError), shared.spent():
        raise KeyError
    assert shared.seconds_left == 0
