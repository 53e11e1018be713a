"""Finding the equilibrium of a discretised body: predict and correct with a reference factor, Newton, load steps.

From a prediction, `solve` first corrects with the factor of a reference state and Anderson mixing, which needs no
stiffness; where that is slow it goes on with Newton's method, then with adaptive load steps. All of them stop at the
same test of the residual. `solve` can also be told to stop after a few iterations, wherever it is then.

Whole Newton steps are taken wherever the trial state is admissible (energy defined, J > 0 at every quadrature point);
what stops the iteration are steps that grow. A line search on the residual or on the energy, or the natural
monotonicity test of Deuflhard's NLEQ-ERR, would shorten the first step of a slender body in bending, after which the
residual is 5000 times and the simplified correction 380 times larger although Newton converges in six more
iterations; where whole steps fail, smaller load steps succeed (docs/decisions/0002-newton-globalisation.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import Field

from forward.model import FloatArray, SolveError, Stability, Work
from forward.settings import Settings
from forward.solvers.anderson import AndersonMixing, Inverse
from forward.solvers.stability import NOT_SCREENED, Screened


class SolverSettings(Settings):
    """Path, tolerance and limits of the solver.

    Parameters
    ----------
    kind
        "predict-correct" uses a prediction and a reference factor where the method has them, and the last factor for
        more than one correction; "newton" is the textbook: from zero, a new factor for every step. Where a method
        counts iterations, both go from its prediction.
    tolerance
        Largest residual of the free unknowns, relative to the loads (and to the reactions where displacements are
        prescribed); in the mixed form, also of the volumes, as the force of the pressure that they lack.
    derivative_tolerance
        Largest error of a tangent or adjoint of a solution that was found with a reference factor, relative to its
        size. Derivatives of other solutions are exact.
    iterations
        Newton iterations allowed in one load step.
    corrections
        Corrections with a reference factor that are allowed before Newton takes over.
    minimum_damping
        Shortest fraction of a Newton step that is tried where the whole step is not admissible.
    minimum_load_step
        Smallest load step, as a fraction of the load, before the solver gives up.
    solve_seconds
        Longest time (s, by the clock) for one solve, after which it has failed; none by default. It is looked at
        between iterations. Whether a solve that takes about so long fails depends on the machine.
    accept_unstable
        Whether an equilibrium counts where the stiffness has negative eigenvalues (the body has buckled). Nothing is
        then spent on looking for them.
    """

    kind: Literal["predict-correct", "newton"] = "predict-correct"
    tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-8
    derivative_tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-6
    iterations: Annotated[int, Field(ge=1)] = 25
    corrections: Annotated[int, Field(ge=1)] = 40
    minimum_damping: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    minimum_load_step: Annotated[float, Field(gt=0, le=1)] = 1 / 8192
    solve_seconds: Annotated[float, Field(gt=0)] | None = None
    accept_unstable: bool = False


QUICK = 5  # a load step that needs no more iterations than this lets the next one be twice as long
GROWTH = 4.0  # a Newton step that is longer than all before by this factor means divergence
WINDOW = 8  # differences that Anderson mixing keeps
PATIENCE = 6  # corrections without a smaller residual before they are given up
ROUGH = 1e-2  # relative residual of a state that only serves to predict the next
SHORTEST = 1 / 8  # part of the way from the reference that is not divided any more
NEAR = 0.2  # a Newton step shorter than this part of the last: its factor is good for more than one correction
POLISH = 8  # corrections with the factor of a Newton step
ROUNDED = 1e-2  # relative residual above which a correction that does not help has not met rounding
ASTRAY = 100  # relative residual after the corrections that were allowed: the reference is too far away
SQUEEZED = 0.3  # J of a cell that is worth a word where the load cannot be raised
LOCATED = 1 / 64  # load step that is not halved any more where it leads to an unstable equilibrium
STALLED = 0.5  # a residual that falls by less may have met its floor of rounding


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
    gap
        Largest distance of a prescribed unknown from its target (m).
    volume
        Norm of the volumes out of balance, of all ranks, as a force (N); 0 where they are rounding, and where
        pressures are no unknowns.
    """

    vector: FloatArray
    size: float
    scale: float
    gap: float
    volume: float = 0.0

    @property
    def relative(self) -> float:
        """The residual relative to the loads."""
        largest = max(self.size, self.volume)
        return largest / self.scale if self.scale > 0 else largest


