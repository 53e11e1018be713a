"""Equilibria of one body at many points at once: in lockstep, with blocked back-substitutions.

Most of what a corrected sample costs is reading the factor of the reference for one right-hand side at a time. Samples
that are corrected together share each reading; everything else (residuals, rotations, what Anderson mixing remembers,
when to stop, what to do if the reference is too far away) is each sample's own
(docs/decisions/0028-lockstep.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import groupby
from typing import Protocol, TypeVar

from forward.model import FloatArray, Guess, ReferenceSolution, SolveError, Work
from forward.solvers.equilibrium import solving
from forward.solvers.settings import SolverSettings
from forward.solvers.steps import Task, failed
from forward.solvers.system import Found, System, Way


class ResumableWay(Way, Protocol):
    """A path from a reference that others interrupt."""

    def resume(self, work: Work, solved: int) -> None:
        """Set the equations to where they were on this path, and count their work and back-substitutions there."""


P = TypeVar("P")


def by_reference(pairs: Iterable[tuple[P, Guess | None]]) -> Iterator[tuple[bool, Iterator[tuple[P, Guess]]]]:
    """Group consecutive points, with their guesses, by the reference from which their states are predicted.

    Yields
    ------
    tuple
        Whether states of the group are predicted from one reference, and the group.
    """
    last: ReferenceSolution | None = None

    def reference(pair: tuple[P, Guess | None]) -> ReferenceSolution | None:
        nonlocal last
        guess = pair[1]
        if guess is None or guess.state is None or guess.reference is None:
            return None
        if last is None or not last.same(guess.reference):
            last = guess.reference
        return last

    for one, group in groupby(pairs, reference):
        yield one is not None, ((point, guess or Guess()) for point, guess in group)


def task(
    system: System, settings: SolverSettings, zero: FloatArray, way: ResumableWay, guess: Guess, work: Work
) -> Task[Found]:
    """Return the search for an equilibrium from a prediction, among others; its work is added to `work`."""
    steps = solving(system, settings, zero, guess.state, way, guess.iterations, audit=guess.audit)
    return Task(steps, partial(way.resume, work))


def refused(error: SolveError) -> Task[Found]:
    """Return the search where there is no model."""
    return Task(failed(error), lambda _: None)
