"""Quantiles far out hold, rise with the probability, or have no end: functions whose quantiles are known."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.coverage import Case, Vectorised
from benchmarks.quantiles import LEVELS, cases, measure
from uq.estimators.quantiles import quantiles_from_replicates, quantiles_of_predictions
from uq.findings import findings
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

KNOWN = {known.case.name: known for known in cases()}
FAR = {"fields": False, "quantiles": LEVELS}


def evaluate(name, seed):
    known = KNOWN[name]
    return Vectorised(Case(name, known.case.function, known.inputs(seed)))


@pytest.fixture(autouse=True)
def fewer_points_of_expansions(monkeypatch):
    monkeypatch.setattr(chaos, "DRAWN", 15)


def at_least(held, count):
    """Whether so many of these intervals hold that their claim of 95 % may be true."""
    return (held * count >= stats.binom.ppf(0.001, count, 0.95)).all()


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("name", "method", "count"),
    [
        ("2 Pareto", MonteCarlo(samples=64, **FAR), 40),
        ("2 Pareto", QuasiMonteCarlo(samples=64, control="none", **FAR), 40),
        ("4 log-normals", QuasiMonteCarlo(samples=64, control="chaos", **FAR), 8),
        ("4 log-normals", Chaos(samples=30, **FAR), 8),
        ("table, exp", Chaos(samples=30, **FAR), 8),
    ],
    ids=lambda one: getattr(one, "kind", one),
)
def test_intervals_far_out_hold_and_rise(name, method, count):
    """Intervals of order statistics that go on exponentially hold 0 to 40 % of the outermost quantiles."""
    row = measure(KNOWN[name], method, count)
    assert at_least(row.held, count), row.held
    assert row.rising == 1


def test_what_samples_do_not_tell_has_no_end_and_is_said():
    data = MonteCarlo(samples=64, **FAR).run(KNOWN["2 Pareto"].inputs(0), evaluate("2 Pareto", 0))
    low, up = data["quantiles_lower"].to_numpy()[:, 0], data["quantiles_upper"].to_numpy()[:, 0]
    p = np.array(LEVELS)
    np.testing.assert_array_equal(np.isinf(low), 64 * p < 1)
    np.testing.assert_array_equal(np.isinf(up), 64 * (1 - p) < 1)
    said = next(one for one in findings(data) if one.code == "quantiles-endless")
    assert said.severity == "note"
    assert "0.01 %, 0.1 %, 1 %, 99 %, 99.9 %, 99.99 %" in said.text
    usual = MonteCarlo(samples=64, fields=False).run(KNOWN["2 Pareto"].inputs(0), evaluate("2 Pareto", 0))
    assert not [one for one in findings(usual) if one.code == "quantiles-endless"]


@pytest.mark.slow
def test_an_expansion_as_control_tells_quantiles_that_samples_do_not():
    """A smooth function: intervals a tenth as wide, and beyond the samples there are some."""
    rows = [
        measure(KNOWN["5 squares of normals"], QuasiMonteCarlo(samples=64, control=control, **FAR), 6)
        for control in ("none", "chaos")
    ]
    assert at_least(rows[1].held, 6)
    inner = slice(3, 8)
    assert (rows[1].width[inner] < 0.1 * rows[0].width[inner]).all()
    assert np.isfinite(rows[1].width).all()
    assert np.isinf(rows[0].width[[0, -1]]).all()


@pytest.mark.unit
def test_errors_of_predictions_are_those_of_samples_near_the_quantile():
    """Of what is left, ±0.1 above the median and nothing below; a norm that no sample shows is Chebyshev's bound."""
    x = np.linspace(0, 1, 4001)[:, None]
    at, part = np.linspace(0, 1, 100)[:, None], np.arange(4001) % 4
    left = np.where(at > 0.5, 0.1, 0.0)
    found = quantiles_of_predictions(x, part, at, left, np.ones(100), (0.2, 0.8, 0.999))
    np.testing.assert_allclose(found.upper - found.central, [[0.0], [0.196], [0.196 * 10**0.5]], atol=2e-2)
    missing = quantiles_of_predictions(x, part, at, 0 * left, np.ones(100), (0.01, 0.5), np.array([0.03]))
    np.testing.assert_allclose(missing.upper - missing.central, [[0.588], [0.0588 * 2**0.5]], rtol=1e-2)


def test_replicates_do_not_agree_on_what_none_of_them_has_met():
    """Sets of four points: the share above the largest value but one is the same in nearly all of them."""
    p = 0.98
    exact, held = stats.norm.ppf(p), []
    for seed in range(60):
        cubes = [sobol_points(seed, r, 0, 4, 1) for r in range(16)]
        values = Inputs({"x": Normal(mean=0.0, std=1.0)}).points(np.concatenate(cubes))
        found = quantiles_from_replicates(values, np.repeat(np.arange(16), 4), (p,))
        held.append(found.lower.item() <= exact <= found.upper.item())
    assert at_least(np.array([np.mean(held)]), 60)