class System(Protocol):
    """A nonlinear system at a load fraction, and the linear system of its factorised stiffness.

    Vectors hold this rank's part; every method is collective over the ranks of the system.
    """

    work: Work

    def at_load(self, fraction: float) -> None:
        """Scale all loads and prescribed displacements."""

    def on_target(self, u: FloatArray) -> FloatArray:
        """Return u with the prescribed unknowns at their targets."""

    def residual(self, u: FloatArray) -> Residual:
        """Return the imbalance at u."""

    def rounding(self, u: FloatArray, scale: float) -> float:
        """What the size of a residual with this scale cannot be expected to fall below at u, whatever the loads (N)."""

    def factorise(self, u: FloatArray) -> None:
        """Assemble and factorise the stiffness at u.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = right with the factor at hand; prescribed rows are identities."""

    def total(self, values: FloatArray) -> FloatArray:
        """Sum over all ranks."""

    def curvature(self, move: FloatArray, change: FloatArray) -> float:
        """Second difference of the energy along a move, from the change of the residual's vector."""

    def weights(self) -> FloatArray:
        """What turns a residual's vector into forces (N)."""

    def norm(self, x: FloatArray) -> float:
        """Euclidean norm over the displacements of all ranks (pressures, in another unit, follow them)."""

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest J = det F over the quadrature points of all ranks."""

    def inertia(self) -> int | None:
        """Number of negative eigenvalues of the factorised stiffness of displacements; None if unknown.

        A stable state has none. Those that belong to pressures (one each, whatever the state) do not count.
        """

    def negative_eigenvalues(self, u: FloatArray) -> int | None:
        """Factorise the stiffness at u; return the same of it, or of its symmetric part where it is not symmetric.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """


class Way(Protocol):
    """The way in parameters from a reference state, whose factor is at hand, to the values that are asked for."""

    @property
    def state(self) -> FloatArray:
        """The state (U_local,) of the reference."""

    @property
    def draw(self) -> float:
        """A number in [0, 1) that depends on the parameters only: states are counted where it is small."""

    def screen(self, u: FloatArray, residual: Residual) -> Screened:
        """Return what the screen of `forward.solvers.stability` says of an equilibrium."""

    def at(self, fraction: float) -> None:
        """Give the system the parameters after a part of the way."""

    def inverse(self, u: FloatArray) -> Inverse:
        """Return an approximate inverse of the stiffness at u."""


class Found(NamedTuple):
    """A state (U_local,) and what is known of it.

    Attributes
    ----------
    state
        The state.
    residual
        Its relative residual.
    converged
        Whether it is an equilibrium to the solver's tolerance.
    corrected
        Whether it was found with the factor of the reference.
    stability
        How its stability was looked at; where that is by counting, the last factor is that of the stiffness there.
    """

    state: FloatArray
    residual: float
    converged: bool = True
    corrected: bool = False
    stability: Stability = Stability.NOT_TESTED


class _Diverged(Exception):  # noqa: N818 - control flow inside this file
    """An attempt at one load failed, for the reason given."""


class _Unstable(_Diverged):
    """An equilibrium was found that is not stable."""

    def __init__(self, negative: int, *, missed: bool) -> None:
        what = f"the equilibrium is unstable (its stiffness has {_counted(negative)})"
        super().__init__(f"{what}: the body buckles, or its mesh is too coarse")
        self.stability = Stability.MISSED if missed else Stability.REFUSED


def solve(
    system: System,
    settings: SolverSettings,
    zero: FloatArray,
    start: FloatArray | None = None,
    way: Way | None = None,
    iterations: int | None = None,
) -> Found:
    """Find the equilibrium at full load: directly if that converges, else by adaptive load steps from `zero`.

    Parameters
    ----------
    system
        The body; its `work` counts what is spent.
    settings
        Path, tolerance and limits.
    zero
        The undeformed state (U_local,).
    start
        A prediction of the state at full load (U_local,).
    way
        Where the prediction comes from.
    iterations
        Stop after so many iterations from `start`, or from `zero`: corrections with the factor that belongs to `way`
        or, without one, Newton steps. The equilibrium is looked for after all where they lead to no admissible state,
        and where they are as many as the settings allow at all.

    Returns
    -------
    Found
        The state, with J > 0 at every quadrature point.

    Raises
    ------
    SolveError
        With the load fraction and the reason where the last attempt stopped, and the history of all attempts.
    """
    history: list[str] = []
    refused = Stability.NOT_TESTED  # of equilibria at full load

    def failed(stop: _Diverged) -> None:
        nonlocal refused
        if isinstance(stop, _Unstable):
            refused = max(refused, stop.stability)

    def known(found: Found) -> Found:
        # What the screen has missed is to be known, even where another equilibrium is found in its place.
        return found._replace(stability=refused) if refused == Stability.MISSED else found

    if iterations is not None and iterations < (settings.iterations if way is None else settings.corrections):
        system.at_load(1.0)
        try:
            return _iterate_few(system, settings, zero if start is None else start, way, iterations, history)
        except _Diverged as stop:
            history.append(f"{stop}: the equilibrium is looked for after all")
            failed(stop)
    from_zero = start is None or (settings.kind == "newton" and iterations is None)
    guesses = [zero] if start is None or from_zero else [start, zero]
    if way is not None and len(guesses) == 2:
        system.at_load(1.0)
        try:
            return known(_predict_correct(system, settings, guesses[0], way, history))
        except _Diverged as stop:
            failed(stop)
    for guess in guesses:
        try:
            return known(_newton(system, settings, guess, history, 1.0)[0])
        except _Diverged as stop:
            failed(stop)
    try:
        return known(_load_steps(system, settings, zero, history))
    except SolveError as error:
        if refused != Stability.NOT_TESTED:
            message = f"{error.reason}; the equilibrium that was found at full load is unstable"
            raise SolveError(message, error.history, error.work, refused) from None
        raise


def _iterate_few(
    system: System, settings: SolverSettings, start: FloatArray, way: Way | None, iterations: int, history: list[str]
) -> Found:
    """Make so many iterations, fewer if they meet the tolerance; or raise `_Diverged`.

    What counts is the last state and not that with the smallest residual: the first step of a slender body in bending
    raises the residual although it brings the body closer.
    """
    u = system.on_target(start)
    residual = system.residual(u)
    mixing = None
    if way is not None and np.isfinite(residual.size):
        window = min(iterations, WINDOW)
        mixing = AndersonMixing(way.inverse(u), window, len(u), system.total, system.weights())
    sizes: list[float] = []
    last: tuple[FloatArray, Residual] | None = None
    for iteration in range(iterations + 1):
        history.append(f"iteration {iteration} of {iterations}: relative residual {residual.relative:.3e}")
        if not np.isfinite(residual.size):
            message = "the state has no finite residual"
            raise _Diverged(message)
        if residual.size > ROUNDED * residual.scale > 0:
            sizes.clear()  # as in `_mix`
        if _converged(system, settings.tolerance, u, residual, sizes):
            if mixing is not None and last is not None and not _convex(system, last, (u, residual)):
                message = "the stiffness is indefinite along the last move"
                raise _Diverged(message)
            stability = _accepted(system, settings, u, residual, way if mixing is not None else None, history)
            return Found(u, residual.relative, corrected=mixing is not None, stability=stability)
        if iteration == iterations:
            break
        last = (u, residual)
        if mixing is not None:
            u = mixing.next(u, residual.vector)
            residual = system.residual(u)
        else:
            _factorise(system, u)
            u, residual = _admissible_step(system, settings, u, system.solve(-residual.vector))
    if mixing is not None and residual.relative > ASTRAY:
        message = "the reference is too far away"
        raise _Diverged(message)
    _check_jacobian(system, u)  # no equilibrium, so neither stable nor unstable
    return Found(u, residual.relative, converged=False, corrected=mixing is not None)


def _convex(system: System, before: tuple[FloatArray, Residual], now: tuple[FloatArray, Residual]) -> bool:
    """Whether the energy is convex along a move; where it is not, only a factor can tell what the state is."""
    return system.curvature(now[0] - before[0], now[1].vector - before[1].vector) >= 0


def _predict_correct(
    system: System, settings: SolverSettings, start: FloatArray, way: Way, history: list[str]
) -> Found:
    """Correct a prediction with a reference factor, in steps along the way where one is too long; or raise `_Diverged`.

    With s the slope of the prediction, the state after a part t of the way is ū + t s + t² q(t). The first step takes
    q = 0; each state that is found gives a value of q, through the last two of which the next is predicted.
    """
    slope = start - way.state
    known: list[tuple[float, FloatArray]] = []
    reached, target = 0.0, 1.0
    while True:
        way.at(target)
        guess = way.state + target * slope + target**2 * _line(known, target)
        tolerance = settings.tolerance if target == 1 else ROUGH
        history.append(f"prediction at {target:.6g} of the way from the reference")
        u = system.on_target(guess)
        residual = system.residual(u)
        close = np.isfinite(residual.size)
        if close:
            u, residual, close = _mix(system, tolerance, u, residual, way.inverse(u), settings.corrections, history)
        if close and target == 1:
            stability = _accepted(system, settings, u, residual, way, history)
            return Found(u, residual.relative, corrected=True, stability=stability)
        if close:
            known.append((target, ((u - way.state) / target - slope) / target))
            reached, target = target, 1.0
        elif target - reached > SHORTEST:
            target = (reached + target) / 2
        else:
            way.at(1.0)
            message = "the reference is too far away"
            history.append(message)
            raise _Diverged(message)


def _line(known: list[tuple[float, FloatArray]], t: float) -> FloatArray | float:
    """Value at t of the line through the last two of the points known, of the constant through one, or zero."""
    if not known:
        return 0.0
    (b, q) = known[-1]
    if len(known) == 1:
        return q
    (a, p) = known[-2]
    return np.asarray(p + (t - a) / (b - a) * (q - p))


def _mix(
    system: System,
    tolerance: float,
    u: FloatArray,
    residual: Residual,
    inverse: Inverse,
    limit: int,
    history: list[str],
) -> tuple[FloatArray, Residual, bool]:
    """Correct u with one factor; return the best state, its residual, and whether it is an equilibrium."""
    mixing = AndersonMixing(inverse, WINDOW, len(u), system.total, system.weights())
    best, smallest, since = u, residual, 0
    sizes: list[float] = []
    last: tuple[FloatArray, Residual] | None = None
    for iteration in range(limit + 1):
        history.append(f"correction {iteration}: relative residual {residual.relative:.3e}")
        if residual.size > ROUNDED * residual.scale > 0:
            sizes.clear()  # corrections falter before they are close
        if _converged(system, tolerance, u, residual, sizes):
            convex = last is None or _convex(system, last, (u, residual))
            return u, residual, convex and system.smallest_jacobian(u) > 0
        if iteration > 0 and residual.size < smallest.size:
            best, smallest, since = u, residual, 0
        else:
            since += 1
        if iteration == limit or since > PATIENCE:
            break
        last = (u, residual)
        u = mixing.next(u, residual.vector)
        residual = system.residual(u)
        if not np.isfinite(residual.size):
            history.append("correction: the state has no finite residual")
            break
    return best, smallest, False


def _converged(system: System, tolerance: float, u: FloatArray, residual: Residual, sizes: list[float]) -> bool:
    """Whether a state is an equilibrium to the tolerance or, where the residual no longer falls, to rounding.

    `sizes` are those of the residuals before, to which this one is added.
    """
    if residual.gap != 0:
        return False
    size = max(residual.size, residual.volume)
    if size <= tolerance * residual.scale:
        return True
    stalled = bool(sizes) and size > STALLED * sizes[-1]
    sizes.append(size)
    return (residual.scale == 0 or stalled) and size <= system.rounding(u, residual.scale)


def _load_steps(system: System, settings: SolverSettings, zero: FloatArray, history: list[str]) -> Found:
    """Raise the load from zero; halve the step where Newton fails, double it where it is quick."""
    reached, step = 0.0, 0.5
    found, slope = Found(zero, 0.0), np.zeros_like(zero)
    while reached < 1:
        load = min(1.0, reached + step)
        try:
            # The secant through the last two states predicts the next one.
            there, iterations = _newton(system, settings, found.state + (load - reached) * slope, history, load)
        except _Diverged as stop:
            step /= 2
            slope = np.zeros_like(zero)
            smallest = settings.minimum_load_step
            if isinstance(stop, _Unstable):
                smallest = max(smallest, LOCATED)  # smaller steps find the same branch and where it ends
            if step < smallest:
                message = f"stopped at {100 * reached:.4g} % of the load: {stop}"
                jacobian = system.smallest_jacobian(found.state)
                if jacobian < SQUEEZED:
                    message += f"; before, cells are already squeezed to J = {jacobian:.2g}"
                raise SolveError(message, history, system.work) from None
            continue
        slope = (there.state - found.state) / (load - reached)
        found, reached = there, load
        system.work.load_steps += 1
        if iterations <= QUICK:
            step *= 2
    return found


def _newton(
    system: System, settings: SolverSettings, u: FloatArray, history: list[str], load: float
) -> tuple[Found, int]:
    """Iterate at one load; return the state and the number of iterations, or raise `_Diverged`."""
    system.at_load(load)
    try:
        return _iterate(system, settings, u, history, load)
    except _Diverged as stop:
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
        raise _Diverged(message)
    for iteration in range(settings.iterations + 1):
        history.append(f"load {load:.6g} iteration {iteration}: relative residual {residual.relative:.3e}")
        if _converged(system, settings.tolerance, u, residual, sizes):
            return Found(u, residual.relative, stability=_accepted(system, settings, u, residual)), iteration
        if iteration == settings.iterations:
            break
        _factorise(system, u)
        step = system.solve(-residual.vector)
        before, length = length, system.norm(step)
        if not np.isfinite(length) or (iteration > 0 and length > GROWTH * longest):
            raise _Diverged("the Newton steps grow" + _instability(system))
        longest = max(longest, length)
        u, residual = _admissible_step(system, settings, u, step)
        if settings.kind != "newton" and length < NEAR * before < np.inf:
            u, residual, reached = _mix(system, settings.tolerance, u, residual, system.solve, POLISH, history)
            if reached:
                return Found(u, residual.relative, stability=_accepted(system, settings, u, residual)), iteration + 1
    message = f"no convergence in {settings.iterations} iterations (relative residual {residual.relative:.3g})"
    raise _Diverged(message + _instability(system))


def _factorise(system: System, u: FloatArray) -> None:
    try:
        system.factorise(u)
    except SolveError as error:
        raise _Diverged(error.reason) from None


def _accepted(
    system: System,
    settings: SolverSettings,
    u: FloatArray,
    residual: Residual,
    way: Way | None = None,
    history: list[str] | None = None,
) -> Stability:
    """Look at an equilibrium: no cell is turned inside out and it is not unstable, or raise `_Diverged`.

    What counts is the stiffness at the state itself, however it was found. Only where a reference is at hand may a
    screen take the place of counting its negative eigenvalues.
    """
    _check_jacobian(system, u)
    if settings.accept_unstable:
        return Stability.NOT_TESTED
    seen = NOT_SCREENED
    if way is not None:
        seen = way.screen(u, residual)
        if history is not None:
            history.append(f"stability: stiffness over that of the reference {seen.lowest:.3g} to {seen.largest:.3g}")
        if way.draw >= seen.chance:
            return Stability.SCREENED
    try:
        negative = system.negative_eigenvalues(u)
    except SolveError as error:
        raise _Diverged(error.reason) from None
    if negative is None:
        return Stability.NOT_TESTED
    if negative > 0:
        raise _Unstable(negative, missed=seen.clear)
    return Stability.COUNTED


def _check_jacobian(system: System, u: FloatArray) -> None:
    jacobian = system.smallest_jacobian(u)
    if not jacobian > 0:
        message = f"a cell is turned inside out (smallest J = {jacobian:.3g})"
        raise _Diverged(message)


def _admissible_step(
    system: System, settings: SolverSettings, u: FloatArray, step: FloatArray
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
    negative = system.inertia()
    if negative is None or negative <= 0:
        return ""
    return f"; the last stiffness has {_counted(negative)} (unstable, or far from equilibrium)"


def _counted(negative: int) -> str:
    return f"{negative} negative eigenvalue{'' if negative == 1 else 's'}"
