"""Formulas of estimates, errors, intervals and indices, each against its closed form."""

import math
from itertools import product

import numpy as np
import pytest
import xarray as xr
from scipy import integrate, optimize, signal, stats

from uq.accuracy.budget import estimates_for, spare_for
from uq.estimators.averaged import average
from uq.estimators.blue import informations, weights
from uq.estimators.indices import (
    RowProducts,
    bootstrap,
    bootstrap_error,
    coefficient_moments,
    exchanged,
    field_indices,
    jackknife_error,
    pair_variances,
    partial_variances,
)
from uq.estimators.moments import (
    combine,
    controlled,
    error_of_root,
    estimate,
    estimate_from_replicates,
    half_width,
    monomials,
    ratio,
    student,
    term,
)
from uq.estimators.quantiles import quantiles, quantiles_from_replicates, quantiles_of_shares
from uq.estimators.scores import rate as rate_of_errors
from uq.estimators.scores import score
from uq.estimators.tails import _share_beyond, by_chance, concentration, influences, of_squares, shown, skewed
from uq.inputs.draws import effective
from uq.methods.method import seconds_per_solve
from uq.methods.multilevel_meshes import bias, rate

pytestmark = pytest.mark.unit
RNG = np.random.default_rng(11)
SHIFTS = np.array([0.0, 3.0, -1.0])


# --- intervals -------------------------------------------------------------------------------------------------------


def probability(t, freedom):
    """P(|x| ≤ t) of Student's t with an odd number of degrees of freedom (Abramowitz & Stegun, 26.7.3)."""
    angle = math.atan(t / math.sqrt(freedom))
    terms, factor = 0.0, 1.0
    for k in range(1, freedom, 2):
        terms += factor * math.cos(angle) ** k
        factor *= (k + 1) / (k + 2)
    return 2 / math.pi * (angle + math.sin(angle) * terms)


@pytest.mark.parametrize("replicates", [2, 4, 16])
def test_intervals_of_replicates_have_one_degree_of_freedom_less(replicates):
    samples = xr.Dataset(coords={"scramble": ("sample", np.repeat(np.arange(replicates), 8))})
    half = half_width(samples)
    assert half == student(replicates - 1)
    assert probability(half, replicates - 1) == pytest.approx(0.95, abs=1e-10)
    means = RNG.normal(size=(replicates, 3))
    found = estimate_from_replicates(np.array([means, means**2 + 1]), SHIFTS)
    low, high = stats.t.interval(0.95, replicates - 1, means.mean(axis=0), stats.sem(means))
    np.testing.assert_allclose(found.mean - half * found.mean_error, low + SHIFTS)
    np.testing.assert_allclose(found.mean + half * found.mean_error, high + SHIFTS)
    # of one degree of freedom it is Cauchy's distribution
    assert student(1) == pytest.approx(math.tan(0.475 * math.pi))
    assert half_width(xr.Dataset()) == 1.96


def test_moments_of_plain_samples():
    w = RNG.exponential(size=(50, 3))
    found = estimate(monomials(w, None).sum(axis=1), 50, SHIFTS)
    np.testing.assert_allclose(found.mean, w.mean(axis=0) + SHIFTS)
    np.testing.assert_allclose(found.mean_error, w.std(axis=0, ddof=1) / np.sqrt(50))
    np.testing.assert_allclose(found.std, w.std(axis=0, ddof=1))
    squares = (w - w.mean(axis=0)) ** 2
    error = np.sqrt(squares.var(axis=0, ddof=1) / 50 + 2 * (w.var(axis=0, ddof=1) / 50) ** 2)
    np.testing.assert_allclose(found.std_error, found.std / 2 * np.expm1(error / found.std**2))
    np.testing.assert_allclose(found.variance_ratio, 1)
    same = combine(SHIFTS, [term(w, w**2)])
    for name in ("mean", "mean_error", "std", "std_error"):
        np.testing.assert_allclose(getattr(same, name), getattr(found, name), rtol=1e-9)
    np.testing.assert_allclose(found.relative_std_error, found.std_error / found.std)
    np.testing.assert_allclose(found.relative_error, found.mean_error / np.maximum(abs(found.mean), found.std))


