"""The learning rate over a run."""

from __future__ import annotations

import math

from corrsfm.training.config import Schedule

__all__ = ["learning_rate_factor"]


def learning_rate_factor(progress: float, warm_up: float, schedule: Schedule) -> float:
    """Share of the largest learning rate at a progress in [0, 1].

    Parameters
    ----------
    progress : float
    warm_up : float
        Share of the run in which the rate rises.
    schedule : Schedule
        One-cycle rises along a cosine from 1/25, cosine along a line from zero; both fall along a cosine.
    """
    if progress < warm_up:
        rising = progress / warm_up
        if schedule is Schedule.ONE_CYCLE:
            return 0.04 + 0.96 * 0.5 * (1 - math.cos(math.pi * rising))
        return rising
    falling = min((progress - warm_up) / max(1 - warm_up, 1e-9), 1.0)
    return 0.5 * (1 + math.cos(math.pi * falling))
