"""Few points with weights ≥ 0 at which integrals are what they are at all points.

Weights that are not negative keep an energy an energy: the reduced stiffness is as positive as that of the points.
Sources: S. S. An, T. Kim, D. L. James, Optimizing cubature for efficient integration of subspace deformations, ACM
Trans. Graph. 27 (2008); C. Farhat et al., Int. J. Numer. Meth. Engng 98 (2014) 625–662.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from forward.model import FloatArray

SHARE = 0.05  # of the points that are in, how many enter at once
TIMES = 2  # how often each row is taken in a mixture


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
    A = values / scale
    right = integrals @ A
    goal = float(np.linalg.norm(integrals))
    inside, gram, x = np.zeros(0, dtype=np.int64), np.zeros((0, 0)), np.zeros(0)
    residual = integrals.copy()
    barred = np.zeros(A.shape[1], dtype=bool)  # points that have just proved of no use
    while goal > 0 and np.linalg.norm(residual) > tolerance * goal and len(inside) < most:
        gains = residual @ A
        gains[inside] = -np.inf
        gains[barred] = -np.inf
        best = np.argsort(-gains)[: max(1, round(SHARE * len(inside)))]
        best = best[gains[best] > max(1e-13 * goal, 0.5 * gains[best[0]])]
        if not len(best):
            break
        beside = A[:, inside].T @ A[:, best]
        gram = np.block([[gram, beside], [beside.T, A[:, best].T @ A[:, best]]])
        inside, x = np.concatenate([inside, best]), np.concatenate([x, np.zeros(len(best))])
        while True:
            s = _solved(gram, right[inside])
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
            inside, x, gram = inside[~out], x[~out], gram[np.ix_(~out, ~out)]
        residual = integrals - A[:, inside] @ x
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


def _solved(gram: FloatArray, right: FloatArray) -> FloatArray:
    for more in (1e-13, 1e-10, 1e-7):
        raised = gram.copy()
        raised[np.diag_indices_from(gram)] *= 1 + more
        try:
            return np.asarray(cho_solve(cho_factor(raised), right))
        except LinAlgError:  # points that do the same
            continue
    return np.asarray(np.linalg.lstsq(gram, right, rcond=1e-10)[0])


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