def test_a_control_that_is_the_quantity_leaves_no_error():
    L = RNG.normal(size=(40, 2)) * [1.0, 3.0]
    found = estimate(monomials(2 * L, 2 * L).sum(axis=1), 40, np.zeros(2), np.array([4.0, 36.0]))
    np.testing.assert_allclose(found.mean, 0, atol=1e-12)
    np.testing.assert_allclose(found.mean_error, 0, atol=1e-7)
    np.testing.assert_allclose(found.std, [2, 6])
    # the slope of the regression on these samples is the optimal coefficient
    w = 3 * L + RNG.normal(size=L.shape)
    fitted = estimate(monomials(w, L).sum(axis=1), 40, np.zeros(2), np.array([1.0, 9.0]), "optimal")
    slopes = [np.polyfit(x, y, 1)[0] for x, y in zip(L.T, w.T, strict=True)]
    np.testing.assert_allclose(fitted.coefficient, slopes)
    np.testing.assert_allclose(fitted.mean, w.mean(axis=0) - fitted.coefficient * L.mean(axis=0))
    # the published second moment has no control
    np.testing.assert_allclose(
        estimate(monomials(w, L).sum(axis=1), 40, np.zeros(2), np.ones(2), "one", "linear").second_coefficient, 0
    )


def test_a_control_that_does_not_help_is_dropped():
    w, noise = RNG.normal(size=(2, 30, 1))
    first, second = controlled(w, w**2, (5 * noise, 5 * noise**2))
    np.testing.assert_array_equal(first, w)
    np.testing.assert_array_equal(second, w**2)
    found = estimate_from_replicates(np.array([w, w**2, 5 * noise, noise]), np.zeros(1), (np.zeros(1), np.zeros(1)))
    assert found.coefficient == 0


def test_sums_of_terms_have_the_sum_of_their_variances():
    one, other = RNG.normal(size=(20, 1)), 0.1 * RNG.normal(size=(10, 1))
    terms = [term(one, one**2), term(other, other)]
    found = combine(np.zeros(1), terms)
    assert found.mean[0] == pytest.approx(one.mean() + other.mean())
    variance = one.var(ddof=1) / 20 + other.var(ddof=1) / 10
    assert found.mean_error[0] == pytest.approx(math.sqrt(variance))
    assert found.std[0] ** 2 == pytest.approx((one**2).mean() + other.mean() - found.mean[0] ** 2 + variance)


def test_errors_of_roots():
    std, error = np.array([2.0, 1.0, 0.0, 1.0]), np.array([4e-6, 0.5, 9.0, 1e4])
    found = error_of_root(std, error)
    assert found[0] == pytest.approx(1e-6, rel=1e-5)  # e/(2σ)
    assert found[1] == pytest.approx((math.exp(0.5) - 1) / 2)
    assert found[2] == 3.0  # √e
    assert found[3] == 100.0
    np.testing.assert_array_equal(ratio(np.array([1.0, 0.0]), np.array([4.0, 0.0]), 7.0), [0.25, 7.0])


def test_replicates_fitted_to_a_control():
    """A line of replicates on the control: its value at the expectation, with the jackknife's error (HC3)."""
    c, noise = RNG.normal(size=(2, 12))
    w = 1 + 2 * c + 0.3 * noise
    found = estimate_from_replicates(
        np.array([w, w**2, c, c])[..., None], np.zeros(1), (np.array([0.2]), np.array([0.2])), "optimal"
    )
    slope, middle = np.polyfit(c, w, 1)
    assert found.mean[0] == pytest.approx(middle + 0.2 * slope)
    X = np.column_stack([np.ones(12), c])
    hat = np.diag(X @ np.linalg.solve(X.T @ X, X.T))
    left = np.array([1, 0.2]) @ np.linalg.solve(X.T @ X, X.T) * (w - X @ [middle, slope]) / (1 - hat)
    residuals_alone = np.array([1, 0.2]) @ np.linalg.solve(X.T @ X, X.T) * (w - X @ [middle, slope])
    assert found.mean_error[0] == pytest.approx(np.sqrt((left**2).sum()) * math.sqrt(11 / 12), rel=1e-9)
    assert found.mean_error[0] > np.sqrt((residuals_alone**2).sum())


# --- quantiles -------------------------------------------------------------------------------------------------------


def test_intervals_of_quantiles_are_those_of_order_statistics():
    n = 199
    values = np.arange(1, n + 1)[:, None] / (n + 1)
    found = quantiles(values, (0.1, 0.5, 0.9))
    np.testing.assert_allclose(found.central[:, 0], np.quantile(values, [0.1, 0.5, 0.9]))
    for k, p in enumerate((0.1, 0.5, 0.9)):
        lower, upper = found.lower[k, 0], found.upper[k, 0]
        # X_(a) of a uniform quantity has a beta distribution
        assert stats.beta.cdf(p, lower * (n + 1), (n + 1) * (1 - lower)) == pytest.approx(0.975, abs=1e-6)
        assert stats.beta.cdf(p, upper * (n + 1), (n + 1) * (1 - upper)) == pytest.approx(0.025, abs=1e-6)
        assert found.error[k, 0] == pytest.approx(max(upper - found.central[k, 0], found.central[k, 0] - lower) / 1.96)
    np.testing.assert_allclose(found.lower + found.upper[::-1], 1)
    worth = quantiles(values, (0.5,), 49.0)
    assert stats.beta.cdf(0.5, worth.lower[0, 0] * 50, 50 * (1 - worth.lower[0, 0])) == pytest.approx(0.975, abs=1e-6)
    shares = quantiles_of_shares(values, (0.5,), np.array([[0.5 / 7]]))  # those of 49 samples
    np.testing.assert_allclose(shares.lower, worth.lower)


