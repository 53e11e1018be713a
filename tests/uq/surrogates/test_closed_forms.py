"""Orthonormal polynomials, errors of samples left out and Poincaré constants, each against its closed form."""

import math

import numpy as np
import pytest
from scipy import integrate, special, stats

from uq.estimators.fidelities import correlations, uncertainty
from uq.estimators.moments import student
from uq.inputs.distributions import Beta, Gamma, LogNormal, LogUniform, Normal, Uniform
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.methods.derivative_based import poincare
from uq.surrogates.basis import Joint, gauss_rule, hermite, hyperbolic, orthonormal
from uq.surrogates.least_squares import left_out

pytestmark = pytest.mark.unit
RNG = np.random.default_rng(21)
MARGINALS = (
    (Uniform(lower=2.0, upper=6.0), stats.uniform(2, 4)),
    (Normal(mean=1.0, std=0.5), stats.norm(1, 0.5)),
    (Beta(a=2.0, b=3.0, lower=-1.0, upper=1.0), stats.beta(2, 3, -1, 2)),
    (Gamma(shape=3.0, scale=0.5), stats.gamma(3, scale=0.5)),
)


@pytest.mark.parametrize(("marginal", "exact"), MARGINALS, ids=lambda one: getattr(one, "kind", ""))
def test_moments_and_rules_are_those_of_the_distribution(marginal, exact):
    assert marginal.moments == pytest.approx((exact.mean(), exact.std()))
    if not marginal.logarithmic:
        t, w = gauss_rule(marginal, 6)  # of the standardised coordinate
        x = exact.mean() + exact.std() * t
        # Exact to degree 2n − 1. SciPy's own moments of a beta distribution integrate quantiles, for a second.
        powers = np.arange(12)
        moments, _ = integrate.quad_vec(lambda value: value**powers * exact.pdf(value), *exact.support(), epsrel=1e-9)
        assert w @ x[:, None] ** powers == pytest.approx(moments, rel=1e-6, abs=1e-7)
    p = np.array([1e-6, 0.025, 0.5, 0.9])
    np.testing.assert_allclose(marginal.quantile(p), exact.ppf(p), rtol=1e-8)
    np.testing.assert_allclose(marginal.cumulative(exact.ppf(p)), p, rtol=1e-6)
    np.testing.assert_allclose(marginal.density(exact.ppf(p[1:])), exact.pdf(exact.ppf(p[1:])), rtol=1e-8)
    np.testing.assert_allclose(marginal.from_normal(special.ndtri(p))[0], exact.ppf(p), rtol=1e-8)


@pytest.mark.parametrize(("marginal", "exact"), MARGINALS[:3], ids=lambda one: getattr(one, "kind", ""))
def test_polynomials_are_orthonormal_and_have_their_slopes(marginal, exact):
    basis = orthonormal(Inputs({"a": marginal}), hyperbolic(1, 5, 1.0))
    t, w = gauss_rule(marginal, 8)
    x = exact.mean() + exact.std() * t
    values = basis.values(x[:, None])
    np.testing.assert_allclose(values.T @ (w[:, None] * values), np.eye(6), atol=1e-10)
    np.testing.assert_allclose(values[:, 1], (x - exact.mean()) / exact.std(), atol=1e-10)
    h = 1e-5 * exact.std()
    slopes = (basis.values(x[:, None] + h) - basis.values(x[:, None] - h)) / 2e-5
    np.testing.assert_allclose(basis.derivatives(x[:, None])[:, 0], slopes, rtol=1e-6, atol=1e-6)


def test_polynomials_by_name():
    t = np.linspace(-2, 2, 7)
    for k, column in enumerate(hermite(t, 5).T):
        np.testing.assert_allclose(column, special.eval_hermitenorm(k, t) / math.sqrt(math.factorial(k)), atol=1e-12)
    two = orthonormal(Inputs({"a": Uniform(lower=-1, upper=1), "b": Uniform(lower=0, upper=1)}), np.array([[3, 2]]))
    x, y = RNG.uniform(size=(2, 5))
    legendre = special.eval_legendre(3, x) * math.sqrt(7) * special.eval_legendre(2, 2 * y - 1) * math.sqrt(5)
    np.testing.assert_allclose(two.values(np.column_stack([x, y]))[:, 0], legendre)


