"""Few points with weights ≥ 0 at which integrals are what they are at all points.

Weights that are not negative keep an energy an energy: the reduced stiffness is as positive as that of the points.
Sources: S. S. An, T. Kim, D. L. James, Optimizing cubature for efficient integration of subspace deformations, ACM
Trans. Graph. 27 (2008); C. Farhat et al., Int. J. Numer. Meth. Engng 98 (2014) 625–662.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular

from forward.model import FloatArray

SHARE = 0.05  # of the points that are in, how many enter at once
TIMES = 2  # how often each row is taken in a mixture
LEAST = 1e-13  # by which diagonals of normal equations are raised, relative,
RAISED = (1e-10, 1e-7)  # and where points do the same


class Rule(NamedTuple):
    """Chosen points (k,) by number, their weights (k,), and what of the integrals they miss, relative to them."""

    points: NDArray[np.int64]
    weights: FloatArray
    missed: float


def chosen(values: FloatArray, integrals: FloatArray, tolerance: float, most: int) -> Rule:
    """Choose points so that Σ w values = integrals, by non-negative least squares that ends at a tolerance.

    The active set method (C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, 1974, chapter 23) with the normal
    equations of the points that are in; several points enter at once, a part of those that are in.

    Parameters
    ----------
    values
        Integrands (rows, n) at n points.
    integrals
        Their integrals (rows,).
    tolerance
        Of the residual, relative to the integrals.
    most
        Largest number of points.
    """
    scale = np.linalg.norm(values, axis=0)
    scale[scale == 0] = 1.0
    of_points = np.ascontiguousarray((values / scale).T)
    right = of_points @ integrals
    goal = float(np.linalg.norm(integrals))
    inside, x, equations = np.zeros(0, dtype=np.int64), np.zeros(0), _Normal()
    residual = integrals.copy()
    barred = np.zeros(len(of_points), dtype=bool)  # points that have just proved of no use
    while goal > 0 and np.linalg.norm(residual) > tolerance * goal and len(inside) < most:
        gains = of_points @ residual
        gains[inside] = -np.inf
        gains[barred] = -np.inf
        best = np.argsort(-gains)[: max(1, round(SHARE * len(inside)))]
        best = best[gains[best] > max(1e-13 * goal, 0.5 * gains[best[0]])]
        if not len(best):
            break
        equations.enter(of_points[inside] @ of_points[best].T, of_points[best] @ of_points[best].T)
        inside, x = np.concatenate([inside, best]), np.concatenate([x, np.zeros(len(best))])
        while True:
            s = equations.solved(right[inside])
            if (s > 0).all():
                x = s
                break
            # Go as far towards s as all stay positive, and leave out those that are zero then.
            down = s <= 0
            step = float(np.min(x[down] / np.maximum(x[down] - s[down], 1e-300)))
            x = x + step * (s - x)
            out = down & (x <= 1e-12 * x.max(initial=0.0))
            barred[:] = False
            barred[inside[out]] = True
            inside, x = inside[~out], x[~out]
            equations.leave(out)
        residual = integrals - x @ of_points[inside]
    order = np.argsort(inside)
    missed = float(np.linalg.norm(residual) / goal) if goal > 0 else 0.0
    return Rule(inside[order], (x / scale[inside])[order], missed)


def beside(values: FloatArray, integrals: FloatArray, tolerance: float, kept: FloatArray) -> Rule:
    """Choose points beside those that are kept with weights (n,), zero where they are not; else as `chosen`."""
    there, others = np.flatnonzero(kept), np.flatnonzero(kept == 0)
    left = integrals - values[:, there] @ kept[there]
    share = float(np.linalg.norm(left)) / (float(np.linalg.norm(integrals)) or 1.0)
    rule = chosen(values[:, others], left, tolerance / share if share > 0 else 1.0, len(others))
    points = np.concatenate([there, others[rule.points]])
    order = np.argsort(points)
    return Rule(points[order], np.concatenate([kept[there], rule.weights])[order], rule.missed * share)


class _Normal:
    """Normal equations of the points that are in, and their Cholesky factor: of it only what changes is made again."""

    def __init__(self) -> None:
        self._gram = np.zeros((0, 0))
        self._factor: FloatArray | None = None  # lower; None where points do the same

    def enter(self, beside: FloatArray, among: FloatArray) -> None:
        """Add points, by their products with those that are in (k, b) and among each other (b, b)."""
        self._gram = np.block([[self._gram, beside], [beside.T, among]])
        known = self._factor
        across = None if known is None else solve_triangular(known, beside, lower=True, check_finite=False).T
        self._go_on(known, across)

    def leave(self, out: NDArray[np.bool_]) -> None:
        """Leave out some of the points (k,)."""
        first, stay = int(np.argmax(out)), ~out
        self._gram = self._gram[np.ix_(stay, stay)]
        known = None if self._factor is None else self._factor[stay, :first]
        self._go_on(None if known is None else known[:first], None if known is None else known[first:])

    def _go_on(self, known: FloatArray | None, across: FloatArray | None) -> None:
        """Find the rest of the factor from that (j, j) of the first points, and the part across (k − j, j)."""
        if known is None or across is None:
            known, across = np.zeros((0, 0)), np.zeros((len(self._gram), 0))
        j = len(known)
        try:
            corner = cholesky(_raised(self._gram[j:, j:], LEAST) - across @ across.T, lower=True, check_finite=False)
        except LinAlgError:
            self._factor = None
            return
        self._factor = np.block([[known, np.zeros((j, len(corner)))], [across, corner]])

    def solved(self, right: FloatArray) -> FloatArray:
        """Return the weights (k,) for right sides (k,)."""
        if self._factor is not None:
            return np.asarray(cho_solve((self._factor, True), right, check_finite=False))
        for more in RAISED:
            try:
                return np.asarray(cho_solve(cho_factor(_raised(self._gram, more)), right))
            except LinAlgError:
                continue
        return np.asarray(np.linalg.lstsq(self._gram, right, rcond=1e-10)[0])


def _raised(gram: FloatArray, more: float) -> FloatArray:
    raised = gram.copy()
    raised[np.diag_indices_from(gram)] *= 1 + more
    return raised


class Mixture:
    """Sums of many rows at random, a few hundred in place of all: norms stay the same on average.

    Each row goes to a few of the sums with random signs (sparse embedding: J. Nelson, H. L. Nguyễn, FOCS 2013).

    Parameters
    ----------
    size
        Number of sums.
    points
        Number of columns.
    seed
        Of the signs.
    """

    def __init__(self, size: int, points: int, seed: int) -> None:
        self.values, self.integrals = np.zeros((size, points)), np.zeros(size)
        self._random = np.random.default_rng(seed)

    def add(self, values: FloatArray, integrals: FloatArray) -> None:
        """Add rows (r, n) with their integrals (r,), no more than there are sums."""
        for _ in range(TIMES):
            where = self._random.permutation(len(self.integrals))[: len(values)]
            signs = self._random.choice([-1.0, 1.0], len(values)) / np.sqrt(TIMES)
            self.values[where] += signs[:, None] * values
            self.integrals[where] += signs * integrals