@pytest.mark.parametrize("replicates", [2, 4, 16])
def test_quantiles_of_replicates_are_worth_what_their_shares_say(replicates):
    each = 64
    values = RNG.uniform(size=(replicates * each, 1))
    names = np.repeat(np.arange(replicates), each)
    found = quantiles_from_replicates(values, names, (0.3,))
    below = (values[:, 0] <= found.central[0, 0]).reshape(replicates, each).mean(axis=1)
    t = stats.t.ppf(0.975, replicates - 1)
    error = max(below.std(ddof=1) / math.sqrt(replicates), math.sqrt(replicates / 12) / len(values))
    worth = quantiles(values, (0.3,), 0.21 / error**2 * (1.96 / t) ** 2)
    np.testing.assert_allclose([found.lower, found.upper], [worth.lower, worth.upper])
    np.testing.assert_allclose(found.error, worth.error * 1.96 / t)


@pytest.mark.unit
def test_small_shares_are_known_in_proportion():
    """An interval to T exp(2 e/T); of 50 rows of which three have nearly all, one more may be missing."""
    even = np.tile([[1.0], [-1.0]], (25, 1))
    found = of_squares(np.array([0.5]), np.array([0.1]), even, 2.0)
    assert found[0] == pytest.approx(0.5 * (math.exp(2 * 0.1 / 0.5) - 1) / 2)
    assert of_squares(np.zeros(1), np.zeros(1), 0 * even, 2.0)[0] == 0
    rare = np.append([20.0, 4.0, 1.0], np.zeros(47))[:, None]
    assert of_squares(np.array([0.5]), np.zeros(1), rare, 2.0)[0] == pytest.approx(1 / 50)


# --- Sobol' indices --------------------------------------------------------------------------------------------------

A, B, C = 2.0, 1.0, 3.0
CORNERS = np.array(list(product([-1.0, 1.0], repeat=2)))


def bilinear(x):
    """5 + A x + B y + C x y of x, y = ±1: V = A² + B² + C², T_x = A² + C², V_xy = C²."""
    return 5 + A * x[..., 0] + B * x[..., 1] + C * x[..., 0] * x[..., 1]


def test_indices_of_exchanged_rows_over_all_corners():
    first, second = (CORNERS[np.array(which)] for which in zip(*product(range(4), repeat=2), strict=True))
    members = np.array([[True, False], [False, True], [True, True]])
    rows = exchanged(first, second, members, pairs=True)
    products = RowProducts(3, 2)
    assert rows.shape == (16, products.size, 2)
    means = np.mean([products.of(bilinear(row)) for row in rows], axis=0)
    found = products.variances(means)
    assert found.variance == pytest.approx(A**2 + B**2 + C**2)
    np.testing.assert_allclose(found.first, [A**2, B**2, A**2 + B**2 + C**2], atol=1e-12)
    np.testing.assert_allclose(found.total, [A**2 + C**2, B**2 + C**2, A**2 + B**2 + C**2])
    np.testing.assert_allclose(found.second, [[0, C**2], [C**2, 0]], atol=1e-12)


def test_indices_of_coefficients():
    indices = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [1, 1]])
    coefficients = np.array([5.0, A, B, 4.0, C])
    variance = A**2 + B**2 + 16 + C**2
    found = coefficient_moments(coefficients, indices)
    assert (found["mean"], found["std"]) == (5.0, pytest.approx(math.sqrt(variance)))
    np.testing.assert_allclose(found["sobol_first"], np.array([A**2 + 16, B**2]) / variance)
    np.testing.assert_allclose(found["sobol_total"], np.array([A**2 + 16 + C**2, B**2 + C**2]) / variance)
    np.testing.assert_allclose(pair_variances(coefficients**2, indices), [[0, C**2], [C**2, 0]])
    whole, first, total = partial_variances(coefficients**2, indices, np.array([[True, True]]))
    assert whole == first[0] == total[0] == pytest.approx(variance)


