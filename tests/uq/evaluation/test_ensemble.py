"""Groups of ranks: same numbers as in one process, no hang when something breaks."""

import sys
import time

import pytest

from tests.launch import on_kept_ranks, run_script

pytestmark = pytest.mark.mpi

STUDY = """
import sys
import time
import weakref
import numpy as np
from mpi4py import MPI
from forward.pointwise import FunctionModel
from forward.model import SolveError
from uq.inputs.distributions import Uniform
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.random_parameters import Inputs
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo

world = MPI.COMM_WORLD
inputs = Inputs({"a": Uniform(lower=0.0, upper=1.0), "b": Uniform(lower=0.0, upper=1.0)})


def function(p):
    if case == "fails" and p[0] > 0.95:
        raise SolveError("too far")
    if case == "breaks" and world.rank == world.size - 1 and p[0] > 0.5:
        raise RuntimeError("a mistake in the model")
    if case == "uneven":
        time.sleep(0.02 * p[0] * (1 + world.rank))
    return np.exp(p[0]) * (1 + p[1])


def sampled(evaluate):
    return SensitivityMonteCarlo(samples=300, seed=3).run(inputs, evaluate)


def many(evaluate):
    # Orders of different length and content in close succession.
    points = np.random.default_rng(0).random((900, 7, 2))
    for i, block in enumerate(points):
        block = block[: 1 + i % 7]
        evaluations = evaluate(Request(block))
        assert (evaluations.outputs[:, 0] == [function(p) for p in block]).all()
    return MonteCarlo(samples=2).run(inputs, evaluate)


def models(evaluate):
    points = np.random.default_rng(0).random((50, 2))
    one = evaluate(Request(points)).outputs
    two = evaluate.on("other")
    assert two.outputs == ("g",)
    assert (two(Request(points)).outputs == 2 * one).all()
    assert (evaluate(Request(points)).outputs == one).all()
    return MonteCarlo(samples=2).run(inputs, evaluate)


def passed(evaluate):
    for name in ("first", "second", "first"):
        there = evaluate.on(name)
        assert there.outputs == (name,)
        there(Request(np.random.default_rng(0).random((9, 2))))
        assert [one.outputs for one in made] == [(name,)], "another one is still in memory"
    return MonteCarlo(samples=2).run(inputs, evaluate)


def method(evaluate):
    raise SolveError("the method gave up")


made = weakref.WeakSet()


def passing(name):
    def make():
        found = FunctionModel(function, ("a", "b"), (name,))
        made.add(found)
        return found

    return make


TASKS = {"many": (many, 3 + sum(1 + i % 7 for i in range(900))), "models": (models, 153), "passing": (passed, None)}
for case in sys.argv[1:]:
    model = FunctionModel(function, ("a", "b"), ("f",), lambda p: [[function(p), np.exp(p[0])]])
    other = FunctionModel(lambda p: 2 * function(p), ("a", "b"), ("g",))
    others = {"other": lambda: other, "first": passing("first"), "second": passing("second")}
    task, expected = TASKS.get(case, (method if case == "method" else sampled, 301))
    counts = [0, 0]

    def count(done, failed):
        counts[0] += done
        counts[1] += failed

    try:
        data = Ensemble.split(world).run(
            model, task, others=others, passing=frozenset({"first", "second"}), progress=count
        )
    except SolveError as error:
        print(f"caught {error}")  # in one piece, among what other ranks print
        sys.exit(1)
    if data is not None:
        lost = 0
        if task is sampled:
            assert data.identical(sampled(SerialEvaluate(model)))
            lost = int((~data.ok).sum())
        assert expected is None or counts == [expected, lost], (case, counts)
        print(case, flush=True)
"""

CASES = ("plain", "fails", "uneven", "many", "models", "passing")


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [pytest.param(2, marks=pytest.mark.slow), 3])  # two are two of three
def test_same_numbers_as_in_one_process(ranks):
    done = run_script(ranks, STUDY, *CASES)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [*CASES]


@pytest.mark.slow
def test_one_process_is_a_group_of_its_own(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["script", *CASES])
    exec(compile(STUDY, "script", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.split() == [*CASES]


def test_a_mistake_on_one_rank_stops_all_ranks():
    begin = time.monotonic()
    done = run_script(3, STUDY, "breaks")
    assert done.returncode != 0
    assert "a mistake in the model" in done.stderr
    assert time.monotonic() - begin < 60


def test_a_method_that_gives_up_releases_the_other_ranks():
    done = on_kept_ranks(2, STUDY, "method")
    assert done.returncode == 1
    assert "caught the method gave up" in done.stdout


def test_ranks_that_cannot_be_split_evenly():
    script = """
from mpi4py import MPI
from uq.evaluation.ensemble import Ensemble
try:
    Ensemble.split(MPI.COMM_WORLD, 3)
except ValueError as error:
    print(error)
"""
    done = on_kept_ranks(2, script)
    assert "2 ranks cannot be split into groups of ranks_per_model = 3" in done.stdout
