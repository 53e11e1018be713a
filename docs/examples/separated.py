"""Responses as sums of products of functions of one coordinate each: place, load, parameters.

    u(x, s, ω, …) ≈ Σ_k X_k(x) Y_k(s) Z_k(ω) …

Evaluated by multiplying numbers: its cost depends on the number of products and of the places where it is wanted, on
nothing else. Two ways lead there:

`from_snapshots`: solved at all points of a grid of the further coordinates, and separated by singular values, first
space from the rest, then the rest coordinate by coordinate (a hierarchical singular value decomposition: W. Hackbusch,
S. Kühn, J. Fourier Anal. Appl. 15 (2009) 706–722). Any response, also of large strains; the errors of all cuts add up
to no more than the tolerance.

`alternating`: proper generalised decomposition of a linear problem whose stiffness and load are themselves sums of
products, without a solution beforehand: pair by pair, in each of which one factor at a time is found with the others
held (A. Ammar, B. Mokdad, F. Chinesta, R. Keunings, J. Non-Newton. Fluid Mech. 139 (2006) 153–176).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, SolveError

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

TURNS = 30  # of alternating directions for a pair, at most
SETTLED = 1e-3  # relative change of a pair in a turn at which it is left as it is
Stencil = tuple[NDArray[np.int64], FloatArray]  # places of a grid, and weights there


@dataclass(frozen=True)
class Separated:
    """A sum of N products.

    Attributes
    ----------
    fields
        Functions X of space (K, U).
    of
        Which of them each product has (N,).
    factors
        Values of the factor of every product on the grid of each further coordinate, each (N, S_i).
    """

    fields: FloatArray
    of: NDArray[np.int64]
    factors: tuple[FloatArray, ...]

    @property
    def pairs(self) -> int:
        """Number N of products."""
        return len(self.of)

    def amplitudes(self, *at: Stencil) -> FloatArray:
        """Return the numbers (K,) that multiply the functions of space at a point: a stencil for each coordinate."""
        product = self.factors[0][:, at[0][0]] @ at[0][1]
        for values, (places, weights) in zip(self.factors[1:], at[1:], strict=True):
            product = product * (values[:, places] @ weights)
        # The functions of space may come in another order than the products, and several times.
        return np.asarray(np.bincount(self.of, product, len(self.fields)))

    def at(self, *at: Stencil) -> FloatArray:
        """Return the response (U,) at a point."""
        return np.asarray(self.amplitudes(*at) @ self.fields)

    def whole(self) -> FloatArray:
        """Return the response at all points of the grids (U, S_1, S_2, …)."""
        letters = "abcdefgh"[: len(self.factors)]
        terms = ",".join(f"k{letter}" for letter in letters)
        return np.asarray(np.einsum(f"ku,{terms}->u{letters}", self.fields[self.of], *self.factors, optimize=True))

    def first(self, count: int) -> Separated:
        """Return the first products alone."""
        return replace(self, of=self.of[:count], factors=tuple(values[:count] for values in self.factors))

    def within(self, rows: NDArray[np.int64]) -> Separated:
        """Return the response at some entries of its vector only."""
        return replace(self, fields=np.ascontiguousarray(self.fields[:, rows]))


def linear_stencil(grid: FloatArray, value: float) -> Stencil:
    """Return the stencil of linear interpolation on a rising grid (S,); the ends beyond it."""
    i = int(np.clip(np.searchsorted(grid, value) - 1, 0, len(grid) - 2))
    t = float(np.clip((value - grid[i]) / (grid[i + 1] - grid[i]), 0.0, 1.0))
    return np.array([i, i + 1]), np.array([1 - t, t])


def cubic_stencil(grid: FloatArray, value: float) -> Stencil:
    """Return the stencil of the cubic through the four nearest points of a rising grid (S,), S ≥ 4; ends beyond it."""
    value = float(np.clip(value, grid[0], grid[-1]))
    first = int(np.clip(np.searchsorted(grid, value) - 2, 0, len(grid) - 4))
    at = np.arange(first, first + 4)
    nodes = grid[at]
    others = [np.delete(nodes, k) for k in range(4)]
    return at, np.array([np.prod((value - rest) / (node - rest)) for node, rest in zip(nodes, others, strict=True)])


def from_snapshots(snapshots: FloatArray, tolerance: float, weights: FloatArray | None = None) -> Separated:
    """Separate responses (U, S_1, S_2, …) at all points of the grids.

    Parameters
    ----------
    snapshots
        The responses.
    tolerance
        Largest root mean square error over all points, relative to the responses.
    weights
        Of the entries (U,) in squares: volumes of the nodes, say; by default all count equally.
    """
    shape = snapshots.shape
    root = np.ones(shape[0]) if weights is None else np.sqrt(weights)
    left, sigma, right = np.linalg.svd(root[:, None] * snapshots.reshape(shape[0], -1), full_matrices=False)
    # Squares of the errors of all cuts add up, so each gets its share.
    allowed = float((tolerance * np.linalg.norm(sigma)) ** 2) / max(len(shape) - 1, 1)
    kept = _enough(sigma, allowed)
    fields = left[:, :kept].T / root
    of, factors = _split(sigma[:kept, None] * right[:kept], shape[1:], allowed)
    strength = np.asarray(prod(np.linalg.norm(values, axis=1) for values in factors))
    order = np.argsort(-strength, kind="stable")
    return Separated(fields, of[order], tuple(values[order] for values in factors))


def _split(
    rows: FloatArray, shape: tuple[int, ...], allowed: float
) -> tuple[NDArray[np.int64], tuple[FloatArray, ...]]:
    """Separate each of rows (k, S_1 S_2 …): which row every product belongs to, and its factors."""
    if len(shape) == 1:
        return np.arange(len(rows)), (rows,)
    cut = [np.linalg.svd(row.reshape(shape[0], -1), full_matrices=False) for row in rows]
    # The smallest singular values of all rows together are left out.
    squares = np.concatenate([sigma**2 for _, sigma, _ in cut])
    falling = np.sort(squares)
    limit = falling[np.searchsorted(np.cumsum(falling), allowed, side="right") :][0] if squares.size else 0.0
    of, first, rest = [], [], []
    for k, (left, sigma, right) in enumerate(cut):
        count = int((sigma**2 >= limit).sum())
        of += [k] * count
        first.append(left[:, :count].T)
        rest.append(sigma[:count, None] * right[:count])
    inner, factors = _split(np.concatenate(rest), shape[1:], allowed)
    return np.array(of, dtype=np.int64)[inner], (np.concatenate(first)[inner], *factors)


def _enough(sigma: FloatArray, allowed: float) -> int:
    """Return how many singular values (falling) have to be kept, one at least."""
    left = np.append(np.cumsum((sigma**2)[::-1])[::-1], 0.0)
    return max(1, int(np.argmax(left <= allowed)))


@dataclass(frozen=True)
class Operator:
    """A part K ⊗ D_1 ⊗ D_2 … of a stiffness.

    Attributes
    ----------
    matrix
        K (U, U), symmetric; the sum of all parts is positive definite.
    factors
        Values of D_i on the grid of each further coordinate (S_i,).
    """

    matrix: csc_matrix
    factors: tuple[FloatArray, ...]


def alternating(
    operators: Sequence[Operator], load: Separated, weights: Sequence[FloatArray], tolerance: float, most: int = 500
) -> Separated:
    """Solve Σ_a (K_a ⊗ D_a) u = f pair by pair, until one adds less than a tolerance of the energy norm so far.

    Parameters
    ----------
    operators
        The stiffness.
    load
        The forces (U entries), at the same points of the grids.
    weights
        Of the points of each grid (S_i,) in integrals over it.
    tolerance
        Energy norm of the last pair, relative to that of all.
    most
        Largest number of pairs.

    Raises
    ------
    SolveError
        If the pairs do not stay finite.
    """
    search, total = _Search(operators, load, weights), 0.0
    while len(search.fields) < most:
        x, ys, energy = search.next()
        if not np.isfinite(energy):
            raise SolveError("the pairs of alternating directions do not stay finite")
        if energy <= tolerance**2 * total or energy <= 0:
            break
        total += energy
        search.keep(x, ys)
    count = len(search.fields)
    return Separated(
        np.array(search.fields).reshape(count, load.fields.shape[1]),
        np.arange(count),
        tuple(np.array(one).reshape(count, len(w)) for one, w in zip(search.factors, weights, strict=True)),
    )


class _Search:
    """The pairs so far, and the search for the next one: its factors are found in turn, each with the others held."""

    def __init__(self, operators: Sequence[Operator], load: Separated, weights: Sequence[FloatArray]) -> None:
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import splu

        self._operators, self._load, self._weights = operators, load, weights
        self._forces = load.fields[load.of]
        self.fields: list[FloatArray] = []
        self.factors: list[list[FloatArray]] = [[] for _ in weights]
        self._images: list[list[FloatArray]] = [[] for _ in operators]  # K_a X_k
        self._random, self._factorise = np.random.default_rng(0), splu
        self._factor = splu(operators[0].matrix) if len(operators) == 1 else None
        # The pattern of all parts, whose entries are then added up.
        self._sum = csc_matrix(sum(abs(one.matrix) for one in operators))
        columns = np.repeat(np.arange(self._sum.shape[1]), np.diff(self._sum.indptr))
        self._entries = np.array([np.asarray(one.matrix[self._sum.indices, columns]).ravel() for one in operators])

    def keep(self, x: FloatArray, ys: Sequence[FloatArray]) -> None:
        """Take a pair."""
        self.fields.append(x)
        for one, image in zip(self._operators, self._images, strict=True):
            image.append(one.matrix @ x)
        for known, y in zip(self.factors, ys, strict=True):
            known.append(y)

    def next(self) -> tuple[FloatArray, list[FloatArray], float]:
        """Return a function of space, the other factors (of norm one) and the square of the pair's energy norm."""
        ys = [_normal(self._random.standard_normal(len(w)), w) for w in self._weights]
        x, energy = np.zeros(self._forces.shape[1]), 0.0
        for _ in range(TURNS):
            x, before = self._field(ys), energy
            for i in range(len(ys)):
                y, energy = self._other(i, x, ys)
                size = float(np.sqrt((self._weights[i] * y**2).sum()))
                ys[i], x = (y / size, x * size) if size > 0 else (y, 0 * x)
            if not abs(energy - before) > SETTLED * energy:
                break
        return x, ys, energy

    def _over(self, i: int, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """∫ y f_i of the load (R,), ∫ y D_i Y_i of every operator and pair (A, k), and ∫ y D_i y (A,)."""
        weighted, by = self._weights[i] * y, np.array([one.factors[i] for one in self._operators])
        known = np.array(self.factors[i]).reshape(-1, len(y))
        return self._load.factors[i] @ weighted, (by * weighted) @ known.T, by @ (weighted * y)

    def _products(self, ys: Sequence[FloatArray], without: int | None = None) -> tuple[FloatArray, ...]:
        """Products of these over all coordinates but one."""
        found = [self._over(i, y) for i, y in enumerate(ys) if i != without]
        if not found:
            counts = len(self._forces), (len(self._operators), len(self.fields)), len(self._operators)
            return tuple(np.ones(count) for count in counts)
        return tuple(np.asarray(prod(parts)) for parts in zip(*found, strict=True))

    def _field(self, ys: Sequence[FloatArray]) -> FloatArray:
        """Return the best function of space (U,)."""
        of_load, of_known, own = self._products(ys)
        right = of_load @ self._forces
        for image, amounts in zip(self._images, of_known, strict=True):
            if image:
                right = right - amounts @ np.array(image)
        if self._factor is not None:
            return np.asarray(self._factor.solve(right) / own[0])
        self._sum.data[:] = own @ self._entries
        return np.asarray(self._factorise(self._sum).solve(right))

    def _other(self, i: int, x: FloatArray, ys: Sequence[FloatArray]) -> tuple[FloatArray, float]:
        """Return the best function of another coordinate (S_i,), and the square of the pair's energy norm."""
        of_load, of_known, own = self._products(ys, without=i)
        top = ((self._forces @ x) * of_load) @ self._load.factors[i]
        bottom = np.zeros(len(ys[i]))
        for a, one in enumerate(self._operators):
            if self.fields:
                known = (np.array(self._images[a]) @ x) * of_known[a]
                top = top - (known @ np.array(self.factors[i])) * one.factors[i]
            bottom += float(x @ (one.matrix @ x)) * own[a] * one.factors[i]
        y = top / np.where(bottom > 0, bottom, np.inf)
        return y, float((self._weights[i] * y**2) @ bottom)


def _normal(y: FloatArray, weights: FloatArray) -> FloatArray:
    return np.asarray(y / np.sqrt((weights * y**2).sum()))
