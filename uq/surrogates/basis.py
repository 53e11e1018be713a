"""Orthonormal polynomials of random parameters, and their derivatives.

They are polynomials of standardised coordinates t, of parameters or their logarithms (`uq.inputs.coordinates`), so that
derivatives along t are "per standard deviation". The orthonormal polynomials of t satisfy √β_{k+1} p_{k+1} =
(t − α_k) p_k − √β_k p_{k−1} (W. Gautschi, Orthogonal Polynomials (2004), section 1.3); p_0 = 1 and p_1 = t. Basis
functions are products ψ_a(t) = Π_i p_{a_i}(t_i) for a set of multi-indices a.

Of parameters given by draws, the products of Hermite polynomials of their coordinates are made orthonormal in the
measure of the draws, degree by degree (`Joint`); ψ_a is one of these times the product of the other parameters'.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations, permutations
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.inputs.coordinates import Coordinates
from uq.inputs.distributions import Distribution, LogNormal, LogUniform, Normal, Uniform
from uq.inputs.random_parameters import LARGEST_DEGREE, Inputs

if TYPE_CHECKING:
    from uq.inputs.draws import Draws

IntArray = NDArray[np.int64]
TOLD = 1e-9  # share of the norm of a function above which draws tell it apart from others
Real = TypeVar("Real", float, FloatArray)
TRUNCATIONS = (0.5, 0.75, 1.0)
ROWS_PER_TERM = 2  # rows of the regression for each unknown, at least
FULL = 8  # number of parameters up to which whole bases are tried; above, functions are selected one by one
DICTIONARY = 2000  # functions to select from, at most


@dataclass(frozen=True)
class Joint:
    """Polynomials of k dependent coordinates, orthonormal in the measure of their draws.

    Attributes
    ----------
    members
        Places (k,) of the coordinates among all.
    indices
        Degrees (Q, k), in the order in which products are made orthonormal.
    inverse
        Upper triangular (Q, Q): orthonormal functions are products of polynomials (n, Q) times it.
    """

    members: IntArray
    indices: IntArray
    inverse: FloatArray

    @classmethod
    def of(cls, draws: Draws, members: IntArray, indices: IntArray) -> Joint:
        """Make products with these degrees (Q, k), which begin with zeros, orthonormal; redundant ones become 0."""
        tables = [hermite(t, int(indices.max(initial=1))) for t in draws.coordinates.T]
        columns = np.sqrt(draws.weights)[:, None] * _products(tables, indices)
        r = np.linalg.qr(columns, mode="r")[: len(indices)]
        diagonal = np.zeros(len(indices))
        diagonal[: len(r)] = np.diag(r)
        # What draws do not tell apart from functions of lower degree is no function of its own.
        told = np.abs(diagonal) > TOLD * np.linalg.norm(columns, axis=0)
        inverse = np.zeros((len(indices), len(indices)))
        part = np.linalg.qr(columns[:, told], mode="r")
        inverse[np.ix_(told, told)] = np.linalg.inv(part) * np.sign(np.diag(part))
        return cls(members, indices, inverse)

    def values(self, t: FloatArray) -> FloatArray:
        """Return the functions (n, Q) at coordinates (n, k)."""
        tables = [hermite(column, int(self.indices.max(initial=1))) for column in t.T]
        return np.asarray(_products(tables, self.indices) @ self.inverse)

    def number(self, indices: IntArray) -> IntArray:
        """Return which functions (P,) have the degrees of multi-indices (P, d) of all parameters."""
        numbers = {index.tobytes(): i for i, index in enumerate(self.indices)}
        return np.fromiter((numbers[i.tobytes()] for i in np.ascontiguousarray(indices[:, self.members])), np.int64)


def hermite(t: FloatArray, degree: int) -> FloatArray:
    """Return the normalised Hermite polynomials (n, degree + 1) at t (n,)."""
    beta = [1.0, *map(float, range(1, degree + 1))]
    return np.column_stack(_recur(t, [0.0] * (degree + 1), beta, degree, derivatives=False)[0])


@dataclass(frozen=True)
class Basis:
    """P orthonormal functions of d parameters.

    Attributes
    ----------
    coordinates
        Their arguments.
    alpha, beta
        Recurrence coefficients (d, N + 1) of the standardised coordinates, for degrees up to N.
    indices
        Multi-indices (P, d): degree of each function in each coordinate.
    joint
        Functions of coordinates that depend on each other, if there are such.
    """

    coordinates: Coordinates
    alpha: FloatArray
    beta: FloatArray
    indices: IntArray
    joint: Joint | None = None

    def values(self, points: FloatArray) -> FloatArray:
        """Return ψ (n, P) at points (n, d)."""
        tables, _ = self._tables(points, derivatives=False)
        return _products(tables, self._numbers)

    def at(self, point: FloatArray) -> FloatArray:
        """Return ψ (P,) at one point (d,), without the overhead of arrays."""
        if self.joint is not None:
            return np.asarray(self.values(point[None, :])[0])
        result = np.ones(len(self.indices))
        t = self.coordinates.of(point).tolist()
        for i, degree in enumerate(self.indices.max(axis=0, initial=0).tolist()):
            table, _ = _recur(t[i], self.alpha[i].tolist(), self.beta[i].tolist(), degree, derivatives=False)
            result *= np.array(table)[self.indices[:, i]]
        return result

    def derivatives(self, points: FloatArray) -> FloatArray:
        """Return ∂ψ/∂t_i (n, d, P) at points (n, d): the derivatives per standard deviation of the coordinates."""
        return self.rows(points, gradients=True)[:, 1:]

    def rows(self, points: FloatArray, *, gradients: bool) -> FloatArray:
        """Return the rows of a regression (n, 1 + d, P): values and derivatives, or values (n, 1, P) only."""
        tables, slopes = self._tables(points, derivatives=gradients)
        numbers, last = self._numbers, len(tables) - 1
        result = np.zeros((len(points), 1 + len(slopes), len(self.indices)))
        result[:, 0] = _products(tables, numbers)
        for i, table in enumerate(slopes):
            factor = i if self.joint is None or i < self.joint.members[0] else last
            varying = np.flatnonzero(numbers[:, factor])
            others = [*tables[:factor], table, *tables[factor + 1 :]]
            result[:, 1 + i, varying] = _products(others, numbers[varying])
        return result

    def of_one(self, i: int, t: FloatArray) -> FloatArray:
        """Return the factor p_{a_i}(t) (n, P) of each function in coordinate i, at values (n,) of it."""
        degree = int(self.indices[:, i].max(initial=0))
        table, _ = _recur(t, self.alpha[i].tolist(), self.beta[i].tolist(), degree, derivatives=False)
        return np.column_stack(table)[:, self.indices[:, i]]

    def subset(self, which: IntArray) -> Basis:
        """Return the basis of some of the functions, by index."""
        return replace(self, indices=self.indices[which])

    def _tables(self, points: FloatArray, *, derivatives: bool) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return p_k(t_i) and p_k'(t_i), each a list over i of (n, N + 1); the values of a joint factor last."""
        t = self.coordinates.of(points)
        values: list[FloatArray] = []
        slopes: list[FloatArray] = []
        for i, degree in enumerate(self._degrees):
            columns = _recur(t[:, i], self.alpha[i].tolist(), self.beta[i].tolist(), degree, derivatives=derivatives)
            values.append(np.column_stack(columns[0]))
            if derivatives:
                slopes.append(np.column_stack(columns[1]))
        if self.joint is None:
            return values, slopes
        start, used = int(self.joint.members[0]), self._joined[0]
        own, together = values[:start], values[start:]
        indices = self.joint.indices[: used[-1] + 1]  # each function is made of products up to its own
        inverse = self.joint.inverse[: len(indices), used]
        for i, table in enumerate(slopes[start:]):
            derived = np.zeros((len(t), len(indices)))
            varying = np.flatnonzero(indices[:, i])
            derived[:, varying] = _products([*together[:i], table, *together[i + 1 :]], indices[varying])
            slopes[start + i] = derived @ inverse
        return [*own, _products(together, indices) @ inverse], slopes

    @property
    def _degrees(self) -> list[int]:
        """Largest degree of each coordinate that is needed."""
        found: IntArray = self.indices.max(axis=0, initial=0)
        if self.joint is not None:
            found[self.joint.members] = self.joint.indices.max(axis=0, initial=0)
        return [int(degree) for degree in found]

    @cached_property
    def _numbers(self) -> IntArray:
        """Columns (P, F) of the tables that each function is the product of."""
        if self.joint is None:
            return self.indices
        own = self.indices[:, : int(self.joint.members[0])]
        return np.column_stack([own, self._joined[1]])

    @cached_property
    def _joined(self) -> tuple[IntArray, IntArray]:
        """Which joint functions are needed, the constant one first; and which of these is in each function (P,)."""
        assert self.joint is not None
        used, places = np.unique([0, *self.joint.number(self.indices)], return_inverse=True)
        return used, places.ravel()[1:]


