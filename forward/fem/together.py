"""Equilibria of one body at many points at once: in lockstep, with blocked back-substitutions.

Most of what a corrected sample costs is reading the factor of the reference for one right-hand side at a time. Samples
that are corrected together share each reading; everything else (residuals, rotations, what Anderson mixing remembers,
when to stop, what to do if the reference is too far away) is each sample's own
(docs/decisions/0028-lockstep.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

from forward.model import FloatArray, Guess, SolveError, Work
from forward.solvers.equilibrium import solving
from forward.solvers.settings import SolverSettings
from forward.solvers.steps import Task, finish_all
from forward.solvers.system import Found, System, Way


class ResumableWay(Way, Protocol):
    """A path from a reference that others interrupt."""

    def resume(self, work: Work, solved: int) -> None:
        """Set the equations to where they were on this path, and count their work and back-substitutions there."""


class Outcome(NamedTuple):
    """What became of a point.

    Attributes
    ----------
    found
        The state, or why there is none.
    work
        What it took.
    """

    found: Found | SolveError
    work: Work


def from_one_reference(guesses: Sequence[Guess | None]) -> list[Guess] | None:
    """Return the guesses if all of them predict a state from the same reference."""
    found = [guess for guess in guesses if guess is not None and guess.state is not None]
    references = [guess.reference for guess in found if guess.reference is not None]
    if len(references) < len(guesses) or not all(references[0].same(other) for other in references[1:]):
        return None
    return found


def find_together(
    system: System,
    settings: SolverSettings,
    zero: FloatArray,
    starts: Sequence[tuple[ResumableWay, Guess]],
    solve: Callable[[FloatArray], FloatArray],
) -> list[Outcome]:
    """Find equilibria from predictions with one reference, whose factor solves for (k, n) right-hand sides."""
    works = [Work() for _ in starts]
    tasks = [
        Task(solving(system, settings, zero, guess.state, way, guess.iterations), partial(way.resume, work))
        for (way, guess), work in zip(starts, works, strict=True)
    ]
    results = finish_all(tasks, solve)
    return [Outcome(found, work) for found, work in zip(results, works, strict=True)]
