"""A third way to spend what a multifidelity study has: full solves where two cheap models differ.

The pilot tells which two cheap models follow the model of the study best, and, with the points taken since, how much
of its variance the choice leaves (`uq.estimators.subsampled_difference`). From that and predicted costs follow how many
points a pool gets and how many of them are chosen, such that the largest relative error of a mean is least.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray
from uq.estimators.doubts import of_tails
from uq.estimators.fidelities import Found, correlations
from uq.estimators.moments import ratio
from uq.estimators.quantiles import Quantiles, quantiles_of_chosen
from uq.estimators.subsampled_difference import FLOOR, Chosen, Design, Pool, Pooled, choice
from uq.estimators.tails import concentration, with_tails
from uq.inputs.sampling import random_points
from uq.methods.fidelity_team import PILOT, Block, Fidelities, Taken
from uq.methods.fidelity_ways import FEWEST, UNLIMITED, Way

TRIED = 60  # numbers of full solves
UNSEEN = 4.0  # times the variance that a pilot predicts, where it has seen no tail
OF_POOL = 0.5  # largest part of a pool that is chosen


class ByChoice(Way):
    """A pool of all cheap models, and full solves of those points where two of them differ.

    Attributes
    ----------
    found
        What all pools so far tell.
    """

    found: Chosen

    def __init__(self, team: Fidelities, pilot: Found, *, known: bool) -> None:
        super().__init__(team)
        self._known = known
        self._all = team.groups.index(tuple(range(1, len(team.members))))
        g = PILOT if PILOT in team.taken else 0
        first = team.taken[g]
        self._pilot, self._counts = (self._pool(first, np.arange(len(first.points))), first), g == 0
        follows = (correlations(pilot.covariance)[:, 1:] ** 2).mean(axis=0)
        best = np.argsort(-follows, kind="stable")[:2] + 1
        self._pair = (int(best[0]), int(best[1]))
        self._pools: list[tuple[Pool, Taken]] = []  # and all that was answered in them
        self._estimate()

    def _pool(self, taken: Taken, chosen: NDArray[np.intp]) -> Pool:
        """A pool of points of which these are chosen."""
        team = self._team
        deviations = team.deviations(taken)
        t = team.members[0].centre.coordinates.of(taken.points)
        return Pool(deviations[:, 1:], t, chosen, deviations[chosen, 0])

    def _estimate(self) -> None:
        team, pools = self._team, self._pools
        if self._counts or not pools:
            pools = [self._pilot, *pools]
        pooled = Pooled([pool for pool, _ in pools], team.slopes, team.inputs.correlation, self._known)
        found = pooled.estimated(team.offsets[0])
        parts = found.rest[1] * len(found.pooled.rows), found.cheap[1] * len(found.cheap[1])
        moved = [one - one.mean(axis=0) for one in parts]
        values = team.offsets[0] + found.predicted
        self.estimates = with_tails(found.estimates, team.inputs, moved, values, of=1)
        self.found = replace(found, estimates=self.estimates)

    def _design(self) -> Design:
        """Which differences count now."""
        found = self.found
        middle = found.estimates.mean - self._team.offsets[0]
        squares = ((found.predicted - middle) ** 2).std(axis=0)
        scale = np.where(found.estimates.std > 0, found.estimates.std, 1.0)
        return Design(self._pair, middle, scale, np.maximum(squares, scale**2))

    def best(self, cost: float) -> tuple[int, int, float]:
        """Return how many full solves and points of a pool are best for a cost.

        And the largest relative variance of a mean afterwards.
        """
        team, found, pooled = self._team, self.found, self.found.pooled
        design = self._design()
        d = design.differences(pooled.cheap)
        size = np.hypot(FLOOR * np.sqrt((d**2).mean()) or 1.0, d)
        errors = found.rest[0] * pooled.expected[:, None]
        # Variance of a full solve by the choice, and of a point of the pool.
        rest = (errors**2 / (size[pooled.rows] * pooled.expected)[:, None]).sum(axis=0) * size.mean()
        cheap = found.cheap[0].var(axis=0) * len(pooled.cheap) ** 2
        counts = bool(self._counts or self._pools)
        before, points = counts * ratio(rest, (found.rest[0] ** 2).sum(axis=0)), counts * len(pooled.cheap)
        per_point, least = float(team.costs[self._all]), min(FEWEST, cost / 2)
        full = np.geomspace(least, max(OF_POOL * cost / (per_point + OF_POOL), least), TRIED)[:, None]
        more = (cost - full) / per_point
        variances = (ratio(rest, before + full) + cheap / (points + more)) / self.estimates.size**2
        i = int(variances.max(axis=1).argmin())
        number = int(full[i, 0] + 1e-9)
        return number, int((cost - number) / per_point + 1e-9), float(variances[i].max())

    def expected(self, cost: float) -> float:
        """Predict the largest relative variance of a mean once so much more is spent."""
        return self.best(cost)[2]

    @property
    def unseen(self) -> float:
        """Predicted variance, over that of even full solves, up to which these may be better for what no point shows.

        Of bounded parameters points show the differences d: if the models miss as much as they differ, even full solves
        have the variance E[d²], and these E[d]².
        """
        if self._team.inputs.tails.any():
            return UNSEEN
        return concentration(self._design().differences(self.found.pooled.cheap), 0.0)

    def needed(self, target: float) -> float:
        """Predict what has to be spent for a largest relative variance."""
        low, high = 0.0, 1.0
        while self.expected(high) > target and high < UNLIMITED:
            low, high = high, 2 * high
        while high - low > 0.02 * high:
            middle = (low + high) / 2
            low, high = (middle, high) if self.expected(middle) > target else (low, middle)
        return high

    def spend(self, cost: float) -> None:
        """Take a pool for a cost, or a little less, and estimate again."""
        team = self._team
        full, count, _ = self.best(cost)
        if not 0 < full < count:
            return
        design, number = self._design(), len(self._pools)
        taken = team.drawn(self._all, sum(pool.count for pool, _ in self._pools), count)
        pool = self._pool(taken, np.empty(0, dtype=int))
        start = float(random_points((team.seed, len(team.groups) + 1), number, number + 1, 1)[0, 0])
        floor, intensity, rows = choice(design, pool.cheap, full, start)
        taken.values[rows, 0] = team.solved(0, taken.points[rows], taken.reasons)
        values = taken.values[rows, 0] - team.offsets[0]
        pool = replace(pool, chosen=rows, values=values, design=design, floor=floor, intensity=intensity)
        self._pools.append((pool, taken))
        self._estimate()

    def quantiles(self, probabilities: tuple[float, ...]) -> Quantiles:
        """Return quantiles of the outputs."""
        return quantiles_of_chosen(self.found, self._team.offsets[0], probabilities)

    def blocks(self) -> list[Block]:
        """What was taken: of each pool the points that were chosen, and the others."""
        team = self._team
        found = [Block(team.groups[0], self._pilot[1], pilot=not self._counts)]
        for pool, taken in self._pools:
            chosen = np.isin(np.arange(pool.count), pool.chosen)
            for group, rows in ((team.groups[0], chosen), (team.groups[self._all], ~chosen)):
                found.append(Block(group, Taken(taken.points[rows], taken.values[rows], taken.reasons), chosen=True))
        return found

    def doubts(self) -> Iterator[Finding]:
        """Say how full solves were chosen, and find what a few of them decide."""
        team, found = self._team, self.found
        chosen, points = sum(len(pool.chosen) for pool, _ in self._pools), sum(pool.count for pool, _ in self._pools)
        first, second = (team.members[k].label for k in self._pair)
        least, most = (f(found.pooled.expected) / len(found.predicted) for f in (np.min, np.max))
        told = {"chosen": chosen, "points": points, "least": least, "most": most, "first": first, "second": second}
        yield Finding("solves-chosen", "note", told)
        values = team.offsets[0] + found.predicted
        moved = found.rest[1] * len(found.pooled.rows)
        relative = ratio(found.estimates.std_error, found.estimates.std)
        yield from of_tails(team.evaluate.outputs, values, relative, moved - moved.mean(axis=0))

    def _values(self) -> FloatArray:
        return self.found.predicted

    def _relative(self) -> FloatArray:
        return self.found.relative

    @property
    def plain(self) -> tuple[FloatArray, FloatArray]:
        return self.estimates.std**2, self.found.left
