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
    """Normal equations of the points that are in, and their Cholesky factor: only what changes is made or moved.

    Of both the lower triangle is kept, in the corner of an array that has room for more.
    """

    def __init__(self) -> None:
        self._count = 0
        self._grams, self._factors = np.zeros((0, 0)), np.zeros((0, 0))
        self._whole = True  # whether there is a factor: there is none where points do the same

    def enter(self, beside: FloatArray, among: FloatArray) -> None:
        """Add points, by their products with those that are in (k, b) and among each other (b, b)."""
        k, n = self._count, self._count + len(among)
        if n > len(self._grams):
            self._grams, self._factors = (_roomier(one, k, 2 * n) for one in (self._grams, self._factors))
        self._grams[k:n, :k], self._grams[k:n, k:n] = beside.T, among
        if self._whole and k:
            across = solve_triangular(self._factors[:k, :k], beside, lower=True, check_finite=False)
            self._factors[k:n, :k] = across.T
        self._count = n
        self._go_on(k)

    def leave(self, out: NDArray[np.bool_]) -> None:
        """Leave out some of the points (k,)."""
        first = int(np.argmax(out))
        behind = first + np.flatnonzero(~out[first:])
        n = first + len(behind)
        self._grams[first:n, :first] = self._grams[behind, :first]
        self._grams[first:n, first:n] = self._grams[np.ix_(behind, behind)]
        self._factors[first:n, :first] = self._factors[behind, :first]
        self._count = n
        self._go_on(first)

    def _go_on(self, j: int) -> None:
        """Make the rest of the factor from that of the first points, of which there are j, and their part across."""
        n, j = self._count, j if self._whole else 0
        across = self._factors[j:n, :j]
        corner = _raised(self._grams[j:n, j:n], LEAST) - across @ across.T
        try:
            self._factors[j:n, j:n] = cholesky(corner, lower=True, check_finite=False)
            self._whole = True
        except LinAlgError:
            self._whole = False

    def solved(self, right: FloatArray) -> FloatArray:
        """Return the weights (k,) for right sides (k,)."""
        n = self._count
        if self._whole:
            factor = self._factors[:n, :n]
            half = solve_triangular(factor, right, lower=True, check_finite=False)
            return np.asarray(solve_triangular(factor, half, lower=True, trans=1, check_finite=False))
        gram = np.tril(self._grams[:n, :n])
        gram += np.tril(gram, -1).T
        for more in RAISED:
            try:
                return np.asarray(cho_solve(cho_factor(_raised(gram, more)), right))
            except LinAlgError:
                continue
        return np.asarray(np.linalg.lstsq(gram, right, rcond=1e-10)[0])


def _roomier(corner: FloatArray, k: int, size: int) -> FloatArray:
    found = np.zeros((size, size))
    found[:k, :k] = corner[:k, :k]
    return found


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