def test_indices_of_fields():
    variance, first = np.array([4.0, 1.0, 0.0]), np.array([[3.0, 0.5, 0.0], [0.0, 0.25, 0.0]])
    total = first + 0.25 * variance
    found = {name: values for name, (_, values) in field_indices(variance, first, total, np.array([1, 2, 1])).items()}
    np.testing.assert_allclose(found["field_sobol_first"], [4 / 6, 0.5 / 6])
    np.testing.assert_allclose(found["field_sobol_total"], [4 / 6 + 0.25, 0.5 / 6 + 0.25])
    np.testing.assert_allclose(found["node_sobol_first"], [[0.75, 0.5, 0], [0, 0.25, 0]])
    np.testing.assert_array_equal(found["dominating"], [0, 0, -1])


def test_errors_by_resampling_are_those_of_the_mean():
    values = RNG.normal(size=16)
    error = values.std(ddof=1) / 4
    left = (values.sum() - values) / 15
    assert jackknife_error(left) == pytest.approx(error)
    drawn = bootstrap(8 * values[:, None], np.full(16, 8), seed=3, draws=20_000)
    assert bootstrap_error(drawn, 16, axis=1)[0] == pytest.approx(error, rel=0.02)
    assert drawn.mean() == pytest.approx(values.mean(), abs=0.03 * error * 4)


# --- models together -------------------------------------------------------------------------------------------------


def test_averages_over_models():
    p = np.array([0.25, 0.75])
    found = average(p, np.array([0.1, 0.1]), *np.array([[1.0, 5.0], [0.1, 0.2], [2.0, 1.0], [0.3, 0.4]])[..., None])
    assert found["mean"][0] == pytest.approx(4)
    assert found["within"][0] == pytest.approx(0.25 * 4 + 0.75)
    assert found["between"][0] == pytest.approx(0.25 * 9 + 0.75)
    assert found["std"][0] == pytest.approx(math.sqrt(1.75 + 3))

    def std(x):
        m, s, q = x[:2], x[2:4], x[4:] / x[4:].sum()
        return math.sqrt(q @ (s**2 + m**2) - (q @ m) ** 2)

    at, errors = np.array([1, 5, 2, 1, 0.25, 0.75]), np.array([0.1, 0.2, 0.3, 0.4, 0.1, 0.1])
    assert found["std_error"][0] == pytest.approx(
        np.linalg.norm(optimize.approx_fprime(at, std, 1e-7) * errors), rel=1e-4
    )
    assert found["mean_error"][0] == pytest.approx(math.sqrt(0.025**2 + 0.15**2 + (0.3**2 + 0.1**2)))


def test_two_models_are_a_control_variate():
    """n samples of both and N of the cheap one alone: ȳ + β(z̄' − z̄), with the variance of approximate controls."""
    covariance, n, N = np.array([[1.0, 0.9], [0.9, 1.0]]), 10, 90
    groups = ((0, 1), (1,))
    told = informations(groups, covariance)
    a = weights(told, np.array([n, N]))
    np.testing.assert_allclose(a.sum(axis=0), [1, 0], atol=1e-9)
    beta = 0.9 * N / (n + N)
    np.testing.assert_allclose(a, [[1, -beta], [0, beta]], atol=1e-7)


# --- meshes, chains, amounts -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0, 3.0])
def test_the_bias_is_the_sum_of_all_further_differences(alpha):
    differences = np.array([[3.0], [-3.0]])[0] * 2.0 ** (-alpha * np.arange(1, 4))[:, None]
    np.testing.assert_allclose(rate(differences), alpha)
    further = abs(3.0 * 2.0 ** (-alpha * np.arange(4, 200))).sum()
    np.testing.assert_allclose(bias(differences, np.array([alpha])), further)


def test_chains_are_worth_what_their_correlation_leaves():
    n, rho = 40_000, 0.5
    noise = np.random.default_rng(1).normal(size=n)
    chain = signal.lfilter([1.0], [1.0, -rho], noise)
    assert effective(chain) == pytest.approx(n * (1 - rho) / (1 + rho), rel=0.06)
    assert effective(noise) == n
    assert effective(np.ones(10)) == 1.0
    two = np.concatenate([chain, chain])
    assert effective(two, np.repeat([0, 1], n)) == pytest.approx(2 * effective(chain), rel=1e-6)


@pytest.mark.parametrize(("unknowns", "seconds"), [(1_575, 0.011), (9_963, 0.067), (70_227, 0.98)])
def test_solves_are_weighed_as_they_were_measured(unknowns, seconds):
    assert seconds_per_solve(unknowns) == pytest.approx(seconds, rel=0.25)


