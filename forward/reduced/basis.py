"""Few directions that hold many states: proper orthogonal decomposition in the inner product of a stiffness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from forward.model import FloatArray

LEAST = 1e-7  # norm of what is left of rows, relative to the largest, below which it is rounding


def orthonormal(
    rows: FloatArray, inner: Callable[[FloatArray], FloatArray], beside: FloatArray, most: int
) -> FloatArray:
    """Return modes (k, U) of rows (s, U), the most important first, orthonormal to each other and to rows `beside`.

    The modes minimise Σ ‖x − P x‖² over all bases of their number (method of snapshots: L. Sirovich, Q. Appl. Math. 45
    (1987) 561–571).

    Parameters
    ----------
    rows
        Vectors.
    inner
        Product of rows with the matrix of the inner product.
    beside
        Orthonormal rows (b, U) that are there already.
    most
        How many modes are wanted.
    """
    largest = float((rows * inner(rows)).sum(axis=1).max(initial=0.0))
    rest = _apart(rows, beside, inner)
    values, vectors = np.linalg.eigh(rest @ inner(rest).T)
    keep = [i for i in np.argsort(values)[::-1] if values[i] > LEAST**2 * largest][:most]
    modes = (vectors[:, keep] / np.sqrt(values[keep])).T @ rest
    found = list(beside)
    for mode in modes:  # what rounding has left
        for _ in range(2):
            there = np.array(found).reshape(-1, rows.shape[1])
            mode = mode - (there @ inner(mode[None])[0]) @ there  # noqa: PLW2901
        found.append(mode / np.sqrt(mode @ inner(mode[None])[0]))
    return np.array(found[len(beside) :]).reshape(-1, rows.shape[1])


def spectrum(rows: FloatArray, inner: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the squares (s,) of the singular values of rows in an inner product, falling."""
    values = np.linalg.eigvalsh(rows @ inner(rows).T)[::-1]
    return np.asarray(np.maximum(values, 0.0))


def enough(squares: FloatArray, tolerance: float) -> int:
    """Return how many modes leave no more than a tolerance of the rows, root mean square relative to them."""
    left = np.sqrt(np.maximum(1 - np.cumsum(squares) / squares.sum(), 0)) if squares.sum() > 0 else np.zeros(1)
    few = np.flatnonzero(left <= tolerance)
    return int(few[0]) + 1 if len(few) else len(squares)


def _apart(rows: FloatArray, beside: FloatArray, inner: Callable[[FloatArray], FloatArray]) -> FloatArray:
    for _ in range(2 if len(beside) else 0):
        rows = rows - (inner(rows) @ beside.T) @ beside
    return rows
