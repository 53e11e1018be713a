"""Newton's method at one load."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray, SolveError
from forward.solvers.acceptance import Diverged, Search, accepted, converged, instability
from forward.solvers.corrections import mix
from forward.solvers.steps import finish, plain
from forward.solvers.system import Found, Move, NoConvergence, Residual, System

GROWTH = 4.0  # a Newton step that is longer than all before by this factor means divergence
NEAR = 0.2  # below this fraction of the last Newton step, a factor is used for more than one correction
POLISH = 8  # corrections with the factor of a Newton step
SEARCHES, ENOUGH = 8, 0.6  # residuals along a line, and the part of the slope that may be left
TOUCHING = 2  # times the iterations that are allowed, where the area in contact is yet to be found
CURVED = 0.1  # relative residual below which the stiffness has the curvature of tools
ASTRAY = 0.6  # distance from where the first step leads, over its length, beyond which a branch is left


def newton(
    search: Search, u: FloatArray, load: float, limit: int | None = None, *, near: bool = False
) -> tuple[Found, int]:
    """Iterate at one load; return the state and the number of iterations, or raise `Diverged`.

    `limit` is on iterations, unless the settings have a lower one. With `near`, u is an equilibrium at another load, so
    that the first step is along the tangent of the branch; the attempt ends where the state leaves its prediction.
    """
    search.system.at_load(load)
    most = search.settings.iterations
    allowed = (most if limit is None else min(limit, most)) * (TOUCHING if search.system.contact else 1)
    try:
        return _iterate(search, u, load, allowed, near=near)
    except NoConvergence as stop:
        search.history.append(f"load {load:.6g}: {stop.reason}")
        raise Diverged(stop.reason) from None
    except Diverged as stop:
        search.history.append(f"load {load:.6g}: {stop}")
        raise


def _iterate(search: Search, u: FloatArray, load: float, limit: int, *, near: bool) -> tuple[Found, int]:
    system, settings = search.system, search.settings
    residual = system.residual(u)
    predicted = u
    last: Move | None = None
    sizes: list[float] = []
    longest, length, first = 0.0, np.inf, 0.0
    if not np.isfinite(residual.size):
        raise Diverged("the starting state has no finite residual")
    for iteration in range(limit + 1):
        search.history.append(f"load {load:.6g} iteration {iteration}: relative residual {residual.relative:.3e}")
        if converged(system, settings.tolerance, u, residual, sizes):
            stability = finish(accepted(search, u, residual), system.solve)
            return Found(u, residual.relative, stability=stability, predicted=predicted), iteration
        if iteration == limit:
            break
        beyond: FloatArray | float = 0.0
        if not (near and iteration == 0 and system.has_factor(u)):
            curved = not system.contact or residual.relative < CURVED
            beyond = factorise(system, u, curved=curved, last=last)
        step = system.solve(-residual.vector - beyond)
        before, length = length, system.norm(step)
        if not np.isfinite(length) or (iteration > 0 and length > GROWTH * longest and not system.contact):
            raise Diverged("the Newton steps grow" + instability(system))
        longest, last = max(longest, length), (u, step)
        if system.contact and residual.gap == 0:
            u, residual = searched_step(search, u, residual, step)
        else:
            if iteration == 0:
                predicted, first = u + step, length
            u, residual = admissible_step(search, u, step)
            if near and system.norm(u - predicted) > ASTRAY * first:
                raise Diverged("the state leaves the tangent's prediction" + instability(system))
        if settings.kind != "newton" and length < NEAR * before < np.inf:
            polish = mix(search, settings.tolerance, u, residual, plain, POLISH)
            u, residual, reached, _ = finish(polish, system.solve)
            if reached:
                stability = finish(accepted(search, u, residual), system.solve)
                return Found(u, residual.relative, stability=stability, predicted=predicted), iteration + 1
    message = f"no convergence in {limit} iterations (relative residual {residual.relative:.3g})"
    raise Diverged(message + instability(system))


def factorise(system: System, u: FloatArray, *, curved: bool = True, last: Move | None = None) -> FloatArray | float:
    """Factorise the stiffness at u, after the `last` step; raise `Diverged` where it is singular."""
    try:
        return system.factorise(u, curved=curved, last=last)
    except SolveError as error:
        raise Diverged(error.reason) from None


def searched_step(search: Search, u: FloatArray, residual: Residual, step: FloatArray) -> tuple[FloatArray, Residual]:
    """Take a step along which the energy falls, nearly to its minimum along that line; the full one if that is so.

    The slope of the energy is that of the imbalance along the step, in the mixed form with the pressures' sign changed
    (`System.curvature`), which is −1 times a sum of squares at the start wherever the body is stable. A root of it is
    bracketed and found by the Illinois variant of the false position.
    """
    system = search.system
    first = system.curvature(step, residual.vector)
    at, found = admissible_step(search, u, step)
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


def admissible_step(search: Search, u: FloatArray, step: FloatArray) -> tuple[FloatArray, Residual]:
    """Take the full step, or halve it until the energy is defined and J > 0 at every quadrature point.

    The full step leads prescribed unknowns to their targets; there they are put exactly, whatever has been rounded.
    """
    system, fraction = search.system, 1.0
    while fraction >= search.settings.minimum_damping:
        trial = system.on_target(u + step) if fraction == 1.0 else u + fraction * step
        if system.smallest_jacobian(trial) > 0:
            residual = system.residual(trial)
            if np.isfinite(residual.size):
                return trial, residual
        fraction /= 2
    message = f"every trial down to {2 * fraction:.2g} of a Newton step turns a cell inside out"
    raise Diverged(message + instability(system))