@pytest.mark.parametrize("alone", [1, 3])
def test_errors_of_samples_left_out_are_those_of_fits_without_them(alone):
    matrix, right = RNG.normal(size=(12, 1, 4)), RNG.normal(size=(12, 1, 2))
    held = np.arange(12) // alone
    q, _ = np.linalg.qr(matrix[:, 0])
    residual = right - (q @ (q.T @ right[:, 0]))[:, None]
    found = left_out(q[:, None], residual, held)
    for number in np.unique(held):
        inside = held != number
        fit = np.linalg.lstsq(matrix[inside, 0], right[inside, 0], rcond=None)[0]
        np.testing.assert_allclose(found[~inside, 0], right[~inside, 0] - matrix[~inside, 0] @ fit)


def test_poincare_constants():
    """Of bounds on total indices: the largest ratio of Var g and E[g'²]."""
    assert poincare(Normal(mean=3.0, std=0.5), logarithm=False) == 0.25
    assert poincare(Uniform(lower=1.0, upper=3.0), logarithm=False) == pytest.approx(4 / math.pi**2)
    assert poincare(LogUniform(lower=1.0, upper=math.e**2), logarithm=True) == pytest.approx(4 / math.pi**2)
    assert poincare(LogNormal(mean=2.0, std=1.0), logarithm=True) == pytest.approx(math.log(1.25))
    assert poincare(LogNormal(mean=2.0, std=1.0), logarithm=False) == math.inf
    # of a Beta(2, 2) distribution on [−1, 1] the slope of the best g is in Legendre functions; by quadrature of any g
    constant = poincare(Beta(a=2, b=2, lower=-1.0, upper=1.0), logarithm=False)
    density = stats.beta(2, 2, -1, 2).pdf
    for g, slope in ((lambda x: x, lambda x: 1.0), (lambda x: x - 0.1 * x**3, lambda x: 1 - 0.3 * x**2)):
        variance = integrate.quad(lambda x, g=g: g(x) ** 2 * density(x), -1, 1)[0]
        energy = integrate.quad(lambda x, slope=slope: slope(x) ** 2 * density(x), -1, 1)[0]
        assert variance / energy <= constant * (1 + 1e-9)
    assert constant < 1.1 * variance / energy
    k, theta = 4.0, 0.5  # (1 − x/(k + 1)) exp(x/(k + 1)) of x = ω/θ attains it
    gamma = stats.gamma(k, scale=theta)

    def g(w):
        x = w / theta / (k + 1)
        return (1 - x) * math.exp(x)

    mean, square, energy = (
        integrate.quad(lambda w, of=of: of(w) * gamma.pdf(w), 0, 60)[0]
        for of in (g, lambda w: g(w) ** 2, lambda w: (w / (theta * (k + 1)) ** 2 * math.exp(w / theta / (k + 1))) ** 2)
    )
    found = poincare(Gamma(shape=k, scale=theta), logarithm=False)
    assert found == pytest.approx((square - mean**2) / energy, rel=1e-6)
    assert poincare(Gamma(shape=4.0, scale=2.0), logarithm=True) == pytest.approx(1 / 3)


def test_sums_of_means_have_the_degrees_of_freedom_of_welch():
    one, other = RNG.normal(size=(8, 1)), 0.5 * RNG.normal(size=(5, 1))
    a, b = one.var(ddof=1) / 8, other.var(ddof=1) / 5
    factor, _ = uncertainty([one, other])
    assert factor[0] == pytest.approx(student((a + b) ** 2 / (a**2 / 7 + b**2 / 4)) / 1.96)
    covariance = np.array([[[4.0, 3.0], [3.0, 9.0]]])
    np.testing.assert_allclose(correlations(covariance), [[1.0, 0.5]])


def test_no_functions_of_draws_have_no_numbers():
    draws = Draws(("a", "b"), np.random.default_rng(0).standard_normal((50, 2)), np.full(50, 0.02), 50.0)
    joint = Joint.of(draws, np.array([0, 1]), hyperbolic(2, 2, 1.0))
    assert joint.number(np.zeros((0, 2), dtype=np.int64)).dtype == np.int64
    np.testing.assert_array_equal(joint.number(joint.indices), range(len(joint.indices)))
