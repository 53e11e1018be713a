"""Randomised quasi-Monte Carlo on analytic models and on the finite-element beam."""

import re
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from benchmarks import coverage, tails
from benchmarks.coverage import Vectorised, measure
from forward.model import SolveError
from forward.pointwise import FunctionModel
from tests.functions import AtOnce, higher_moments
from tests.launch import on_kept_ranks
from uq.evaluation.evaluate import SerialEvaluate
from uq.findings import findings
from uq.inputs.distributions import Beta, Gamma, LogNormal, LogUniform, Normal, Triangular, TruncatedNormal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods import quasi_monte_carlo
from uq.methods.monte_carlo import MonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.surrogates import basis, taylor
from uq.surrogates.field_regression import Deviations
from uq.surrogates.linearisation import linearise
from uq.surrogates.taylor import quadratic, tangent

remembered = cache(sobol_points)
recurrence = cache(basis.recurrence)


@pytest.fixture(autouse=True)
def points_are_drawn_once(monkeypatch):
    """Repeats with other controls have the same points, which take most of the time, and the same polynomials."""
    monkeypatch.setattr(quasi_monte_carlo, "sobol_points", remembered)
    monkeypatch.setattr(basis, "recurrence", recurrence)


UNIT = Uniform(lower=0.0, upper=1.0)
ANGLE = Uniform(lower=-np.pi, upper=np.pi)
CONTROLS = ("none", "tangent", "quadratic", "chaos")


def case(function, jacobian, mean, variance, *marginals):
    """A model of one output with its inputs and its exact moments."""
    names = tuple("abc"[: len(marginals)])
    return (
        Inputs(dict(zip(names, marginals, strict=True))),
        FunctionModel(function, names, ("f",), jacobian),
        mean,
        variance,
    )


LINEAR = case(lambda p: 2 * p[0] - p[1] + 3, lambda p: [[2, -1]], 3.5, 5 / 12, UNIT, UNIT)
QUADRATIC = case(
    lambda p: p[0] + p[1] ** 2 / 2,
    lambda p: [[1, p[1]]],
    0.5 + 7 / 6,
    1 / 12 + (31 / 5 - 49 / 9) / 4,
    UNIT,
    Uniform(lower=1.0, upper=2.0),
)
A, B = 7.0, 0.1
ISHIGAMI = case(
    lambda p: np.sin(p[0]) + A * np.sin(p[1]) ** 2 + B * p[2] ** 4 * np.sin(p[0]),
    lambda p: [[np.cos(p[0]) * (1 + B * p[2] ** 4), A * np.sin(2 * p[1]), 4 * B * p[2] ** 3 * np.sin(p[0])]],
    A / 2,
    A**2 / 8 + B * np.pi**4 / 5 + B**2 * np.pi**8 / 18 + 1 / 2,
    ANGLE,
    ANGLE,
    ANGLE,
)
PRODUCT = case(
    lambda p: p[0] * p[1] * np.exp(p[2]),
    lambda p: [np.exp(p[2]) * np.array([p[1], p[0], p[0] * p[1]])],
    1.5**2 * (np.e - 1),
    (7 / 3) ** 2 * (np.e**2 - 1) / 2 - (1.5**2 * (np.e - 1)) ** 2,
    Uniform(lower=1.0, upper=2.0),
    Uniform(lower=1.0, upper=2.0),
    UNIT,
)
STEEP = case(
    lambda p: np.exp(3 * p[0]),
    lambda p: [3 * np.exp(3 * p)],
    (np.e**3 - 1) / 3,
    (np.e**6 - 1) / 6 - ((np.e**3 - 1) / 3) ** 2,
    UNIT,
)
CASES = {"linear": LINEAR, "quadratic": QUADRATIC, "ishigami": ISHIGAMI, "product": PRODUCT}


def repeats(of, count, **settings):
    """Deviations of mean and variance from the exact ones, and the errors that were claimed, each (count,)."""
    inputs, model, mean, variance = of
    rows = []
    for seed in range(count):
        data = QuasiMonteCarlo(seed=seed, fields=False, **settings).run(inputs, AtOnce(model))
        e, s, es = data["mean"].item(), data["std"].item(), data["std_error"].item()
        rows.append((e - mean, data["mean_error"].item(), s**2 - variance, 2 * s * es))
    return np.array(rows).T


def is_unbiased(deviations, scale):
    """Whether deviations have the mean zero, by their own scatter; rounding errors of `scale` aside."""
    return abs(deviations.mean()) < 4 * deviations.std(ddof=1) / np.sqrt(len(deviations)) + 1e-13 * scale


def leaning(deviations):
    """Surplus of positive over negative deviations, in standard deviations of a fair coin."""
    return np.sign(deviations).sum() / np.sqrt(len(deviations))


