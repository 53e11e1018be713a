"""Dependent random parameters given by draws: the weighted draws themselves are the distribution.

No density is fitted to them. What methods need is a map of the unit cube to the draws that keeps their measure exactly:
a tree halves the draws, by weight, across that coordinate along which a part of them is widest, and the cube along with
them. Each draw has a box whose volume is its weight; boxes of the upper levels are elementary intervals, into which
nets of Sobol' points fall evenly, and neighbours in the cube are neighbours among the draws. (Maps of a fitted density,
such as Rosenblatt's, are smoother, but the error of the density remains however many points are taken.)

The draws are a sample of what they stand for: `effective` is the number of independent ones that they are worth, and
what an estimate errs for that reason is not seen in the points taken from them (`uq.estimators.input_sample_error`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.inputs.distributions import Distribution
from uq.inputs.univariate import RARE, WIDE

IntArray = NDArray[np.int64]
SAME = 1e-10  # range of draws over their size below which they are one number
SINGULAR = 1e-10  # eigenvalue of a correlation matrix below which draws are linearly dependent


@dataclass(frozen=True, eq=False)
class Draws:
    """Weighted draws of k parameters.

    Attributes
    ----------
    names
        Of the parameters.
    values
        (N, k).
    weights
        (N,), of sum 1.
    effective
        Number of independent draws that they are worth.
    digest
        Of what they were read from.
    """

    names: tuple[str, ...]
    values: FloatArray
    weights: FloatArray
    effective: float
    digest: str = ""

    def objection(self) -> str | None:
        """Say why they are no distribution of these parameters, or None."""
        if self.different <= len(self.names) + 1:
            return f"holds {self.different} different draws of {len(self.names)} parameters, expected more"
        for name, column in zip(self.names, self.values.T, strict=True):
            if np.ptp(column) <= SAME * np.abs(column).max():
                return f"'{name}' is {column[0]:g} in all draws, expected a fixed number in the model in its place"
        if np.linalg.eigvalsh(self._correlation).min() < SINGULAR:
            return f"the draws of {', '.join(self.names)} depend linearly on each other, expected one of them less"
        return None

    @cached_property
    def different(self) -> int:
        """Number of different draws."""
        return len(np.unique(self.values[self.weights > 0], axis=0))

    @cached_property
    def marginals(self) -> dict[str, Distribution]:
        """The distribution of each parameter: it answers what distributions of parameters with draws are asked."""
        columns = zip(self.names, self.values.T, strict=True)
        found = {name: Empirical(np.ascontiguousarray(column), self.weights, self.digest) for name, column in columns}
        return cast("dict[str, Distribution]", found)

    @cached_property
    def largest_degree(self) -> int:
        """Largest degree of polynomials of which there are at most as many as a quarter of the draws, at least 1."""
        k, count, degree = len(self.names), self.different // 4, 1
        while comb(k + degree + 1, k) <= count:
            degree += 1
        return degree

    @property
    def equal(self) -> bool:
        """Whether all draws have the same weight."""
        return bool(np.ptp(self.weights) <= 1e-12 * self.weights.max())

    def standardised(self, values: FloatArray) -> FloatArray:
        """Return x (n, k) of values (n, k): parameters, or their logarithms, of mean 0 and standard deviation 1."""
        columns = [
            ((np.log(column) if one.logarithmic else column) - one.of_coordinate[0]) / one.of_coordinate[1]
            for one, column in zip(self.marginals.values(), values.T, strict=True)
        ]
        return np.column_stack(columns)

    @cached_property
    def _correlation(self) -> FloatArray:
        x = self.standardised(self.values)
        return np.asarray(x.T @ (self.weights[:, None] * x))

    @cached_property
    def mixing(self) -> FloatArray:
        """Symmetric root M (k, k) of the correlation matrix of x = M t, of which t is uncorrelated."""
        values, vectors = np.linalg.eigh(self._correlation)
        return np.asarray((vectors * np.sqrt(values)) @ vectors.T)

    @cached_property
    def coordinates(self) -> FloatArray:
        """The draws as coordinates t (N, k)."""
        return np.asarray(self.standardised(self.values) @ np.linalg.inv(self.mixing))

    @cached_property
    def _tree(self) -> tuple[list[tuple[IntArray, FloatArray, IntArray]], IntArray]:
        return _halved(self.coordinates, self.weights)

    def points(self, uniforms: FloatArray) -> FloatArray:
        """Map points (n, k) of the unit cube to draws (n, k): those in whose boxes they lie."""
        u, rows = np.array(uniforms, dtype=float), np.arange(len(uniforms))
        levels, draw = self._tree
        part = np.zeros(len(u), dtype=np.int64)
        for axes, cuts, children in levels:
            axis, share = axes[part], cuts[part]
            at = u[rows, axis]
            first = (at < share) | (share == 1.0)  # rounding may bring a coordinate to 1
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of the half that is not taken
                u[rows, axis] = np.where(first, at / share, (at - share) / (1 - share))
            part = children[part] + ~first
        return np.asarray(self.values[draw[part]])

    def in_turn(self, seed: int | tuple[int, ...], start: int, stop: int) -> FloatArray:
        """Return the draws number `start` to `stop` of an endless sequence in which all come once, again and again.

        Each time they come in another random order, which depends on the seed. For draws of equal weight only.
        """
        N = len(self.values)
        rounds = range(start // N, -(-stop // N))
        base = np.atleast_1d(seed).tolist()
        orders = [np.random.default_rng([*base, r]).permutation(N) for r in rounds]
        which = np.concatenate([np.empty(0, dtype=np.int64), *orders])
        return np.asarray(self.values[which[start - N * rounds.start : stop - N * rounds.start]])


@dataclass(frozen=True, eq=False)
class Empirical:
    """The distribution of one parameter by its draws (N,) with weights (N,); what others say, see `distributions`."""

    values: FloatArray
    weights: FloatArray
    digest: str

    @cached_property
    def _sorted(self) -> tuple[FloatArray, FloatArray]:
        order = np.argsort(self.values, kind="stable")
        return self.values[order], np.cumsum(self.weights[order])

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Expected value and standard deviation."""
        return self._moments(self.values)

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest draw."""
        return float(self.values.min()), float(self.values.max())

    @property
    def range(self) -> tuple[float, float]:
        """The same."""
        return self.support

    @cached_property
    def logarithmic(self) -> bool:
        """Whether polynomials are of ln ω: if the draws are positive and span more than a decade."""
        return self.support[0] > 0 and self.at(1 - RARE) > WIDE * self.at(RARE)

    @cached_property
    def of_coordinate(self) -> tuple[float, float]:
        """Expected value and standard deviation of the argument of polynomials."""
        return self._moments(np.log(self.values)) if self.logarithmic else self.moments

    def _moments(self, x: FloatArray) -> tuple[float, float]:
        mean = float(self.weights @ x)
        return mean, float(np.sqrt(self.weights @ (x - mean) ** 2))

    def quantile(self, probability: FloatArray) -> FloatArray:
        """Smallest draw up to which there is at least this weight, of any shape."""
        ordered, sums = self._sorted
        return np.asarray(ordered[np.searchsorted(sums, probability).clip(max=len(ordered) - 1)])

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map standard normal values z, of any shape, to draws; the derivatives are zero almost everywhere."""
        from scipy.special import ndtr

        return self.quantile(ndtr(z)), np.zeros(np.shape(z))

    def at(self, probability: float) -> float:
        """Quantile of one probability."""
        return float(self.quantile(np.array([probability]))[0])

    def model_dump(self, **_: Any) -> dict[str, Any]:
        """As a block of a study would be: what it was read from."""
        return {"kind": "draws", "digest": self.digest, "mean": self.moments[0], "std": self.moments[1]}


