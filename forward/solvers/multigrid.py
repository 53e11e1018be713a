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

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray
from forward.solvers.lanczos import Apply, Total, process
from forward.solvers.steps import finish

DEGREE = 2  # of the polynomial: products with K before and after the coarse level
RANGE = 10.0  # upper over lower end of the eigenvalues that it damps: the coarse level sees the others
MARGIN = 1.2  # of the upper end over what a few steps of Lanczos have found
STEPS = 8
SPAN = 3  # iterations whose increments of the energy are compared with those of as many before


@dataclass(frozen=True)
class Levels:
    """A matrix K, and what a cycle for it needs: products with K, D⁻¹ and PA⁻¹Pᵀ, sums, the bound of D⁻¹K."""

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


def largest_eigenvalue(multiply: Apply, precondition: Apply, start: FloatArray, total: Total) -> float:
    """Return nearly the largest eigenvalue of P⁻¹K, with P⁻¹ positive definite, from below."""
    ritz = finish(process(multiply, start, total, STEPS, lambda _: False), precondition)
    return float(ritz.values[-1])


def conjugate_gradients(
    multiply: Apply, precondition: Apply, right: FloatArray, total: Total, tolerance: float, iterations: int
) -> tuple[FloatArray, bool, bool]:
    """Solve Kx = b (n,); stop where √(rᵀM⁻¹r), nearly the error in energy, has fallen by the tolerance.

    Returns x, whether that has converged, and whether no direction of negative energy was met.
    """
    x, r = np.zeros_like(right), np.array(right)
    z = precondition(r)
    p, size = z, float(total(np.array([r @ z]))[0])
    first = size
    if size == 0:
        return x, True, True
    for _ in range(iterations):
        if not size > 0:  # the preconditioner is not positive
            return x, False, False
        q = multiply(p)
        energy = float(total(np.array([p @ q]))[0])
        if not energy > 0:
            return x, False, False
        x, r = x + size / energy * p, r - size / energy * q
        z = precondition(r)
        before, size = size, float(total(np.array([r @ z]))[0])
        if abs(size) <= tolerance**2 * first:
            return x, True, True
        p = z + size / before * p
    return x, False, True


def smoothed(
    multiply: Apply, precondition: Apply, right: FloatArray, total: Total, tolerance: float, iterations: int
) -> tuple[FloatArray, FloatArray, bool]:
    """Solve A x = b (n,) roughly; return x, b − Ax, and whether the energy xᵀb has settled to the tolerance.

    Residuals are orthogonal to all directions searched. Where A is symmetric and positive these are preconditioned
    conjugate gradients, in which xᵀb grows to the energy of the solution, so that its last increments say what is
    missing (M. R. Hestenes, E. Stiefel, J. Res. Natl. Bur. Stand. 49 (1952) 409–436, eq. 6:1).

    Parameters
    ----------
    multiply, precondition
        Products with A, and with P⁻¹.
    right
        This rank's part of b.
    total
        Sum over the ranks.
    tolerance
        Part of the energy that may be missing, as its increments tell.
    iterations
        Largest number.
    """
    x, r = np.zeros_like(right), np.array(right)
    directions, images = (np.empty((iterations, len(right))) for _ in range(2))  # pages are taken as they are needed
    energies = np.zeros((iterations, iterations))  # directions · images
    ahead = np.zeros(iterations)  # directions · b
    reached = [0.0]
    for k in range(iterations):
        direction = precondition(r)
        size = np.sqrt(total(np.array([direction @ direction]))[0])
        if not np.isfinite(size) or size == 0:
            return x, r, bool(size == 0)
        directions[k] = direction / size
        images[k] = multiply(directions[k])
        D, Q = directions[: k + 1], images[: k + 1]
        down, along, energies[k, :k] = np.split(
            total(np.concatenate([D @ images[k], [directions[k] @ right], images[:k] @ directions[k]])),
            [k + 1, k + 2],
        )
        energies[: k + 1, k], ahead[k] = down, along[0]
        try:
            parts = np.linalg.solve(energies[: k + 1, : k + 1], ahead[: k + 1])
        except np.linalg.LinAlgError:
            return x, r, False
        x, r = parts @ D, right - parts @ Q
        reached.append(float(parts @ ahead[: k + 1]))
        if not np.isfinite(reached[-1]):
            return x, r, False
        if k + 1 >= 2 * SPAN and _missing(reached) <= tolerance * abs(reached[-1]):
            return x, r, True
    return x, r, False


def minimised(
    multiply: Apply,
    precondition: Apply,
    right: FloatArray,
    weights: FloatArray,
    total: Total,
    tolerance: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray, bool]:
    """Solve A x = b (n,) roughly, whatever the signs of its eigenvalues; return x, b − Ax, and whether that is small.

    The weighted residual is the smallest in the space of all directions searched: generalised conjugate residuals
    (S. C. Eisenstat, H. C. Elman, M. H. Schultz, SIAM J. Numer. Anal. 20 (1983) 345–357).

    Arguments are those of `smoothed`, with weights (n,) of residuals, and a tolerance of these relative to b.
    """
    r = weights * right
    directions, images = (np.empty((iterations, len(right))) for _ in range(2))
    triangle, parts = np.zeros((iterations, iterations)), np.zeros(iterations)  # of QR of the images, Qᵀb
    size = np.sqrt(total(np.array([r @ r]))[0])
    found, k = bool(size == 0), 0
    while k < iterations and not found:
        directions[k] = precondition(r / weights)
        image = weights * multiply(directions[k])
        triangle[:k, k] = total(images[:k] @ image)
        image -= triangle[:k, k] @ images[:k]
        length = np.sqrt(total(np.array([image @ image]))[0])
        if not np.isfinite(length) or length == 0:
            break
        images[k], triangle[k, k] = image / length, length
        parts[k] = total(np.array([images[k] @ r]))[0]
        r -= parts[k] * images[k]
        k += 1
        found = bool(np.sqrt(total(np.array([r @ r]))[0]) <= tolerance * size)
    x = np.linalg.solve(triangle[:k, :k], parts[:k]) @ directions[:k]
    return x, r / weights, found


def _missing(reached: list[float]) -> float:
    """Estimate what an energy still lacks, as if its increments went on to shrink as fast as they have."""
    before, last = reached[-1 - SPAN] - reached[-1 - 2 * SPAN], reached[-1] - reached[-1 - SPAN]
    ratio = abs(last) / abs(before) if before else 0.0
    return abs(last) * ratio / (1 - ratio) if ratio < 1 else np.inf