@pytest.mark.parametrize(
    ("name", "control"),
    [  # what the controls are exact for is in a test of its own
        *(("product", control) for control in CONTROLS if control != "chaos"),
        pytest.param("product", "chaos", marks=pytest.mark.slow),
        *(
            pytest.param(name, control, marks=pytest.mark.slow)
            for name in ("ishigami", "linear", "quadratic")
            for control in CONTROLS
        ),
    ],
)
def test_mean_and_variance_are_unbiased(name, control):
    mean, _, variance, _ = repeats(CASES[name], 30, samples=32, scrambles=4, control=control)
    assert is_unbiased(mean, CASES[name][2])
    assert is_unbiased(variance, CASES[name][3])


def test_a_control_of_which_the_mean_is_not_known_would_be_noticed(monkeypatch):
    inputs = PRODUCT[0]
    elsewhere = Inputs(dict.fromkeys(inputs.names, Uniform(lower=0.9, upper=2.1)))
    for name, control in (("tangent", tangent), ("quadratic", quadratic)):
        of = partial(lambda control, _, *rest, **fields: control(elsewhere, *rest, **fields), control)
        monkeypatch.setattr(quasi_monte_carlo, name, of)
    for control in ("tangent", "quadratic"):
        mean, _, _, _ = repeats(PRODUCT, 30, samples=32, scrambles=4, control=control)
        assert not is_unbiased(mean, PRODUCT[2])


def with_slopes_times(factor, of):
    """The same model with wrong derivatives."""
    inputs, model, mean, variance = of
    return (
        inputs,
        FunctionModel(
            model.function, model.parameters, model.outputs, lambda p: factor * np.array(model.jacobian(p), dtype=float)
        ),
        mean,
        variance,
    )


@pytest.mark.slow
def test_a_bad_fit_costs_efficiency_and_no_bias():
    """All of it at most: a control that does not help is dropped, which leaves what there is without one."""
    settings = {"samples": 32, "scrambles": 4}
    good, bad, none = (
        repeats(of, 60, **settings, control=control)
        for of, control in ((PRODUCT, "chaos"), (with_slopes_times(3, PRODUCT), "chaos"), (PRODUCT, "none"))
    )
    for n, exact in ((0, PRODUCT[2]), (2, PRODUCT[3])):
        assert is_unbiased(bad[n], exact)
        assert 3 * good[n].std() < bad[n].std() < 1.2 * none[n].std()


@pytest.mark.slow
def test_samples_that_the_control_was_fitted_to_would_be_noticed(monkeypatch):
    settings = {"samples": 8, "scrambles": 2, "control": "chaos", "control_samples": 4}
    mean, _, variance, _ = repeats(STEEP, 120, **settings)
    assert is_unbiased(mean, STEEP[2])
    assert is_unbiased(variance, STEEP[3])
    assert abs(leaning(mean)) < 4
    assert abs(leaning(variance)) < 4
    monkeypatch.setattr(quasi_monte_carlo, "FIT", 0)
    mean, _, variance, _ = repeats(STEEP, 120, **settings)
    # Where the control is dropped, deviations are so large that they hide the bias of the others, of variances most.
    assert min(leaning(mean), leaning(variance)) < -4


def test_a_wrong_second_moment_of_the_control_would_be_noticed(monkeypatch):
    exact = taylor.tangent
    monkeypatch.setattr(
        quasi_monte_carlo,
        "tangent",
        lambda *a: replace(exact(*a), features_second=0.99 * exact(*a).features_second),
    )
    _, _, variance, _ = repeats(PRODUCT, 60, samples=256, scrambles=4, control="tangent")
    assert not is_unbiased(variance, PRODUCT[3])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("control", "coefficient"),
    [
        ("none", "one"),
        ("tangent", "one"),
        ("tangent", "optimal"),
        ("quadratic", "one"),
        ("quadratic", "optimal"),
        ("chaos", "one"),
        ("chaos", "optimal"),
    ],
)
def test_claimed_intervals_cover_where_controls_are_useless(control, coefficient):
    check_coverage(ISHIGAMI, 250, samples=1024, control=control, coefficient=coefficient)


@pytest.mark.parametrize(
    ("control", "coefficient"),
    [
        ("tangent", "one"),
        pytest.param("quadratic", "optimal", marks=pytest.mark.slow),
        *(pytest.param(control, "one", marks=pytest.mark.slow) for control in ("none", "quadratic", "chaos")),
    ],
)
def test_claimed_intervals_cover(control, coefficient):
    check_coverage(PRODUCT, 80, samples=256, control=control, coefficient=coefficient)


@pytest.mark.slow
def test_claimed_intervals_cover_with_a_chaos_control():
    """A share of them is for what no sample has seen: they may cover more, but are no wider than errors are."""
    mean, mean_error, variance, variance_error = repeats(STEEP, 200, samples=64, control="chaos", coefficient="one")
    for error, claimed, least in ((mean, mean_error, 0.92), (variance, variance_error, 0.91)):
        assert (np.abs(error) < stats.t.ppf(0.975, 15) * claimed).mean() >= least
        assert np.sqrt((claimed**2).mean()) < 1.5 * np.sqrt((error**2).mean())


