"""Newton's method for a reduced model: where it begins, how it goes on, and whether it ends stable."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from forward.model import FloatArray, SolveError, Work
from forward.reduced.data import ReducedData
from forward.reduced.reduced_equations import ReducedEquations

ITERATIONS = 25
TOLERANCE = 1e-12  # of the forces, relative to what they would be if they did not cancel
ROUNDING = 1e-13  # changes of the coordinates, relative to them, below which nothing changes any more
STEPS = (1, 2, 4, 8, 16, 32)  # into which the way from the nearest snapshot is cut
GROWTH = 2.0  # of the forces in a step of Newton's method, above which it is shortened
TOUCHING = 60  # iterations under tools
SEARCHES = 12  # lengths of a step that are tried there

# Finds coordinates (N,) and the stiffness (N, N) there, from all parameters (d,) and coordinates (N,); None where there
# is no way.
Way = Callable[[ReducedEquations, FloatArray, FloatArray, Work], "tuple[FloatArray, FloatArray] | None"]


def newton(
    level: ReducedEquations, whole: FloatArray, c: FloatArray, work: Work
) -> tuple[FloatArray, FloatArray] | None:
    """Find an equilibrium (`Way`); steps are shortened where forces grow."""
    free, c = level.free, c.copy()
    step, before, still = np.zeros(level.modes), np.inf, False
    for _ in range(ITERATIONS):
        shortened = 0
        while True:
            R, K, scale = level.stiffness(c, whole)
            work.assemblies += 1
            size = float(np.abs(R[free]).max(initial=0.0))
            if np.isfinite(K).all() and size <= GROWTH * before:
                break
            if shortened == 10 or not step.any():
                return None
            step = step / 2
            c[free] -= step
            shortened += 1
        if size <= TOLERANCE * scale or still:
            return c, K
        before = size
        found = step_by(K[free, free], R[free], work)
        if found is None:
            return None
        step = found
        c[free] += step
        still = bool(np.abs(step).max() <= ROUNDING * np.abs(c[free]).max())
    return None


def under_tools(
    level: ReducedEquations, whole: FloatArray, c: FloatArray, work: Work
) -> tuple[FloatArray, FloatArray] | None:
    """Find an equilibrium (`Way`) by its energy: forces grow by orders where points begin to touch, energies fall.

    Steps are as long as the work of the forces on them has fallen to a half, its sign included (H. Matthies, G. Strang,
    Int. J. Numer. Meth. Engng 14 (1979) 1613–1626).
    """
    free, c, still = level.free, c.copy(), False
    for _ in range(TOUCHING):
        R, K, scale = level.stiffness(c, whole)
        work.assemblies += 1
        if not np.isfinite(K).all():
            return None
        if float(np.abs(R[free]).max(initial=0.0)) <= TOLERANCE * scale or still:
            return c, K
        step = step_by(K[free, free], R[free], work)
        if step is None:
            return None
        first = float(R[free] @ step)
        if first > 0:  # uphill, where the stiffness is not definite
            step, first = -step, -first
        step = _length(level, whole, c, step, first, work) * step
        c[free] += step
        still = bool(np.abs(step).max() <= ROUNDING * np.abs(c[free]).max())
    return None


def step_by(K: FloatArray, R: FloatArray, work: Work) -> FloatArray | None:
    """Return the step −K⁻¹R (n,) of Newton's method; None without one."""
    try:
        step = -np.linalg.solve(K, R)
    except np.linalg.LinAlgError:
        return None
    work.factorisations += 1
    work.back_substitutions += 1
    return step


def _length(
    level: ReducedEquations, whole: FloatArray, c: FloatArray, step: FloatArray, first: float, work: Work
) -> float:
    """Return how much of a step (n,) to go, at most all, by the work of the forces on it, `first` < 0 at its begin."""
    low, high, below, length = 0.0, 1.0, first, 1.0
    for _ in range(SEARCHES):
        moved = c.copy()
        moved[level.free] += length * step
        there = float(level.forces(moved, whole)[0][level.free] @ step)
        work.residuals += 1
        if there <= -0.5 * first and (there >= 0.5 * first or length == 1.0):
            break
        if there < 0:
            low, below = length, there
        else:
            high = length
        # Where the work is not finite, halves; else where it would vanish were it linear.
        share = below / (below - there) if np.isfinite(there) and there > 0 else 0.5
        length = low + (high - low) * min(max(share, 0.1), 0.5)
    return length


def in_steps(
    way: Way, level: ReducedEquations, data: ReducedData, whole: FloatArray, work: Work
) -> tuple[FloatArray, FloatArray]:
    """Go from the nearest snapshot to the parameters (d,), in more and more steps.

    Raises
    ------
    SolveError
        If none of them gets there.
    """
    scale = np.where(data.spread > 0, data.spread, 1.0)
    near = int(np.argmin((((data.snapshots - whole) / scale) ** 2).sum(axis=1)))
    for steps in STEPS:
        modes = data.coordinates[near, level.free]
        for k in range(1, steps + 1):
            at = data.snapshots[near] + k / steps * (whole - data.snapshots[near])
            found = way(level, at, level.coordinates(at, modes), work)
            if found is None:
                break
            work.load_steps += 1
            modes = found[0][level.free]
        else:
            assert found is not None
            return found
    outside = outside_of(data, whole)
    hint = f"; {outside}" if outside else ""
    message = f"the reduced model finds no equilibrium, though it went there in {STEPS[-1]} steps{hint}"
    raise SolveError(message, work=work)


def outside_of(data: ReducedData, whole: FloatArray) -> str:
    """Say which parameters (d,) lie outside the snapshots; empty if none does."""
    found = [
        f"{path} = {value:.4g} (trained from {low:.4g} to {high:.4g})"
        for path, value, low, high in zip(data.parameters, whole, data.lower, data.upper, strict=True)
        if value < low - 1e-9 * abs(low) or value > high + 1e-9 * abs(high)
    ]
    return f"outside the trained range: {', '.join(found[:3])}" if found else ""


def predictor(data: ReducedData, level: ReducedEquations) -> Callable[[FloatArray], FloatArray]:
    """Interpolate the snapshots by |r|³ and linear functions (M. D. Buhmann, Radial Basis Functions, 2003).

    Returns
    -------
    callable
        Coordinates (n,) of the modes at all parameters (d,).
    """
    varied = data.spread > 0
    scale = data.spread[varied]
    x = (data.snapshots[:, varied] - data.nominal[varied]) / scale
    y = data.coordinates[:, level.free]
    distances = np.linalg.norm(x[:, None] - x[None], axis=2)
    linear = np.column_stack([np.ones(len(x)), x])
    k = linear.shape[1]
    matrix = np.block([[distances**3, linear], [linear.T, np.zeros((k, k))]])
    weights = np.linalg.lstsq(matrix, np.vstack([y, np.zeros((k, y.shape[1]))]), rcond=1e-10)[0]

    def at(whole: FloatArray) -> FloatArray:
        z = (whole[varied] - data.nominal[varied]) / scale
        basis = np.concatenate([np.sqrt(((x - z) ** 2).sum(axis=1)) ** 3, [1.0], z])
        return np.asarray(basis @ weights)

    return at


def stable(K: FloatArray, pressures: int) -> bool:
    """Whether the symmetric part of a stiffness (n, n) has no negative eigenvalues beyond those of pressures."""
    K = (K + K.T) / 2
    if pressures:
        return int((np.linalg.eigvalsh(K) < 0).sum()) <= pressures
    try:
        np.linalg.cholesky(K)
    except np.linalg.LinAlgError:
        return False
    return True
