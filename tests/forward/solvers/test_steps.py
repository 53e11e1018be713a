"""Solvers that ask for back-substitutions, many at once."""

import numpy as np
import pytest

from forward.model import SolveError
from forward.solvers.steps import Task, abreast, finish, finish_all, through


def asking(times, value):
    """Ask for so many solutions, starting with a value; return the last."""
    x = np.array([float(value)])
    for _ in range(times):
        x = yield x
    return float(x[0])


def failed():
    """A solver that has failed before it asks for anything."""
    raise SolveError("broken")
    yield  # a generator


def run(lengths, most, broken=()):
    columns, begun = [], []

    def doubled(rights):
        columns.append(len(rights))
        return 2 * rights

    def tasks():
        for i, length in enumerate(lengths):
            begun.append(i)
            yield Task(failed() if i in broken else asking(length, i), lambda _: None)

    seen = []
    for result in finish_all(tasks(), doubled, most):
        seen.append(result)
        assert len(begun) <= len(seen) + 2 * most
    return seen, columns


@pytest.mark.unit
@pytest.mark.parametrize("most", [1, 3, 50])
def test_results_come_in_turn_whatever_is_together(most):
    lengths = [3, 1, 0, 9, 2, 2, 0, 0, 5, 1, 1, 4]
    seen, columns = run(lengths, most)
    assert seen == [i * 2.0**n for i, n in enumerate(lengths)]
    assert sum(columns) == sum(lengths)
    assert max(columns) == min(most, sum(n > 0 for n in lengths))


@pytest.mark.unit
def test_as_many_as_possible_are_together():
    _, columns = run([1, 2, 3, 4] * 25, 4)
    assert columns[:-4] == [4] * (len(columns) - 4)


@pytest.mark.unit
def test_one_that_takes_long_does_not_let_results_pile_up():
    seen, columns = run([40] + [1] * 30, 4)
    assert seen[1:] == [2.0 * i for i in range(1, 31)]
    assert columns[0] == 4
    assert 1 in columns  # the others wait for the first


@pytest.mark.unit
def test_what_fails_is_returned_in_its_place():
    seen, _ = run([2, 2, 2, 2], 2, broken={1, 3})
    assert [isinstance(one, SolveError) for one in seen] == [False, True, False, True]
    assert seen[2] == 8.0
    assert run([], 4) == ([], [])


@pytest.mark.unit
def test_a_solver_through_an_approximate_inverse():
    def halved(x):
        return (yield x / 2) + 1

    assert finish(through(asking(3, 8.0), halved), lambda x: 2 * x) == 11.0


@pytest.mark.unit
def test_a_solver_asks_for_several_at_once():
    """Alone and among others; each part is resumed before it goes on, with what its own solution was."""
    resumed, sizes = [], []

    def several(lengths):
        tasks = [Task(asking(n, i + 1), lambda count, i=i: resumed.append((i, count))) for i, n in enumerate(lengths)]
        return (yield from abreast(tasks))

    def doubled(rights):
        sizes.append(np.atleast_2d(rights).shape[0])
        return 2 * rights

    assert finish(several([3, 0, 1]), doubled) == [8.0, 2.0, 6.0]
    assert sizes == [2, 1, 1]
    assert resumed == [(0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (0, 1), (0, 1)]
    sizes.clear()
    counted = []
    tasks = [Task(asking(2, 1), lambda _: None), Task(several([2, 2, 1]), counted.append)]
    assert list(finish_all(tasks, doubled, 4)) == [4.0, [4.0, 8.0, 6.0]]
    assert sizes == [4, 3]
    assert counted == [0, 3, 2]


@pytest.mark.unit
def test_of_several_at_once_one_that_fails_ends_all():
    tasks = [Task(asking(2, 1), lambda _: None), Task(failed(), lambda _: None)]
    with pytest.raises(SolveError, match="broken"):
        finish(abreast(tasks), lambda right: right)
