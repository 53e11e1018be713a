"""Lanczos' process from a random start: whether a stiffness K is positive definite, without a factor of its own.

With M positive definite, the eigenvalues of M⁻¹K have the signs of those of K (Sylvester). M may be anything that
resembles K: a cycle of two levels, or the factor of another state.

Source: J. Kuczyński, H. Woźniakowski, SIAM J. Matrix Anal. Appl. 13 (1992) 1094–1122. Vectors (n,) are a rank's part.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray, SolveError
from forward.solvers.steps import Steps

Apply = Callable[[FloatArray], FloatArray]
Total = Callable[[FloatArray], FloatArray]  # sums an array over the ranks that share the vectors

SURE = 1e-4  # chance that an unstable state passes, at most
MOST = 150  # steps
FEWEST = 8
ROUNDING = 1e-12
KNOWN = 0.05  # relative error below which a Ritz value is an eigenvalue


class Ritz(NamedTuple):
    """Ritz values in ascending order, and how far each is from an eigenvalue at most."""

    values: FloatArray
    errors: FloatArray


def negative_eigenvalues(multiply: Apply, start: FloatArray, total: Total, size: int) -> Steps[int | None]:
    """Return 0 if K is positive definite, else how many negative eigenvalues were found; None if that is not clear.

    Asks for products with M⁻¹. Stops at the first negative Ritz value, which proves a negative eigenvalue, or once
    the chance that one exists, though all Ritz values are positive, is below `SURE`: after k steps it is at most
    1.648 √n exp(−√ε (2k−1)), with ε the lowest Ritz value over the width of the spectrum. Where j of the
    lowest are eigenvalues already, those directions may count as known: ε is the next one's, after k−j steps without.

    Parameters
    ----------
    multiply
        Products with K.
    start
        Random forces (n,), so that smooth shapes prevail in M⁻¹ times these.
    size
        Number n of unknowns on all ranks.

    Raises
    ------
    SolveError
        If M⁻¹ is not positive definite.
    """
    last = yield from process(multiply, start, total, MOST, lambda found: _judged(found, size) is not None)
    return _judged(last, size)


def _judged(found: Ritz, size: int) -> int | None:
    """How many negative eigenvalues there are, as `negative_eigenvalues`; None while that is not clear."""
    values, k = found.values, len(found.values)
    if values[0] <= 0:
        return int((values <= 0).sum())
    known = int(np.argmin(np.append(found.errors <= KNOWN * values, False)))
    j = np.arange(min(known, k - 1) + 1)
    chances = 1.648 * np.sqrt(size) * np.exp(-np.sqrt(values[j] / values[-1]) * (2 * (k - j) - 1))
    if k >= FEWEST and (chances[found.errors[j] <= values[j] / 2] <= SURE).any():
        return 0
    if found.errors.max() <= ROUNDING * values[-1] < values[0] / KNOWN:  # all there are
        return 0
    return None


def process(
    multiply: Apply, start: FloatArray, total: Total, steps: int, enough: Callable[[Ritz], bool]
) -> Steps[Ritz]:
    """Return the Ritz values of M⁻¹K after so many steps, or once they are `enough`, with full orthogonalisation."""
    n = len(start)
    images, rows = (np.empty((steps, n)) for _ in range(2))  # Mv and v; pages are taken as they are needed
    diagonal, beside = np.zeros(steps), np.zeros(steps)
    found = Ritz(np.empty(0), np.empty(0))
    r = start
    z = yield r
    squared = float(total(np.array([r @ z]))[0])
    for k in range(steps):
        if not squared > 0:
            raise SolveError("the preconditioner of the stiffness is not positive definite")
        length = np.sqrt(squared)
        images[k], rows[k] = r / length, z / length
        r = multiply(rows[k])
        for sweep in range(2):
            parts = total(rows[: k + 1] @ r)
            if sweep == 0:
                diagonal[k] = parts[k]
            r = r - parts @ images[: k + 1]
        z = yield r
        squared = float(total(np.array([r @ z]))[0])
        beside[k] = np.sqrt(max(squared, 0.0))
        T = np.diag(diagonal[: k + 1]) + np.diag(beside[:k], 1) + np.diag(beside[:k], -1)
        if not np.isfinite(T).all():
            raise SolveError("the stiffness has entries that are not finite")
        values, vectors = np.linalg.eigh(T)
        found = Ritz(values, beside[k] * np.abs(vectors[-1]))
        if enough(found) or beside[k] <= ROUNDING * np.abs(values).max():
            break
    return found