def _products(tables: list[FloatArray], indices: IntArray) -> FloatArray:
    """Return the products (n, P) of the columns of d tables (n, N + 1) given by multi-indices (P, d).

    Columns 0 are one, and most indices of many parameters are zero.
    """
    result = np.ones((len(tables[0]), len(indices)))
    for table, degrees in zip(tables, indices.T, strict=True):
        varying = np.flatnonzero(degrees)
        if varying.size == degrees.size:
            result *= table[:, degrees]
        elif varying.size:
            result[:, varying] *= table[:, degrees[varying]]
    return result


def _recur(t: Real, alpha: list[float], beta: list[float], degree: int, *, derivatives: bool) -> tuple[list[Real], ...]:
    """Return p_k(t) and (or None) p_k'(t) for k up to a degree, for numbers t or arrays of them."""
    p, dp = [0 * t + 1], [0 * t]
    for k in range(degree):
        root, step = math.sqrt(beta[k + 1]), t - alpha[k]
        back = math.sqrt(beta[k]) / root if k else 0.0
        p.append(step * p[k] / root - (back * p[k - 1] if k else 0.0))
        if derivatives:
            dp.append((p[k] + step * dp[k]) / root - (back * dp[k - 1] if k else 0.0))
    return p, dp


def orthonormal(inputs: Inputs, indices: IntArray) -> Basis:
    """Return the orthonormal polynomials with these multi-indices (P, d), of parameters without correlations.

    Those of draws contain all functions of lower degree (hyperbolic sets do, and their unions).
    """
    degree = int(indices.max(initial=1))
    members = list(inputs.joint)
    pairs = [recurrence(one, degree) for one in inputs.own.values()]
    pairs += [recurrence(Normal(mean=0.0, std=1.0), degree)] * len(members)
    alpha, beta = (np.array(column) for column in zip(*pairs, strict=True))
    joint = None
    if inputs.draws is not None:
        joint = Joint.of(inputs.draws, np.array(members), by_degree(np.unique(indices[:, members], axis=0)))
    return Basis(inputs.coordinates, alpha, beta, indices, joint)


