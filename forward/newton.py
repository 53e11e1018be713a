"""Newton's method with a step guard, and adaptive load steps, for a discretised body.

Whole Newton steps are taken wherever the trial state is admissible (energy defined, J > 0 at every quadrature point);
what stops the iteration are steps that grow. A line search on the residual or on the energy, or the natural
monotonicity test of Deuflhard's NLEQ-ERR, would shorten the first step of a slender body in bending, after which the
residual is 5000 times and the simplified correction 380 times larger although Newton converges in six more
iterations; where whole steps fail, smaller load steps succeed (docs/decisions/0002-newton-globalisation.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field

from forward.model import FloatArray, SolveError, Work
from forward.settings import Settings


class NewtonSettings(Settings):
    """Tolerance and limits of the solver.

    Parameters
    ----------
    tolerance
        Largest residual of the free unknowns, relative to the loads (and to the reactions where displacements are
        prescribed); in the mixed form, also of the volumes, as the force of the pressure that they lack.
    iterations
        Newton iterations allowed in one load step.
    minimum_damping
        Shortest fraction of a Newton step that is tried where the whole step is not admissible.
    minimum_load_step
        Smallest load step, as a fraction of the load, before the solver gives up.
    """

    tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-8
    iterations: Annotated[int, Field(ge=1)] = 25
    minimum_damping: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    minimum_load_step: Annotated[float, Field(gt=0, le=1)] = 1 / 512


QUICK = 5  # a load step that needs no more iterations than this lets the next one be twice as long
GROWTH = 4.0  # a Newton step that is longer than all before by this factor means divergence


@dataclass(frozen=True)
class Residual:
    """Imbalance of a state.

    Attributes
    ----------
    vector
        This rank's part: forces on the free displacements, distance from the target on the prescribed ones, volumes
        on the pressures.
    size
        Euclidean norm over the free displacements, of all ranks (N).
    scale
        What `size` is compared with (N).
    rounding
        What `size` cannot be expected to fall below, whatever the loads (N).
    gap
        Largest distance of a prescribed unknown from its target (m).
    volume
        Norm of the volumes out of balance, of all ranks, as a force (N); 0 where they are rounding, and where
        pressures are no unknowns.
    """

    vector: FloatArray
    size: float
    scale: float
    rounding: float
    gap: float
    volume: float = 0.0

    @property
    def relative(self) -> float:
        """The residual relative to the loads."""
        largest = max(self.size, self.volume)
        return largest / self.scale if self.scale > 0 else largest

    def converged(self, tolerance: float) -> bool:
        """Whether the state is an equilibrium to `tolerance`, or to rounding."""
        return self.gap == 0 and max(self.size, self.volume) <= max(tolerance * self.scale, self.rounding)


class System(Protocol):
    """A nonlinear system at a load fraction, and the linear system of its factorised stiffness.

    Vectors hold this rank's part; every method is collective over the ranks of the system.
    """

    work: Work

    def at_load(self, fraction: float) -> None:
        """Scale all loads and prescribed displacements."""

    def residual(self, u: FloatArray) -> Residual:
        """Return the imbalance at u."""

    def factorise(self, u: FloatArray) -> None:
        """Assemble and factorise the stiffness at u.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = right with the factor at hand; prescribed rows are identities."""

    def norm(self, x: FloatArray) -> float:
        """Euclidean norm over the displacements of all ranks (pressures, in another unit, follow them)."""

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest J = det F over the quadrature points of all ranks."""

    def negative_pivots(self) -> int:
        """Number of negative eigenvalues of the factorised stiffness of displacements; −1 if unknown.

        A stable state has none. Those that belong to pressures (one each, whatever the state) do not count.
        """


class _Diverged(Exception):  # noqa: N818 - control flow inside this file
    """An attempt at one load failed, for the reason given."""