def check_coverage(of, count, **settings):
    """The 95 % intervals of Student's distribution for 16 scrambles cover the mean in 92 to 98 % of 250 repeats.

    Of few, in as many as are as probable.
    """
    mean, mean_error, variance, variance_error = repeats(of, count, **settings)
    t = stats.t.ppf(0.975, 15 if settings["coefficient"] == "one" else 14)
    few = count < 200
    low, high = stats.binom.ppf([0.015, 0.988], count, 0.95) / count if few else (0.92, 0.98)
    assert low <= (np.abs(mean) < t * mean_error).mean() <= high
    t = stats.t.ppf(0.975, 15 if settings["coefficient"] == "one" else 13)
    low, high = stats.binom.ppf([0.004, 0.9985], count, 0.95) / count if few else (0.91, 0.99)
    assert low <= (np.abs(variance) < t * variance_error).mean() <= high


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["ishigami", "product"])
def test_converges_faster_than_monte_carlo(name):
    few, many = (repeats(CASES[name], 12, samples=n, scrambles=8, control="none")[0].std() for n in (128, 2048))
    assert few / many > 8, "16 times the samples: 4 for Monte Carlo"
    inputs, model, _, _ = CASES[name]
    plain = MonteCarlo(samples=2048, fields=False).run(inputs, AtOnce(model))["mean_error"].item()
    assert many < plain / 5


@pytest.mark.parametrize("coefficient", ["one", "optimal"])
def test_controls_are_exact_where_the_model_is_their_polynomial(coefficient):
    for of, control in ((LINEAR, "tangent"), (QUADRATIC, "quadratic"), (QUADRATIC, "chaos")):
        mean, mean_error, variance, variance_error = repeats(
            of, 3, samples=64, scrambles=8, control=control, coefficient=coefficient
        )
        for found in (mean, mean_error, variance, variance_error):
            assert np.abs(found).max() < 1e-12


def test_the_better_the_control_the_smaller_the_error():
    errors = [repeats(PRODUCT, 4, samples=64, control=control) for control in CONTROLS]
    none, tangent, quadratic, chaos = (np.sqrt((e**2).mean(axis=1)) for e in errors)
    for estimate in (0, 1, 2, 3):
        assert 2 * quadratic[estimate] < tangent[estimate] < none[estimate]
        assert 2 * chaos[estimate] < quadratic[estimate]


def test_a_control_that_grows_where_nothing_is_sampled_is_dropped():
    """exp(−a − b) of log-normals: the square of its quadratic polynomial in ln a, ln b is known from the tails."""
    case = next(case for case in tails.cases() if case.name == "exp(−a − b), cv 2")
    for seed in range(4):
        none, quadratic = (
            QuasiMonteCarlo(samples=64, control=c, seed=seed).run(case.inputs, Vectorised(case))
            for c in ("none", "quadratic")
        )
        assert quadratic["coefficient"].item() == 0
        for name in ("mean", "mean_error", "std", "std_error"):
            assert quadratic[name].item() == pytest.approx(none[name].item())
        (found,) = findings(quadratic)
        assert found.severity == "note"
        assert "mean and standard deviation are estimated without" in found.text


@pytest.mark.slow
def test_claims_of_means_count_what_no_sample_has_seen(monkeypatch):
    monkeypatch.setattr(coverage, "REFERENCE", 8)
    case = next(case for case in tails.cases() if case.name == "product, cv 0.5")
    row = measure(case, QuasiMonteCarlo(samples=64, control="chaos", fields=False), 40)
    assert row.covered[0] >= 0.88  # it was 0.8
    assert row.claimed[0] < 2


@pytest.mark.slow
def test_claims_of_polynomial_controls_count_what_no_sample_has_seen(monkeypatch):
    monkeypatch.setattr(coverage, "REFERENCE", 8)
    case = next(case for case in tails.cases() if case.name == "sum, cv 0.5")
    for control in ("quadratic", "chaos"):
        row = measure(case, QuasiMonteCarlo(samples=64, control=control), 16)
        assert row.covered[1] > 0.7  # it was half


