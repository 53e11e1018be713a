"""Newton's method at one load, and adaptive load steps."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray, SolveError
from forward.solvers.acceptance import Diverged, Unstable, accepted, converged, instability
from forward.solvers.corrections import mix
from forward.solvers.settings import SolverSettings
from forward.solvers.system import Found, Residual, System

QUICK = 5  # after a load step with at most this many iterations, the next one is twice as long
GROWTH = 4.0  # a Newton step that is longer than all before by this factor means divergence
NEAR = 0.2  # below this fraction of the last Newton step, a factor is used for more than one correction
POLISH = 8  # corrections with the factor of a Newton step
SQUEEZED = 0.3  # J of a cell that is reported if the load cannot be raised
LOCATED = 1 / 64  # of the load: how accurately the end of a stable branch is located
REFUSALS = 8  # load steps that may fail once an unstable equilibrium has been found


def load_steps(
    system: System, settings: SolverSettings, zero: FloatArray, history: list[str], *, unstable: bool
) -> Found:
    """Raise the load from zero; halve the step where Newton fails, double it where it is quick.

    The load at which an equilibrium was unstable is not tried again until the stable branch has been followed to within
    `LOCATED` of it: from further away Newton would only find the same state. Once an equilibrium was unstable (at full
    load, if `unstable` says so), the branch is expected to end, and only `REFUSALS` more attempts may fail.
    """
    reached, step, refusals = 0.0, 0.5, 0
    barrier = 1.0 if unstable else np.inf
    found, slope = Found(zero, 0.0), np.zeros_like(zero)
    while reached < 1:
        load = min(1.0, reached + step)
        if load >= barrier:
            load = barrier if barrier - reached <= LOCATED else (reached + barrier) / 2
        try:
            # The secant through the last two states predicts the next one.
            there, iterations = newton(system, settings, found.state + (load - reached) * slope, history, load)
        except Diverged as stop:
            step = (load - reached) / 2
            slope = np.zeros_like(zero)
            if isinstance(stop, Unstable):
                barrier, unstable = load, True
            refusals += unstable
            smallest = settings.minimum_load_step
            if unstable:
                smallest = max(smallest, LOCATED)
            if step < smallest or refusals > REFUSALS:
                message = f"stopped at {100 * reached:.4g} % of the load: {stop}"
                jacobian = system.smallest_jacobian(found.state)
                if jacobian < SQUEEZED:
                    message += f"; before, cells are already squeezed to J = {jacobian:.2g}"
                raise SolveError(message, history, system.work) from None
            continue
        slope = (there.state - found.state) / (load - reached)
        found, reached = there, load
        if reached >= barrier:
            barrier = np.inf
        system.work.load_steps += 1
        if iterations <= QUICK:
            step *= 2
    return found


def newton(
    system: System, settings: SolverSettings, u: FloatArray, history: list[str], load: float
) -> tuple[Found, int]:
    """Iterate at one load; return the state and the number of iterations, or raise `Diverged`."""
    system.at_load(load)
    try:
        return _iterate(system, settings, u, history, load)
    except Diverged as stop:
        history.append(f"load {load:.6g}: {stop}")
        raise


def _iterate(
    system: System, settings: SolverSettings, u: FloatArray, history: list[str], load: float
) -> tuple[Found, int]:
    residual = system.residual(u)
    sizes: list[float] = []
    longest, length = 0.0, np.inf
    if not np.isfinite(residual.size):
        message = "the starting state has no finite residual"
        raise Diverged(message)
    for iteration in range(settings.iterations + 1):
        history.append(f"load {load:.6g} iteration {iteration}: relative residual {residual.relative:.3e}")
        if converged(system, settings.tolerance, u, residual, sizes):
            return Found(u, residual.relative, stability=accepted(system, settings, u, residual)), iteration
        if iteration == settings.iterations:
            break
        factorise(system, u)
        step = system.solve(-residual.vector)
        before, length = length, system.norm(step)
        if not np.isfinite(length) or (iteration > 0 and length > GROWTH * longest):
            raise Diverged("the Newton steps grow" + instability(system))
        longest = max(longest, length)
        u, residual = admissible_step(system, settings, u, step)
        if settings.kind != "newton" and length < NEAR * before < np.inf:
            u, residual, reached = mix(system, settings.tolerance, u, residual, system.solve, POLISH, history)
            if reached:
                return Found(u, residual.relative, stability=accepted(system, settings, u, residual)), iteration + 1
    message = f"no convergence in {settings.iterations} iterations (relative residual {residual.relative:.3g})"
    raise Diverged(message + instability(system))


def factorise(system: System, u: FloatArray) -> None:
    """Factorise the stiffness at u; raise `Diverged` where it is singular."""
    try:
        system.factorise(u)
    except SolveError as error:
        raise Diverged(error.reason) from None


def admissible_step(
    system: System, settings: SolverSettings, u: FloatArray, step: FloatArray
) -> tuple[FloatArray, Residual]:
    """Take the full step, or halve it until the energy is defined and J > 0 at every quadrature point."""
    fraction = 1.0
    while fraction >= settings.minimum_damping:
        trial = u + fraction * step
        if system.smallest_jacobian(trial) > 0:
            residual = system.residual(trial)
            if np.isfinite(residual.size):
                return trial, residual
        fraction /= 2
    message = f"every trial down to {2 * fraction:.2g} of a Newton step turns a cell inside out"
    raise Diverged(message + instability(system))
