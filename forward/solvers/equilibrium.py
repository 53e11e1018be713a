"""Finding the equilibrium of a discretised body: predict and correct with a reference factor, Newton, load steps.

From a prediction, `solving` first corrects with the factor of a reference state and Anderson mixing, which needs no
stiffness; if that is slow it continues with Newton's method, then with adaptive load steps. Without a prediction it
begins with these. All of them use the same residual test, and the answer is the equilibrium that is joined to rest
(`joined`), whichever of them finds it. It can also be told to stop after a few iterations, wherever it is then.

Full Newton steps are taken wherever the trial state is admissible (energy defined, J > 0 at every quadrature point);
the iteration stops when steps grow. A line search on the residual or on the energy, or the natural
monotonicity test of Deuflhard's NLEQ-ERR, would shorten the first step of a slender body in bending, after which the
residual is 5000 times and the simplified correction 380 times larger although Newton converges in six more
iterations; where whole steps fail, smaller load steps succeed (docs/decisions/0002-newton-globalisation.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from forward.model import FloatArray, SolveError, Stability
from forward.solvers.acceptance import Diverged, Unstable, accepted, check_jacobian, converged, convex
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
    search = _Search(system, settings, zero, way, audit)
    if iterations is not None and iterations < (settings.iterations if way is None else settings.corrections):
        try:
            return (yield from search.few(zero if start is None else start, iterations, alone=start is not None))
        except Diverged as stop:
            search.history.append(f"{stop}: the equilibrium is looked for after all")
            search.failed(stop)
    if start is None and settings.kind != "newton" and not system.contact:
        return search.from_rest()
    guesses = [zero] if start is None or (settings.kind == "newton" and iterations is None) else [start, zero]
    if way is not None and len(guesses) == 2:
        if system.contact:
            guesses[0] = _closer(system, guesses[0], way.state)
        system.at_load(1.0)
        try:
            return (yield from search.corrected(guesses[0], way))
        except Unstable as stop:
            search.failed(stop)
            guesses = []  # at full load Newton would find the same equilibrium, or another unstable one
        except Diverged as stop:
            search.failed(stop)
            if stop.closest is not None:
                guesses.insert(0, stop.closest)
    for guess in guesses:
        try:
            return (yield from search.newton(guess, start))
        except Unstable as stop:
            search.failed(stop)
            break
        except Diverged as stop:
            search.failed(stop)
    return search.from_rest()


@dataclass
class _Search:
    """Attempts to find an equilibrium at full load, and what they have shown.

    Attributes
    ----------
    system, settings, zero, way, audit
        As of `solving`.
    history
        Their iterations.
    refused
        What is known of equilibria that were refused.
    """

    system: System
    settings: SolverSettings
    zero: FloatArray
    way: Way | None
    audit: bool
    history: list[str] = field(default_factory=list)
    refused: Stability = Stability.NOT_TESTED

    def failed(self, stop: Diverged) -> None:
        """Note that an attempt has failed."""
        self.refused = max(self.refused, stop.stability)

    def few(self, start: FloatArray, iterations: int, *, alone: bool) -> Steps[Found]:
        """Make a few iterations; what is reached `alone`, without a reference, has no branch."""
        self.system.at_load(1.0)
        found = yield from _iterate_few(self.system, self.settings, start, self.way, iterations, self.history)
        if not found.converged or (self.way is None and alone):
            return found
        return (yield from self._settled(found, self.way))

    def corrected(self, start: FloatArray, way: Way) -> Steps[Found]:
        """Correct a prediction with the factor of the reference."""
        found = yield from predict_correct(self.system, self.settings, start, way, self.history)
        return (yield from self._settled(found, way))

    def newton(self, guess: FloatArray, start: FloatArray | None) -> Steps[Found]:
        """Find it by Newton's method from a guess: the prediction `start` or near it, or zero."""
        found = newton(self.system, self.settings, guess, self.history, 1.0)[0]
        if self.way is None or guess is self.zero:
            return (yield from self._settled(found, None, guess))
        return (yield from self._settled(found._replace(predicted=start), self.way))

    def from_rest(self) -> Found:
        """Raise the loads from zero."""
        self.system.work.audits += not self.system.contact
        unstable = self.refused != Stability.NOT_TESTED
        try:
            return self._known(load_steps(self.system, self.settings, self.zero, self.history, unstable=unstable))
        except SolveError as error:
            if unstable:
                message = f"{error.reason}; the equilibrium that was found at full load is unstable"
                raise SolveError(message, error.history, error.work, self.refused) from None
            raise

    def _settled(self, found: Found, way: Way | None, before: FloatArray | None = None) -> Steps[Found]:
        answer = settled(self.system, self.settings, self.zero, found, self.history, way, before, audit=self.audit)
        return self._known((yield from answer))

    def _known(self, found: Found) -> Found:
        """Note what has happened on the way: a miss of the screen counts even if another equilibrium is found."""
        self.system.work.snaps += found.snapped
        return found._replace(stability=self.refused) if self.refused == Stability.MISSED else found


def _closer(system: System, start: FloatArray, other: FloatArray) -> FloatArray:
    """Return the prediction, or the state of the reference if its residual is smaller, as where a tool moves far."""
    system.at_load(1.0)
    predicted, there = (system.residual(system.on_target(u)).size for u in (start, other))
    return other if there < predicted or not np.isfinite(predicted) else start


def _iterate_few(
    system: System, settings: SolverSettings, start: FloatArray, way: Way | None, iterations: int, history: list[str]
) -> Steps[Found]:
    """Make this many iterations, fewer if they meet the tolerance; or raise `Diverged`.

    The last state counts, not the one with the smallest residual: the first step of a slender body in bending raises
    the residual although it brings the body closer to equilibrium.
    """
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
        history.append(f"iteration {iteration} of {iterations}: relative residual {residual.relative:.3e}")
        if not np.isfinite(residual.size):
            raise Diverged("the state has no finite residual")
        if residual.size > ROUNDED * residual.scale > 0:
            sizes.clear()  # as in `mix`
        if converged(system, settings.tolerance, u, residual, sizes):
            if mixing is not None and last is not None and not convex(system, last, (u, residual)):
                raise Diverged("the stiffness is indefinite along the last move")
            tested = accepted(system, settings, u, residual, way if mixing is not None else None, history)
            stability = yield from tested
            return Found(u, residual.relative, corrected=mixing is not None, stability=stability)
        if iteration == iterations:
            break
        last = (u, residual)
        if mixing is not None:
            u = mixing.next(u, residual.vector, (yield from correct(residual.vector)))
            residual = system.residual(u)
        else:
            factorise(system, u)
            u, residual = admissible_step(system, settings, u, system.solve(-residual.vector))
    if mixing is not None and residual.relative > ASTRAY:
        raise Diverged("the reference is too far away")
    check_jacobian(system, u)  # no equilibrium, so neither stable nor unstable
    return Found(u, residual.relative, converged=False, corrected=mixing is not None)
