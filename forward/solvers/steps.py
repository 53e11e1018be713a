"""Solvers that ask for back-substitutions instead of making them, so that those of many states can be made at once.

Such a solver is a generator: it yields a right-hand side (n,), or several (k, n), is sent what solves them, and returns
its result. Meanwhile others may use the same equations.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
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
    """Make the back-substitutions, (n,) → (n,) or of rows, that a solver asks for in turn; return its result."""
    try:
        right = next(steps)
        while True:
            right = steps.send(solve(right))
    except StopIteration as stop:
        result: T = stop.value
        return result


def through(steps: Steps[T], correct: Corrector) -> Steps[T]:
    """Return a solver whose back-substitutions are those of an approximate inverse."""
    try:
        right = next(steps)
        while True:
            right = steps.send((yield from correct(right)))
    except StopIteration as stop:
        result: T = stop.value
        return result


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


def _moved(task: Task[T], answer: FloatArray | None, end: Callable[[T], None]) -> FloatArray | None:
    """Begin, or go on with an answer: return what is asked for next, or hand the result to `end` and return None."""
    task.resume(0 if answer is None else 1 if answer.ndim == 1 else len(answer))
    try:
        return next(task.steps) if answer is None else task.steps.send(answer)
    except StopIteration as stop:
        end(stop.value)
        return None


def abreast(tasks: Sequence[Task[T]]) -> Steps[list[T]]:
    """Return a solver that asks at once, as rows (k, n), for what these solvers ask for one by one.

    Its result is that of each. It fails as soon as one does.
    """
    results: dict[int, T] = {}
    answers: dict[int, FloatArray | None] = dict.fromkeys(range(len(tasks)))
    while answers:
        waiting: dict[int, FloatArray] = {}
        for i, answer in answers.items():
            found = _moved(tasks[i], answer, partial(results.__setitem__, i))
            if found is not None:
                waiting[i] = found
        answers = dict(zip(waiting, (yield np.array(list(waiting.values()))), strict=True)) if waiting else {}
    return [results[i] for i in range(len(tasks))]


def finish_all(
    tasks: Iterable[Task[T]], solve: Callable[[FloatArray], FloatArray], most: int
) -> Iterator[T | SolveError]:
    """Make the back-substitutions (k, n) → (k, n) that up to `most` solvers ask for together.

    As one ends, the next begins; no further ahead of the first one that has not ended than twice as many. Which are
    together depends on them alone, not on when results are asked for.

    Yields
    ------
    object
        The result of each in turn, or why it has none. One without a result does not change those of the others, but
        for rounding: how many right-hand sides are solved for at once decides in which order numbers are added.
    """
    coming = enumerate(tasks)
    results: dict[int, T | SolveError] = {}
    waiting: list[tuple[int, Task[T], FloatArray]] = []  # for the solution of a right-hand side
    due = 0  # the next result
    more = True

    def moved(i: int, task: Task[T], answer: FloatArray | None) -> None:
        try:
            found = _moved(task, answer, partial(results.__setitem__, i))
        except SolveError as error:
            results[i] = error
            return
        if found is not None:
            waiting.append((i, task, found))

    while waiting or more:
        if waiting:
            answers = solve(np.concatenate([np.atleast_2d(right) for _, _, right in waiting]))
            before, waiting, first = waiting, [], 0
            for i, task, right in before:
                rows = np.atleast_2d(right).shape[0]
                moved(i, task, answers[first] if right.ndim == 1 else answers[first : first + rows])
                first += rows
        begun = due + len(results) + len(waiting)
        while more and len(waiting) < most and begun < due + 2 * most:
            found = next(coming, None)
            more = found is not None
            if found is not None:
                moved(*found, None)
                begun += 1
        while due in results:
            yield results.pop(due)
            due += 1
