"""What estimators promise over many repeats: intervals that contain the truth, and no bias, on an analytic function."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from forward.pointwise import FunctionModel
from tests.functions import AtOnce
from uq.estimators.moments import estimate, monomials
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos, monte_carlo
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.surrogates.linearisation import linearise

INPUTS = Inputs({name: Uniform(lower=0.0, upper=1.0) for name in "abc"})
MODEL = FunctionModel(
    lambda p: (1 + p[0]) * (1 + p[1]) * np.exp(p[2]),
    INPUTS.names,
    ("f",),
    lambda p: [np.exp(p[2]) * np.array([1 + p[1], 1 + p[0], (1 + p[0]) * (1 + p[1])])],
)
MEAN = 1.5**2 * (np.e - 1)
STD = np.sqrt((7 / 3) ** 2 * (np.e**2 - 1) / 2 - MEAN**2)
REPEATS = 200


def repeats(method, count=REPEATS):
    """Deviations of mean and variance from the exact ones, and claimed errors of mean and variance, (4, count)."""
    rows = []
    for seed in range(count):
        data = method.model_copy(update={"seed": seed}).run(INPUTS, AtOnce(MODEL))
        std = data["std"].item()
        errors = data["mean_error"].item(), 2 * std * data["std_error"].item()
        rows.append((data["mean"].item() - MEAN, std**2 - STD**2, *errors))
    return np.array(rows).T


def coverage(found, freedom):
    mean, variance, mean_error, variance_error = found
    t = stats.t.ppf(0.975, freedom)
    return (np.abs(mean) < t * mean_error).mean(), (np.abs(variance) < t * variance_error).mean()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "freedom"),
    [
        (MonteCarlo(samples=200, fields=False), 199),
        (SensitivityMonteCarlo(samples=200, fields=False), 199),
    ],
    ids=("plain", "tangent"),
)
def test_intervals_cover(method, freedom):
    count = 100
    low, high = stats.binom.ppf([0.025, 0.975], count, 0.95) / count  # of 200: 92 and 98 %
    for share in coverage(repeats(method, count), freedom):
        assert low <= share <= high


@pytest.mark.parametrize("coefficient", ["one", "optimal"])
def test_intervals_of_a_fitted_coefficient_cover_from_400_samples_on(coefficient):
    """With fewer the fit to the samples that it corrects shows: 92 % for the variance with 200."""
    n, count = 400, 4000
    points = np.random.default_rng(0).random((n, count, 3))
    values = (1 + points[..., 0]) * (1 + points[..., 1]) * np.exp(points[..., 2])
    slopes = np.sqrt(np.e) * np.array([1.5, 1.5, 2.25])
    nominal = np.full(count, 2.25 * np.sqrt(np.e))
    sums = monomials(values - nominal, (points - 0.5) @ slopes).sum(axis=1)
    found = estimate(sums, n, nominal, np.full(count, slopes @ slopes / 12), coefficient)
    deviations = found.mean - MEAN, found.std**2 - STD**2, found.mean_error, 2 * found.std * found.std_error
    assert all(0.92 <= share <= 0.98 for share in coverage(deviations, n - 1))


@pytest.mark.slow
@pytest.mark.parametrize("gradients", [True, False])
def test_intervals_of_chaos_cover(monkeypatch, gradients):
    """At least: what a polynomial fit leaves is smooth, and integrated better than samples can tell."""
    monkeypatch.setattr(chaos, "DRAWN", 12)
    found = repeats(Chaos(samples=12 if gradients else 30, max_order=3, gradients=gradients))
    mean, variance = coverage(found, 1000)
    assert mean >= 0.92
    assert variance >= 0.92
    # Not by being useless.
    assert np.median(found[2]) < 4 * np.sqrt(np.mean(found[0] ** 2))
    assert np.median(found[3]) < 8 * np.sqrt(np.mean(found[1] ** 2))


# --- no bias -------------------------------------------------------------------------------------------------------


def is_unbiased(deviations):
    return abs(deviations.mean()) < 4 * deviations.std(ddof=1) / np.sqrt(len(deviations))


@pytest.mark.slow
def test_sensitivity_monte_carlo_is_unbiased_and_a_wrong_expansion_point_is_noticed(monkeypatch):
    method = SensitivityMonteCarlo(samples=32, fields=False)
    mean, variance, *_ = repeats(method)
    assert is_unbiased(mean)
    assert is_unbiased(variance)
    elsewhere = Inputs(dict.fromkeys(INPUTS.names, Uniform(lower=-0.1, upper=0.9)))
    monkeypatch.setattr(monte_carlo, "linearise", lambda _, evaluate: linearise(elsewhere, evaluate))
    mean, *_ = repeats(method)
    assert not is_unbiased(mean)


@pytest.mark.slow
def test_a_running_mean_in_the_second_moment_is_noticed(monkeypatch):
    """The square of the deviation from the mean of the same samples, without the variance of that mean."""
    method = MonteCarlo(samples=8, fields=False)
    exact = monte_carlo.estimate

    def running(sums, n, *rest):
        found = exact(sums, n, *rest)
        return replace(found, std=np.sqrt(np.maximum(found.std**2 - found.mean_error**2, 0)))

    assert is_unbiased(repeats(method, 1000)[1])
    monkeypatch.setattr(monte_carlo, "estimate", running)
    assert not is_unbiased(repeats(method, 1000)[1])


@pytest.mark.unit
def test_a_coefficient_fitted_to_the_samples_it_corrects_is_noticed():
    """The optimal coefficient from independent samples has no bias; from the four that it corrects it has one."""
    rng = np.random.default_rng(3)
    centre = linearise(INPUTS, SerialEvaluate(MODEL))

    def estimates(*, reuse):
        points = rng.random((20_000, 2, 4, 3))
        values = (1 + points[..., 0]) * (1 + points[..., 1]) * np.exp(points[..., 2])
        controls = (points - centre.point) @ centre.tangents[0]
        fitted = 0 if reuse else 1
        w, c = values[:, fitted], controls[:, fitted]
        c = c - c.mean(axis=1, keepdims=True)
        slope = (c * w).sum(axis=1) / (c**2).sum(axis=1)
        return values[:, 0].mean(axis=1) - slope * controls[:, 0].mean(axis=1) - MEAN

    assert is_unbiased(estimates(reuse=False))
    assert not is_unbiased(estimates(reuse=True))