def test_an_optimal_coefficient_mends_a_control_that_hurts():
    """A control of three times the right slope: the coefficient is a third, and the estimate the same."""
    inputs, model, _, _ = PRODUCT
    wrong = with_slopes_times(3, PRODUCT)
    steep = wrong[1]
    hurt = repeats(wrong, 12, samples=256, control="tangent")
    mended, right = (repeats(of, 12, samples=256, control="tangent", coefficient="optimal") for of in (wrong, PRODUCT))
    np.testing.assert_allclose(mended, right, rtol=1e-6, atol=1e-12)
    # It is dropped where it hurts, and what is claimed is what plain samples claim: more than with the fitted one,
    # which counts what its fit to 16 scrambles hides.
    assert (np.abs(hurt).mean(axis=1)[[1, 3]] > 1.05 * np.abs(mended).mean(axis=1)[[1, 3]]).all()
    none = repeats(PRODUCT, 12, samples=256, control="none")
    assert (np.abs(hurt).mean(axis=1)[[1, 3]] <= 1.01 * np.abs(none).mean(axis=1)[[1, 3]]).all()
    slopes = [
        QuasiMonteCarlo(samples=256, coefficient="optimal").run(inputs, SerialEvaluate(m))["coefficient"].item()
        for m in (model, steep)
    ]
    assert slopes[0] == pytest.approx(3 * slopes[1])


def test_quadratic_control_with_a_copula():
    """Mean of a ln b is E[a]E[ln b] + their covariance, which the quadratic control knows; σ has the tangent's."""
    a, b = Uniform(lower=1.0, upper=2.0), LogNormal(mean=1.0, std=0.2)
    inputs = Inputs({"a": a, "b": b}, (("a", "b", 0.7),))
    model = FunctionModel(lambda p: p[0] * np.log(p[1]), ("a", "b"), ("f",), lambda p: [[np.log(p[1]), p[0] / p[1]]])
    data = QuasiMonteCarlo(samples=2048, control="quadratic").run(inputs, AtOnce(model))
    mu, sigma = b.of_coordinate
    exact = 1.5 * mu + 0.7 * sigma / (2 * np.sqrt(np.pi))  # Cov(Φ(x), z) = ρ/(2√π)
    assert data["mean"].item() == pytest.approx(exact, rel=1e-12)
    plain = QuasiMonteCarlo(samples=16 * 4096, control="none", fields=False).run(inputs, AtOnce(model))
    error = np.hypot(data["std_error"].item(), plain["std_error"].item())
    assert abs(data["std"].item() - plain["std"].item()) < 4 * error


@pytest.mark.parametrize(
    ("marginal", "skewness", "kurtosis"),
    [
        (Uniform(lower=600.0, upper=900.0), 0, 1.8),
        (Beta(a=2.0, b=2.0, lower=2e5, upper=4e5), 0, 15 / 7),
        (Normal(mean=3e5, std=2e2), 0, 3),
        (Gamma(shape=4.0, scale=0.25), 1, 4.5),
        (LogUniform(lower=1.0, upper=1e3), *(stats.loguniform.stats(1, 1e3, moments="sk") + np.array([0, 3]))),
        (Triangular(lower=0.0, upper=1.0, mode=0.2), float(stats.triang.stats(0.2, moments="s")), 2.4),
        (
            TruncatedNormal(mean=1000.0, std=50.0, lower=900.0, upper=1200.0),
            *(stats.truncnorm.stats(-2, 4, moments="sk") + np.array([0, 3])),
        ),
    ],
    ids=lambda x: getattr(x, "kind", None),
)
def test_higher_moments(marginal, skewness, kurtosis):
    third, fourth = higher_moments(marginal)
    std = marginal.moments[1]
    assert third / std**3 == pytest.approx(skewness, abs=1e-6)
    assert fourth / std**4 == pytest.approx(kurtosis, rel=1e-6)


