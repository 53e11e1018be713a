"""Finding the equilibrium of a discretised body: predict and correct with a reference factor, Newton, load steps.

From a prediction, `solving` first corrects with the factor of a reference state and Anderson mixing, which needs no
stiffness; if that is slow it continues with Newton's method, then with adaptive load steps. Without a prediction it
begins with these. All of them use the same residual test, and the answer is the equilibrium that is joined to rest
(`joined`), whichever of them finds it. It can also be told to stop after a few iterations, wherever it is then.

Full Newton steps are taken wherever the trial state is admissible (energy defined, J > 0 at every quadrature point);
the iteration stops when steps grow. A line search would shorten the first step of a slender body in bending; where
whole steps fail, smaller load steps succeed (docs/decisions/0002-newton-globalisation.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray, SolveError, Stability
from forward.solvers.acceptance import Diverged, Search, Unstable, accepted, check_jacobian, converged, convex
from forward.solvers.anderson import AndersonMixing
from forward.solvers.corrections import ROUNDED, WINDOW, predict_correct
from forward.solvers.joined import load_steps, settled
from forward.solvers.newton import admissible_step, factorise, newton
from forward.solvers.settings import SolverSettings
from forward.solvers.steps import Corrector, Steps, plain
from forward.solvers.system import Found, Residual, System
from forward.solvers.way import Way

ASTRAY = 100  # relative residual after all allowed corrections: the reference is too far away


def solving(
    system: System,
    settings: SolverSettings,
    zero: FloatArray,
    start: FloatArray | None = None,
    way: Way | None = None,
    iterations: int | None = None,
    *,
    audit: bool = False,
) -> Steps[Found]:
    """Find the equilibrium at full load: from `start` if that converges, else by adaptive load steps from `zero`.

    Parameters
    ----------
    system
        The discrete equations; their `work` counts the cost.
    settings
        Path, tolerance and limits.
    zero
        The undeformed state (U_local,).
    start
        A prediction of the state at full load (U_local,).
    way
        Where the prediction comes from.
    iterations
        Stop after this many iterations from `start`, or from `zero`: corrections with the factor that belongs to `way`
        or, without one, Newton steps. The equilibrium is computed after all if they lead to no admissible state, or if
        they are as many as the settings allow anyway.
    audit
        Whether the path from rest is followed though nothing calls for it.

    Returns
    -------
    Found
        The state, with J > 0 at every quadrature point.

    Raises
    ------
    SolveError
        With the load fraction and the reason where the last attempt stopped, and the history of all attempts.
    """
    attempts = _Attempts(Search(system, settings), zero, way, audit)
    if iterations is not None and iterations < (settings.iterations if way is None else settings.corrections):
        try:
            return (yield from attempts.few(zero if start is None else start, iterations, alone=start is not None))
        except Diverged as stop:
            attempts.search.history.append(f"{stop}: the equilibrium is looked for after all")
            attempts.failed(stop)
    if start is None and settings.kind != "newton" and not system.contact:
        return attempts.from_rest()
    guesses = [zero] if start is None or (settings.kind == "newton" and iterations is None) else [start, zero]
    if way is not None and len(guesses) == 2:
        system.at_load(1.0)
        if system.contact:  # the reference's state may be nearer than the prediction, as where a tool moves far
            predicted, there = (system.residual(system.on_target(u)).size for u in (guesses[0], way.state))
            if there < predicted or not np.isfinite(predicted):
                guesses[0] = way.state
        try:
            return (yield from attempts.corrected(guesses[0], way))
        except Unstable as stop:
            attempts.failed(stop)
            guesses = []  # at full load Newton would find the same equilibrium, or another unstable one
        except Diverged as stop:
            attempts.failed(stop)
            if stop.closest is not None:
                guesses.insert(0, stop.closest)
    for guess in guesses:
        try:
            return (yield from attempts.newton(guess, start))
        except Unstable as stop:
            attempts.failed(stop)
            break
        except Diverged as stop:
            attempts.failed(stop)
    return attempts.from_rest()


@dataclass
class _Attempts:
    """Attempts to find an equilibrium at full load, and what they have shown.

    Attributes
    ----------
    search, zero, way, audit
        As of `solving`.
    refused
        What is known of equilibria that were refused.
    """

    search: Search
    zero: FloatArray
    way: Way | None
    audit: bool
    refused: Stability = Stability.NOT_TESTED

    def failed(self, stop: Diverged) -> None:
        """Note that an attempt has failed."""
        self.refused = max(self.refused, stop.stability)

    def few(self, start: FloatArray, iterations: int, *, alone: bool) -> Steps[Found]:
        """Make a few iterations; what is reached `alone`, without a reference, has no branch."""
        self.search.system.at_load(1.0)
        found = yield from _iterate_few(self.search, start, self.way, iterations)
        if not found.converged or (self.way is None and alone):
            return found
        return (yield from self._settled(found, self.way))

    def corrected(self, start: FloatArray, way: Way) -> Steps[Found]:
        """Correct a prediction with the factor of the reference."""
        found = yield from predict_correct(self.search, start, way)
        return (yield from self._settled(found, way))

    def newton(self, guess: FloatArray, start: FloatArray | None) -> Steps[Found]:
        """Find it by Newton's method from a guess: the prediction `start` or near it, or zero."""
        found = newton(self.search, guess, 1.0)[0]
        if self.way is None or guess is self.zero:
            return (yield from self._settled(found, None, guess))
        return (yield from self._settled(found._replace(predicted=start), self.way))

    def from_rest(self) -> Found:
        """Raise the loads from zero."""
        system = self.search.system
        system.work.audits += not system.contact
        unstable = self.refused != Stability.NOT_TESTED
        try:
            return self._known(load_steps(self.search, self.zero, unstable=unstable))
        except SolveError as error:
            if unstable:
                message = f"{error.reason}; the equilibrium that was found at full load is unstable"
                raise SolveError(message, error.history, error.work, self.refused) from None
            raise

    def _settled(self, found: Found, way: Way | None, before: FloatArray | None = None) -> Steps[Found]:
        return self._known((yield from settled(self.search, found, way, before, audit=self.audit)))

    def _known(self, found: Found) -> Found:
        """Note what has happened on the way: a miss of the screen counts even if another equilibrium is found."""
        self.search.system.work.snaps += found.snapped
        return found._replace(stability=self.refused) if self.refused == Stability.MISSED else found


