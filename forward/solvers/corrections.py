"""Correcting a prediction with the factor of another state, by Anderson mixing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.solvers.acceptance import Diverged, Search, accepted, converged, convex
from forward.solvers.anderson import AndersonMixing
from forward.solvers.steps import Corrector, Steps
from forward.solvers.system import Found, Residual
from forward.solvers.way import Way

NEAR = 0.3  # distance from the tangent's prediction, over that which the state has moved, of the same branch
WINDOW = 8  # differences that Anderson mixing keeps
PATIENCE = 6  # corrections without a smaller residual before giving up
TOUCHING, LESS = 4, 1 / 3  # corrections of a body in contact after which the residual must be this much smaller
ROUGH = 1e-2  # relative residual of a state that only predicts the next
SHORTEST = 1 / 8  # fraction of the path from the reference that is not divided further
CLOSE = 0.05  # relative residual at the end of the path below which a state is a better start than the prediction
FAILURES = 2  # corrections at the end of the path that may fail, once a state as close as that is known
ROUNDED = 1e-2  # relative residual above which a useless correction is not due to rounding


def predict_correct(search: Search, start: FloatArray, way: Way) -> Steps[Found]:
    """Correct a prediction with a reference factor, in several steps if one is too long.

    With s the slope of the prediction, the state after a fraction t of the path is ū + t s + t² q(t). The first step
    takes q = 0; each state found gives a value of q, and the last two values predict the next. Where a tool touches the
    body, there is one step only: as points come into contact and leave it, corrections of several steps take longer
    than Newton's method.

    Raises
    ------
    Diverged
        If the reference is too far away, with the state at the end of the path that came closest, if one did.
    """
    system, settings, history = search.system, search.settings, search.history
    slope = start - way.state
    flat = system.norm(slope) == 0  # then the first correction is the tangent's prediction
    known: list[tuple[float, FloatArray]] = []
    reached, target = 0.0, 1.0
    closest: FloatArray | None = None
    least, failures, astray = CLOSE, 0, False  # astray: a state on the way may lie beyond a jump
    while True:
        way.at(target)
        guess = straight(way.state, slope, known, target)
        tolerance = settings.tolerance if target == 1 else ROUGH
        history.append(f"prediction at {target:.6g} of the way from the reference")
        u = system.on_target(guess)
        residual = system.residual(u)
        close = bool(np.isfinite(residual.size))
        predicted = system.on_target(start) if astray else u
        if close:
            mixed = yield from mix(search, tolerance, u, residual, way.corrector(u), settings.corrections)
            u, residual, close, first = mixed
            if flat and not known:
                predicted = first
            if close and target < 1:
                astray = astray or system.norm(u - predicted) > NEAR * system.norm(u - way.state)
        if close and target == 1:
            stability = yield from accepted(search, u, residual, way)
            return Found(u, residual.relative, corrected=True, stability=stability, predicted=predicted)
        if target == 1:
            failures += 1
            if residual.relative < least and system.smallest_jacobian(u) > 0:
                closest, least = u, residual.relative
        if close:
            known.append((target, ((u - way.state) / target - slope) / target))
            reached, target = target, 1.0
        elif target - reached > SHORTEST and not system.contact and (failures < FAILURES or closest is None):
            target = (reached + target) / 2
        else:
            way.at(1.0)
            message = "the reference is too far away"
            history.append(message)
            raise Diverged(message, closest)


def straight(state: FloatArray, slope: FloatArray, known: list[tuple[float, FloatArray]], t: float) -> FloatArray:
    """Predict the state (U_local,) after a fraction t of the path from a state, as in `predict_correct`."""
    bend: FloatArray | float = known[-1][1] if known else 0.0
    if len(known) > 1:  # the line through the last two
        (a, p), (b, q) = known[-2:]
        bend = p + (t - a) / (b - a) * (q - p)
    return np.asarray(state + t * slope + t**2 * bend)


class Mixed(NamedTuple):
    """The best state of some corrections, its residual, whether it is an equilibrium, and the first correction."""

    state: FloatArray
    residual: Residual
    reached: bool
    first: FloatArray


def mix(
    search: Search, tolerance: float, u: FloatArray, residual: Residual, correct: Corrector, limit: int
) -> Steps[Mixed]:
    """Correct u with one factor."""
    system, history = search.system, search.history
    mixing = AndersonMixing(WINDOW, len(u), system.total, system.weights())
    best, smallest, since, begun, first = u, residual, 0, residual.size, u
    sizes: list[float] = []
    last: tuple[FloatArray, Residual] | None = None
    for iteration in range(limit + 1):
        history.append(f"correction {iteration}: relative residual {residual.relative:.3e}")
        if residual.size > ROUNDED * residual.scale > 0:
            sizes.clear()  # corrections falter before they are close
        if converged(system, tolerance, u, residual, sizes):
            stable = last is None or convex(system, last, (u, residual))
            return Mixed(u, residual, stable and system.smallest_jacobian(u) > 0, first)
        if iteration > 0 and residual.size < smallest.size:
            best, smallest, since = u, residual, 0
        else:
            since += 1
        if iteration == limit or since > PATIENCE:
            break
        if system.contact and iteration == TOUCHING and smallest.size > LESS * begun:
            history.append("corrections: the area in contact moves too far")
            break
        last = (u, residual)
        u = mixing.next(u, residual.vector, (yield from correct(residual.vector)))
        first = u if iteration == 0 else first
        residual = system.residual(u)
        if not np.isfinite(residual.size):
            history.append("correction: the state has no finite residual")
            break
    return Mixed(best, smallest, False, first)