def test_moments_of_features():
    """E[φ] and E[φφᵀ] against a Gauss rule of independent inputs that are not symmetric."""
    marginals = {"a": Beta(a=2.0, b=5.0, lower=0.0, upper=3.0), "b": Gamma(shape=2.0, scale=0.5)}
    inputs = Inputs(marginals)
    model = FunctionModel(lambda p: p[0], ("a", "b"), ("f",), lambda p: [[1, 0]])
    evaluate = SerialEvaluate(model)
    of = taylor.quadratic(inputs, evaluate, linearise(inputs, evaluate), fields=False)
    x, w = np.polynomial.legendre.leggauss(64)
    y = 1.5 * (x + 1)
    wa = w * stats.beta(2, 5, 0, 3).pdf(y) * 1.5
    z, wb = np.polynomial.laguerre.laggauss(40)
    wb = wb * z  # z e^{−z}: shape 2
    grid = np.stack(np.meshgrid(y, z * 0.5, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = np.outer(wa, wb).ravel()
    features = of.features(grid)
    np.testing.assert_allclose(weights @ features, of.features_mean, atol=1e-9)
    np.testing.assert_allclose(np.einsum("n,nk,nl->kl", weights, features, features), of.features_second, atol=1e-9)


def test_an_expansion_is_held_beyond_its_samples_where_it_goes_wrong():
    """The square root of a + x² is no polynomial: beyond ten samples the one of sixth order errs by thousands."""
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in "abc"})

    def function(p):
        return np.sqrt(0.1 + p[0] ** 2) + p[1] * p[2]

    model = FunctionModel(function, tuple("abc"), ("f",), lambda p: [[p[0] / np.sqrt(0.1 + p[0] ** 2), p[2], p[1]]])
    x, w = np.polynomial.legendre.leggauss(400)
    root, w = np.sqrt(0.1 + 81 * x**2), w * np.exp(-81 * x**2 / 2)
    w = w / w.sum()
    exact = np.sqrt(w @ root**2 - (w @ root) ** 2 + 1)
    for seed in range(3):  # up to 11 times the standard deviation off, and 95 % intervals that missed it
        data = QuasiMonteCarlo(samples=64, control="chaos", seed=seed).run(inputs, AtOnce(model))
        assert data["std"].item() == pytest.approx(exact, rel=0.15)


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [24, 0, 2])
def test_borehole(seed):
    """A log-normal parameter that does next to nothing made the standard deviation 4.6e5 ± 4e-7 in place of 28.596.

    The expansion is right beyond its samples, of seed 24 too, where one hardly beyond them misses it by chance.
    """
    case = next(case for case in coverage.CASES if case.name == "borehole")
    data = QuasiMonteCarlo(samples=256, control="chaos", seed=seed, fields=False).run(case.inputs, Vectorised(case))
    # Held where samples do not tell that it goes wrong, it was off by 0.020 and claimed 0.0026 (95 %).
    assert seed != 24 or abs(data["mean"].item() - 73.7389) < 0.005
    assert data["mean"].item() == pytest.approx(73.739, rel=1e-3)
    assert data["std"].item() == pytest.approx(28.596, rel=1e-3)
    assert 1e-5 < data["std_error"].item() / 28.596 < 1e-2


@pytest.mark.parametrize("control", CONTROLS)
def test_log_normal_parameters_with_every_control(control):
    """Of 1/(1 + a + b), which polynomials of a and b do not approach; the standard deviation was 20 times off."""
    inputs = Inputs(dict.fromkeys("ab", LogNormal(mean=1.0, std=0.5)))
    model = FunctionModel(
        lambda p: 1 / (1 + p[0] + p[1]), ("a", "b"), ("f",), lambda p: [[-1 / (1 + p[0] + p[1]) ** 2] * 2]
    )
    x, w = np.polynomial.hermite_e.hermegauss(60)
    w = w / w.sum()
    a = inputs.marginals["a"].from_normal(x)[0]
    f = 1 / (1 + a[:, None] + a[None, :])
    mean = w @ f @ w
    std = np.sqrt(w @ (f - mean) ** 2 @ w)
    within = {"none": 0.2, "tangent": 0.1, "quadratic": 0.03, "chaos": 0.02}[control]
    for seed in range(4):
        data = QuasiMonteCarlo(samples=128, control=control, seed=seed).run(inputs, AtOnce(model))
        assert data["std"].item() == pytest.approx(std, rel=within)
        assert abs(data["mean"].item() - mean) < 4 * data["mean_error"].item() + 1e-3 * std


def test_moments_of_what_is_held():
    marginals = {
        "a": Normal(mean=2.0, std=3.0),
        "b": LogNormal(mean=1.0, std=0.7),
        "c": Gamma(shape=1.5, scale=0.5),
        "d": Uniform(lower=0.0, upper=2.0),
    }
    inputs = Inputs(marginals)
    basis_of = basis.orthonormal(inputs, basis.hyperbolic(4, 3, 1.0))
    ends = SimpleNamespace(points=inputs.coordinates.points(np.array([[-1.0] * 4, [1.2] * 4])))
    nothing = np.zeros((len(basis_of.indices), 0))
    fitted = Deviations(basis_of, nothing, nothing, np.zeros(0), np.ones(4, dtype=bool), None, None, ends)
    control = taylor.held_expansion(inputs, fitted)
    features = control.features(inputs.points(remembered(1, 0, 0, 2**15, 4)))
    assert np.abs(features).max() < 60  # of the basis itself: thousands
    np.testing.assert_allclose(features.mean(axis=0), control.features_mean, atol=2e-3)
    np.testing.assert_allclose(features.T @ features / len(features), control.features_second, atol=2e-2)
    bounded = Inputs({"d": marginals["d"]})
    assert taylor.held_expansion(bounded, fitted) is None


# --- points, amounts and failures ----------------------------------------------------------------------------------


def test_points_depend_on_their_numbers_only():
    whole = sobol_points(5, 3, 0, 64, 4)
    assert (whole > 0).all()
    assert (whole < 1).all()
    np.testing.assert_array_equal(sobol_points(5, 3, 16, 50, 4), whole[16:50])
    assert not np.array_equal(sobol_points(5, 2, 0, 64, 4), whole)
    assert not np.array_equal(sobol_points(6, 3, 0, 64, 4), whole)
    # one point in each interval of 1/64, along each axis
    assert (np.sort(np.floor(64 * whole), axis=0) == np.arange(64)[:, None]).all()


