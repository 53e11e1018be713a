"""Solving with the factor of another matrix: Anderson mixing for equilibria, block GCR for linear systems.

Both improve the plain correction x ← x − P⁻¹r(x) by what earlier corrections have shown of r. On a linear system the
two span the same spaces. They converge as fast as P resembles the derivative of r; neither needs it symmetric.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from forward.model import FloatArray

Inverse = Callable[[FloatArray], FloatArray]  # applies P⁻¹ to (n,) or to rows (k, n)
Total = Callable[[FloatArray], FloatArray]  # sums an array over the ranks that share the vectors
NEGLIGIBLE = 1e-13  # relative size of a direction, in least squares, that is taken to be rounding


class AndersonMixing:
    """Fixed-point iteration u ← u − P⁻¹f(u) with mixing of the last iterates.

    Of all combinations of the last differences, the one is taken out that leaves the linearised f smallest in the
    Euclidean norm. Source: H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49 (2011) 1715–1735.

    Parameters
    ----------
    inverse
        Applies P⁻¹.
    window
        Number of differences that are kept.
    size
        Length n of this rank's part of the vectors.
    total
        Sum over the ranks.
    weights
        What makes the entries (n,) of f comparable in the Euclidean norm.
    """

    def __init__(
        self, inverse: Inverse, window: int, size: int, total: Total, weights: FloatArray | float = 1.0
    ) -> None:
        self._inverse = inverse
        self._weights = weights
        self._window = window
        self._total = total
        self._changes = np.empty((window, size))
        self._misses = np.empty((window, size))
        self._gram = np.zeros((window, window))
        self._count = 0
        self._last: tuple[FloatArray, FloatArray] | None = None

    def next(self, u: FloatArray, f: FloatArray) -> FloatArray:
        """Return the next iterate (n,) from the last one and its residual f."""
        target = u - self._inverse(f)
        f = self._weights * f
        if self._last is not None:
            slot = self._count % self._window
            self._changes[slot] = f - self._last[0]
            self._misses[slot] = target - self._last[1]
            self._count += 1
        self._last = (f, target)
        kept = min(self._count, self._window)
        if kept == 0:
            return target
        slot = (self._count - 1) % self._window
        changes = self._changes[:kept]
        row, right = self._total(np.array([changes @ changes[slot], changes @ f]))
        self._gram[slot, :kept] = self._gram[:kept, slot] = row
        return target - _least_squares(self._gram[:kept, :kept], right) @ self._misses[:kept]


def _least_squares(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations (k, k) of scaled columns, without the directions that are rounding."""
    size = np.sqrt(np.diag(gram))
    size[size == 0] = 1
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    good = values > NEGLIGIBLE * values[-1]
    vectors = vectors[:, good]
    return np.asarray((vectors / values[good]) @ (vectors.T @ (right / size)) / size)


def block_gcr(
    multiply: Callable[[FloatArray], FloatArray],
    precondition: Inverse,
    right: FloatArray,
    total: Total,
    size: Callable[[FloatArray], FloatArray],
    tolerance: float,
    iterations: int,
) -> FloatArray | None:
    """Solve A x_i = b_i for all k right-hand sides together by generalised conjugate residuals.

    All residuals are minimised over the sum of their search spaces, so that k systems need fewer iterations than one.
    Stopped where the next correction P⁻¹r, times the factor by which the last iteration has shortened it, is below the
    tolerance; that correction is still added, since it costs no product.
    Source: S. C. Eisenstat, H. C. Elman, M. H. Schultz, SIAM J. Numer. Anal. 20 (1983) 345–357.

    Parameters
    ----------
    multiply, precondition
        (k, n) → (k, n): products with A, and with P⁻¹ for a P that resembles A.
    right
        Right-hand sides (k, n).
    total
        Sum over the ranks.
    size
        (k, n) → (k,): what corrections and solutions are measured with.
    tolerance
        Error of each solution relative to its size.
    iterations
        Largest number of iterations.

    Returns
    -------
    numpy.ndarray or None
        Solutions (k, n); nothing if they are not reached.
    """
    x = np.zeros_like(right)
    r = np.array(right)
    search: list[tuple[FloatArray, FloatArray]] = []  # directions, and A times them, orthonormal
    lengths = np.full(len(right), np.inf)
    for _ in range(iterations):
        z = precondition(r)
        before, lengths = lengths, size(z)
        factor = np.where(before < np.inf, np.minimum(1, lengths / np.maximum(before, np.finfo(float).tiny)), 1)
        if not np.isfinite(lengths).all():
            return None
        unfinished = lengths * factor > tolerance * size(x + z)
        if not unfinished.any():
            return np.asarray(x + z)
        z = z[unfinished]
        q = multiply(z)
        for _ in range(2):  # the second pass removes what rounding has left
            for direction, image in search:
                overlap = total(q @ image.T)
                q = q - overlap @ image
                z = z - overlap @ direction
        z, q = _orthonormal(z, q, total)
        part = total(r @ q.T)
        x += part @ z
        r -= part @ q
        search.append((z, q))
    return None


def _orthonormal(z: FloatArray, q: FloatArray, total: Total) -> tuple[FloatArray, FloatArray]:
    """Combine the rows of z and q alike so that those of q are orthonormal; rows that depend on others drop out."""
    for _ in range(2):
        gram = total(q @ q.T)
        size = np.sqrt(np.diag(gram))
        size[size == 0] = 1
        values, vectors = np.linalg.eigh(gram / np.outer(size, size))
        good = values > NEGLIGIBLE * values[-1]
        change = ((vectors[:, good] / np.sqrt(values[good])) / size[:, None]).T
        z, q = change @ z, change @ q
    return z, q
