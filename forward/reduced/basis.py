"""Few directions that hold many states: proper orthogonal decomposition in the inner product of a stiffness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from forward.model import FloatArray

LEAST = 1e-7  # norm of what is left of rows, relative to the largest, below which it is rounding


def orthonormal(
    rows: FloatArray, inner: Callable[[FloatArray], FloatArray], beside: FloatArray, most: int | float
) -> tuple[FloatArray, FloatArray]:
    """Return modes (k, U) of rows (s, U), the most important first, orthonormal to each other and to rows `beside`.

    The modes minimise Σ ‖x − P x‖² over all bases of their number (method of snapshots: L. Sirovich, Q. Appl. Math. 45
    (1987) 561–571). The other array (s,) holds the squares of the singular values, falling.

    Parameters
    ----------
    rows
        Vectors.
    inner
        Product of rows with the matrix of the inner product.
    beside
        Orthonormal rows (b, U) that are there already.
    most
        How many modes are wanted; below 1, what they may leave of the rows: root mean square, relative.
    """
    times = inner(rows)
    largest = float(np.einsum("ij,ij->i", rows, times).max(initial=0.0))
    rest = rows
    if len(beside):
        of_beside = inner(beside)
        for _ in range(2):
            rest = rest - (rest @ of_beside.T) @ beside
        times = inner(rest)
    values, vectors = np.linalg.eigh(rest @ times.T)
    squares = np.maximum(values[::-1], 0.0)
    count = enough(squares, most) if most < 1 else int(most)
    count = min(count, int((squares > LEAST**2 * largest).sum()))
    modes = (vectors[:, ::-1][:, :count] / np.sqrt(squares[:count])).T @ rest
    for _ in range(2):  # what rounding has left
        if len(beside):
            modes = modes - (modes @ of_beside.T) @ beside
        gram = modes @ inner(modes).T
        modes = np.linalg.solve(np.linalg.cholesky((gram + gram.T) / 2), modes)
    return modes, squares


def enough(squares: FloatArray, tolerance: float) -> int:
    """Return how many modes leave no more than a tolerance of the rows, root mean square relative to them."""
    left = np.sqrt(np.maximum(1 - np.cumsum(squares) / squares.sum(), 0)) if squares.sum() > 0 else np.zeros(1)
    few = np.flatnonzero(left <= tolerance)
    return int(few[0]) + 1 if len(few) else len(squares)
