"""Moments of a model that is solved where two cheap ones differ: a choice with probabilities, and no bias from it.

All cheap models are asked at many points, a *pool*; the model of the study, model 0, at some of them. Point i is chosen
with a probability π_i that grows with the difference of the two cheap models that follow model 0 best,

    π_i = min(1, κ √(a² + d_i²)),   d² = Σ_j (Δw_j / s_j)² + (Δ(w_j − m_j)² / v_j)²,

over all outputs j, of which m, s and v are about the mean, the standard deviation and that of the squares; a is a part
of the root mean square of d, so that every point may be chosen, and κ follows from the number that is wanted. The
choice is systematic (W. G. Madow, Ann. Math. Stat. 20 (1949) 333–354): exactly so many points, with these chances.

With a prediction c of model 0 by the cheap ones, the mean of model 0 is that of c over all N points, and

    Σ_{i chosen} (ψ_0 − c)_i / λ_i,   λ_i = Σ_r N_r π_r(ω_i),

D. G. Horvitz and D. J. Thompson's estimate (J. Am. Stat. Assoc. 47 (1952) 663–685) of what it misses. λ is how many
chosen points as this one were to be expected in all pools r, with the pilot as one whose points are all chosen: so they
count together (the balance heuristic: E. Veach, L. Guibas, SIGGRAPH 1995, 419–428). c comes from weighted regression on
the chosen points of other folds, and is therefore independent of what it predicts; weights λ⁻² make what remains of the
sum least. Polynomials of the coordinates, whose expectation is known, are taken off c over the pools. Both moments are
sums over independent points, and their scatter is the error; degrees of freedom follow from its kurtosis.

Points at which the cheaper of the cheap models alone is asked would make means more accurate, but not more trustworthy:
their tails reach beyond those of the pool, and nothing tells how far that model can be trusted there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.fidelities import FOLDS, FREE, ROUNDS, uncertainty
from uq.estimators.moments import Estimates, Z, combine, student, term

FLOOR = 0.5  # a over the root mean square of d
PER_FEATURE = 10  # points of the pools for each polynomial that is taken off


@dataclass(frozen=True)
class Design:
    """With which probability points of a pool are chosen.

    Attributes
    ----------
    pair
        The two cheap models (counted from 1) whose difference decides; empty if all points are chosen.
    middle, scale, second
        m, s and v (m,) of the outputs, as deviations.
    """

    pair: tuple[int, ...]
    middle: FloatArray
    scale: FloatArray
    second: FloatArray

    def differences(self, cheap: FloatArray) -> FloatArray:
        """Return d (n,) from deviations (n, K − 1, m) of cheap models."""
        one, other = (cheap[:, k - 1] - self.middle for k in self.pair)
        squares = ((one - other) / self.scale) ** 2 + ((one**2 - other**2) / self.second) ** 2
        return np.asarray(np.sqrt(squares.sum(axis=1)))


@dataclass(frozen=True)
class Pool:
    """Points at which all cheap models have an answer, and model 0 at some.

    Attributes
    ----------
    cheap
        w_k (n, K − 1, m).
    coordinates
        Of the points (n, d): with mean 0 and variance 1.
    chosen
        Places (c,) among the points of those that were chosen.
    values
        w_0 there (c, m); NaN without an answer.
    design, floor, intensity
        The choice, a and κ; by default all points are chosen.
    """

    cheap: FloatArray
    coordinates: FloatArray
    chosen: NDArray[np.intp]
    values: FloatArray
    design: Design | None = None
    floor: float = 1.0
    intensity: float = np.inf

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.cheap)

    def expected(self, cheap: FloatArray) -> FloatArray:
        """How many points (n,) like these were to be chosen in the pool, for each of these."""
        if self.design is None:
            return np.full(len(cheap), float(self.count))
        size = np.hypot(self.floor, self.design.differences(cheap))
        return np.asarray(self.count * np.minimum(1.0, self.intensity * size))


def choice(design: Design, cheap: FloatArray, count: int, start: float) -> tuple[float, float, NDArray[np.intp]]:
    """Return a, κ and the places of so many points chosen from a pool (n, K − 1, m), with a random start in (0, 1)."""
    d = design.differences(cheap)
    floor = FLOOR * float(np.sqrt((d**2).mean())) or 1.0
    probabilities, intensity = shares(np.hypot(floor, d), count)
    steps = np.floor(np.concatenate([[0.0], np.cumsum(probabilities)]) * (count / probabilities.sum()) + start)
    return floor, intensity, np.flatnonzero(np.diff(steps) > 0)


def shares(sizes: FloatArray, count: int) -> tuple[FloatArray, float]:
    """Return probabilities min(1, κ size) (n,) with the sum `count`, and κ."""
    if count >= len(sizes):
        return np.ones(len(sizes)), np.inf
    ordered = np.sort(sizes)[::-1]
    rest = np.cumsum(ordered[::-1])[::-1]
    # Of the largest i, all certain, the next is not: that is the first κ for which it is so.
    found = (count - np.arange(count)) / rest[:count]
    first = int(np.argmax(found * ordered[:count] <= 1)) if (found * ordered[:count] <= 1).any() else count - 1
    intensity = float(found[first])
    return np.minimum(1.0, intensity * sizes), intensity


@dataclass(frozen=True)
class Chosen:
    """Estimates of all outputs from pools.

    Attributes
    ----------
    estimates
        Of mean and standard deviation, by output; errors with Student's factor.
    relative
        Relative variances (2, m) of the squared errors of mean and variance, as estimates of these.
    predicted
        c (N, m) at all points, as deviations.
    rest, cheap
        Summands of mean and variance: (ψ_0 − c)/λ of the chosen (2, c, m), and those of c (2, N, m).
    pooled
        What it is estimated from.
    left
        Variance (m,) of what a plain sample leaves of model 0 beside its tangent.
    """

    estimates: Estimates
    relative: FloatArray
    predicted: FloatArray
    rest: FloatArray
    cheap: FloatArray
    pooled: Pooled
    left: FloatArray


@dataclass(frozen=True)
class Pooled:
    """All pools together, as one list of points.

    Attributes
    ----------
    pools
        The pools.
    slopes
        Slopes (m, d) of the tangent of model 0.
    correlation
        Of the coordinates (d, d).
    known
        Whether the mean of the coordinates may be used.
    """

    pools: Sequence[Pool]
    slopes: FloatArray
    correlation: FloatArray
    known: bool = True

    @cached_property
    def cheap(self) -> FloatArray:
        """Deviations (N, K − 1, m) of the cheap models."""
        return np.concatenate([one.cheap for one in self.pools])

    @cached_property
    def starts(self) -> NDArray[np.intp]:
        """Where each pool begins, and the last ends."""
        return np.cumsum([0, *(one.count for one in self.pools)])

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """Places (c,) of the chosen points among all."""
        return np.concatenate([one.chosen + start for one, start in zip(self.pools, self.starts, strict=False)])

    @cached_property
    def values(self) -> FloatArray:
        """Deviations (c, m) of model 0 at the chosen points."""
        return np.concatenate([one.values for one in self.pools])

    @cached_property
    def expected(self) -> FloatArray:
        """λ (c,) of the chosen points."""
        return np.asarray(np.sum([one.expected(self.cheap[self.rows]) for one in self.pools], axis=0))

    @cached_property
    def answered(self) -> float:
        """Estimated probability of an answer of model 0."""
        missing = ~np.isfinite(self.values).all(axis=1)
        return max(1.0 - float((1 / self.expected[missing]).sum()), 1 / len(self.values))

    @cached_property
    def _parts(self) -> NDArray[np.intp]:
        """The fold of each point (N,)."""
        return np.concatenate([np.arange(one.count) % FOLDS for one in self.pools])

    @cached_property
    def _coordinates(self) -> FloatArray:
        return np.concatenate([one.coordinates for one in self.pools])

    def estimated(self, offset: FloatArray) -> Chosen:
        """Estimate the moments of model 0, whose deviations are from `offset` (m,)."""
        ok, w = np.isfinite(self.values).all(axis=1), 1 / self.expected
        middle = w[ok] @ self.values[ok] / w[ok].sum()
        N, m = len(self.cheap), offset.size
        predicted, second, cheap = np.empty((N, m)), np.empty((N, m)), np.empty((2, N, m))
        left = np.empty(m)
        for j in range(m):
            y = np.where(ok, self.values[:, j] - middle[j], 0.0)
            (predicted[:, j], second[:, j]), bare = self._predicted(j, y, ok)
            cheap[:, :, j] = bare / N
        # A chosen point without an answer counts as the others do in the mean.
        mean, square = np.zeros(m), np.zeros(m)
        y = self.values - middle
        for _ in range(1 if ok.all() else ROUNDS):
            first = np.where(ok[:, None], y, mean) - predicted[self.rows]
            squares = np.where(ok[:, None], y**2, square) - second[self.rows]
            rest = np.array([first, squares]) * w[:, None]
            mean, square = cheap.sum(axis=1) + rest.sum(axis=1)
        sums = cheap.copy()
        sums[:, self.rows] += rest
        parts = [sums[:, a:b] * (b - a) for a, b in pairwise(self.starts)]
        found = combine(offset + middle, [term(a, b) for a, b in parts])
        moved = [b - 2 * mean * a for a, b in parts]
        relative = np.array([uncertainty(one)[1] for one in ([a for a, _ in parts], moved)])
        factors = [
            [student(float(d)) / Z / self.answered for d in np.maximum(2 / np.maximum(one, 1e-9), FREE)]
            for one in relative
        ]
        found = replace(found, mean_error=found.mean_error * factors[0], std_error=found.std_error * factors[1])
        for j in range(m):
            T = self._coordinates @ self.slopes[j]
            c = predicted[:, j] - predicted[:, j].mean()
            slope = T @ c / max(float(T @ T), 1e-300)
            left[j] = (c - slope * T).var() + (rest[0, :, j] ** 2 / w).sum()
        of_rest, of_cheap = (np.array([one[0], one[1] - 2 * mean * one[0]]) for one in (rest, cheap))
        return Chosen(found, relative, predicted + middle, of_rest, of_cheap, self, left)

    def _predicted(self, j: int, y: FloatArray, ok: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Predictions (2, N) of output j and of its square, and both without polynomials."""
        N, T = len(self.cheap), self._coordinates @ self.slopes[j]
        A = np.column_stack([np.ones(N), self.cheap[:, :, j], *([T] if self.slopes[j].any() else [])])
        known = self._polynomials(T, float(self.slopes[j] @ self.correlation @ self.slopes[j]))
        predicted, bare = np.empty((2, N)), np.empty((2, N))
        for f in range(min(FOLDS, max(one.count for one in self.pools))):
            here, fit = self._parts == f, ok & (self._parts[self.rows] != f)
            rows, weights = self.rows[fit], 1 / self.expected[fit]
            c = A @ _regression(A[rows], y[fit], weights)
            B = np.column_stack([np.ones(N), c, c**2])
            both = np.column_stack([c, B @ _regression(B[rows], y[fit] ** 2, weights)])
            others = both[~here]
            slopes = _projection(known[~here], others - others.mean(axis=0))
            predicted[:, here] = both[here].T
            bare[:, here] = (both[here] - known[here] @ slopes).T
        return predicted, bare

    def _polynomials(self, T: FloatArray, variance: float) -> FloatArray:
        """Polynomials (N, q) with expectation zero: as many as the pools tell the slopes of."""
        t = self._coordinates
        if not self.known:
            return np.empty((len(t), 0))
        if 2 * t.shape[1] * PER_FEATURE <= len(self.cheap):
            return np.column_stack([t, t**2 - 1, T**2 - variance])
        if t.shape[1] * PER_FEATURE <= len(self.cheap):
            return np.column_stack([t, T**2 - variance])
        return np.column_stack([T, T**2 - variance])


def _regression(x: FloatArray, y: FloatArray, weights: FloatArray) -> FloatArray:
    """Slopes (q,) of y (n,) on x (n, q), with weighted residuals."""
    x = x * weights[:, None]
    scale = np.sqrt((x**2).sum(axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    return np.asarray(np.linalg.lstsq(x / scale, y * weights, rcond=1e-9)[0] / scale)


def _projection(x: FloatArray, y: FloatArray) -> FloatArray:
    """Slopes (q, k) of y (n, k) on many x (n, q) that are nearly orthogonal, by normal equations."""
    scale = np.sqrt((x**2).sum(axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    x = x / scale
    return np.asarray(np.linalg.lstsq(x.T @ x, x.T @ y, rcond=1e-10)[0] / scale[:, None])
