"""Orthonormal polynomials of independent random parameters, and their derivatives.

Every parameter is standardised, t = (ω − E ω)/σ, so that a derivative along t is one "per standard deviation". The
orthonormal polynomials of t satisfy √β_{k+1} p_{k+1} = (t − α_k) p_k − √β_k p_{k−1} (W. Gautschi, Orthogonal
Polynomials (2004), section 1.3); p_0 = 1 and p_1 = t. Basis functions are products ψ_a(t) = Π_i p_{a_i}(t_i) over a
set of multi-indices a.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import TypeVar, assert_never

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.distributions import (
    Beta,
    Distribution,
    Gamma,
    LogNormal,
    LogUniform,
    Normal,
    Triangular,
    TruncatedNormal,
    Uniform,
)
from uq.inputs import Inputs

IntArray = NDArray[np.int64]
Real = TypeVar("Real", float, FloatArray)
PANEL = 200  # Gauss points of a panel on which a density is smooth
FAR = 12  # standard deviations beyond which a normal density is nothing


@dataclass(frozen=True)
class Basis:
    """P orthonormal functions of d parameters.

    Attributes
    ----------
    centre, scale
        Expected values and standard deviations (d,) of the parameters.
    alpha, beta
        Recurrence coefficients (d, N + 1) of the standardised parameters, for degrees up to N.
    indices
        Multi-indices (P, d): degree of each function in each parameter.
    """

    centre: FloatArray
    scale: FloatArray
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
        t = ((point - self.centre) / self.scale).tolist()
        for i, degree in enumerate(self.indices.max(axis=0, initial=0).tolist()):
            table, _ = _recur(t[i], self.alpha[i].tolist(), self.beta[i].tolist(), degree, derivatives=False)
            result *= np.array(table)[self.indices[:, i]]
        return result

    def derivatives(self, points: FloatArray) -> FloatArray:
        """Return σ_i ∂ψ/∂ω_i (n, d, P) at points (n, d): the derivatives per standard deviation."""
        tables, slopes = self._tables(points, derivatives=True)
        d = len(tables)
        columns = [self._products([(slopes if j == i else tables)[j] for j in range(d)]) for i in range(d)]
        return np.stack(columns, axis=1)

    def subset(self, which: IntArray) -> Basis:
        """Return the basis of some of the functions, by their numbers."""
        return replace(self, indices=self.indices[which])

    def _tables(self, points: FloatArray, *, derivatives: bool) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return p_k(t_i) and p_k'(t_i), each a list over i of (n, N + 1)."""
        t = (np.asarray(points, dtype=float) - self.centre) / self.scale
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
    return Basis(inputs.mean, inputs.std, alpha, beta, indices)


@cache
def recurrence(marginal: Distribution, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return α and β (degree + 1,) of the standardised parameter, with β_0 = 1; not to be written to.

    Chaospy knows them in closed form for uniform, beta, normal, log-normal and gamma parameters. For the others its
    numbers hold to six digits only; theirs come from the Stieltjes procedure with Gauss–Legendre panels.
    """
    mean, std = marginal.moments
    rule = _rule(marginal)
    if rule is None:
        pair = marginal.recurrence(degree)
        alpha, beta = (pair[0] - mean) / std, pair[1] / std**2
        beta[0] = 1.0
        return alpha, beta
    nodes, weights = rule
    t = (nodes - mean) / std
    alpha, beta = np.zeros(degree + 1), np.ones(degree + 1)
    before, p = np.zeros_like(t), np.ones_like(t)
    for k in range(degree + 1):
        alpha[k] = weights @ (t * p**2)
        p_next = (t - alpha[k]) * p - (np.sqrt(beta[k]) * before if k else 0.0)
        if k < degree:
            beta[k + 1] = weights @ p_next**2
            before, p = p, p_next / np.sqrt(beta[k + 1])
    return alpha, beta


def gauss(inputs: Inputs, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the points (countᵈ, d) and weights of the tensor product of Gauss rules with `count` points each.

    Points and weights are eigenvalues and squared first components of eigenvectors of the Jacobi matrices
    (G. H. Golub, J. H. Welsch, Math. Comp. 23 (1969) 221–230).
    """
    from scipy.linalg import eigh_tridiagonal

    points, weights = [], []
    for marginal, mean, std in zip(inputs.marginals.values(), inputs.mean, inputs.std, strict=True):
        alpha, beta = recurrence(marginal, count - 1)
        t, vectors = eigh_tridiagonal(alpha, np.sqrt(beta[1:]))
        points.append(mean + std * t)
        weights.append(vectors[0] ** 2)
    grid = np.stack(np.meshgrid(*points, indexing="ij"), axis=-1).reshape(-1, len(points))
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


def _rule(marginal: Distribution) -> tuple[FloatArray, FloatArray] | None:
    """Points and weights (of sum 1) that integrate polynomials against a density; nothing where chaospy is exact."""
    match marginal:
        case LogUniform():
            logs, weights = _panels([np.log(marginal.lower), np.log(marginal.upper)])
            return np.exp(logs), weights / weights.sum()
        case Triangular():
            nodes, weights = _panels([marginal.lower, marginal.mode, marginal.upper])
            inside = (marginal.lower, marginal.mode, marginal.upper)
            weights = weights * np.interp(nodes, inside, (0.0, 1.0, 0.0))
        case TruncatedNormal():
            steps = marginal.mean + marginal.std * np.arange(-FAR, FAR + 1)
            within = steps[(steps > marginal.lower) & (steps < marginal.upper)].tolist()
            nodes, weights = _panels([marginal.lower, *within, marginal.upper])
            exponent = -(((nodes - marginal.mean) / marginal.std) ** 2) / 2
            weights = weights * np.exp(exponent - exponent.max())
        case Uniform() | Beta() | Normal() | LogNormal() | Gamma():
            return None
        case _:
            assert_never(marginal)
    return nodes, weights / weights.sum()


def _panels(breaks: list[float]) -> tuple[FloatArray, FloatArray]:
    """Composite Gauss–Legendre rule between breakpoints."""
    x, w = np.polynomial.legendre.leggauss(PANEL)  # type: ignore[no-untyped-call]
    parts = [(a + (b - a) * (x + 1) / 2, w * (b - a) / 2) for a, b in pairwise(breaks) if b > a]
    return np.concatenate([nodes for nodes, _ in parts]), np.concatenate([weights for _, weights in parts])
