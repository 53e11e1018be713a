"""Whether an equilibrium is joined to rest: whether raising the loads from zero leads to it.

A body may have several stable equilibria under the same loads: an arch that is up or has snapped, a block that is
turned by 180 degrees through the planes that hold it. Only the path tells which of them it takes. Two paths do: that of
the loads from zero (`load_steps`), and, from a reference that is joined to rest, the straight line in parameters. Along
both, a step is taken only if it ends where the tangent predicts it, in a stable state; where no step is short enough
for that, the branch ends, and what is found beyond is a jump.

Every equilibrium is screened (`strayed`), which costs next to nothing; what a screen calls for, and what is drawn at
random, is audited (`settled`): the path is followed, and the state that it leads to is the answer
(docs/decisions/0044-joined-to-rest.md).
"""

from __future__ import annotations

from contextlib import suppress
from copy import copy
from dataclasses import replace

import numpy as np

from forward.model import FloatArray, SolveError, Stability
from forward.solvers.acceptance import Diverged, Search
from forward.solvers.corrections import NEAR, mix, straight
from forward.solvers.newton import newton
from forward.solvers.steps import Steps, T, Task, abreast
from forward.solvers.system import Found, System
from forward.solvers.way import Way

TURNED = np.pi / 4  # angle (rad) by which a node is turned against the prediction
SAME = 1e-5  # distance of two states that are one, over their size: tolerances of residuals allow for less
FEW = 0.01  # the same over the size of the state, below which no two branches are told apart
STEPS = 4  # parts of the way from a reference, after each of which the state is looked at
ROUGH = 1e-3  # relative residual of the states on that way
QUICK = 5  # after a load step with at most this many iterations, the next one is twice as long
SQUEEZED = 0.3  # J of a cell that is reported if the load cannot be raised
SHORTEST = 1 / 256  # of the load: a step that is no longer than this and still leaves the prediction is a jump
LOCATED = 1 / 64  # of the load: how accurately the end of a stable branch is located
REFUSALS = 8  # load steps that may fail once an unstable equilibrium has been found
LATE = 8  # iterations of each of them: where a branch ends Newton's method is quick, or wanders
ABOVE = (1 / 32, 1 / 16, 1 / 8)  # of the load that is added to find a jump
FIRST = 1 / 8  # of the load: where no step from rest as long as this follows the tangent, that may have a kink
TINY = 2.0**-20  # of the load: so little that stiffnesses change by nothing but kinks


def strayed(system: System, before: FloatArray, predicted: FloatArray, u: FloatArray, way: Way | None = None) -> str:
    """Say why a state u may lie on another branch than the one before, from which a tangent predicted it; or nothing.

    Where tools touch the body the tangent predicts little, and only planes are looked at. Distances from the prediction
    are compared with the length of the `way`, if that is known to be more than the state has moved.
    """
    system.work.screens += 1
    if system.crossed(u):
        return "the body has passed through a plane that holds it"
    if system.contact:
        return ""
    moved, apart = system.norm(u - before), system.norm(u - predicted)
    if apart > max(NEAR * moved, NEAR * (way.length if way is not None else 0.0), FEW * system.norm(u)):
        share = apart / moved if moved > 0 else np.inf
        return f"its distance from the tangent's prediction is {share:.2g} of the way"
    rotations = system.rotations if way is None else way.rotations
    angle = system.angle(rotations(predicted), rotations(u))
    if angle > TURNED:
        return f"a node is turned by {np.degrees(angle):.0f}° against the prediction"
    return ""


def same(system: System, u: FloatArray, v: FloatArray) -> bool:
    """Whether two states are one, to the solver's tolerance."""
    return system.norm(u - v) <= SAME * max(system.norm(u), system.norm(v))


