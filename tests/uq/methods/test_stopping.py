"""How long methods go on: samples, tolerance, budget."""

import math
from dataclasses import replace

import numpy as np
import pytest

from forward.pointwise import FunctionModel
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import Evaluate, Evaluations, Request
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

INPUTS = Inputs({"a": Uniform(lower=0.0, upper=1.0), "b": Uniform(lower=0.0, upper=1.0)})
MODEL = FunctionModel(
    lambda p: np.exp(p[0]) * (1 + p[1]),
    ("a", "b"),
    ("f",),
    lambda p: [[np.exp(p[0]) * (1 + p[1]), np.exp(p[0])]],
)


class OneSecond(Recorder):
    """Every solve takes one second."""

    def __call__(self, request: Request) -> Evaluations:
        found = super().__call__(request)
        return replace(found, seconds=np.ones(len(found.points)))


METHODS = [
    MonteCarlo(budget_seconds=300),
    QuasiMonteCarlo(budget_seconds=300, control="none"),
    Chaos(budget_seconds=30, tolerance=1e-14, max_order=2),
]


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.kind)
def test_a_budget_is_used_and_kept(method: MonteCarlo | QuasiMonteCarlo | Chaos) -> None:
    evaluate = OneSecond(SerialEvaluate(MODEL))
    data = method.run(INPUTS, evaluate)
    assert method.budget_seconds is not None
    assert 0.5 * method.budget_seconds <= evaluate.solves <= method.budget_seconds
    assert f"budget_seconds = {method.budget_seconds:g} pays for" in data.attrs["stopped"]


def test_whichever_comes_first() -> None:
    def stopped(**amount: float) -> str:
        return str(MonteCarlo(**amount).run(INPUTS, OneSecond(SerialEvaluate(MODEL))).attrs["stopped"])  # type: ignore[arg-type]

    assert "tolerance 0.05 met" in stopped(tolerance=0.05, budget_seconds=1e6, samples=5000)
    assert "not met" in stopped(tolerance=1e-6, budget_seconds=100, samples=5000)
    assert "100 samples, as asked" in stopped(budget_seconds=1e6, samples=100)


@pytest.mark.unit
def test_other_models_are_evaluated_and_charged() -> None:
    double = replace(MODEL, function=lambda p: 2 * np.exp(p[0]) * (1 + p[1]))
    first: Evaluate = SerialEvaluate(MODEL, others={"double": double})
    recorder = Recorder(first)
    points = np.random.default_rng(0).random((5, 2))
    one, two = recorder(Request(points)), recorder.on("double")(Request(points))
    np.testing.assert_array_equal(two.outputs, 2 * one.outputs)
    assert recorder.solves == 10
    assert recorder.seconds > 0


@pytest.mark.unit
def test_a_budget_pays_for_what_is_left_of_it():
    """Of 25 s, 10 solves have taken 10: the other 15 s pay for 15."""
    budget = MonteCarlo(budget_seconds=25.0)
    assert budget.affordable(10, 10.0) == pytest.approx(15)
    assert budget.affordable(10, 25.0) == 0
    assert budget.affordable(10, 50.0) == 0
    assert budget.affordable(10, 0.0) == math.inf
    assert MonteCarlo(samples=10).affordable(10, 10.0) == math.inf
    accurate = MonteCarlo(tolerance=1e-3)
    assert accurate.met(1e-3)
    assert not accurate.met(1.001e-3)
    assert not budget.met(0.0)
