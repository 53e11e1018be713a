"""Orthonormal polynomials of independent random parameters, and their derivatives.

They are polynomials of standardised coordinates t, of the parameters or of logarithms (`uq.coordinates`), so that a
derivative along t is one "per standard deviation". The orthonormal polynomials of t satisfy √β_{k+1} p_{k+1} =
(t − α_k) p_k − √β_k p_{k−1} (W. Gautschi, Orthogonal Polynomials (2004), section 1.3); p_0 = 1 and p_1 = t. Basis
functions are products ψ_a(t) = Π_i p_{a_i}(t_i) over a set of multi-indices a.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.coordinates import Coordinates
from uq.distributions import Distribution, LogNormal, LogUniform, Normal, Uniform
from uq.inputs import Inputs

IntArray = NDArray[np.int64]
Real = TypeVar("Real", float, FloatArray)


@dataclass(frozen=True)
class Basis:
    """P orthonormal functions of d parameters.

    Attributes
    ----------
    coordinates
        What they are polynomials of.
    alpha, beta
        Recurrence coefficients (d, N + 1) of the standardised coordinates, for degrees up to N.
    indices
        Multi-indices (P, d): degree of each function in each parameter.
    """

    coordinates: Coordinates
    alpha: FloatArray
    beta: FloatArray
    indices: IntArray

    def values(self, points: FloatArray) -> FloatArray:
        """Return ψ (n, P) at points (n, d)."""
        tables, _ = self._tables(points, derivatives=False)
        return self._products(tables)

    def at(self, point: FloatArray) -> FloatArray:
        """Return ψ (P,) at one point (d,), without the overhead of arrays."""
        result = np.ones(len(self.indices))
        t = self.coordinates.of(point).tolist()
        for i, degree in enumerate(self.indices.max(axis=0, initial=0).tolist()):
            table, _ = _recur(t[i], self.alpha[i].tolist(), self.beta[i].tolist(), degree, derivatives=False)
            result *= np.array(table)[self.indices[:, i]]
        return result

    def derivatives(self, points: FloatArray) -> FloatArray:
        """Return ∂ψ/∂t_i (n, d, P) at points (n, d): the derivatives per standard deviation of the coordinates."""
        tables, slopes = self._tables(points, derivatives=True)
        d = len(tables)
        columns = [self._products([(slopes if j == i else tables)[j] for j in range(d)]) for i in range(d)]
        return np.stack(columns, axis=1)

    def subset(self, which: IntArray) -> Basis:
        """Return the basis of some of the functions, by their numbers."""
        return replace(self, indices=self.indices[which])

    def _tables(self, points: FloatArray, *, derivatives: bool) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return p_k(t_i) and p_k'(t_i), each a list over i of (n, N + 1)."""
        t = self.coordinates.of(points)
        values, slopes = [], []
        for i, degree in enumerate(self.indices.max(axis=0, initial=0).tolist()):
            columns = _recur(t[:, i], self.alpha[i].tolist(), self.beta[i].tolist(), degree, derivatives=derivatives)
            values.append(np.column_stack(columns[0]))
            if derivatives:
                slopes.append(np.column_stack(columns[1]))
        return values, slopes

    def _products(self, tables: list[FloatArray]) -> FloatArray:
        result = np.ones((len(tables[0]), len(self.indices)))
        for table, degrees in zip(tables, self.indices.T, strict=True):
            result *= table[:, degrees]
        return result


def _recur(t: Real, alpha: list[float], beta: list[float], degree: int, *, derivatives: bool) -> tuple[list[Real], ...]:
    """Return p_k(t) and (or nothing) p_k'(t) for k up to a degree, for numbers t or arrays of them."""
    p, dp = [0 * t + 1], [0 * t]
    for k in range(degree):
        root, step = math.sqrt(beta[k + 1]), t - alpha[k]
        back = math.sqrt(beta[k]) / root if k else 0.0
        p.append(step * p[k] / root - (back * p[k - 1] if k else 0.0))
        if derivatives:
            dp.append((p[k] + step * dp[k]) / root - (back * dp[k - 1] if k else 0.0))
    return p, dp


