"""Solving with the factor of another matrix: Anderson mixing for equilibria, projections for linear systems.

Both improve the plain correction x ← x − P⁻¹r(x) by what earlier corrections have shown of r. On a linear system the
two span the same spaces. They converge the faster, the closer P is to the derivative of r, which need not be symmetric.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

Inverse = Callable[[FloatArray], FloatArray]  # applies P⁻¹ to (n,) or to rows (k, n)
Total = Callable[[FloatArray], FloatArray]  # sums an array over the ranks that share the vectors
NEGLIGIBLE = 1e-13  # relative size of a direction, in least squares, that counts as rounding
MARGIN = 2.0  # times more that a correction may miss than those before it


class AndersonMixing:
    """Fixed-point iteration u ← u − P⁻¹f(u) with mixing of the last iterates.

    Subtracts the combination of the last differences that makes the linearised f smallest in the Euclidean norm.
    Source: H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49 (2011) 1715–1735.

    Parameters
    ----------
    window
        Number of differences that are kept.
    size
        Length n of this rank's part of the vectors.
    total
        Sum over the ranks.
    weights
        Weights that make the entries (n,) of f comparable in the Euclidean norm.
    """

    def __init__(self, window: int, size: int, total: Total, weights: FloatArray | float = 1.0) -> None:
        self._weights = weights
        self._window = window
        self._total = total
        self._changes = np.empty((window, size))
        self._misses = np.empty((window, size))
        self._gram = np.zeros((window, window))
        self._count = 0
        self._last: tuple[FloatArray, FloatArray] | None = None

    def next(self, u: FloatArray, f: FloatArray, correction: FloatArray) -> FloatArray:
        """Return the next iterate (n,) from the last one, its residual f, and P⁻¹f."""
        target = u - correction
        f = self._weights * f
        if self._last is not None:
            slot = self._count % self._window
            np.subtract(f, self._last[0], out=self._changes[slot])
            np.subtract(target, self._last[1], out=self._misses[slot])
            self._count += 1
        self._last = (f, target)
        kept = min(self._count, self._window)
        if kept == 0:
            return target
        slot = (self._count - 1) % self._window
        changes = self._changes[:kept]
        row, right = self._total(np.array([changes[slot], f]) @ changes.T)
        self._gram[slot, :kept] = self._gram[:kept, slot] = row
        return target - _least_squares(self._gram[:kept, :kept], right) @ self._misses[:kept]


def _least_squares(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations (k, k), without directions that are rounding."""
    size, values, vectors, good = scaled_eigenpairs(gram)
    vectors = vectors[:, good]
    return np.asarray((vectors / values[good]) @ (vectors.T @ (right / size)) / size)


def scaled_eigenpairs(gram: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Decompose normal equations (…, k, k) whose columns are scaled to one size.

    Returns
    -------
    tuple of numpy.ndarray
        Sizes (…, k) of the columns; eigenvalues (…, k) and eigenvectors (…, k, k), as columns, of the scaled equations;
        and which (…, k) of these directions are more than rounding.
    """
    size = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
    size[size == 0] = 1
    values, vectors = np.linalg.eigh(gram / (size[..., :, None] * size[..., None, :]))
    return size, values, vectors, values > NEGLIGIBLE * values[..., -1:]


def block_galerkin(
    multiply: Callable[[FloatArray], FloatArray],
    precondition: Inverse,
    right: FloatArray,
    total: Total,
    size: Callable[[FloatArray], FloatArray],
    tolerance: float,
    iterations: int,
    first: FloatArray | None = None,
) -> FloatArray | None:
    """Solve A x_i = b_i for all k right-hand sides together, with residuals orthogonal to all directions searched.

    Where A is symmetric these are block conjugate gradients, whose errors are the smallest in energy; with
    P ≈ A that says more about x than the size of a residual. Full orthogonalisation preserves this under rounding,
    and allows A without symmetry. All systems share their search spaces, so that k need fewer iterations than one.
    Stops when the next correction, times the larger part of themselves that the last two have missed and with a margin,
    is below the tolerance; that correction is still added, since it costs no product.
    Sources: D. P. O'Leary, Linear Algebra Appl. 29 (1980) 293–322; Y. Saad, Math. Comp. 37 (1981) 105–126.

    Parameters
    ----------
    multiply, precondition
        (k, n) → (k, n): products with A, and with P⁻¹ for a P that resembles A.
    right
        Right-hand sides (k, n).
    total
        Sum over the ranks.
    size
        (k, n) → (k,): norm of corrections and solutions.
    tolerance
        Error of each solution relative to its size.
    iterations
        Largest number of iterations.
    first
        Directions (j, n) that are searched before all others.

    Returns
    -------
    numpy.ndarray or None
        Solutions (k, n); None without convergence.
    """
    x, r = np.zeros_like(right), np.array(right)
    most = (0 if first is None else len(first)) + iterations * len(right)
    directions, images = np.empty((most, right.shape[1])), np.empty((most, right.shape[1]))
    energies = np.empty((most, most))  # directions · images
    inverse = np.empty((0, 0))  # of the energies so far
    searched = 0

    def search(p: FloatArray) -> None:
        """Make the residuals orthogonal to the directions p (j, n) too."""
        nonlocal x, r, inverse, searched
        old, new = slice(searched), slice(searched, searched + len(p))
        searched = new.stop
        directions[new], images[new] = p, multiply(p)
        D, Q = directions[:searched], images[:searched]
        both = np.concatenate([images[new], r])
        ahead, back = total(D @ both.T), total(p @ images[old].T)
        energies[:searched, new], energies[new, old] = ahead[:, : len(p)], back
        inverse = _scaled_inverse(energies[:searched, :searched])
        part = (inverse @ ahead[:, len(p) :]).T
        x = x + part @ D
        r = r - part @ Q

    if first is not None:
        search(first)
    reached, lengths, missed = x, np.full(len(right), np.inf), np.ones(len(right))
    for _ in range(iterations):
        p = precondition(r)
        if searched:
            overlap = total(images[:searched] @ p.T)
            p -= (inverse @ overlap).T @ directions[:searched]
        last, reached, before = reached, x + p, lengths
        lengths, moved, whole = size(np.concatenate([p, reached - last, reached])).reshape(3, -1)
        if not np.isfinite(lengths).all():
            return None
        earlier, missed = missed, moved / np.maximum(before, np.finfo(float).tiny)
        unfinished = MARGIN * lengths * np.maximum(missed, earlier) > tolerance * whole
        if not unfinished.any():
            return np.asarray(reached)
        search(p[unfinished])
    return None


def _scaled_inverse(matrix: FloatArray) -> FloatArray:
    """Invert a small matrix (k, k) of scaled rows and columns, without the directions that are rounding."""
    if not np.isfinite(matrix).all():
        return np.full_like(matrix, np.nan)
    size = np.sqrt(np.abs(np.diag(matrix)))
    size[size == 0] = 1
    scale = np.outer(size, size)
    left, values, right = np.linalg.svd(matrix / scale)
    good = values > NEGLIGIBLE * values[0]
    return np.asarray((right[good].T / values[good]) @ left[:, good].T / scale)
