"""Estimators against closed forms and against their own error estimates."""

import numpy as np
import pytest
from scipy import stats

from uq.estimators.moments import estimate, estimate_from_replicates, monomials
from uq.estimators.quantiles import quantiles

REPEATS, N = 2000, 100
# w = x + x²/5 with x ~ N(0, 1) has mean 1/5 and variance 1 + 2/25.
MEAN, STD = 0.2, np.sqrt(1.08)


def repeats(**settings):
    """Many independent estimates at once: the shape of the quantity is the number of repeats."""
    x = np.random.default_rng(1).normal(size=(N, REPEATS))
    w = x + x**2 / 5
    zero = np.zeros(REPEATS)
    if settings.pop("plain", False):
        return estimate(monomials(w, None).sum(axis=1), N, zero)
    return estimate(monomials(w, x).sum(axis=1), N, zero, zero + 1, **settings)


@pytest.mark.unit
def test_plain_estimates_are_numpys():
    x = np.random.default_rng(0).normal(3, 2, size=(50, 4))
    reference = np.full(4, 2.9)
    m = estimate(monomials(x - reference, None).sum(axis=1), 50, reference)
    np.testing.assert_allclose(m.mean, x.mean(axis=0))
    np.testing.assert_allclose(m.std, x.std(axis=0, ddof=1))
    np.testing.assert_allclose(m.mean_error, x.std(axis=0, ddof=1) / np.sqrt(50))


VARIANTS = [
    {"plain": True},
    {"coefficient": "one"},
    {"coefficient": "optimal"},
    {"coefficient": "one", "second_moment": "linear"},
]


@pytest.mark.parametrize("settings", VARIANTS, ids=str)
def test_unbiased_with_honest_errors(settings):
    m = repeats(**settings)
    # The optimal coefficient is estimated on the same samples, which biases by O(1/n).
    slack = 0.3 / N if settings.get("coefficient") == "optimal" else 0
    assert abs(m.mean.mean() - MEAN) < 4 * m.mean.std() / np.sqrt(REPEATS) + slack
    assert abs((m.std**2).mean() - STD**2) < 4 * (m.std**2).std() / np.sqrt(REPEATS) + 4 * slack
    assert m.mean_error.mean() == pytest.approx(m.mean.std(), rel=0.1)
    assert m.std_error.mean() == pytest.approx(m.std.std(), rel=0.15)


def test_variance_ratio_is_what_is_gained():
    gained = repeats(plain=True).mean.var() / repeats(coefficient="one").mean.var()
    assert np.median(repeats(coefficient="one").variance_ratio) == pytest.approx(gained, rel=0.2)
    assert gained > 10


def test_a_control_that_hurts_is_dropped():
    x = np.random.default_rng(2).normal(size=(N, REPEATS))
    zero = np.zeros(REPEATS)
    m = estimate(monomials(x, -x).sum(axis=1), N, zero, zero + 1, "one")
    np.testing.assert_array_equal(m.coefficient, 0)
    np.testing.assert_array_equal(m.variance_ratio, 1)
    plain = estimate(monomials(x, None).sum(axis=1), N, zero)
    np.testing.assert_array_equal(m.mean_error, plain.mean_error)
    optimal = estimate(monomials(x, -x).sum(axis=1), N, zero, zero + 1, "optimal")
    np.testing.assert_allclose(optimal.coefficient, -1)


@pytest.mark.unit
def test_expansion_away_from_the_mean_is_caught():
    """A control whose mean is not zero biases the estimate: the check above would fail."""
    x = np.random.default_rng(1).normal(size=(N, REPEATS))
    m = estimate(monomials(x, x + 0.1).sum(axis=1), N, np.zeros(REPEATS), np.ones(REPEATS), "one")
    assert abs(m.mean.mean()) > 4 * max(m.mean.std(), 1e-12) / np.sqrt(REPEATS)


@pytest.mark.unit
def test_nodes_that_do_not_move_have_no_error():
    sums = monomials(np.zeros((10, 3)), np.zeros((10, 3))).sum(axis=1)
    m = estimate(sums, 10, np.zeros(3), np.zeros(3), "optimal")
    for value in (m.mean, m.mean_error, m.std, m.std_error):
        np.testing.assert_array_equal(value, 0)


@pytest.mark.unit
def test_an_estimated_variance_below_nothing_has_a_finite_error():
    """The square of a mean that is known badly may exceed the mean of the squares."""
    means = np.random.default_rng(0).normal(size=(2, 16, 500)) * [[[0.3]], [[1e-2]]]
    found = estimate_from_replicates(means, np.zeros(500))
    clipped = found.std == 0
    assert clipped.any()
    assert np.isfinite(found.std_error).all()
    assert (found.std_error[clipped] > 0).all()


EXACT = {np.random.Generator.random: stats.uniform, np.random.Generator.standard_exponential: stats.expon}


@pytest.mark.slow
@pytest.mark.parametrize("n", [16, 24, 40, 400])
@pytest.mark.parametrize("draw", [np.random.Generator.random, np.random.Generator.standard_exponential])
def test_quantile_intervals_cover(n, draw):
    """Between order statistics; beyond the samples where a tail has less than four; of less than one without end."""
    probabilities = (0.05, 0.5, 0.95)
    exact = EXACT[draw].ppf(probabilities)[:, None]
    found = quantiles(draw(np.random.default_rng(3), (n, 2000)), probabilities)
    held = ((found.lower <= exact) & (exact <= found.upper)).mean(axis=1)
    endless = np.isinf(found.error).all(axis=1)
    np.testing.assert_array_equal(endless, [n == 16, False, n == 16])
    assert ((held > 0.93) & (held < np.where(endless, 1.0, 0.985))).all(), held
    assert ((np.abs(found.central - exact) <= 1.96 * found.error).mean(axis=1) >= held).all()


@pytest.mark.unit
def test_the_interval_of_the_median_lies_between_the_order_statistics_of_the_binomial_distribution():
    """Of 25 samples, X_(8) and X_(18) hold it with 95.7 %, X_(9) and X_(17) with 89 %."""
    found = quantiles(np.arange(1.0, 26)[:, None], (0.5,))
    assert 8 < found.lower.item() < 8.3
    assert 17.7 < found.upper.item() < 18


@pytest.mark.unit
def test_errors_of_standard_deviations_of_skewed_samples_cover():
    """Intervals of ln σ²: σ ± 1.96 e/(2σ) covers 80 %."""
    n, count = 64, 4000
    values = np.random.default_rng(5).standard_exponential((n, count))
    found = estimate(monomials(values, None).sum(axis=1), n, np.zeros(count))
    assert (np.abs(found.std - 1) < 1.96 * found.std_error).mean() > 0.86


@pytest.mark.unit
def test_claims_of_fitted_coefficients_count_what_the_fit_hides():
    """Of 32 samples of x + x²/5 residuals alone hold 82 % of the standard deviations."""
    n = 32
    x = np.random.default_rng(3).normal(size=(n, REPEATS))
    w, zero = x + x**2 / 5, np.zeros(REPEATS)
    found = estimate_from_replicates(np.array([w, w**2, x, x**2]), zero, (zero, zero + 1), "optimal")
    assert (np.abs(found.std - STD) < 1.96 * found.std_error).mean() > 0.88
    by_residuals = estimate(monomials(w, x).sum(axis=1), n, zero, zero + 1, "optimal")
    np.testing.assert_allclose(found.mean, by_residuals.mean)
    assert np.median(found.mean_error / by_residuals.mean_error) > 1
    assert np.median(found.std_error / by_residuals.std_error) < 1.5