def _halved(t: FloatArray, weights: FloatArray) -> tuple[list[tuple[IntArray, FloatArray, IntArray]], IntArray]:
    """Halve draws t (N, k), with weights (N,), across the widest coordinate of each part until all are apart.

    Returns, for each level, across which coordinate its parts are halved, where, and the numbers of their first halves;
    and the draw of each part of the last level.
    """
    order = np.flatnonzero(weights > 0)
    # Equal draws are one with their weights together, the first.
    _, first, inverse = np.unique(t[order], axis=0, return_index=True, return_inverse=True)
    weight = np.bincount(inverse.ravel(), weights=weights[order])
    order = order[first]
    starts = np.array([0])
    levels = []
    while len(starts) < len(order):
        sizes = np.diff(np.append(starts, len(order)))
        part = np.repeat(np.arange(len(starts)), sizes)
        total = np.add.reduceat(weight, starts)
        mean = np.add.reduceat(weight[:, None] * t[order], starts) / total[:, None]
        spread = np.add.reduceat(weight[:, None] * (t[order] - mean[part]) ** 2, starts)
        axis = spread.argmax(axis=1)
        sort = np.lexsort((t[order, axis[part]], part))
        order, weight = order[sort], weight[sort]
        below = np.cumsum(weight)
        below = (below - (below[starts] - weight[starts])[part]) / total[part]
        last = starts + sizes - 1
        distance = np.abs(below - 0.5)
        distance[last] = np.where(sizes > 1, np.inf, 0.0)
        least = np.minimum.reduceat(distance, starts)
        candidates = np.flatnonzero(distance <= least[part])
        cut = candidates[np.searchsorted(candidates, starts)]
        alone = sizes == 1
        share = np.where(alone, 1.0, below[cut])
        children = np.where(alone, 1, 2)
        levels.append((axis, share, np.cumsum(children) - children))
        starts = np.sort(np.concatenate([starts, cut[~alone] + 1]))
    return levels, order


def effective(values: FloatArray, chains: FloatArray | None = None) -> float:
    """Return the number of independent draws that draws (N,) of chains (N,) are worth for their mean.

    N/(1 + 2 Σ ρ_t), summed over pairs of autocorrelations as long as these are positive and no larger than before
    (C. J. Geyer, Stat. Sci. 7 (1992) 473–483). Without chains the draws are those of one, in their order.
    """
    parts = [values] if chains is None else [values[chains == one] for one in np.unique(chains)]
    worth = 0.0
    for part in parts:
        n = len(part)
        deviations = part - values.mean()
        power = np.abs(np.fft.rfft(deviations, 2 * n)) ** 2
        products = np.fft.irfft(power)[:n] / n
        if products[0] <= 0:
            worth += 1.0
            continue
        rho = products / products[0]
        if abs(rho[1]) < 2 / np.sqrt(n):  # as of independent draws
            worth += n
            continue
        pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
        ends = np.flatnonzero(pairs <= 0)
        pairs = np.minimum.accumulate(pairs[: ends[0] if ends.size else None])
        worth += n / max(2 * pairs.sum() - 1, 1 / np.log10(max(n, 10)))
    return float(min(worth, len(values)))