def test_a_longer_study_begins_with_the_shorter_one():
    inputs, model, _, _ = PRODUCT
    short, long = (QuasiMonteCarlo(samples=n, seed=4).run(inputs, SerialEvaluate(model)) for n in (64, 256))
    for name in ("points", "values", "scramble"):
        np.testing.assert_array_equal(long[name][:64], short[name])
    at = long.sel(round=64)
    assert at["running_mean"].item() == short["mean"].item()
    assert at["running_mean_error"].item() == short["mean_error"].item()
    more = QuasiMonteCarlo(samples=128, scrambles=32, seed=4).run(inputs, SerialEvaluate(model))
    np.testing.assert_array_equal(more["points"][more.scramble == 9], short["points"][short.scramble == 9])


def test_tolerance_is_met_by_doubling():
    inputs, model, _, _ = PRODUCT
    asked = []

    def counting(p):
        asked.append(tuple(p))
        return model.function(p)

    counted = replace(model, function=counting)
    data = QuasiMonteCarlo(tolerance=4e-5, seed=1).run(inputs, SerialEvaluate(counted))
    n = data.sizes["sample"]
    assert data["mean_error"].item() <= 4e-5 * data["mean"].item()
    assert 64 < n < 100_000
    assert n == 16 * 2 ** int(np.log2(n / 16))
    assert len(asked) == 1 + n, "no point is asked for twice"
    assert re.fullmatch(
        r"tolerance 4e-05 met: relative error .* samples \(16 scrambles of \d+ Sobol' points\)", data.stopped
    )
    fixed = QuasiMonteCarlo(samples=n, seed=1).run(inputs, SerialEvaluate(model))
    assert fixed["mean"].item() == data["mean"].item()
    short = QuasiMonteCarlo(tolerance=1e-9, samples=128).run(inputs, SerialEvaluate(model))
    assert short.sizes["sample"] == 128
    assert "not met" in short.stopped


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples": 300}, "samples = 300, expected scrambles = 16 times a power of two, such as 256 or 512"),
        ({"samples": 10}, "such as 16"),
        ({"samples": 96, "scrambles": 8}, "such as 64 or 128"),
        ({"samples": 6, "scrambles": 3, "coefficient": "optimal"}, "expected at least 4"),
        ({}, "neither samples nor tolerance"),
        ({"samples": 32, "control_samples": 8}, "control_samples = 8, expected none for control = 'tangent'"),
    ],
)
def test_amounts_that_cannot_be(settings, message):
    with pytest.raises(ValidationError, match=message):
        QuasiMonteCarlo(**settings)


def test_planned_solves():
    inputs, model, _, _ = PRODUCT
    for control, fitted, more in (
        ("none", None, 0),
        ("tangent", None, 0),
        ("quadratic", None, 6),
        ("chaos", None, 10),
        ("chaos", 5, 5),
    ):
        method = QuasiMonteCarlo(samples=64, control=control, control_samples=fitted)
        asked = []
        counted = replace(model, function=lambda p, asked=asked: (asked.append(1), model.function(p))[1])
        data = method.run(inputs, SerialEvaluate(counted))
        assert method.planned(3) == len(asked) == 65 + more
        if control == "chaos":
            assert data["control_samples"].item() == more
            assert 0 < data["loo_error"].item() < 0.2
    # Twice what order 3 needs with d + 1 rows for each sample, and order 2 above eight parameters.
    assert [QuasiMonteCarlo(samples=16, control="chaos").planned(d) - 17 for d in (1, 2, 4, 8, 9)] == [4, 7, 14, 37, 11]


def test_tolerance_and_budget_with_a_chaos_control():
    inputs, model, mean, _ = PRODUCT
    data = QuasiMonteCarlo(tolerance=1e-5, control="chaos", control_samples=40).run(inputs, SerialEvaluate(model))
    assert data.sizes["sample"] == 64, "the tangent takes more, see above"
    assert "tolerance 1e-05 met" in data.stopped
    assert abs(data["mean"].item() - mean) < 5 * data["mean_error"].item()
    poor = QuasiMonteCarlo(budget_seconds=1e-9, control="chaos").run(inputs, SerialEvaluate(model))
    assert poor.sizes["sample"] == 64
    assert "all that budget_seconds = 1e-09 pays for" in poor.stopped


def test_a_chaos_control_needs_independent_parameters():
    inputs, model, _, _ = PRODUCT
    correlated = Inputs(inputs.marginals, (("a", "b", 0.3),))
    with pytest.raises(ValueError, match="independent parameters"):
        QuasiMonteCarlo(samples=32, control="chaos").run(correlated, SerialEvaluate(model))


