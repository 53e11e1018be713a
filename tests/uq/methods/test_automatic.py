"""The method that is chosen for a tolerance, against closed forms; and the others that stop at one."""

import json

import numpy as np
import pytest

from forward.pointwise import FunctionModel
from uq.accuracy.goal import Goal
from uq.estimators.moments import half_width
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.findings import findings
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.automatic import Automatic
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

UNIT = Uniform(lower=0.0, upper=1.0)


pytestmark = pytest.mark.usefixtures("few_draws")


def exponential(p):
    return np.array([np.exp(p[0] + 0.5 * p[1])])


def exponential_slopes(p):
    return exponential(p)[:, None] * np.array([[1.0, 0.5]])


# ∫ exp(a x) over [0, 1].
def moment(a):
    return (np.exp(a) - 1) / a


MEAN = moment(1.0) * moment(0.5)
STD = np.sqrt(moment(2.0) * moment(1.0) - MEAN**2)


def hinge(p):
    return np.array([max(p[0] + p[1] - 1, 0.0)])


def hinge_slopes(p):
    return float(p[0] + p[1] > 1) * np.ones((1, 2))


HINGE = (1 / 6, np.sqrt(1 / 12 - 1 / 36))  # of a triangular sum


def model(function, slopes=None):
    return SerialEvaluate(FunctionModel(function, ("a", "b"), ("y",), slopes))


def two(marginal=UNIT, **more):
    return Inputs({"a": marginal, "b": marginal}, **more)


def solved(method, inputs, evaluate, goal):
    recorder = Recorder(evaluate)
    found = method.until(inputs, recorder, goal)
    return found, recorder.solves


def chosen(found):
    return json.loads(found.attrs["chosen"])


@pytest.mark.parametrize("tolerance", [1e-2, pytest.param(1e-4, marks=pytest.mark.slow), 1e-6])
def test_a_smooth_model_takes_an_expansion(tolerance):
    found, solves = solved(
        Automatic(), two(), model(exponential, exponential_slopes), Goal.of(tolerance, ["1"], 10_000)
    )
    assert chosen(found)["method"] == "chaos"
    assert solves <= 40
    assert abs(found["mean"].item() / MEAN - 1) < tolerance
    assert abs(found["std"].item() / STD - 1) < tolerance
    assert "Polynomial chaos" in chosen(found)["reasons"][0]


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_kink_takes_quasi_monte_carlo(seed):
    goal = Goal.of(2e-3, ["1"], 10_000)
    found, solves = solved(Automatic(seed=seed), two(), model(hinge, hinge_slopes), goal)
    assert chosen(found)["method"] == "quasi-monte-carlo"
    assert solves < 3_000  # plain Monte Carlo would take more than a million
    assert abs(found["mean"].item() / HINGE[0] - 1) < 2 * 2e-3
    assert abs(found["std"].item() / HINGE[1] - 1) < 2e-3
    first, last = chosen(found)["reasons"]
    assert "samples are predicted" in first
    assert f"{solves:,} solves" in last


@pytest.mark.parametrize("method", [Automatic(seed=4), Chaos(samples=300, seed=4)], ids=["automatic", "chaos"])
def test_first_samples_that_are_explained_are_not_believed(method):
    """The first of them may all lie on one side of a jump, where the function is linear."""
    seen = []

    def function(p):
        seen.append(p)
        return np.array([p[0] + (len(seen) > FEW)])

    FEW = 1 + 4  # the mean parameters and the first samples
    evaluate = model(function, lambda p: np.array([[1.0, 0.0]]))
    goal = Goal.of(1e-2, ["1"], 40)
    found, _ = solved(method, two(), evaluate, goal)
    assert len(seen) > FEW
    assert goal.reached({name: found[name].to_numpy() for name in ("mean", "mean_error", "std", "std_error")}) > 1


def test_without_derivatives_and_with_correlations():
    goal = Goal.of(1e-2, ["1"], 10_000)
    plain, solves = solved(Automatic(), two(), model(exponential), goal)
    assert chosen(plain)["method"] == "chaos"
    assert solves < 60
    correlated = two(Normal(mean=0.5, std=0.1), correlations=(("a", "b", 0.7),))
    found, _ = solved(Automatic(), correlated, model(exponential, exponential_slopes), goal)
    assert "correlated" in chosen(found)["reasons"][0]
    variance = 0.01 * (1 + 0.25 + 0.7)
    mean = np.exp(0.75 + variance / 2)
    assert abs(found["mean"].item() / mean - 1) < 1e-2
    assert abs(found["std"].item() / (mean * np.sqrt(np.expm1(variance))) - 1) < 1e-2


