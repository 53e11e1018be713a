"""Solvers that ask for back-substitutions instead of making them, so that those of many states can be made at once.

Such a solver is a generator: it yields a right-hand side (n,), is sent the solution, and returns its result. Meanwhile
others may use the same equations.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from forward.model import FloatArray, SolveError

T = TypeVar("T")
Steps = Generator[FloatArray, FloatArray, T]
Corrector = Callable[[FloatArray], Steps[FloatArray]]  # applies an approximate inverse to (n,)


def plain(right: FloatArray) -> Steps[FloatArray]:
    """Apply the inverse itself."""
    return (yield right)


def finish(steps: Steps[T], solve: Callable[[FloatArray], FloatArray]) -> T:
    """Make the back-substitutions (n,) → (n,) that a solver asks for one by one; return its result."""
    try:
        right = next(steps)
        while True:
            right = steps.send(solve(right))
    except StopIteration as stop:
        result: T = stop.value
        return result


def finished(steps: Steps[T], solve: Callable[[FloatArray], FloatArray]) -> Steps[T]:
    """Return a solver that asks for nothing: `finish`."""
    return finish(steps, solve)
    yield  # a generator


@dataclass(frozen=True, eq=False)
class Task(Generic[T]):
    """A solver among others that share the equations.

    Attributes
    ----------
    steps
        The solver.
    resume
        Sets the equations to its point, before each of its steps, given how many solutions it is about to be sent.
    """

    steps: Steps[T]
    resume: Callable[[int], None]


def finish_all(tasks: Sequence[Task[T]], solve: Callable[[FloatArray], FloatArray]) -> list[T | SolveError]:
    """Make the back-substitutions (k, n) → (k, n) that several solvers ask for together.

    Returns
    -------
    list
        The result of each, or why it has none. One without a result does not change those of the others, but for
        rounding: how many right-hand sides are solved for at once decides in which order numbers are added.
    """
    results: list[T | SolveError | None] = [None] * len(tasks)
    active, answers = list(range(len(tasks))), None
    while active:
        waiting, rights = [], []
        for row, i in enumerate(active):
            task = tasks[i]
            task.resume(0 if answers is None else 1)
            try:
                rights.append(next(task.steps) if answers is None else task.steps.send(answers[row]))
                waiting.append(i)
            except StopIteration as stop:
                results[i] = stop.value
            except SolveError as error:
                results[i] = error
        active = waiting
        if rights:
            answers = solve(np.array(rights))
    return results  # type: ignore[return-value]
