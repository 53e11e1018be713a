"""The diagonal of the inverse of a large sparse matrix, exactly, without a solve for each of its entries.

Vertices are ordered by nested dissection of their places: a layer of vertices that separates the others is eliminated
after both sides, and so on (A. George, SIAM J. Numer. Anal. 10 (1973) 345–363). Each separator S is eliminated with a
dense matrix over itself and its border B, the later vertices that it is coupled with by then:
X = F_SS⁻¹F_SB, and F_BB − F_BS X goes to the next. Backwards, the inverse Z on S ∪ B follows from that on B alone:
Z_SB = −X Z_BB and Z_SS = F_SS⁻¹ + X Z_BB Xᵀ (K. Takahashi, J. Fagan, M. Chen, PICA Proc. (1973) 63–69; S. Li, S. Ahmed,
G. Klimeck, E. Darve, J. Comput. Phys. 227 (2008) 9408–9427). The work is that of a few factorisations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

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
    """The order of elimination of a symmetric matrix, used again for every matrix with the same pattern.

    Parameters
    ----------
    pattern
        The matrix, or one with entries where it has some (N, N).
    places
        Coordinates (N, 3) of its vertices.
    """

    def __init__(self, pattern: csr_matrix, places: FloatArray) -> None:
        self._indptr, self._indices = pattern.indptr, pattern.indices
        self._places = places
        self._fronts: list[_Front] = []
        self._size = len(places)
        self._marks = np.zeros(self._size, dtype=np.int64)
        self._divide(np.arange(self._size))
        del self._marks

    def _neighbours(self, vertices: Indices) -> Indices:
        counts = self._indptr[vertices + 1] - self._indptr[vertices]
        starts = np.repeat(self._indptr[vertices] - np.cumsum(counts) + counts, counts)
        return np.asarray(self._indices[starts + np.arange(counts.sum())], dtype=np.int64)

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
            self._marks[low] = 1
            high = vertices[order[len(order) // 2 :]]
            # Those of the upper half that touch the lower half separate the rest of it.
            touching = np.zeros(len(high), dtype=bool)
            near = np.unique(self._neighbours(low))
            touching[np.isin(high, near, assume_unique=True)] = True
            self._marks[low] = 0
            own = high[touching]
            before = self._divide(low) + self._divide(high[~touching])
        inherited = [self._fronts[k].border for k in before]
        candidates = np.unique(np.concatenate([self._neighbours(own), *inherited]))
        eliminated = np.concatenate([own, *([vertices] if before else [])])
        border = candidates[~np.isin(candidates, eliminated)]
        self._fronts.append(_Front(np.sort(own), border, before))
        return (len(self._fronts) - 1,)

    def diagonal_of_inverse(self, matrix: Any) -> Any:
        """Return the diagonal (N,) of the inverse of a symmetric matrix, real or complex."""
        eliminated: list[tuple[Any, Any]] = []
        waiting: dict[int, Any] = {}
        position = np.zeros(self._size, dtype=np.int64)
        matrix = matrix.tocsr()
        for k, front in enumerate(self._fronts):
            every = np.concatenate([front.own, front.border])
            position[every] = np.arange(len(every))
            s = len(front.own)
            F = np.zeros((len(every), len(every)), dtype=matrix.dtype)
            rows = matrix[front.own]
            owner = np.repeat(np.arange(s), np.diff(rows.indptr))
            known = np.isin(rows.indices, every)
            F[owner[known], position[rows.indices[known]]] = rows.data[known]
            F[s:, :s] = F[:s, s:].T
            for child in front.before:
                at = position[self._fronts[child].border]
                F[np.ix_(at, at)] += waiting.pop(child)
            inverse = np.linalg.inv(F[:s, :s])
            X = inverse @ F[:s, s:]
            waiting[k] = F[s:, s:] - F[s:, :s] @ X
            eliminated.append((inverse, X))
        diagonal = np.empty(self._size, dtype=matrix.dtype)
        below: dict[int, Any] = {}
        for k in range(len(self._fronts) - 1, -1, -1):
            front, (inverse, X) = self._fronts[k], eliminated.pop()
            Z = below.pop(k, np.zeros((0, 0)))
            of_border = -X @ Z
            own = inverse - of_border @ X.T
            diagonal[front.own] = np.diagonal(own)
            whole = np.block([[own, of_border], [of_border.T, Z]])
            position[np.concatenate([front.own, front.border])] = np.arange(len(whole))
            for child in front.before:
                at = position[self._fronts[child].border]
                below[child] = whole[np.ix_(at, at)]
        return diagonal