def _iterate_few(search: Search, start: FloatArray, way: Way | None, iterations: int) -> Steps[Found]:
    """Make this many iterations, fewer if they meet the tolerance; or raise `Diverged`.

    The last state counts, not the one with the smallest residual: the first step of a slender body in bending raises
    the residual although it brings the body closer to equilibrium.
    """
    system = search.system
    u = system.on_target(start)
    residual = system.residual(u)
    mixing: AndersonMixing | None = None
    correct: Corrector = plain
    if way is not None and np.isfinite(residual.size):
        mixing = AndersonMixing(min(iterations, WINDOW), len(u), system.total, system.weights())
        correct = way.corrector(u)
    sizes: list[float] = []
    last: tuple[FloatArray, Residual] | None = None
    for iteration in range(iterations + 1):
        search.history.append(f"iteration {iteration} of {iterations}: relative residual {residual.relative:.3e}")
        if not np.isfinite(residual.size):
            raise Diverged("the state has no finite residual")
        if residual.size > ROUNDED * residual.scale > 0:
            sizes.clear()  # as in `mix`
        if converged(system, search.settings.tolerance, u, residual, sizes):
            if mixing is not None and last is not None and not convex(system, last, (u, residual)):
                raise Diverged("the stiffness is indefinite along the last move")
            stability = yield from accepted(search, u, residual, way if mixing is not None else None)
            return Found(u, residual.relative, corrected=mixing is not None, stability=stability)
        if iteration == iterations:
            break
        last = (u, residual)
        if mixing is not None:
            u = mixing.next(u, residual.vector, (yield from correct(residual.vector)))
            residual = system.residual(u)
        else:
            factorise(system, u)
            u, residual = admissible_step(search, u, system.solve(-residual.vector))
    if mixing is not None and residual.relative > ASTRAY:
        raise Diverged("the reference is too far away")
    check_jacobian(system, u)  # no equilibrium, so neither stable nor unstable
    return Found(u, residual.relative, converged=False, corrected=mixing is not None)
