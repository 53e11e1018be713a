"""The choice of observations one after the other, each the one that adds most, with a budget by number or cost.

For a submodular criterion the set that is found tells at least 1 − 1/e = 63 % of what the best set of that number does
(G. L. Nemhauser, L. A. Wolsey, M. L. Fisher, Math. Program. 14 (1978) 265–294), mostly far more. What a candidate added
before bounds what it adds now, so that few candidates are looked at again in each step (M. Minoux, 1978). With costs
that differ, the choice by gain for the cost and that by gain alone are both made, and the better one counts (J.
Leskovec et al., KDD 2007: at least (1 − 1/e)/2 of the best).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.designs.criteria import Criterion

TOGETHER = 16  # candidates that are looked at again at once
ROUNDING = 1e-9  # of a budget


class Choice(NamedTuple):
    """Chosen candidates.

    Attributes
    ----------
    order
        Their numbers, the first chosen first.
    gains
        What each added.
    looks
        How many times a candidate was looked at.
    """

    order: tuple[int, ...]
    gains: tuple[float, ...]
    looks: int

    @property
    def worth(self) -> float:
        """What they are worth together."""
        return sum(self.gains)


def choose(make: Callable[[], Criterion], costs: FloatArray, *, number: int | None, budget: float | None) -> Choice:
    """Choose a number of candidates with costs (c,), or as many as a budget pays for, by a criterion made anew."""
    found = greedy(make(), costs, costs, number=number, budget=budget)
    if budget is not None and np.ptp(costs) > 0:
        other = greedy(make(), costs, np.ones(len(costs)), number=number, budget=budget)
        found = other if other.worth > found.worth else found
    return found


def greedy(
    criterion: Criterion, costs: FloatArray, divisors: FloatArray, *, number: int | None, budget: float | None
) -> Choice:
    """Choose candidates by gain over divisor (c,), until there are enough, or none that the budget pays for."""
    spare = np.inf if budget is None else budget * (1 + ROUNDING)
    order: list[int] = []
    gains: list[float] = []
    free, looks = np.ones(len(costs), dtype=bool), len(costs)
    bounds = criterion.gains(np.arange(looks))
    while len(order) < (len(costs) if number is None else number):
        open_ = np.flatnonzero(free & (costs <= spare))
        if len(open_) == 0:
            break
        if order:
            looks += _look_again(criterion, bounds, divisors, open_)
        best = int(open_[np.argmax(bounds[open_] / divisors[open_])])
        order.append(best)
        gains.append(float(bounds[best]))
        free[best] = False
        spare -= costs[best]
        criterion.take(best)
    return Choice(tuple(order), tuple(gains), looks)


def _look_again(criterion: Criterion, bounds: FloatArray, divisors: FloatArray, open_: NDArray[np.int64]) -> int:
    """Bring bounds up to date until the largest is one that is; return how many were."""
    if not criterion.submodular:
        bounds[open_] = criterion.gains(open_)
        return len(open_)
    ranked = open_[np.argsort(-bounds[open_] / divisors[open_], kind="stable")]
    best, looks = -np.inf, 0
    while looks < len(ranked) and bounds[ranked[looks]] / divisors[ranked[looks]] >= best:
        some = ranked[looks : looks + TOGETHER]
        bounds[some] = criterion.gains(some)
        best = max(best, float((bounds[some] / divisors[some]).max()))
        looks += len(some)
    return looks