def orthonormal(inputs: Inputs, indices: IntArray) -> Basis:
    """Return the orthonormal polynomials of independent parameters with these multi-indices (P, d)."""
    degree = int(indices.max(initial=1))
    pairs = [recurrence(marginal, degree) for marginal in inputs.marginals.values()]
    alpha, beta = (np.array(column) for column in zip(*pairs, strict=True))
    return Basis(inputs.coordinates, alpha, beta, indices)


@cache
def recurrence(marginal: Distribution, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return α and β (degree + 1,) of the standardised coordinate, with β_0 = 1; not to be written to.

    Where they have no closed form they come from the Stieltjes procedure with the rule of the distribution.
    """
    match marginal:
        case LogNormal():
            marginal = Normal(mean=0.0, std=1.0)
        case LogUniform():
            marginal = Uniform(lower=0.0, upper=1.0)
        case _:
            pass
    if marginal.closed and not marginal.logarithmic:
        alpha, beta = marginal.recurrence(degree)
        return alpha, beta
    origin, offsets, weights = marginal.rule
    x = np.log(origin + offsets) if marginal.logarithmic else offsets
    t = x - weights @ x
    t = t / np.sqrt(weights @ t**2)
    alpha, beta = np.zeros(degree + 1), np.ones(degree + 1)
    before, p = np.zeros_like(t), np.ones_like(t)
    for k in range(degree + 1):
        alpha[k] = weights @ (t * p**2)
        p_next = (t - alpha[k]) * p - (np.sqrt(beta[k]) * before if k else 0.0)
        if k < degree:
            beta[k + 1] = weights @ p_next**2
            before, p = p, p_next / np.sqrt(beta[k + 1])
    return alpha, beta


def gauss_rule(marginal: Distribution, count: int) -> tuple[FloatArray, FloatArray]:
    """Return points (count,) of the standardised coordinate and weights of the Gauss rule of a distribution.

    The points are eigenvalues of the Jacobi matrix (G. H. Golub, J. H. Welsch, Math. Comp. 23 (1969) 221–230), the
    weights 1/Σ p_k², which has small ones to all digits, other than the components of its eigenvectors.
    """
    from scipy.linalg import eigvalsh_tridiagonal

    alpha, beta = recurrence(marginal, count - 1)
    t = eigvalsh_tridiagonal(alpha, np.sqrt(beta[1:]))
    values, _ = _recur(t, alpha.tolist(), beta.tolist(), count - 1, derivatives=False)
    weights = 1 / (np.array(values) ** 2).sum(axis=0)
    return t, weights / weights.sum()


def gauss(inputs: Inputs, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the points (countᵈ, d) and weights of the tensor product of Gauss rules with `count` points each."""
    nodes, weights = zip(*(gauss_rule(marginal, count) for marginal in inputs.marginals.values()), strict=True)
    grid = inputs.coordinates.points(np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(nodes)))
    products = np.ones(1)
    for w in weights:
        products = np.outer(products, w).ravel()
    return grid, products


def hyperbolic(dimension: int, order: int, q: float) -> IntArray:
    """Return the multi-indices a (P, d) with (Σ a_i^q)^(1/q) ≤ order, by degree.

    q = 1 is the full basis of that total degree; smaller q drop products of many parameters
    (G. Blatman, B. Sudret, J. Comput. Phys. 230 (2011) 2345–2367).
    """
    budget = order**q * (1 + 1e-12)
    rows: list[tuple[int, ...]] = [()]
    spent = [0.0]
    for _ in range(dimension):
        longer = [
            ((*row, k), s + k**q)
            for row, s in zip(rows, spent, strict=True)
            for k in range(order + 1)
            if s + k**q <= budget
        ]
        rows, spent = [row for row, _ in longer], [s for _, s in longer]
    return np.array(sorted(rows, key=by_degree), dtype=np.int64).reshape(-1, dimension)


def by_degree(index: tuple[int, ...]) -> tuple[int, ...]:
    """Return the key that sorts multi-indices by total degree, and those of one degree by the first parameters."""
    return (sum(index), *(-k for k in index))
