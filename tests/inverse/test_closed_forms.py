"""Formulas of evidences, weights, noise and units of data, each against its closed form."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats

from inverse.criticism.comparison import _chance_errors, probabilities, quantiles
from inverse.criticism.weights import (
    effective_sample_size,
    normalised,
    pareto_shape,
    resampled,
)
from inverse.data.table import factor, split_head
from inverse.fields.newton_cg import Marginal
from inverse.low_dimensional.evidence import weighed
from inverse.low_dimensional.laplace import SHARE, WIDER, Laplace, Mixture
from inverse.low_dimensional.surrogate import SCRAMBLES
from uq.inputs.distributions import LogNormal, LogUniform

pytestmark = pytest.mark.unit
RNG = np.random.default_rng(3)


@pytest.mark.parametrize(
    ("unit", "si", "expected"),
    [
        ("mm", "m", 1e-3),
        ("cm", "m", 1e-2),
        ("mm²", "m²", 1e-6),
        ("cm^2", "m²", 1e-4),
        ("mm3", "m³", 1e-9),
        ("dm³", "m³", 1e-3),
        ("km^3", "m³", 1e9),
        ("kPa", "Pa", 1e3),
        ("GPa", "Pa", 1e9),
        ("µN", "N", 1e-6),
        ("mJ", "J", 1e-3),
        ("nm", "m", 1e-9),
        ("m", "m", 1.0),
        ("%", "1", 1e-2),
        ("1", "1", 1.0),
    ],
)
def test_units(unit, si, expected):
    assert factor(unit, si) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("unit", "si"), [("mm", "m²"), ("mm²", "m"), ("Pa", "N"), ("in", "m"), ("m3", "m2")])
def test_other_units_are_refused(unit, si):
    with pytest.raises(ValueError, match="expected"):
        factor(unit, si)


def test_heads():
    assert split_head("force [mN]") == ("force", "mN")
    assert split_head("depth (mm)") == ("depth", "mm")
    assert split_head("depth") == ("depth", None)


# --- weights ---------------------------------------------------------------------------------------------------------


def test_weights_of_points():
    np.testing.assert_allclose(normalised(np.log([1.0, 2.0, 5.0]) + 700), [0.125, 0.25, 0.625])
    assert effective_sample_size(np.full(10, 0.1)) == pytest.approx(10)
    assert effective_sample_size(np.array([0.5, 0.5, 0.0])) == pytest.approx(2)
    assert effective_sample_size(np.array([0.5, 0.25, 0.25])) == pytest.approx(8 / 3)
    counts = np.bincount(resampled(np.array([0.5, 0.0, 0.25, 0.25]), 400, seed=1), minlength=4)
    np.testing.assert_array_equal(counts, [200, 0, 100, 100])


@pytest.mark.parametrize("k", [0.2, 0.5, 0.8])
def test_the_shape_of_weights_that_are_paretos(k):
    """Quantiles of a Pareto distribution; the estimate is drawn to 1/2 as by ten weights more."""
    n = 100_000
    shape = pareto_shape(((np.arange(n) + 0.5) / n) ** -k)
    m = math.ceil(3 * math.sqrt(n))
    assert shape == pytest.approx((m * k + 5) / (m + 10), abs=0.04)


# --- evidences -------------------------------------------------------------------------------------------------------


def gaussian(c=3):
    root = RNG.normal(size=(c, c)) + 2 * np.eye(c)
    hessian = root @ root.T
    mode = RNG.normal(size=c)
    return Laplace(mode, -4.0, hessian, True, (), mode[None], np.array([-4.0]), 0.0)


def test_the_evidence_of_a_gaussian():
    """∫ exp(v − ½ δᵀHδ) (2π)^(−c/2) dx = exp(v) det H^(−½)."""
    found = gaussian()
    assert found.log_evidence == pytest.approx(-4 - np.log(np.linalg.det(found.hessian)) / 2)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(found.hessian))
    np.testing.assert_allclose(found.root @ found.root.T, np.linalg.inv(found.hessian))
    one = Laplace(np.zeros(1), 0.5, np.array([[4.0]]), True, (), np.zeros((1, 1)), np.zeros(1), 0.0)
    density = integrate.quad(lambda x: math.exp(0.5 - 2 * x**2) / math.sqrt(2 * math.pi), -9, 9)[0]
    assert one.log_evidence == pytest.approx(math.log(density))


def test_densities_of_proposals():
    """Of a Gaussian, widened, and the prior, over that of the prior."""
    found, prior = gaussian(), stats.multivariate_normal(np.zeros(3))
    x = RNG.normal(size=(20, 3))
    wide = stats.multivariate_normal(found.mode, WIDER**2 * np.linalg.inv(found.hessian))
    expected = np.log(SHARE * wide.pdf(x) / prior.pdf(x) + 1 - SHARE)
    mixture = Mixture.of(found)
    np.testing.assert_allclose(mixture.log_over_prior(x), expected, rtol=1e-9)
    two = Mixture(np.array([found.mode, -found.mode]), np.array([WIDER * found.root, 2 * np.eye(3)]))
    other = stats.multivariate_normal(-found.mode, 4 * np.eye(3))
    expected = np.log(SHARE * (wide.pdf(x) + other.pdf(x)) / 2 / prior.pdf(x) + 1 - SHARE)
    np.testing.assert_allclose(two.log_over_prior(x), expected, rtol=1e-9)
    cubes = np.random.default_rng(0).uniform(size=(40_000, 4))
    drawn = mixture.draw(cubes[cubes[:, 0] < SHARE])
    np.testing.assert_allclose(drawn.mean(axis=0), found.mode, atol=0.05)
    np.testing.assert_allclose(np.cov(drawn.T), wide.cov, atol=0.05 * wide.cov.max())
    np.testing.assert_allclose(mixture.draw(cubes[cubes[:, 0] >= SHARE]).std(axis=0), 1, atol=0.05)


@pytest.mark.parametrize("shift", [0.0, 900.0, -900.0])
def test_the_evidence_of_weights_is_their_mean(shift):
    w = RNG.uniform(0.5, 1.5, size=(SCRAMBLES, 16))
    points = SimpleNamespace(x=RNG.normal(size=(w.size, 1)))  # all distinct
    found = weighed(points, np.log(w).ravel() + shift, "importance", "")
    means = w.mean(axis=1)
    assert found.log_evidence == pytest.approx(math.log(w.mean()) + shift)
    assert found.error == pytest.approx(stats.sem(means) / means.mean())
    assert found.ess == pytest.approx(w.sum() ** 2 / (w**2).sum())
    np.testing.assert_allclose(found.weights, w.ravel() / w.sum())
    changed, error = found.reweighted(np.full(w.size, 0.25))
    assert changed == pytest.approx(found.log_evidence + 0.25)
    assert error == pytest.approx(found.error)
    change = RNG.normal(size=w.size)
    assert found.reweighted(change)[0] == pytest.approx(math.log((w.ravel() * np.exp(change)).mean()) + shift)


# --- noise -----------------------------------------------------------------------------------------------------------


def marginal(n=9, rank=4):
    """Of data d = Ax + s e with n numbers, of which x are N(0, I): d is N(0, AAᵀ + s²I), by dense matrices."""
    A = RNG.normal(size=(n, rank))
    vectors, sizes, _ = np.linalg.svd(A, full_matrices=False)
    d = RNG.normal(size=n)
    along = (vectors.T @ d) ** 2
    found = Marginal(sizes**2, along, float(d @ d - along.sum()), n, n / 2 * math.log(2 * math.pi))

    def exact(s):
        scatter = A @ A.T + s[:, None, None] ** 2 * np.eye(n)
        misfit = np.linalg.solve(scatter, np.tile(d[:, None], (len(s), 1, 1)))[..., 0] @ d
        return -(misfit + np.linalg.slogdet(scatter)[1] + n * math.log(2 * math.pi)) / 2

    return found, exact


def test_the_density_of_the_size_of_the_noise():
    found, exact = marginal()
    s = np.array([0.1, 1.0, 3.0])
    np.testing.assert_allclose(found.log_density(s), exact(s), rtol=1e-10)
    assert found.log_density(np.array([0.0]))[0] == -np.inf


@pytest.mark.parametrize("unit", [1.0, 2.0])
@pytest.mark.parametrize(
    "prior", [LogUniform(lower=0.2, upper=8.0), LogNormal(mean=1.5, std=1.0)], ids=["flat", "bell"]
)
def test_the_size_of_the_noise_is_integrated_out(prior, unit):
    """The unit is the size of the noise at which the model was linearised."""
    found, exact = marginal()
    best, log_std, log_evidence = found.integrated(prior, unit)
    x = np.linspace(-7, 7, 2801)
    s = prior.from_normal(x)[0]
    log_density = exact(s / unit) + stats.norm.logpdf(x)
    top = log_density.max()
    w = np.exp(log_density - top)
    assert log_evidence == pytest.approx(top + math.log(w.sum() * (x[1] - x[0])), abs=1e-6)
    w /= w.sum()
    assert log_std == pytest.approx(math.sqrt(w @ (np.log(s) - w @ np.log(s)) ** 2), rel=1e-4)
    assert best == pytest.approx(s[w.argmax()], rel=0.01)


# --- models and predictions ------------------------------------------------------------------------------------------


def test_probabilities_of_models():
    log_evidence, prior = np.array([-1000.0, -1000 + math.log(3), -1002.0]), np.array([0.5, 0.25, 0.25])
    expected = prior * [1, 3, math.exp(-2)]
    np.testing.assert_allclose(probabilities(log_evidence, prior), expected / expected.sum())
    P, errors = np.array([0.2, 0.8]), np.array([0.1, 0.3])
    # P = 1/(1 + Z_1/Z_0): the error of the logarithm of the ratio times P(1 − P)
    np.testing.assert_allclose(_chance_errors(P, errors), 0.16 * math.hypot(0.1, 0.3))


def test_quantiles_of_weighted_points():
    grid = np.arange(1000) / 1000 + 0.0005
    np.testing.assert_allclose(quantiles(grid[::-1], np.full(1000, 1e-3), (0.025, 0.5, 0.975)), [0.025, 0.5, 0.975])
    # twice the weight is twice the point
    np.testing.assert_allclose(
        quantiles(grid, np.where(grid < 0.5, 2.0, 1.0) / 1500, (1 / 3, 2 / 3)), [0.25, 0.5], atol=1e-3
    )
