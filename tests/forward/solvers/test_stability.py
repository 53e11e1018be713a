"""The stability map tells right answers, explained failures, wrong answers and silent failures apart."""

import signal
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import stability
from forward.model import SolveError

pytestmark = pytest.mark.fem


@pytest.fixture(scope="module")
def case():
    return replace(next(stability.cells()), finer=None)


def test_an_answer_that_every_check_confirms(case):
    row = stability.run(case)
    assert row.outcome == "converged"
    assert row.note == ""
    assert row.factorisations >= 2
    assert row.negative == 0
    assert max(row.residual, row.correction, row.path) < 1e-8
    assert 1e2 < row.condition < 1e4


@pytest.mark.slow
def test_a_failure_is_explained(case):
    ((path, traction),) = case.numbers
    soon = case.spec.model_copy(update={"solver": case.spec.solver.model_copy(update={"minimum_load_step": 1e-2})})
    row = stability.run(replace(case, spec=soon, numbers=((path, 1e6 * traction),)))
    assert row.outcome == "failed"
    assert row.note.startswith("stopped at ")


def test_a_wrong_answer_is_found(case, monkeypatch):
    solve = stability.within_limit
    monkeypatch.setattr(stability, "within_limit", lambda model, point: solve(model, point * (1 + 1e-5)))
    row = stability.run(case)
    assert row.outcome == "WRONG"
    assert "not converged" in row.note
    assert "another state" in row.note


@pytest.mark.parametrize("error", [SolveError("something went wrong"), ZeroDivisionError("by zero"), stability.Hang()])
def test_what_is_not_explained_is_silent(case, monkeypatch, error):
    def fail(model, point):
        raise error

    monkeypatch.setattr(stability, "within_limit", fail)
    row = stability.run(case)
    assert row.outcome == "SILENT"
    assert row.note


def test_a_solve_without_end_is_stopped(monkeypatch):
    class Endless:
        def solve(self, point):
            while True:
                pass

    monkeypatch.setattr(stability, "LIMIT", 1)
    with pytest.raises(stability.Hang):
        stability.within_limit(Endless(), np.zeros(1))
    assert signal.alarm(0) == 0


def test_the_condition_number_is_that_of_the_stiffness(case):
    spec = case.spec
    model = spec.build(stability.MPI.COMM_SELF, ())
    body = model.solve(np.empty(0)).linearise()
    free = np.setdiff1d(np.arange(body.size), body.fixed)
    unit = np.eye(body.size)
    stiffness = np.array([body.stiffness_times(unit[i])[free] for i in free])
    assert 0.7 < stability.condition(body) / np.linalg.cond(stiffness) < 1 + 1e-9  # an estimate from below
