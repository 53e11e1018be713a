"""Equilibria of a reduced model at many points in lockstep: one product with the modes for all of them.

Corrections u ← u − K̄⁻¹R(u) by the stiffness of one equilibrium, with Anderson mixing: about ten residuals in place of
four assemblies with factorisations. What is read from memory, the values of the modes at the points, is read once for
all samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.reduced.at_points import Integrand
from forward.reduced.level import Level
from forward.solvers.anderson import AndersonMixing

TOGETHER = 64  # samples
WINDOW = 8  # differences that Anderson mixing keeps
ITERATIONS = 40
TOLERANCE = 1e-9  # of the forces, relative to what they would be if they did not cancel


def equilibria(
    level: Level, parameters: FloatArray, modes: FloatArray, inverse: FloatArray, tolerance: float = TOLERANCE
) -> tuple[FloatArray, list[int]]:
    """Find equilibria at parameters (s, d) from coordinates (s, n) of the modes, with an inverse stiffness (n, n).

    Parameters
    ----------
    level
        The model.
    parameters, modes, inverse
        The samples, where they begin, and what corrects them.
    tolerance
        What may be left of the forces, relative to what they would be if they did not cancel.

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
    mixing = [AndersonMixing(WINDOW, level.modes, lambda values: values) for _ in range(s)]
    active = np.arange(s)
    for _ in range(ITERATIONS):
        parts = [still[active], *(one.forces(c[active], active) for one in moving)]
        R = np.sum(parts, axis=0)
        size = np.max([np.abs(part[:, free]).max(axis=1, initial=0.0) for part in parts], axis=0)
        size = np.maximum(size, np.abs(R[:, : level.before]).max(axis=1, initial=0.0))
        left = np.abs(R[:, free]).max(axis=1, initial=0.0)
        for i in active:
            iterations[i] += 1
        done = left <= tolerance * size
        found[active[done]] = c[active[done]]
        on = ~done & np.isfinite(R).all(axis=1)
        forces = R[on][:, free]
        for i, force, correction in zip(active[on], forces, forces @ inverse.T, strict=True):
            c[i, free] = mixing[i].next(c[i, free], force, correction)
        active = active[on]
        if not len(active):
            break
    return found, iterations


def _still(level: Level, parameters: FloatArray) -> FloatArray:
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

    def __init__(self, work: Integrand, level: Level, parameters: FloatArray) -> None:
        self._work = work
        self._numbers = [level.numbers(point) for point in parameters]
        self._inputs = np.array([work.without_state(level.coefficients(point)).copy() for point in parameters])
        self._acting = np.empty((len(parameters), work.size, self._inputs.shape[2]))

    def forces(self, c: FloatArray, which: NDArray[np.int64]) -> FloatArray:
        """Return the forces (k, N) of the samples `which` (k,) at coordinates (k, N)."""
        work, acting = self._work, self._acting[: len(which)]
        for i, of_state, out in zip(which, work.states(c), acting, strict=True):
            self._inputs[i, : work.components] = of_state
            work.values(self._inputs[i], self._numbers[i], out)
        return np.asarray(acting.reshape(len(which), -1) @ work.weighted)
