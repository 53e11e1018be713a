"""Whether a state is an equilibrium, and a stable one."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

from forward.model import FloatArray, SolveError, Stability
from forward.solvers.settings import SolverSettings
from forward.solvers.stability import NOT_SCREENED
from forward.solvers.steps import Steps
from forward.solvers.system import NoConvergence, Residual, System
from forward.solvers.way import Way

STALLED = 0.5  # a residual that falls by less may have reached rounding


@dataclass(frozen=True)
class Search:
    """A search for equilibria of a system, and what it has gone through so far, a line for each residual.

    The system's `work` counts the cost; settings are path, tolerance and limits.
    """

    system: System
    settings: SolverSettings
    history: list[str] = field(default_factory=list)


class Diverged(Exception):  # noqa: N818 - control flow of the solvers
    """An attempt at one load failed, for the reason given; `closest` is a state from which to try again, if known.

    Its `stability` is that of an equilibrium that was refused.
    """

    stability = Stability.NOT_TESTED

    def __init__(self, reason: str, closest: FloatArray | None = None) -> None:
        super().__init__(reason)
        self.closest = closest


class Unstable(Diverged):
    """An equilibrium was found that is not stable."""

    def __init__(self, negative: int, *, missed: bool) -> None:
        what = f"the equilibrium is unstable (its stiffness has {_counted(negative)})"
        super().__init__(f"{what}: the body buckles, or its mesh is too coarse")
        self.stability = Stability.MISSED if missed else Stability.REFUSED


def converged(system: System, tolerance: float, u: FloatArray, residual: Residual, sizes: list[float]) -> bool:
    """Whether a state is an equilibrium to the tolerance or, where the residual no longer falls, to rounding.

    `sizes` are those of the previous residuals, to which this one is appended.
    """
    if residual.gap != 0:
        return False
    size = max(residual.size, residual.volume)
    if size <= tolerance * residual.scale:
        return True
    stalled = bool(sizes) and size > STALLED * sizes[-1]
    sizes.append(size)
    return (residual.scale == 0 or stalled) and size <= system.rounding(u, residual.scale)


def convex(system: System, before: tuple[FloatArray, Residual], now: tuple[FloatArray, Residual]) -> bool:
    """Whether the energy is convex along a move; if not, only a factorisation can tell what the state is."""
    return system.curvature(now[0] - before[0], now[1].vector - before[1].vector) >= 0


def accepted(search: Search, u: FloatArray, residual: Residual, way: Way | None = None) -> Steps[Stability]:
    """Check that an equilibrium has no inverted cell and is not unstable, or raise `Diverged`.

    What counts is the stiffness at the state itself, however it was found. Only with a reference solution may a screen
    replace counting its negative eigenvalues, and Lanczos' process the factor that they are counted with.
    """
    system = search.system
    check_jacobian(system, u)
    if search.settings.accept_unstable:
        return Stability.NOT_TESTED
    seen = NOT_SCREENED
    if way is not None:
        seen = yield from way.screen(u, residual)
        text = f"stability: stiffness over that of the reference {seen.lowest:.3g} to {seen.largest:.3g}"
        search.history.append(text)
        if way.draw >= seen.chance:
            return Stability.SCREENED
        if seen.clear and (yield from way.definite(u, residual)):
            return Stability.COUNTED
    try:
        negative = system.negative_eigenvalues(u)
    except SolveError as error:
        raise Diverged(error.reason) from None
    if negative is None:
        return Stability.NOT_TESTED
    if negative > 0:
        raise Unstable(negative, missed=seen.clear)
    return Stability.COUNTED


def check_jacobian(system: System, u: FloatArray) -> None:
    """Raise `Diverged` if a cell is inverted."""
    jacobian = system.smallest_jacobian(u)
    if not jacobian > 0:
        raise Diverged(f"a cell is turned inside out (smallest J = {jacobian:.3g})")


def instability(system: System) -> str:
    """Say what the last factor tells about a failure; empty if it shows no negative eigenvalue."""
    negative = None
    with suppress(NoConvergence):  # that is not what has failed
        negative = system.inertia()
    if negative is None or negative <= 0:
        return ""
    return f"; the last stiffness has {_counted(negative)} (unstable, or far from equilibrium)"


def _counted(negative: int) -> str:
    return f"{negative} negative eigenvalue{'' if negative == 1 else 's'}"
