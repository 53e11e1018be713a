"""A few steps of a Krylov method: what is left of a linear system for a coarser space to solve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from forward.model import FloatArray
from forward.solvers.anderson import Total

Apply = Callable[[FloatArray], FloatArray]
SPAN = 3  # iterations whose increments of the energy are compared with those of as many before


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

    Parameters
    ----------
    multiply, precondition, right, total, iterations
        As of `smoothed`.
    weights
        Of the entries (n,) of residuals.
    tolerance
        Of the residual, relative to b.
    """
    r = weights * right
    directions, images = (np.empty((iterations, len(right))) for _ in range(2))
    triangle, parts = np.zeros((iterations, iterations)), np.zeros(iterations)  # of QR of the images, Qᵀb
    size = np.sqrt(total(np.array([r @ r]))[0])
    if size == 0:
        return np.zeros_like(right), np.array(right), True
    found, k = False, 0
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
