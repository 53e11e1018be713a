"""Equilibria of a reduced model at many points in lockstep: one product with the modes for all of them.

Corrections u ← u − K̄⁻¹R(u) by the stiffness of one equilibrium, with Anderson mixing: about ten residuals in place of
four assemblies with factorisations. What is read from memory, the values of the modes at the points, is read once for
all samples. Where more of the forces may be left than single precision leaves of them, that is what integrands are
evaluated in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.reduced.kernels import Integrand
from forward.reduced.reduced_equations import ReducedEquations
from forward.solvers.anderson import scaled_eigenpairs

TOGETHER = 64  # samples
WINDOW = 8  # differences that Anderson mixing keeps
ITERATIONS = 40
TOLERANCE = 1e-9  # of the forces, relative to what they would be if they did not cancel
SINGLE = 1e-5  # from which on single precision is enough


def equilibria(
    level: ReducedEquations,
    parameters: FloatArray,
    modes: FloatArray,
    inverse: FloatArray,
    tolerance: float = TOLERANCE,
) -> tuple[FloatArray, list[int]]:
    """Find equilibria at parameters (s, d) from coordinates (s, n) of the modes, with an inverse stiffness (n, n).

    The tolerance is relative to what forces would be if they did not cancel.

    Returns
    -------
    tuple of numpy.ndarray and list of int
        All coordinates (s, N), NaN where they are not found; and the iterations of each.
    """
    s, free = len(parameters), level.free
    c = np.array([level.coordinates(point, some) for point, some in zip(parameters, modes, strict=True)])
    found, iterations = np.full_like(c, np.nan), [0] * s
    moving = [_Moving(work, level, parameters) for work in level.works if not work.dead]
    still = np.array([_still(level, point) for point in parameters])
    mixing = _Mixing(s, level.modes)
    active = np.arange(s)
    for _ in range(ITERATIONS):
        parts = [still[active], *(one.forces(c[active], active) for one in moving)]
        R = np.sum(parts, axis=0)
        size = np.max([np.abs(part[:, free]).max(axis=1, initial=0.0) for part in parts], axis=0)
        size = np.maximum(size, np.abs(R[:, : level.before]).max(axis=1, initial=level.least))
        left = np.abs(R[:, free]).max(axis=1, initial=0.0)
        for i in active:
            iterations[i] += 1
        done = left <= tolerance * size
        found[active[done]] = c[active[done]]
        on = ~done & np.isfinite(R).all(axis=1)
        active, forces = active[on], R[on][:, free]
        if not len(active):
            break
        c[active, free] = mixing.next(active, c[active, free], forces, forces @ inverse.T)
    return found, iterations


class _Mixing:
    """Anderson mixing, as `forward.solvers.anderson.AndersonMixing` does it, of s samples of n coordinates at once."""

    def __init__(self, s: int, n: int) -> None:
        self._changes, self._misses = np.empty((2, s, WINDOW, n))
        self._gram = np.zeros((s, WINDOW, WINDOW))
        self._forces, self._targets = np.empty((2, s, n))
        self._count = -1  # differences so far

    def next(self, which: NDArray[np.int64], u: FloatArray, f: FloatArray, correction: FloatArray) -> FloatArray:
        """Return the next iterates (k, n) of samples `which` (k,), the same or fewer each time."""
        target, self._count = u - correction, self._count + 1
        kept, slot = min(self._count, WINDOW), (self._count - 1) % WINDOW
        if kept:
            self._changes[which, slot] = f - self._forces[which]
            self._misses[which, slot] = target - self._targets[which]
        self._forces[which], self._targets[which] = f, target
        if not kept:
            return target
        changes = self._changes[which, :kept]
        row, right = np.matmul(changes, np.stack([changes[:, slot], f], axis=2)).transpose(2, 0, 1)
        self._gram[which, slot, :kept] = row
        self._gram[which, :kept, slot] = row
        parts = _least_squares(self._gram[which, :kept, :kept], right)
        return np.asarray(target - np.matmul(parts[:, None], self._misses[which, :kept])[:, 0])


def _least_squares(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations (s, k, k) as `AndersonMixing` does, of s samples at once."""
    size, values, vectors, good = scaled_eigenpairs(gram)
    inverse = np.where(good, 1 / np.where(good, values, 1.0), 0.0)
    along = np.matmul(vectors.swapaxes(1, 2), (right / size)[..., None]) * inverse[..., None]
    return np.asarray(np.matmul(vectors, along)[..., 0] / size)


def _still(level: ReducedEquations, parameters: FloatArray) -> FloatArray:
    """Forces (N,) that do not depend on the state."""
    numbers, coefficients = level.numbers(parameters), level.coefficients(parameters)
    R = level.proportional(parameters)
    for work in level.works:
        if work.dead:
            inputs = work.without_state(coefficients)
            inputs[: work.components] = 0
            R = R + work.values(inputs, numbers).ravel() @ work.weighted
    return R


class _Moving:
    """A virtual work that depends on the state, at the parameters (s, d) of several samples."""

    def __init__(self, work: Integrand, level: ReducedEquations, parameters: FloatArray) -> None:
        self._work = work
        self._numbers = [level.numbers(point) for point in parameters]
        self._inputs = np.array([work.without_state(level.coefficients(point)).copy() for point in parameters])
        self._acting = np.empty((len(parameters), work.size, self._inputs.shape[2]), work.real)

    def forces(self, c: FloatArray, which: NDArray[np.int64]) -> FloatArray:
        """Return the forces (k, N) of the samples `which` (k,) at coordinates (k, N)."""
        work, acting = self._work, self._acting[: len(which)]
        for i, of_state, out in zip(which, work.states(c), acting, strict=True):
            self._inputs[i, : work.components] = of_state
            work.values(self._inputs[i], self._numbers[i], out)
        return np.asarray(acting.reshape(len(which), -1) @ work.weighted)