def load_steps(search: Search, zero: FloatArray, *, unstable: bool = False, beyond: FloatArray | None = None) -> Found:
    """Raise the load from zero along the branch of equilibria from rest; where that ends, jump.

    The whole load is tried first; a step is halved where Newton's method fails or the state is not where the tangent
    predicts it, and doubled where that is quick. The branch has ended where a step of `SHORTEST` of the load is still
    too long, or the shortest that settings allow. Beyond, steps are taken wherever Newton's method leads; at most
    `REFUSALS` of them may fail.

    The load at which an equilibrium was unstable is not tried again until the stable branch has been followed to within
    `LOCATED` of it: from further away Newton would only find the same state. Once an equilibrium was unstable (at full
    load, if `unstable` says so), the branch is expected to end: only `REFUSALS` attempts may find others, and each has
    `LATE` iterations. It need not end: a body that is pushed aside a little bends much where without that it buckles.

    Where the energy has a kink at rest, as that of fibres which carry only tension, the tangent there predicts no step.
    The branch is then followed from a `TINY` load on (`_off_rest`).

    `beyond` is a stable equilibrium at full load, the answer if the branch from rest ends before.

    Raises
    ------
    SolveError
        With the load fraction where the branch from rest ends and why.
    """
    system, settings, history = search.system, search.settings, search.history
    reached, step, refusals = 0.0, 1.0, 0
    barrier = 1.0 if unstable else np.inf
    found, near = Found(zero, 0.0), not system.contact
    refused = Stability.NOT_TESTED
    ended: tuple[float, FloatArray, Diverged] | None = None  # where the branch from rest does
    if unstable or system.contact:
        step = 0.5
    while reached < 1:
        load = min(1.0, reached + step)
        if load >= barrier:
            load = barrier if barrier - reached <= LOCATED else (reached + barrier) / 2
        limit = LATE if unstable and reached else None
        try:
            there, iterations = _step(search, found.state, load, limit, near=near)
        except Diverged as stop:
            step = (load - reached) / 2
            smallest, refusal = settings.minimum_load_step, stop.stability != Stability.NOT_TESTED
            if refusal:
                barrier, unstable, refused = load, True, max(refused, stop.stability)
                smallest = max(smallest, LOCATED)
            refusals += refusal or not near
            if near and reached == 0 and step < FIRST <= load:
                off = _off_rest(search, zero)
                if off is not None:
                    found, reached, step = off, 2 * TINY, 1.0
                    continue
            if near and (step < smallest or 2 * step <= SHORTEST * load):
                history.append(f"the branch from rest ends at {100 * reached:.4g} % of the load")
                if beyond is not None:
                    system.at_load(1.0)
                    return Found(beyond, 0.0, snapped=True)
                near, ended, step = False, ended or (reached, found.state, stop), 1.0 - reached
            if step < smallest or refusals > REFUSALS:
                return _jumped(search, refused, *(ended or (reached, found.state, stop)))
            continue
        found, reached = there, load
        if reached >= barrier:
            barrier = np.inf
        system.work.load_steps += reached < 1 or system.work.load_steps > 0
        near = not system.contact
        if iterations <= QUICK:
            step *= 2
    return found._replace(snapped=ended is not None)


def _off_rest(search: Search, zero: FloatArray) -> Found | None:
    """Return the state under twice a `TINY` load if it is twice that under this load, which no tangent predicts.

    Then the branch has a kink at rest and goes on straight from there, as the tangent beside the kink predicts; where
    one at rest predicts the first state, or the states do not tell, there is none.
    """
    system = search.system
    with suppress(Diverged):
        one = newton(search, zero, TINY)[0]
        if one.predicted is not None and strayed(system, zero, one.predicted, one.state):
            two = _step(search, one.state, 2 * TINY, None, near=True)[0]
            if not strayed(system, zero, 2 * one.state - zero, two.state):
                search.history.append("the tangent at rest has a kink")
                return two
    return None


def _jumped(search: Search, refused: Stability, load: float, u: FloatArray, why: Diverged) -> Found:
    """Find where a body jumps to from u, the last stable state, at more than the whole load; go back from there.

    Just beyond the end of a branch residuals are small along a long way, on which Newton's method is lost.

    Raises
    ------
    SolveError
        If nothing is found, or if an unstable equilibrium was `refused`: then the branch goes on as that.
    """
    system = search.system
    if refused == Stability.NOT_TESTED and not system.contact:
        for more in ABOVE:
            with suppress(Diverged):
                above = newton(search, u, 1.0 + more)[0]
                return _step(search, above.state, 1.0, None, near=True)[0]._replace(snapped=True)
    message = f"stopped at {100 * load:.4g} % of the load{system.in_words(load)}: {why}"
    jacobian = system.smallest_jacobian(u)
    if jacobian < SQUEEZED:
        message += f"; before, cells are already squeezed to J = {jacobian:.2g}"
    raise SolveError(message, search.history, system.work, refused) from None


def _step(search: Search, u: FloatArray, load: float, limit: int | None, *, near: bool) -> tuple[Found, int]:
    """Go from an equilibrium to one at another load, if `near` to where a tangent predicts it; or raise `Diverged`."""
    there, iterations = newton(search, u, load, limit, near=near)
    predicted = there.predicted if near and there.predicted is not None else there.state
    why = strayed(search.system, u, predicted, there.state)
    if why:
        search.history.append(f"load {load:.6g}: {why}")
        raise Diverged(f"{why}: the body buckles, snaps, or bends too sharply to be followed")
    return there, iterations


