"""Newton's method at one load, and adaptive load steps."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray, SolveError, Stability
from forward.solvers.acceptance import Diverged, Unstable, accepted, converged, instability
from forward.solvers.corrections import mix
from forward.solvers.linear import NoConvergence
from forward.solvers.settings import SolverSettings
from forward.solvers.steps import finish, plain
from forward.solvers.system import Found, Residual, System

QUICK = 5  # after a load step with at most this many iterations, the next one is twice as long
GROWTH = 4.0  # a Newton step that is longer than all before by this factor means divergence
NEAR = 0.2  # below this fraction of the last Newton step, a factor is used for more than one correction
POLISH = 8  # corrections with the factor of a Newton step
SQUEEZED = 0.3  # J of a cell that is reported if the load cannot be raised
SEARCHES, ENOUGH = 8, 0.6  # residuals along a line, and the part of the slope that may be left
TOUCHING = 2  # times the iterations that are allowed, where the area in contact is yet to be found
CURVED = 0.1  # relative residual below which the stiffness has the curvature of tools
LOCATED = 1 / 64  # of the load: how accurately the end of a stable branch is located
REFUSALS = 8  # load steps that may fail once an unstable equilibrium has been found
LATE = 8  # iterations of each of them: where a branch ends Newton's method is quick, or wanders


def load_steps(
    system: System, settings: SolverSettings, zero: FloatArray, history: list[str], *, unstable: bool
) -> Found:
    """Raise the load from zero; halve the step where Newton fails, double it where it is quick.

    The load at which an equilibrium was unstable is not tried again until the stable branch has been followed to within
    `LOCATED` of it: from further away Newton would only find the same state. Once an equilibrium was unstable (at full
    load, if `unstable` says so), the branch is expected to end: only `REFUSALS` more attempts may fail, and each after
    the first has `LATE` iterations.
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
            start = found.state + (load - reached) * slope
            there, iterations = newton(system, settings, start, history, load, LATE if unstable and reached else None)
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
                message = f"stopped at {100 * reached:.4g} % of the load{system.in_words(reached)}: {stop}"
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
    system: System, settings: SolverSettings, u: FloatArray, history: list[str], load: float, limit: int | None = None
) -> tuple[Found, int]:
    """Iterate at one load; return the state and the number of iterations, or raise `Diverged`.

    `limit` is on iterations, unless the settings have a lower one.
    """
    system.at_load(load)
    allowed = settings.iterations if limit is None else min(limit, settings.iterations)
    try:
        return _iterate(system, settings, u, history, load, allowed * (TOUCHING if system.contact else 1))
    except NoConvergence as stop:
        history.append(f"load {load:.6g}: {stop.reason}")
        raise Diverged(stop.reason) from None
    except Diverged as stop:
        history.append(f"load {load:.6g}: {stop}")
        raise


def _iterate(
    system: System, settings: SolverSettings, u: FloatArray, history: list[str], load: float, limit: int
) -> tuple[Found, int]:
    residual = system.residual(u)
    sizes: list[float] = []
    longest, length = 0.0, np.inf
    if not np.isfinite(residual.size):
        message = "the starting state has no finite residual"
        raise Diverged(message)
    for iteration in range(limit + 1):
        history.append(f"load {load:.6g} iteration {iteration}: relative residual {residual.relative:.3e}")
        if converged(system, settings.tolerance, u, residual, sizes):
            return Found(u, residual.relative, stability=_accepted(system, settings, u, residual)), iteration
        if iteration == limit:
            break
        factorise(system, u, curved=not system.contact or residual.relative < CURVED)
        step = system.solve(-residual.vector)
        before, length = length, system.norm(step)
        if not np.isfinite(length) or (iteration > 0 and length > GROWTH * longest and not system.contact):
            raise Diverged("the Newton steps grow" + instability(system))
        longest = max(longest, length)
        if system.contact and residual.gap == 0:
            u, residual = searched_step(system, settings, u, residual, step)
        else:
            u, residual = admissible_step(system, settings, u, step)
        if settings.kind != "newton" and length < NEAR * before < np.inf:
            polish = mix(system, settings.tolerance, u, residual, plain, POLISH, history)
            u, residual, reached = finish(polish, system.solve)
            if reached:
                return Found(u, residual.relative, stability=_accepted(system, settings, u, residual)), iteration + 1
    message = f"no convergence in {limit} iterations (relative residual {residual.relative:.3g})"
    raise Diverged(message + instability(system))


def _accepted(system: System, settings: SolverSettings, u: FloatArray, residual: Residual) -> Stability:
    """Accept a state that no reference screens: its negative eigenvalues are counted."""
    return finish(accepted(system, settings, u, residual), system.solve)


def factorise(system: System, u: FloatArray, *, curved: bool = True) -> None:
    """Factorise the stiffness at u; raise `Diverged` where it is singular."""
    try:
        system.factorise(u, curved=curved)
    except SolveError as error:
        raise Diverged(error.reason) from None


def searched_step(
    system: System, settings: SolverSettings, u: FloatArray, residual: Residual, step: FloatArray
) -> tuple[FloatArray, Residual]:
    """Take a step along which the energy falls, nearly to its minimum along that line; the full one if that is so.

    The slope of the energy is that of the imbalance along the step, in the mixed form with the pressures' sign changed
    (`System.curvature`), which is −1 times a sum of squares at the start wherever the body is stable. A root of it is
    bracketed and found by the Illinois variant of the false position.
    """
    first = system.curvature(step, residual.vector)
    at, found = admissible_step(system, settings, u, step)
    if not first < 0:
        return at, found
    fraction = 1.0 if at is u else system.norm(at - u) / system.norm(step)
    low, of_low, high, of_high = 0.0, first, fraction, system.curvature(step, found.vector)
    last = of_high
    for _ in range(SEARCHES):
        if last <= ENOUGH * abs(first) and (last >= -ENOUGH * abs(first) or high == fraction == 1.0):
            break
        if of_high <= 0:
            break
        fraction = (low * of_high - high * of_low) / (of_high - of_low)
        fraction = min(max(fraction, low + 0.05 * (high - low)), high - 0.05 * (high - low))
        at = u + fraction * step
        found = system.residual(at)
        last = system.curvature(step, found.vector)
        if last > 0:
            high, of_high, of_low = fraction, last, of_low / 2
        else:
            low, of_low, of_high = fraction, last, of_high / 2
    return at, found


def admissible_step(
    system: System, settings: SolverSettings, u: FloatArray, step: FloatArray
) -> tuple[FloatArray, Residual]:
    """Take the full step, or halve it until the energy is defined and J > 0 at every quadrature point.

    The full step leads prescribed unknowns to their targets; there they are put exactly, whatever has been rounded.
    """
    fraction = 1.0
    while fraction >= settings.minimum_damping:
        trial = system.on_target(u + step) if fraction == 1.0 else u + fraction * step
        if system.smallest_jacobian(trial) > 0:
            residual = system.residual(trial)
            if np.isfinite(residual.size):
                return trial, residual
        fraction /= 2
    message = f"every trial down to {2 * fraction:.2g} of a Newton step turns a cell inside out"
    raise Diverged(message + instability(system))
