"""Conjugate gradients with two levels: what a large stiffness is solved with, and whether it is positive definite.

The coarse space is contained in the space of the unknowns (linear elements in quadratic ones on the same mesh), and its
stiffness is the restriction of K, A = PᵀKP. A cycle is a Chebyshev polynomial of D⁻¹K, with D the blocks of the nodes,
a solve with A, and the same polynomial again: symmetric and, if A and D are positive definite, positive definite for
*every* K, since the polynomial damps all eigenvalues up to a bound and grows below zero. So the eigenvalues of M⁻¹K,
with M⁻¹ the cycle, have the signs of those of K (Sylvester), lie between the lowest one and about one, and Lanczos'
process (`forward.solvers.lanczos`) finds the lowest in few steps. A has no more negative eigenvalues than K (Cauchy).

Source: M. Adams, M. Brezina, J. Hu, R. Tuminaro, J. Comput. Phys. 188 (2003) 593–610 (polynomial smoothers).
Vectors (n,) are a rank's part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.solvers.lanczos import process
from forward.solvers.steps import finish

Apply = Callable[[FloatArray], FloatArray]
Total = Callable[[FloatArray], FloatArray]  # sums an array over the ranks that share the vectors

DEGREE = 2  # of the polynomial: products with K before and after the coarse level
RANGE = 10.0  # upper over lower end of the eigenvalues that it damps: the coarse level sees the others
MARGIN = 1.2  # of the upper end over what a few steps of Lanczos have found
STEPS = 8


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
    ritz = finish(process(multiply, start, total, STEPS, lambda _: False), precondition)
    return float(ritz.values[-1])


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