@cache
def recurrence(marginal: Distribution, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return α and β (degree + 1,) of the standardised coordinate, with β_0 = 1; read-only.

    Without a closed form they come from the Stieltjes procedure with the rule of the distribution.
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
    weights 1/Σ p_k², which keeps small ones accurate, unlike the components of its eigenvectors.
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
    blocks = [np.zeros((1, dimension), dtype=np.int64)]
    for pattern in _patterns(dimension, order, q):
        places = np.array(list(combinations(range(dimension), len(pattern))))
        for degrees in sorted(set(permutations(pattern))):
            block = np.zeros((len(places), dimension), dtype=np.int64)
            np.put_along_axis(block, places, np.array(degrees)[None, :], axis=1)
            blocks.append(block)
    return by_degree(np.concatenate(blocks))


def hyperbolic_count(dimension: int, order: int, q: float) -> int:
    """Return the number of rows of `hyperbolic`, without computing them."""
    return 1 + sum(
        math.comb(dimension, len(pattern))
        * math.factorial(len(pattern))
        // math.prod(math.factorial(pattern.count(degree)) for degree in set(pattern))
        for pattern in _patterns(dimension, order, q)
    )


def _patterns(dimension: int, order: int, q: float) -> Iterator[tuple[int, ...]]:
    """Yield the nonzero degrees of each kind of index of `hyperbolic`, in descending order."""
    budget = order**q * (1 + 1e-12)
    longer: list[tuple[tuple[int, ...], float]] = [((), 0.0)]
    while longer:
        pattern, spent = longer.pop()
        if pattern:
            yield pattern
        if len(pattern) < dimension:
            largest = pattern[-1] if pattern else order
            longer += [((*pattern, k), spent + k**q) for k in range(1, largest + 1) if spent + k**q <= budget]


def by_degree(indices: IntArray) -> IntArray:
    """Sort multi-indices (P, d) by total degree, and within a degree by the first parameters."""
    return np.asarray(indices[np.lexsort((*(-indices.T[::-1]), indices.sum(axis=1)))])


def rows_of(inputs: Inputs, *, gradients: bool) -> int:
    """Number of rows of one sample."""
    return 1 + len(inputs.names) if gradients else 1


@dataclass(frozen=True)
class Candidate:
    """Some functions of the largest basis, by index, with the order and q of their set.

    If `sparse`, they are a dictionary from which functions are selected.
    """

    order: int
    q: float
    which: IntArray
    sparse: bool = False


@dataclass(frozen=True)
class Candidates:
    """Sets of functions to choose from, of up to the order `limit`; `basis` is their union."""

    basis: Basis
    sets: tuple[Candidate, ...]
    limit: int = LARGEST_DEGREE


def whole(inputs: Inputs, order: int) -> Candidates:
    """Return the full basis of one order as the only choice."""
    indices = hyperbolic(len(inputs.names), order, 1.0)
    return Candidates(orthonormal(inputs, indices), (Candidate(order, 1.0, np.arange(len(indices))),))


def candidates_of(inputs: Inputs, max_order: int, rows: int, dictionary: int = DICTIONARY) -> Candidates:
    """Return the bases that `rows` rows may determine, and for each q a set of up to `dictionary` to select from."""
    d = len(inputs.names)
    max_order = min(max_order, inputs.largest_degree)
    most = max(rows // ROWS_PER_TERM, d + 1)
    found: dict[tuple[bool, bytes], tuple[IntArray, int, float]] = {}
    determined = False
    for q in reversed(TRUNCATIONS):
        counts = {order: hyperbolic_count(d, order, q) for order in range(1, max_order + 1)}
        if d <= FULL:
            for order, count in counts.items():
                if count <= most or order == 1:
                    indices = hyperbolic(d, order, q)
                    found.setdefault((False, indices.tobytes()), (indices, order, q))
        order = max(order for order, count in counts.items() if count <= dictionary or order == 1)
        widest = order
        while not determined and order > 0:
            indices = hyperbolic(d, order, q)
            found.setdefault((True, indices.tobytes()), (indices, order, q))
            # With fewer rows than functions, smaller dictionaries help.
            order = order - 1 if rows < counts[order] and order > 2 else 0
        # With as many rows as functions, nothing is lost by selecting from all.
        determined = determined or (widest == max_order and counts[widest] <= rows)
    union = by_degree(np.unique(np.concatenate([indices for indices, *_ in found.values()]), axis=0))
    number = {index.tobytes(): i for i, index in enumerate(union)}
    sets = [
        Candidate(order, q, np.array([number[index.tobytes()] for index in indices]), sparse)
        for (sparse, _), (indices, order, q) in found.items()
    ]
    return Candidates(orthonormal(inputs, union), tuple(sets), max_order)


def lacking(inputs: Inputs, basis: Basis, powers: IntArray) -> tuple[Basis, FloatArray]:
    """Return the powers (K, d) of single coordinates that a basis lacks, and the norms (K,) of what is new in them."""
    if basis.joint is None or not powers[:, basis.joint.members].any():
        return orthonormal(inputs, powers), np.ones(len(powers))
    draws, start = inputs.draws, inputs.joint.start
    assert draws is not None
    alpha, beta = recurrence(Normal(mean=0.0, std=1.0), int(powers.max()))
    d = powers.shape[1]
    plain = Basis(basis.coordinates, np.tile(alpha, (d, 1)), np.tile(beta, (d, 1)), powers)
    points = np.hstack([np.tile(inputs.mean[:start], (len(draws.values), 1)), draws.values])
    alone = basis.subset(np.flatnonzero((basis.indices[:, :start] == 0).all(axis=1)))
    known, new = alone.values(points), plain.values(points)
    left = new - known @ (known.T @ (draws.weights[:, None] * new))
    return plain, np.sqrt(draws.weights @ left**2)


def gaps(indices: IntArray, i: int) -> IntArray:
    """Return lower powers (K, d) of parameter i that no function of a basis (P, d) has."""
    lower = np.setdiff1d(np.arange(2, indices[:, i].max()), indices[:, i])
    return np.asarray(lower[:, None] * np.eye(indices.shape[1], dtype=np.int64)[i])


def neighbours(indices: IntArray, tails: NDArray[np.bool_], partners: IntArray) -> Iterator[IntArray]:
    """Go through powers (d,) that a basis (P, d) lacks: the next two of a parameter with a tail, alone and in products.

    Products are with one of the partners; with another tail, of what is the highest power alone too. And `gaps`: where
    few samples chose from many powers, others may look the same there.
    """
    known = {tuple(row) for row in indices.tolist()}
    unit = np.eye(indices.shape[1], dtype=np.int64)
    for i in np.flatnonzero(tails):
        following = int(indices[:, i].max()) + 1
        found = [following * unit[i], (following + 1) * unit[i], *gaps(indices, i)]
        for j in partners[partners != i]:
            found.append(following * unit[i] + unit[j])
            if tails[j]:
                found.append(max(following - 1, 1) * unit[i] + unit[j])
        yield from (one for one in found if tuple(one.tolist()) not in known)