def settled(
    search: Search, found: Found, way: Way | None = None, before: FloatArray | None = None, *, audit: bool = False
) -> Steps[Found]:
    """Return the equilibrium that is joined to rest: the one found, unless an audit ends elsewhere.

    The one found is stable at full load, with what a tangent predicted for it: on the way from a reference, or from a
    state `before` (U_local,), by default that of rest. An audit is drawn at random.

    Raises
    ------
    SolveError
        If the loads cannot be raised, and the state found cannot be the answer.
    """
    system, zero = search.system, np.zeros_like(found.state)
    start = way.state if way is not None else zero if before is None else before
    if search.settings.accept_unstable:
        return found
    predicted = start if found.predicted is None else found.predicted
    why = strayed(system, start, predicted, found.state, way)
    known = way is not None and way.joined  # so that a path from there tells
    if way is not None and not way.joined:
        why = why or "the reference is not joined to rest"
    elif way is not None and way.reversed_from > NEAR:  # a body that buckles to the side to which it is pushed
        known, why = False, why or "a load is reversed on the way from the reference"
    if not why and not audit:
        return found
    work = system.work
    spent = replace(work)
    work.calls += bool(why)
    work.audits += 1
    search.history.append(f"audit: {why or 'drawn at random'}")
    if known and way is not None and (yield from _leads(search, found, way, counted=bool(why))):
        answer = found
    else:
        answer = load_steps(search, zero, beyond=None if system.crossed(found.state) else found.state)
        if same(system, answer.state, found.state):
            answer = found._replace(snapped=answer.snapped)
        else:
            search.history.append("audit: the state that is joined to rest is another one")
            system.work.others += 1
    work.audit_residuals += work.residuals - spent.residuals
    work.audit_factorisations += work.factorisations - spent.factorisations
    work.audit_back_substitutions += work.back_substitutions - spent.back_substitutions
    return answer


def _leads(search: Search, found: Found, way: Way, *, counted: bool) -> Steps[bool]:
    """Whether the straight line in parameters from a reference leads to a state, without loss of stability.

    States after each of `STEPS` equal parts of the line are corrected with the factor of the reference, all at a time,
    from where the tangent at the reference and the state found predict them. Each has to lie where those before it
    predict it. So has the state found, to a part of the last step, or what is corrected from that prediction is it.
    Where Lanczos' process does not tell that a state is stable, negative eigenvalues are counted if `counted`; if not,
    at the end only, as they were for the state found.
    """
    system = search.system
    slope = found.state - way.state if way.slope is None else way.slope
    bend = found.state - way.state - slope
    ways, shares = [copy(way) for _ in range(STEPS)], [k / STEPS for k in range(1, STEPS + 1)]

    def there(k: int, steps: Steps[T]) -> Task[T]:
        """Return a solver at a place, among others that use the equations in turn."""
        return Task(steps, lambda _: ways[k].at(shares[k]))

    def corrected(k: int, start: FloatArray, tolerance: float) -> Task[FloatArray]:
        return there(k, _corrected(search, start, ways[k], tolerance))

    try:
        starts = [way.state + t * (slope + t * bend) for t in shares[:-1]]
        states = yield from abreast([corrected(k, start, ROUGH) for k, start in enumerate(starts)])
        states.append(found.state)
        known: list[tuple[float, FloatArray]] = []
        predicted = way.state
        for t, u in zip(shares, states, strict=True):
            predicted = straight(way.state, slope, known, t)
            if strayed(system, way.state, predicted, u, way):
                return False
            known.append((t, ((u - way.state) / t - slope) / t))
        if system.norm(found.state - predicted) > NEAR * system.norm(found.state - states[-2]):
            (end,) = yield from abreast([corrected(STEPS - 1, predicted, search.settings.tolerance)])
            if not same(system, end, found.state):
                return False
        open_ones = list(enumerate(states))[: STEPS - (found.stability == Stability.COUNTED)]
        definite = yield from abreast([there(k, _definite(system, u, ways[k])) for k, u in open_ones])
        for (k, u), sure in zip(open_ones, definite, strict=True):
            if not sure and (counted or k == STEPS - 1):
                ways[k].at(shares[k])
                if system.negative_eigenvalues(u) != 0:
                    return False
    except (SolveError, Diverged):
        return False
    finally:
        way.at(1.0)
    return True


def _corrected(search: Search, start: FloatArray, way: Way, tolerance: float) -> Steps[FloatArray]:
    """Correct a prediction with the factor of the reference, or raise `Diverged`."""
    u = search.system.on_target(start)
    residual = search.system.residual(u)
    if not np.isfinite(residual.size):
        raise Diverged("the state has no finite residual")
    mixed = yield from mix(search, tolerance, u, residual, way.corrector(u), search.settings.corrections)
    if not mixed.reached:
        raise Diverged("the reference is too far away")
    return mixed.state


def _definite(system: System, u: FloatArray, way: Way) -> Steps[bool]:
    """Whether Lanczos' process shows that the stiffness at a state is positive definite."""
    way.corrector(u)  # remembers the rotations there
    return (yield from way.definite(u, system.residual(u)))
