"""Affine maps of parameters, and products with sparse matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, eye

from forward.model import FloatArray


def times(matrix: csr_matrix, rows: FloatArray) -> FloatArray:
    """Return the product (…, n) of a matrix (n, m) with a vector (m,), or with each of k rows (k, m)."""
    return np.asarray((matrix @ np.asarray(rows).T).T)


def picked(which: Sequence[int] | NDArray[np.int64], count: int) -> csr_matrix:
    """Return the matrix (n, count) that takes n of so many numbers, by their places."""
    return eye(count, format="csr")[np.array(which, dtype=np.int64)]


class Affine(Protocol):
    """An affine map p = A q + b of parameters q (d,) to parameters p (D,)."""

    def values(self, points: FloatArray) -> FloatArray:
        """Return p (n, D) of points q (n, d)."""

    def along(self, directions: FloatArray) -> FloatArray:
        """Return A q (n, D) of directions q (n, d)."""

    def back(self, gradients: FloatArray) -> FloatArray:
        """Return gradients (n, d) by q of gradients (n, D) by p."""


@dataclass(frozen=True, eq=False)
class Sparse:
    """An affine map by a sparse matrix.

    Parameters
    ----------
    A
        (D, d).
    b
        (D,).
    """

    A: csr_matrix
    b: FloatArray

    def values(self, points: FloatArray) -> FloatArray:
        """Return p (n, D) of points q (n, d)."""
        return times(self.A, points) + self.b

    def along(self, directions: FloatArray) -> FloatArray:
        """Return A q (n, D) of directions q (n, d)."""
        return times(self.A, directions)

    def back(self, gradients: FloatArray) -> FloatArray:
        """Return gradients (n, d) by q of gradients (n, D) by p."""
        return times(self.A.T, gradients)


def along(by: Affine, directions: FloatArray) -> FloatArray:
    """Return A q (…, D) of directions q (…, d)."""
    return by.along(np.atleast_2d(directions)).reshape(*np.shape(directions)[:-1], -1)
