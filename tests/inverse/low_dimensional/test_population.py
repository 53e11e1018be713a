"""Populations: closed forms of normal specimens, coverage, and correlation matrices."""

import re

import numpy as np
import pytest

from inverse.low_dimensional.population import Fit, Hyperprior, Specimen, _roots, fitted
from inverse.methods.population import Columns
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.random_parameters import Inputs


@pytest.mark.parametrize("width", [0.05, 0.4])  # of a population, over the errors of its specimens
def test_specimens_are_shrunken_as_the_closed_form_says(width):
    rng = np.random.default_rng(1)
    z = rng.standard_normal((4000, 1)) * 0.5 + 2
    z = 2 + 0.5 * (z - z.mean()) / z.std()
    one = Specimen(z, np.full(4000, 1 / 4000), np.zeros(4000), 4000.0)  # a flat prior
    fit = Fit(np.full((4000, 1), 1.5), np.full((4000, 1, 1), (0.5 * width) ** 2), 4000.0, (one,))
    draws, size = fit.estimates(0, 0)
    precision = 1 / 0.25 + 1 / (0.5 * width) ** 2
    assert draws.mean() == pytest.approx((2 / 0.25 + 1.5 / (0.5 * width) ** 2) / precision, abs=0.03)
    assert draws.std() == pytest.approx(precision**-0.5, rel=0.1)
    assert size < 4000


def test_the_mean_of_a_population_of_known_specimens_is_theirs():
    rng = np.random.default_rng(2)
    truth = rng.normal(1.0, 0.3, 40)
    specimens = []
    for one in truth:
        z = one + 1e-3 * rng.standard_normal((50, 1))
        specimens.append(Specimen(z, np.full(50, 0.02), np.zeros(50), 50.0))
    fit = fitted(specimens, Hyperprior(np.zeros(1), np.ones(1)), 1000, 0, steps=200)
    assert fit.mean.mean() == pytest.approx(truth.mean(), abs=0.01)
    assert fit.mean.std() == pytest.approx(truth.std() / np.sqrt(40), rel=0.15)
    assert fit.std.mean() == pytest.approx(truth.std(ddof=1), rel=0.1)


def test_covariates_move_the_mean_as_a_regression_says():
    """Known specimens around a line in a grade: slope, its error, what is left, and a new specimen of a grade."""
    rng = np.random.default_rng(4)
    grade = np.repeat([1.0, 2.0, 3.0, 4.0], 10)
    truth = 1 + 0.5 * grade + rng.normal(0, 0.2, 40)
    specimens = []
    for one in truth:
        z = one + 1e-3 * rng.standard_normal((50, 1))
        specimens.append(Specimen(z, np.full(50, 0.02), np.zeros(50), 50.0))
    x = (grade - grade.mean())[:, None]
    fit = fitted(specimens, Hyperprior(np.zeros(1), np.full(1, 2.0)), 1000, 0, steps=300, covariates=x)
    line = np.polyfit(grade, truth, 1)
    left = float(np.std(truth - np.polyval(line, grade), ddof=2))
    assert fit.slopes.mean() == pytest.approx(line[0], abs=0.01)
    assert fit.slopes.std() == pytest.approx(left / np.linalg.norm(x), rel=0.2)
    assert fit.std.mean() == pytest.approx(left, rel=0.1)
    new = fit.predictive(0, np.array([5.0 - grade.mean()]))
    assert new.mean() == pytest.approx(np.polyval(line, 5.0), abs=0.05)
    without = fitted(specimens, Hyperprior(np.zeros(1), np.full(1, 2.0)), 1000, 0, steps=300)
    assert without.std.mean() > 2.5 * left  # the grade is then a part of how specimens vary


def test_covariates_are_numbers_or_words():
    names = ["one", "two", "three", "four"]
    region = dict(zip(names, ("cortex", "thalamus", "cortex", "corona"), strict=True))
    found = Columns.of({"region": region}, names)
    assert found.names == ("region = cortex", "region = thalamus")
    assert (found.values + found.means).tolist() == [[1, 0], [0, 1], [1, 0], [0, 0]]
    assert (found.row({"region": "thalamus"}) + found.means).tolist() == [0, 1]
    assert found.row({}).tolist() == [0, 0]
    grade = Columns.of({"grade": {"one": 1.0, "two": 2.0, "three": 3.0, "four": 2.0}}, names)
    assert grade.row({"grade": 4.0}).tolist() == [2.0]
    for wrong, said in (
        ({"grade": {"one": 1.0, "tow": 2.0}}, "'tow' is not a specimen; did you mean 'two'?"),
        ({"grade": {"one": 1.0, "two": 2.0}}, "nothing is said of three, four"),
        ({"grade": dict.fromkeys(names, 1.0)}, "the same for all specimens"),
        ({"grade": region | {"one": 1.0}}, "numbers and words"),
        ({"a": region, "b": region}, "4 numbers to find for each parameter from 4 specimens"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)):
            Columns.of(wrong, names)
    for new, said in (({"graed": 1.0}, "did you mean 'grade'?"), ({"grade": "high"}, "expected a number")):
        with pytest.raises(ValueError, match=re.escape(said)):
            grade.row(new)


def test_intervals_hold_what_they_claim():
    """Some of the 200 populations of `python -m benchmarks population`."""
    from benchmarks.population import coverage

    found = coverage(range(12), steps=150, draws=400)
    assert found["specimens"].mean() == pytest.approx(0.95, abs=0.05)
    assert min(found["typical"].mean(), found["spread"].mean(), found["new specimen"].mean()) >= 0.8


@pytest.mark.parametrize("d", [2, 3])
def test_correlations_have_the_density_that_is_said(d):
    """Draws of y by their density are those of det R: for d = 2, p has the density 3/4 (1 − p²)."""
    y = np.random.default_rng(0).normal(0, 1.2, (200_000, d * (d - 1) // 2))
    roots, logs = _roots(y, d)
    matrices = roots @ np.swapaxes(roots, 1, 2)
    np.testing.assert_allclose(np.einsum("aii->ai", matrices), 1, atol=1e-12)
    weights = np.exp(logs + (y**2).sum(axis=1) / 2 / 1.44)
    weights /= weights.sum()
    second = np.einsum("a,aij->ij", weights, matrices**2)
    # Each correlation is beta(η + (d − 2)/2) on (−1, 1): variance 1/(2η + d − 1), η = 2.
    np.testing.assert_allclose(second[~np.eye(d, dtype=bool)], 1 / (3 + d), rtol=0.03)


def test_densities_of_correlated_priors():
    from scipy.stats import multivariate_normal

    inputs = Inputs({"a": Normal(mean=1.0, std=2.0), "b": Normal(mean=0.0, std=0.5)}, (("a", "b", 0.6),))
    points = np.random.default_rng(0).standard_normal((5, 2))
    exact = multivariate_normal([1, 0], [[4, 0.6], [0.6, 0.25]]).logpdf(points)
    np.testing.assert_allclose(inputs.log_density(points), exact, rtol=1e-10)
    assert Inputs({"a": Uniform(lower=0.0, upper=2.0)}).log_density(np.array([[1.0], [3.0]])).tolist() == [
        pytest.approx(np.log(0.5)),
        -np.inf,
    ]