def solve(system: System, settings: NewtonSettings, zero: FloatArray, start: FloatArray | None = None) -> FloatArray:
    """Find the equilibrium at full load: directly if that converges, else by adaptive load steps from `zero`.

    Parameters
    ----------
    system
        The body; its `work` counts what is spent.
    settings
        Tolerance and limits.
    zero
        The undeformed state (U_local,).
    start
        A prediction of the state at full load (U_local,).

    Returns
    -------
    numpy.ndarray
        The state (U_local,), with J > 0 at every quadrature point.

    Raises
    ------
    SolveError
        With the load fraction and the reason where the last attempt stopped, and the history of all attempts.
    """
    history: list[str] = []
    for guess in (start, zero):
        if guess is not None:
            try:
                return _newton(system, settings, guess, history, 1.0)[0]
            except _Diverged:
                continue
    return _load_steps(system, settings, zero, history)


def _load_steps(system: System, settings: NewtonSettings, zero: FloatArray, history: list[str]) -> FloatArray:
    """Raise the load from zero; halve the step where Newton fails, double it where it is quick."""
    reached, step = 0.0, 0.5
    u, slope = zero, np.zeros_like(zero)
    while reached < 1:
        load = min(1.0, reached + step)
        try:
            # The secant through the last two states predicts the next one.
            solution, iterations = _newton(system, settings, u + (load - reached) * slope, history, load)
        except _Diverged as stop:
            step /= 2
            slope = np.zeros_like(zero)
            if step < settings.minimum_load_step:
                message = f"stopped at {100 * reached:.4g} % of the load: {stop}"
                raise SolveError(message, history, system.work) from None
            continue
        slope = (solution - u) / (load - reached)
        u, reached = solution, load
        system.work.load_steps += 1
        if iterations <= QUICK:
            step *= 2
    return u


def _newton(
    system: System, settings: NewtonSettings, u: FloatArray, history: list[str], load: float
) -> tuple[FloatArray, int]:
    """Iterate at one load; return the state and the number of iterations, or raise `_Diverged`."""
    system.at_load(load)
    try:
        return _iterate(system, settings, u, history, load)
    except _Diverged as stop:
        history.append(f"load {load:.6g}: {stop}")
        raise


def _iterate(
    system: System, settings: NewtonSettings, u: FloatArray, history: list[str], load: float
) -> tuple[FloatArray, int]:
    residual = system.residual(u)
    longest = 0.0
    if not np.isfinite(residual.size):
        message = "the starting state has no finite residual"
        raise _Diverged(message)
    for iteration in range(settings.iterations + 1):
        history.append(f"load {load:.6g} iteration {iteration}: relative residual {residual.relative:.3e}")
        if residual.converged(settings.tolerance):
            jacobian = system.smallest_jacobian(u)
            if not jacobian > 0:
                message = f"a cell is turned inside out (smallest J = {jacobian:.3g})"
                raise _Diverged(message)
            return u, iteration
        if iteration == settings.iterations:
            break
        try:
            system.factorise(u)
        except SolveError as error:
            raise _Diverged(error.reason) from None
        step = system.solve(-residual.vector)
        length = system.norm(step)
        if not np.isfinite(length) or (iteration > 0 and length > GROWTH * longest):
            raise _Diverged("the Newton steps grow" + _instability(system))
        longest = max(longest, length)
        u, residual = _admissible_step(system, settings, u, step)
    message = f"no convergence in {settings.iterations} iterations (relative residual {residual.relative:.3g})"
    raise _Diverged(message + _instability(system))


def _admissible_step(
    system: System, settings: NewtonSettings, u: FloatArray, step: FloatArray
) -> tuple[FloatArray, Residual]:
    """Go the whole step, or halve it until the energy is defined and J > 0 at every quadrature point."""
    fraction = 1.0
    while fraction >= settings.minimum_damping:
        trial = u + fraction * step
        if system.smallest_jacobian(trial) > 0:
            residual = system.residual(trial)
            if np.isfinite(residual.size):
                return trial, residual
        fraction /= 2
    message = f"every trial down to {2 * fraction:.2g} of a Newton step turns a cell inside out"
    raise _Diverged(message + _instability(system))


def _instability(system: System) -> str:
    negative = system.negative_pivots()
    if negative <= 0:
        return ""
    plural = "" if negative == 1 else "s"
    return f"; the last stiffness has {negative} negative eigenvalue{plural} (unstable, or far from equilibrium)"
