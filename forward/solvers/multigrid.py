"""Conjugate gradients with two levels: what a large stiffness is solved with, and whether it is positive definite.

The coarse space is contained in the space of the unknowns (linear elements in quadratic ones on the same mesh), and its
stiffness is the restriction of K, A = PᵀKP. A cycle is a Chebyshev polynomial of D⁻¹K, with D the blocks of the nodes,
a solve with A, and the same polynomial again: symmetric and, if A and D are positive definite, positive definite for
*every* K, since the polynomial damps all eigenvalues up to a bound and grows below zero. So the eigenvalues of M⁻¹K,
with M⁻¹ the cycle, have the signs of those of K (Sylvester), lie between the lowest one and about one, and a Lanczos
process finds the lowest in few steps. A itself has no more negative eigenvalues than K (Cauchy).

Sources: M. Adams, M. Brezina, J. Hu, R. Tuminaro, J. Comput. Phys. 188 (2003) 593–610 (polynomial smoothers);
J. Kuczyński, H. Woźniakowski, SIAM J. Matrix Anal. Appl. 13 (1992) 1094–1122 (Lanczos from a random start).
Vectors (n,) are a rank's part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray, SolveError

Apply = Callable[[FloatArray], FloatArray]
Total = Callable[[FloatArray], FloatArray]  # sums an array over the ranks that share the vectors

DEGREE = 2  # of the polynomial: products with K before and after the coarse level
RANGE = 10.0  # upper over lower end of the eigenvalues that it damps: the coarse level sees the others
MARGIN = 1.2  # of the upper end over what a few steps of Lanczos have found
STEPS = 8
SURE = 1e-4  # chance that an unstable state passes, at most
MOST = 150  # steps of Lanczos
FEWEST = 8
ROUNDING = 1e-12
KNOWN = 0.05  # relative error below which a Ritz value is an eigenvalue


@dataclass(frozen=True)
class Levels:
    """A matrix K, and what a cycle for it needs.

    Attributes
    ----------
    multiply
        Products with K.
    smooth
        Products with D⁻¹.
    coarse
        Products with PA⁻¹Pᵀ.
    total
        Sum over the ranks.
    largest
        Bound of the eigenvalues of D⁻¹K.
    """

    multiply: Apply
    smooth: Apply
    coarse: Apply
    total: Total
    largest: float

    def cycle(self, right: FloatArray) -> FloatArray:
        """Return what solves roughly for a right-hand side: the product with M⁻¹."""
        x, left = self._smoothed(np.zeros_like(right), right)
        step = self.coarse(left)
        x, _ = self._smoothed(x + step, left - self.multiply(step), rest=False)
        return x

    def _smoothed(self, x: FloatArray, left: FloatArray, *, rest: bool = True) -> tuple[FloatArray, FloatArray]:
        """Damp what is `left` of a right-hand side at x; return both, the latter of use only if asked for."""
        upper, lower = self.largest, self.largest / RANGE
        centre, half = (upper + lower) / 2, (upper - lower) / 2
        ratio = half / centre
        step = self.smooth(left) / centre
        for k in range(DEGREE):
            x = x + step
            if k == DEGREE - 1 and not rest:
                break
            left = left - self.multiply(step)
            if k < DEGREE - 1:
                after = 1 / (2 * centre / half - ratio)
                step = after * ratio * step + (2 * after / half) * self.smooth(left)
                ratio = after
        return x, left


class Solved(NamedTuple):
    """What conjugate gradients have found.

    Attributes
    ----------
    x
        The solution (n,).
    converged
        Whether it is one to the tolerance.
    definite
        Whether no direction of negative energy was met.
    iterations
        Their number.
    """

    x: FloatArray
    converged: bool
    definite: bool
    iterations: int


def largest_eigenvalue(multiply: Apply, precondition: Apply, start: FloatArray, total: Total) -> float:
    """Return nearly the largest eigenvalue of P⁻¹K, with P⁻¹ positive definite, from below."""
    *_, last = _lanczos(multiply, precondition, start, total, STEPS)
    return float(last.values[-1])


def conjugate_gradients(
    multiply: Apply, precondition: Apply, right: FloatArray, total: Total, tolerance: float, iterations: int
) -> Solved:
    """Solve Kx = b (n,); stop where √(rᵀM⁻¹r), nearly the error in energy, has fallen by the tolerance."""
    x, r = np.zeros_like(right), np.array(right)
    z = precondition(r)
    p, size = z, float(total(np.array([r @ z]))[0])
    first = size
    if size == 0:
        return Solved(x, converged=True, definite=True, iterations=0)
    for k in range(iterations):
        if not size > 0:  # the preconditioner is not positive
            return Solved(x, converged=False, definite=False, iterations=k)
        q = multiply(p)
        energy = float(total(np.array([p @ q]))[0])
        if not energy > 0:
            return Solved(x, converged=False, definite=False, iterations=k)
        x, r = x + size / energy * p, r - size / energy * q
        z = precondition(r)
        before, size = size, float(total(np.array([r @ z]))[0])
        if abs(size) <= tolerance**2 * first:
            return Solved(x, converged=True, definite=True, iterations=k + 1)
        p = z + size / before * p
    return Solved(x, converged=False, definite=True, iterations=iterations)


def negative_eigenvalues(
    multiply: Apply, precondition: Apply, start: FloatArray, total: Total, size: int
) -> int | None:
    """Return 0 if K is positive definite, else how many negative eigenvalues were found; None if that is not clear.

    Lanczos from a random `start` stops at the first negative Ritz value, which proves a negative eigenvalue, or once
    the chance that one exists, though all Ritz values are positive, is below `SURE`: after k steps it is at most
    1.648 √n exp(−√ε (2k−1)), with ε the lowest Ritz value over the width of the spectrum. Where the j lowest are
    eigenvalues already, those directions are known, and ε is the next one's, after k−j steps without them.

    Parameters
    ----------
    multiply, precondition
        Products with K and with M⁻¹, which is positive definite.
    start
        Random forces (n,), so that smooth shapes prevail in M⁻¹ times these.
    size
        Number n of unknowns on all ranks.

    Raises
    ------
    SolveError
        If M⁻¹ is not positive definite.
    """
    for k, found in enumerate(_lanczos(multiply, precondition, start, total, MOST), 1):
        values = found.values
        if values[0] <= 0:
            return int((values <= 0).sum())
        known = int(np.argmin(np.append(found.errors <= KNOWN * values, False)))
        at = min(known, k - 1)
        share = values[at] / values[-1]
        chance = 1.648 * np.sqrt(size) * np.exp(-np.sqrt(share) * (2 * (k - at) - 1))
        if k >= FEWEST and chance <= SURE and found.errors[at] <= values[at] / 2:
            return 0
        if found.errors.max() <= ROUNDING * values[-1] < values[0] / KNOWN:  # all there are
            return 0
    return None


class _Ritz(NamedTuple):
    """Ritz values in ascending order, and how far each is from an eigenvalue at most."""

    values: FloatArray
    errors: FloatArray


def _lanczos(multiply: Apply, precondition: Apply, start: FloatArray, total: Total, steps: int) -> Iterator[_Ritz]:
    """Yield the Ritz values of M⁻¹K after each step, with full orthogonalisation."""
    n = len(start)
    images, rows = (np.empty((steps, n)) for _ in range(2))  # Mv and v; pages are taken as they are needed
    diagonal, beside = np.zeros(steps), np.zeros(steps)
    r = start
    z = precondition(r)
    squared = float(total(np.array([r @ z]))[0])
    for k in range(steps):
        if not squared > 0:
            message = "the preconditioner of the stiffness is not positive definite"
            raise SolveError(message)
        length = np.sqrt(squared)
        images[k], rows[k] = r / length, z / length
        r = multiply(rows[k])
        for sweep in range(2):
            parts = total(rows[: k + 1] @ r)
            if sweep == 0:
                diagonal[k] = parts[k]
            r = r - parts @ images[: k + 1]
        z = precondition(r)
        squared = float(total(np.array([r @ z]))[0])
        beside[k] = np.sqrt(max(squared, 0.0))
        T = np.diag(diagonal[: k + 1]) + np.diag(beside[:k], 1) + np.diag(beside[:k], -1)
        values, vectors = np.linalg.eigh(T)
        if not np.isfinite(values).all():
            message = "the stiffness has entries that are not finite"
            raise SolveError(message)
        yield _Ritz(values, beside[k] * np.abs(vectors[-1]))
        if beside[k] <= ROUNDING * np.abs(values).max():
            return