def test_estimates_of_the_mesh_take_a_fifth():
    assert [estimates_for(n) for n in (1, 60, 100, 200, 10_000)] == [3, 3, 5, 10, 16]
    assert estimates_for(10_000, paid=1) == 2
    assert spare_for(200) == 0.0
    assert spare_for(20) == -8.0


# --- tails -----------------------------------------------------------------------------------------------------------


def test_skewed_samples_have_longer_intervals():
    samples = np.array([[1.0]] * 20 + [[0.0]] * 80)
    skewness = stats.skew(samples[:, 0])
    assert skewed(samples)[0] == pytest.approx(math.sqrt(1 + 2.16 * skewness**2 / 100))
    assert skewed(np.array([[-1.0], [1.0]]))[0] == 1


def test_concentration_and_limits():
    assert concentration(np.array([1.0, -1.0, 1.0, -1.0]), 1.0) == 1
    assert concentration(np.array([4.0, 0.0, 0.0, 0.0]), 1.0) == 4
    assert concentration(np.full(4, 1e-12), 1.0) == 0
    assert [shown(n) for n in (16, 64, 128, 1024)] == pytest.approx([1, 1, 2**0.4, 16**0.4])
    w = RNG.normal(size=(30, 2))
    moved = influences(w, w**2)
    np.testing.assert_allclose(moved, (w - w.mean(axis=0)) ** 2 - w.var(axis=0), atol=1e-12)


@pytest.mark.parametrize(("s", "n"), [(0.3, 64), (0.6, 64), (0.6, 1024), (0.8, 16)])
def test_what_lies_beyond_the_samples_of_a_log_normal_quantity(s, n):
    a = stats.norm.isf(1 / n)
    mean, variance = math.exp(s**2 / 2), math.exp(2 * s**2) - math.exp(s**2)

    def beyond(of):
        return integrate.quad(lambda z: of(z) * stats.norm.pdf(z), a, 14)[0]

    expected = beyond(lambda z: (math.exp(s * z) - mean) ** 2) / variance - beyond(lambda z: z**2)
    assert _share_beyond(s, n) == pytest.approx(max(expected, 0), rel=1e-6)


def test_replicates_that_agree_by_chance_claim_what_chance_explains():
    values = np.concatenate([np.zeros((60, 1)), np.full((4, 1), 10.0)])
    deviations = values - values.mean()
    found = estimate(monomials(deviations, None).sum(axis=1), 64, values.mean(axis=0))
    small = found.__class__(**{**found.__dict__, "std_error": 0.01 * found.std_error})
    for replicates in (2, 4, 16):
        most = math.sqrt((replicates - 1) / stats.chi2.ppf(0.05, replicates - 1))
        raised = by_chance(small, influences(deviations, deviations**2), replicates)
        assert raised.std_error[0] == pytest.approx(most * small.std_error[0])
    even = RNG.uniform(-1, 1, size=(64, 1))  # carried by all
    np.testing.assert_array_equal(by_chance(small, influences(even, even**2), 4).std_error, small.std_error)


# --- comparisons -----------------------------------------------------------------------------------------------------


def test_scores_of_repeats():
    errors = np.array([[[1.0], [-2.0], [2.0], [np.nan]]])
    found = score(errors, np.full(errors.shape, 1.0), np.full((1, 4), 1.96), np.array([0.0]))
    assert found.rmse[0, 0] == pytest.approx(math.sqrt(3))
    assert found.rmse_error[0, 0] == pytest.approx(np.std([1, 4, 4], ddof=1) / math.sqrt(3) / 2 / math.sqrt(3))
    assert found.claimed[0, 0] == pytest.approx(1.0)
    assert found.coverage[0, 0] == pytest.approx(1 / 3)
    assert bool(found.resolved[0, 0])
    assert not score(errors, np.ones(errors.shape), np.full((1, 4), 1.96), np.array([1.0])).resolved[0, 0]
    many = np.where(np.arange(40)[None, :, None] < 30, 1.0, 3.0)
    assert score(many, np.ones(many.shape), np.full((1, 40), 1.96), np.zeros(1)).understated[0, 0]


def test_rates_of_errors():
    solves, sizes = np.array([10.0, 20.0, 40.0]), RNG.uniform(0.5, 1.5, size=8)
    slope, error = rate_of_errors(solves, sizes / solves[:, None] ** 0.5)
    assert slope == pytest.approx(-0.5)
    assert error == pytest.approx(0, abs=1e-12)
    assert math.isnan(rate_of_errors(solves[:1], sizes[None, :])[0])