def test_tails_are_waited_for():
    found, _ = solved(
        Automatic(),
        two(LogNormal(mean=1.0, std=0.3)),
        model(lambda p: p[:1] / p[1:], lambda p: np.array([[1 / p[1], -p[0] / p[1] ** 2]])),
        Goal.of(1e-2, ["1"], 10_000),
    )
    s = np.log(1.09)  # ln(a/b) has twice that variance
    mean = np.exp(s)
    assert abs(found["mean"].item() / mean - 1) < 1e-2
    assert abs(found["std"].item() / (mean * np.sqrt(np.expm1(2 * s))) - 1) < 1e-2


def test_the_most_solves_are_the_most():
    goal = Goal.of(1e-6, ["1"], 300)
    found, solves = solved(Automatic(), two(), model(hinge, hinge_slopes), goal)
    assert solves <= 300
    assert goal.reached({name: found[name].values for name in ("mean", "std", "mean_error", "std_error")}) > 1


def test_outputs_that_vanish_or_do_not_vary_ask_for_nothing():
    def function(p):
        return np.array([p[0] + 2 * p[1], 1e-15 * np.sin(1e3 * p[0]), 3.0])

    evaluate = SerialEvaluate(FunctionModel(function, ("a", "b"), ("y", "zero", "constant")))
    found, solves = solved(Automatic(), two(), evaluate, Goal.of(1e-4, ["m", "m", "m"], 1000))
    assert solves < 20
    assert found["mean"].sel(output="y").item() == pytest.approx(1.5, rel=1e-4)


@pytest.mark.parametrize(
    "method",
    [
        MonteCarlo(samples=100_000),
        SensitivityMonteCarlo(samples=100_000),
        QuasiMonteCarlo(samples=2**16),
        QuasiMonteCarlo(samples=2**16, control="chaos"),
        Chaos(samples=1000),
    ],
    ids=lambda method: f"{method.kind} {getattr(method, 'control', '')}",
)
def test_a_given_method_stops_at_the_goal(method):
    goal = Goal.of(2e-2, ["1"], 50_000)
    found, solves = solved(method, two(), model(exponential, exponential_slopes), goal)
    assert method.aims
    assert abs(found["mean"].item() / MEAN - 1) < 2e-2
    assert abs(found["std"].item() / STD - 1) < 2e-2
    assert solves < (20_000 if method.kind == "monte-carlo" else 3_000)
    assert "as asked" not in found.attrs["stopped"]
    assert not any(one.severity == "error" for one in findings(found))


def test_where_half_as_many_samples_more_are_enough_scrambles_are_added():
    goal = Goal.of(0.03, ["1"], 10_000)
    found, solves = solved(QuasiMonteCarlo(samples=8192, control="none", fields=False), two(), model(hinge), goal)
    n = 16
    assert int(found["scramble"].max()) + 1 == 24
    assert solves == 1 + 24 * n
    # The same points as if there had been so many from the start, and the same estimates.
    plain = QuasiMonteCarlo(samples=24 * n, scrambles=24, control="none", fields=False)
    whole = plain.run(two(), model(hinge))
    for name in ("points", "scramble", "mean", "mean_error", "std", "std_error", "round"):
        assert np.array_equal(found[name], whole[name])
    few = QuasiMonteCarlo(samples=16 * n, control="none", fields=False).run(two(), model(hinge))
    widths = [half_width(one) * one["std_error"].item() / one["std"].item() for one in (few, found)]
    assert widths[0] > 0.03 >= widths[1]
    # As many as are allowed, and no more.
    fewer = Goal.of(goal.tolerance, ["1"], 300)
    _, solves = solved(QuasiMonteCarlo(samples=8192, control="none", fields=False), two(), model(hinge), fewer)
    assert solves == 1 + 16 * n


def test_it_does_nothing_without_a_tolerance():
    with pytest.raises(ValueError, match=r"accuracy\.tolerance"):
        Automatic().run(two(), model(hinge))
    assert not Chaos(fit="projection").aims