def test_many_parameters_are_selected_from():
    """Above eight parameters, two of which matter; a model of degree 2 is reproduced."""
    inputs = Inputs({f"p{i}": UNIT for i in range(10)})
    model = FunctionModel(
        lambda p: p[3] * p[7] + p[0],
        inputs.names,
        ("f",),
        lambda p: [np.eye(10)[0] + p[7] * np.eye(10)[3] + p[3] * np.eye(10)[7]],
    )
    data = QuasiMonteCarlo(samples=32, scrambles=4, control="chaos").run(inputs, SerialEvaluate(model))
    assert data["mean"].item() == pytest.approx(0.75, abs=1e-12)
    assert data["std"].item() ** 2 == pytest.approx(1 / 9 - 1 / 16 + 1 / 12, abs=1e-12)


@pytest.mark.parametrize("fitted", [2, 3])
def test_an_expansion_of_hardly_any_samples_stands_for_none(fitted):
    """Of two, no fit can leave one out: plain estimates count, and claims hold."""
    inputs = Inputs({"a": UNIT, "b": Normal(mean=0.5, std=1.0)})
    model = FunctionModel(
        lambda p: [np.sin(p.sum()), p[0] * p[1] ** 2],
        inputs.names,
        ("wave", "product"),
        lambda p: [[np.cos(p.sum())] * 2, [p[1] ** 2, 2 * p[0] * p[1]]],
    )
    method = QuasiMonteCarlo(samples=256, control="chaos", control_samples=fitted, fields=False)
    data = method.run(inputs, SerialEvaluate(model))
    # E sin(a + b) is the imaginary part of E exp(ia) E exp(ib).
    wave = float(((np.exp(1j) - 1) / 1j * np.exp(0.5j - 0.5)).imag)
    np.testing.assert_array_less(np.abs(data["mean"] - [wave, 0.625]), 4 * data["mean_error"])


def test_failures_are_left_out_and_counted():
    def fails_sometimes(p):
        if p[0] > 0.95:
            message = "gone"
            raise SolveError(message)
        return p[0]

    model = FunctionModel(fails_sometimes, ("a", "b"), ("f",), lambda p: [[1, 0]])
    inputs = Inputs({"a": UNIT, "b": UNIT})
    for control in CONTROLS:
        fitted = 40 if control == "chaos" else None
        method = QuasiMonteCarlo(samples=512, control=control, control_samples=fitted)
        data = method.run(inputs, SerialEvaluate(model))
        failed = int((~data.ok).sum())
        assert failed == pytest.approx(0.05 * 512, abs=16)
        assert f"{failed} of 512 samples have no answer" in data.attrs["note"]
        if control == "chaos":
            lost = 40 - data["control_samples"].item()
            assert lost > 0
            assert f"{lost} of 40 samples for the chaos control have no answer" in data.attrs["note"]
        assert ("follow" in data.attrs["note"]) == (control != "none")
        assert np.isfinite(data["mean"].item())
    plain = QuasiMonteCarlo(samples=512, control="none").run(inputs, SerialEvaluate(model))
    assert abs(plain["mean"].item() - 0.475) < 4 * plain["mean_error"].item() + 1 / 32


def test_failures_that_leave_nothing_are_an_error():
    def fails_off_centre(p):
        if abs(p[0] - 0.5) > 1e-9:
            message = "gone"
            raise SolveError(message)
        return p[0]

    inputs = Inputs({"a": UNIT})
    model = FunctionModel(fails_off_centre, ("a",), ("f",), lambda p: [[1]])
    for control, message in (
        ("tangent", "0 of 16 scrambles have an answer.*gone"),
        ("quadratic", "near the mean.*gone"),
        ("chaos", "control = 'chaos': 0 samples have an answer, too few"),
    ):
        with pytest.raises(SolveError, match=message):
            QuasiMonteCarlo(samples=32, control=control).run(inputs, SerialEvaluate(model))


def test_a_model_without_derivatives_needs_no_control():
    inputs, model, mean, _ = PRODUCT
    bare = replace(model, jacobian=None)
    with pytest.raises(ValueError, match="no derivatives"):
        QuasiMonteCarlo(samples=32).run(inputs, SerialEvaluate(bare))
    data = QuasiMonteCarlo(samples=1024, control="none").run(inputs, SerialEvaluate(bare))
    assert abs(data["mean"].item() - mean) < 5 * data["mean_error"].item()
    assert "coefficient" not in data


