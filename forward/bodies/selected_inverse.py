"""The diagonal of the inverse of a large sparse matrix, exactly, without a solve for each of its entries.

Vertices are ordered by nested dissection of their places: a layer of vertices that separates the others is eliminated
after both sides, and so on (A. George, SIAM J. Numer. Anal. 10 (1973) 345–363). Each separator S is eliminated with a
dense matrix over itself and its border B, the later vertices that it is coupled with by then:
X = F_SS⁻¹F_SB, and F_BB − F_BS X goes to the next. Backwards, the inverse Z on S ∪ B follows from that on B alone:
Z_SB = −X Z_BB and Z_SS = F_SS⁻¹ + X Z_BB Xᵀ (K. Takahashi, J. Fagan, M. Chen, PICA Proc. (1973) 63–69; S. Li, S. Ahmed,
G. Klimeck, E. Darve, J. Comput. Phys. 227 (2008) 9408–9427). The work is that of a few factorisations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Indices = NDArray[np.int64]
SMALLEST = 48  # vertices that are not divided further


class _Front(NamedTuple):
    """Vertices that are eliminated together, those coupled with them that come later, and the fronts before."""

    own: Indices
    border: Indices
    before: tuple[int, ...]


class Dissection:
    """The order of elimination of a symmetric matrix, used again for every matrix with the same pattern (N, N).

    `places` are the coordinates (N, 3) of its vertices.
    """

    def __init__(self, pattern: csr_matrix, places: FloatArray) -> None:
        self._pattern, self._places = pattern, places
        self._fronts: list[_Front] = []
        self._size = len(places)
        self._divide(np.arange(self._size))

    def _neighbours(self, vertices: Indices) -> Indices:
        return np.asarray(self._pattern[vertices].indices, dtype=np.int64)

    def _divide(self, vertices: Indices) -> tuple[int, ...]:
        """Add the fronts of a set of vertices; return the last one, if there are any."""
        if len(vertices) == 0:
            return ()
        before: tuple[int, ...] = ()
        own = vertices
        if len(vertices) > SMALLEST:
            places = self._places[vertices]
            axis = int(np.ptp(places, axis=0).argmax())
            order = np.argsort(places[:, axis], kind="stable")
            low = vertices[order[: len(order) // 2]]
            high = vertices[order[len(order) // 2 :]]
            # Those of the upper half that touch the lower half separate the rest of it.
            touching = np.isin(high, np.unique(self._neighbours(low)), assume_unique=True)
            own = high[touching]
            before = self._divide(low) + self._divide(high[~touching])
        inherited = [self._fronts[k].border for k in before]
        candidates = np.unique(np.concatenate([self._neighbours(own), *inherited]))
        border = candidates[~np.isin(candidates, vertices)]
        self._fronts.append(_Front(np.sort(own), border, before))
        return (len(self._fronts) - 1,)

    def diagonal_of_inverse(self, matrix: csr_matrix, change: csr_matrix, order: int) -> FloatArray:
        """Return the coefficient (N,) of t^order in the diagonal of (A + tM)⁻¹, of symmetric matrices A and M.

        All arithmetic is that of polynomials in t, cut off after this power, so that nothing is lost by differences.
        """
        eliminated: list[tuple[FloatArray, FloatArray]] = []
        waiting: dict[int, FloatArray] = {}
        position = np.zeros(self._size, dtype=np.int64)
        for k, front in enumerate(self._fronts):
            every = np.concatenate([front.own, front.border])
            position[every] = np.arange(len(every))
            s = len(front.own)
            F = np.zeros((order + 1, len(every), len(every)))
            for power, one in enumerate((matrix, change)[: order + 1]):
                rows = one[front.own]
                owner = np.repeat(np.arange(s), np.diff(rows.indptr))
                known = np.isin(rows.indices, every)
                F[power, owner[known], position[rows.indices[known]]] = rows.data[known]
            F[:, s:, :s] = F[:, :s, s:].swapaxes(1, 2)
            for child in front.before:
                at = position[self._fronts[child].border]
                F[:, at[:, None], at] += waiting.pop(child)
            inverse = _inverse(F[:, :s, :s])
            X = _product(inverse, F[:, :s, s:])
            waiting[k] = F[:, s:, s:] - _product(F[:, s:, :s], X)
            eliminated.append((inverse, X))
        diagonal = np.empty(self._size)
        below: dict[int, FloatArray] = {}
        for k in range(len(self._fronts) - 1, -1, -1):
            front, (inverse, X) = self._fronts[k], eliminated.pop()
            s, b = len(front.own), len(front.border)
            whole = np.empty((order + 1, s + b, s + b))
            whole[:, s:, s:] = below.pop(k, 0.0)
            whole[:, :s, s:] = -_product(X, whole[:, s:, s:])
            whole[:, s:, :s] = whole[:, :s, s:].swapaxes(1, 2)
            whole[:, :s, :s] = inverse - _product(whole[:, :s, s:], X.swapaxes(1, 2))
            diagonal[front.own] = np.diagonal(whole[order])[:s]
            position[np.concatenate([front.own, front.border])] = np.arange(s + b)
            for child in front.before:
                at = position[self._fronts[child].border]
                below[child] = whole[:, at[:, None], at]
        return diagonal


def _product(one: FloatArray, other: FloatArray) -> FloatArray:
    """Multiply polynomials of matrices (order + 1, m, n)."""
    return np.array([sum(one[i] @ other[k - i] for i in range(k + 1)) for k in range(len(one))])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert a polynomial of matrices (order + 1, n, n)."""
    found = [np.linalg.inv(matrix[0])]
    for k in range(1, len(matrix)):
        found.append(-found[0] @ sum(matrix[i] @ found[k - i] for i in range(1, k + 1)))
    return np.array(found)