def test_quantiles_and_their_errors():
    """Quantiles of one uniform variable: errors are as large as deviations are, and smaller than those of samples."""
    inputs = Inputs({"a": UNIT, "b": UNIT})
    model = FunctionModel(lambda p: p[0] + p[1], ("a", "b"), ("f",))
    exact = np.array([np.sqrt(0.1), 1, 2 - np.sqrt(0.1)])
    found = [QuasiMonteCarlo(samples=512, seed=s, control="none").run(inputs, AtOnce(model)) for s in range(25)]
    deviations = np.array([d["quantiles"].to_numpy()[:, 0] - exact for d in found])
    errors = np.array([d["quantiles_error"].to_numpy()[:, 0] for d in found])
    actual = np.sqrt((deviations**2).mean(axis=0))
    assert (errors.mean(axis=0) > 0.6 * actual).all()
    assert (errors.mean(axis=0) < 3 * actual).all()
    plain = MonteCarlo(samples=512).run(inputs, SerialEvaluate(model))["quantiles_error"].to_numpy()[:, 0]
    assert (errors.mean(axis=0) < plain).all()


RANKS = """
import numpy as np
from mpi4py import MPI
from forward.pointwise import FunctionModel
from uq.inputs.distributions import Uniform
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.evaluate import SerialEvaluate
from uq.surrogates.field_regression import Deviations
from uq.inputs.random_parameters import Inputs
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

inputs = Inputs({name: Uniform(lower=0.5, upper=2.0) for name in "ab"})
model = FunctionModel(
    lambda p: [p[0] * np.sin(p[1]), p[1] ** 3], ("a", "b"), ("f", "g"),
    lambda p: [[np.sin(p[1]), p[0] * np.cos(p[1])], [0, 3 * p[1] ** 2]],
)
for control in ("quadratic", "chaos"):
    method = QuasiMonteCarlo(tolerance=1e-5, samples=2048, control=control)
    data = Ensemble.split(MPI.COMM_WORLD).run(model, lambda evaluate: method.run(inputs, evaluate))
    if data is not None:
        assert data.identical(method.run(inputs, SerialEvaluate(model)))
        print("same", control)
"""


@pytest.mark.mpi
def test_same_numbers_as_in_one_process():
    done = on_kept_ranks(2, RANKS)
    assert done.returncode == 0, done.stderr
    assert "same quadratic" in done.stdout
    assert "same chaos" in done.stdout


# --- the finite-element beam ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def beam():
    from mpi4py import MPI

    from workflows.config.study import load

    study = load(Path(__file__).parent.parent.parent.parent / "configs" / "tiny.toml")
    return study.inputs, SerialEvaluate(study.model.build(MPI.COMM_SELF, study.inputs.names))


@pytest.mark.fem
@pytest.mark.parametrize(
    ("control", "coefficient"),
    [
        ("tangent", "one"),
        ("chaos", "one"),
        ("tangent", "optimal"),
        *(pytest.param(control, "one", marks=pytest.mark.slow) for control in ("none", "quadratic")),
        *(pytest.param(control, "optimal", marks=pytest.mark.slow) for control in ("none", "quadratic", "chaos")),
    ],
)
def test_field_agrees_with_scalar(beam, control, coefficient):
    """The largest displacement is that of a corner of the free end at every sample, so its moments are the field's."""
    inputs, evaluate = beam
    data = QuasiMonteCarlo(samples=32, scrambles=8, seed=5, control=control, coefficient=coefficient).run(
        inputs, evaluate
    )
    tip = np.abs(data["field_nominal"].sel(component="y")).argmax().item()
    for name, sign in (("mean", -1), ("std", 1)):
        field = data[f"field_{name}"].sel(component="y")[tip].item()
        assert sign * field == pytest.approx(data[name].sel(output="uy_max").item(), rel=1e-5)
        # Errors of outputs count besides how skewed their samples are.
        error = data[f"field_{name}_error"].sel(component="y")[tip].item()
        assert 1 - 1e-5 < data[f"{name}_error"].sel(output="uy_max").item() / error < 1.5


@pytest.mark.fem
def test_fields_do_not_change_scalars_and_are_continued(beam, monkeypatch):
    inputs, evaluate = beam
    monkeypatch.setattr(quasi_monte_carlo, "FIRST_ROUND", 16)
    fixed = QuasiMonteCarlo(samples=32, scrambles=8).run(inputs, evaluate)
    scalars = QuasiMonteCarlo(samples=32, scrambles=8, fields=False).run(inputs, evaluate)
    grown = QuasiMonteCarlo(samples=32, scrambles=8, tolerance=1e-12).run(inputs, evaluate)
    for name in ("points", "values", "mean", "mean_error", "std", "std_error"):
        rounding = 1e-11 * float(np.abs(fixed["points" if name == "points" else "values"]).max())
        for other in (scalars, grown):  # samples of a block are rounded together, and blocks are others
            np.testing.assert_allclose(other[name], fixed[name], rtol=0, atol=0 if name == "points" else rounding)
    for name in ("field_mean", "field_mean_error", "field_std", "field_std_error"):
        np.testing.assert_allclose(grown[name], fixed[name], rtol=1e-7, atol=1e-14)
