"""Random inputs: moments, quantiles, copula."""

import mpmath
import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy import stats

from tests.functions import higher_moments
from uq.inputs.distributions import (
    Beta,
    Distribution,
    Gamma,
    LogNormal,
    LogUniform,
    Normal,
    Triangular,
    TruncatedNormal,
    Uniform,
)
from uq.inputs.quadrature import panels
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import even_points, random_points, sobol_points

# Each block beside SciPy's version of the same distribution.
PAIRS = [
    (Uniform(lower=2.0, upper=5.0), stats.uniform(2, 3)),
    (LogUniform(lower=1.0, upper=10.0), stats.loguniform(1, 10)),
    (Triangular(lower=0.0, mode=1.0, upper=3.0), stats.triang(1 / 3, 0, 3)),
    (Beta(a=2.0, b=3.0, lower=600.0, upper=900.0), stats.beta(2, 3, 600, 300)),
    (TruncatedNormal(mean=1.0, std=0.5, lower=0.5, upper=3.0), stats.truncnorm(-1, 4, 1, 0.5)),
    (Normal(mean=3.0, std=2.0), stats.norm(3, 2)),
    (LogNormal(mean=2.0, std=0.5), stats.lognorm(np.sqrt(np.log1p(1 / 16)), scale=2 / np.sqrt(1 + 1 / 16))),
    (Gamma(shape=2.0, scale=3.0, shift=1.0), stats.gamma(2, 1, 3)),
]


@pytest.mark.unit
@pytest.mark.parametrize(("block", "reference"), PAIRS, ids=lambda p: getattr(p, "kind", ""))
def test_distribution_agrees_with_scipy(block, reference):
    p = np.array([1e-6, 0.01, 0.3, 0.5, 0.9, 1 - 1e-6])
    np.testing.assert_allclose(block.quantile(p), reference.ppf(p), rtol=1e-6)
    np.testing.assert_allclose(block.moments, (reference.mean(), reference.std()), rtol=1e-5)
    ends = reference.ppf(stats.norm.cdf([-6.0, 6.0])) if block.support is None else reference.support()
    np.testing.assert_allclose(block.ends(6.0), ends, rtol=1e-6)
    assert block.range == (block.support or pytest.approx(tuple(reference.ppf([1e-4, 1 - 1e-4])), rel=1e-9))


@pytest.mark.unit
@pytest.mark.parametrize("block", [block for block, _ in PAIRS], ids=lambda b: b.kind)
def test_distribution_survives_its_own_dump(block):
    assert TypeAdapter(Distribution).validate_python(block.model_dump()) == block


@pytest.mark.unit
def test_log_normal_is_given_by_its_own_moments():
    assert LogNormal(mean=2.0, std=0.5).moments == pytest.approx((2.0, 0.5))


@pytest.mark.unit
def test_copula_gives_the_correlation_of_normals():
    inputs = Inputs({"a": Normal(mean=1.0, std=2.0), "b": Normal(mean=0.0, std=3.0)}, (("a", "b", 0.6),))
    np.testing.assert_allclose(inputs.correlation, [[1, 0.6], [0.6, 1]], rtol=1e-10)
    logarithms = Inputs(dict.fromkeys("ab", LogNormal(mean=1.0, std=2.0)), (("a", "b", 0.6),))
    np.testing.assert_allclose(logarithms.correlation, [[1, 0.6], [0.6, 1]], rtol=1e-10)


def test_correlation_is_that_of_the_coordinates_of_points():
    marginals = {
        "a": LogNormal(mean=2.0, std=1.0),
        "b": Beta(a=2.0, b=2.0, lower=0.0, upper=1.0),
        "c": Uniform(lower=0, upper=1),
    }
    inputs = Inputs(marginals, (("a", "b", 0.7), ("b", "c", -0.4)))
    points = inputs.points(random_points(3, 0, 400_000, 3))
    np.testing.assert_allclose(np.cov(inputs.coordinates.of(points).T), inputs.correlation, atol=6e-3)
    np.testing.assert_allclose(points.mean(axis=0), inputs.mean, rtol=4e-3)


@pytest.mark.unit
def test_correlation_keeps_the_marginals():
    inputs = Inputs({"a": Uniform(lower=0, upper=1), "b": Uniform(lower=0, upper=1)}, (("a", "b", 0.9),))
    points = inputs.points(random_points(5, 0, 20_000, 2))
    assert stats.kstest(points[:, 1], "uniform").pvalue > 1e-3


@pytest.mark.unit
@pytest.mark.parametrize(
    ("correlations", "message"),
    [
        ((("a", "x", 0.5),), "expected one of: a, b, c"),
        ((("a", "b", 1.0),), "−1 < value < 1"),
        ((("a", "a", 0.5),), "two different names"),
        ((("a", "b", 0.9), ("b", "c", 0.9), ("a", "c", -0.9)), "positive definite"),
    ],
)
def test_impossible_correlations(correlations, message):
    marginals = {name: Uniform(lower=0, upper=1) for name in "abc"}
    with pytest.raises(ValueError, match=message):
        Inputs(marginals, correlations)


@pytest.mark.unit
def test_points_depend_on_seed_and_index_only():
    whole = random_points(7, 0, 100, 3)
    np.testing.assert_array_equal(random_points(7, 40, 60, 3), whole[40:60])
    assert not np.array_equal(random_points(8, 0, 100, 3), whole)
    assert ((whole > 0) & (whole < 1)).all()


def test_normal_coordinates_and_their_derivatives():
    """ω(x) agrees with the quantiles at Φ(x); its derivatives with central differences."""
    from scipy.special import ndtr

    marginals = {
        "uniform": Uniform(lower=1.0, upper=3.0),
        "log-uniform": LogUniform(lower=1.0, upper=30.0),
        "triangular": Triangular(lower=0.0, upper=2.0, mode=0.5),
        "beta": Beta(a=2.0, b=2.0, lower=0.0, upper=1.0),
        "truncated": TruncatedNormal(mean=0.0, std=1.0, lower=-1.0, upper=2.0),
        "normal": Normal(mean=1.0, std=2.0),
        "log-normal": LogNormal(mean=1.0, std=0.5),
        "gamma": Gamma(shape=2.0, scale=1.0, shift=1.0),
    }
    x = np.random.default_rng(0).standard_normal((4, 8))
    independent = Inputs(marginals)
    np.testing.assert_allclose(independent.from_normals(x)[0], independent.points(ndtr(x)), rtol=1e-12)
    joined = Inputs(marginals, (("uniform", "log-uniform", 0.5), ("normal", "gamma", -0.3)))
    _, slopes = joined.from_normals(x)
    for j, step in enumerate(1e-5 * np.eye(8)):
        difference = (joined.from_normals(x + step)[0] - joined.from_normals(x - step)[0]) / 2e-5
        np.testing.assert_allclose(slopes[:, :, j], difference, atol=1e-8)


# --- distributions at awkward numbers ------------------------------------------------------------------------------


def exactly(density, *breaks):
    """Mean, standard deviation, skewness and kurtosis of a density that need not be normalised, to 30 digits."""
    with mpmath.workdps(30):
        points = [mpmath.mpf(b) for b in breaks]
        whole = mpmath.quad(density, points)
        mean = points[0] + mpmath.quad(lambda x: (x - points[0]) * density(x), points) / whole
        second, third, fourth = (
            mpmath.quad(lambda x, k=k: (x - mean) ** k * density(x), points) / whole for k in (2, 3, 4)
        )
        return [float(x) for x in (mean, mpmath.sqrt(second), third / second**1.5, fourth / second**2)]


def moments_of(marginal):
    (mean, std), (third, fourth) = marginal.moments, higher_moments(marginal)
    return [mean, std, third / std**3, fourth / std**4]


@pytest.mark.parametrize("cut", [8.0, 10.0, 38.0, 1e3])
@pytest.mark.parametrize("sign", [1, -1])
def test_normals_that_are_cut_far_in_their_tails(cut, sign):
    ends = sorted((sign * cut, sign * 2 * cut))
    marginal = TruncatedNormal(mean=0.0, std=1.0, lower=ends[0], upper=ends[1])
    breaks = [cut, *(cut + k / cut for k in (1, 3, 9, 27, 81) if k < cut**2), 2 * cut]
    mean, std, skewness, kurtosis = exactly(lambda x: mpmath.exp(-(x**2 - mpmath.mpf(cut) ** 2) / 2), *breaks)
    np.testing.assert_allclose(moments_of(marginal), [sign * mean, std, sign * skewness, kurtosis], rtol=1e-9)
    p = np.array([1e-3, 0.2, 0.5, 0.9, 1 - 1e-6])
    values = marginal.quantile(p)
    assert ((values >= ends[0]) & (values <= ends[1])).all()
    np.testing.assert_allclose(marginal.cumulative(values), p, rtol=1e-6)
    with mpmath.workdps(40):
        below, above = (mpmath.ncdf(-abs(e)) for e in (2 * cut, cut))
        shares = [(mpmath.ncdf(-abs(v)) - below) / (above - below) for v in values.tolist()]
    share = np.array([float(s) for s in shares])  # farther out than v
    np.testing.assert_allclose(share, 1 - p if sign > 0 else p, rtol=1e-5)


@pytest.mark.parametrize(
    ("marginal", "density", "breaks"),
    [
        (LogUniform(lower=1e-3, upper=1e3), lambda x: 1 / x, [10.0**k for k in range(-3, 4)]),
        (LogUniform(lower=1e-8, upper=1e8), lambda x: 1 / x, [10.0**k for k in range(-8, 9)]),
        (Triangular(lower=0.0, mode=1e-6, upper=3.0), lambda x: min(x * 1e6, (3 - x) / (3 - 1e-6)), [0, 1e-6, 3]),
        (TruncatedNormal(mean=0.0, std=1.0, lower=0.0, upper=1e-3), lambda x: mpmath.exp(-(x**2) / 2), [0, 1e-3]),
    ],
    ids=["six decades", "sixteen decades", "triangular", "truncated-normal"],
)
def test_moments_up_to_the_fourth(marginal, density, breaks):
    np.testing.assert_allclose(moments_of(marginal), exactly(density, *breaks), rtol=1e-7)


@pytest.mark.unit
@pytest.mark.parametrize(("a", "b"), [(0.5, 1.5), (1.3, 0.7), (1e-3, 1e-3), (1e-2, 5.0), (1e3, 2e3), (1.0, 1.0)])
def test_beta_at_awkward_exponents(a, b):
    skewness = 2 * (b - a) * np.sqrt(a + b + 1) / ((a + b + 2) * np.sqrt(a * b))
    excess = 6 * ((a - b) ** 2 * (a + b + 1) - a * b * (a + b + 2)) / (a * b * (a + b + 2) * (a + b + 3))
    expected = [a / (a + b), np.sqrt(a * b / (a + b + 1)) / (a + b), skewness, 3 + excess]
    np.testing.assert_allclose(moments_of(Beta(a=a, b=b, lower=0.0, upper=1.0)), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.unit
@pytest.mark.parametrize("cv", [1e-3, 0.1, 1.0, 10.0])
def test_log_normal_from_narrow_to_wide(cv):
    marginal = LogNormal(mean=3.0, std=3 * cv)
    w = 1 + cv**2
    np.testing.assert_allclose(marginal.moments, [3, 3 * cv], rtol=1e-12)
    assert marginal.quantile(np.array([0.5]))[0] == pytest.approx(3 / np.sqrt(w), rel=1e-12)


AWKWARD = [
    Uniform(lower=1e6, upper=1e6 + 1),
    LogUniform(lower=1e-6, upper=1e6),
    Triangular(lower=1.0, mode=2.0, upper=2.0),
    Beta(a=0.3, b=0.6, lower=0.0, upper=1.0),
    Beta(a=50.0, b=900.0, lower=0.0, upper=1.0),
    TruncatedNormal(mean=0.0, std=1.0, lower=-40.0, upper=-9.0),
    TruncatedNormal(mean=0.0, std=1.0, lower=-1.0, upper=9.0),
    TruncatedNormal(mean=0.0, std=1.0, lower=0.3, upper=0.31),
    LogNormal(mean=1.0, std=10.0),
    Gamma(shape=0.3, scale=2.0),
    Gamma(shape=1e4, scale=2.0),
]


@pytest.mark.unit
@pytest.mark.parametrize("marginal", AWKWARD, ids=lambda m: m.kind)
def test_normal_coordinates_of_awkward_distributions(marginal):
    from scipy.special import ndtr

    z = np.array([-5.0, -2.0, -0.3, 0.4, 2.0, 5.0])
    values, slopes = marginal.from_normal(z)
    np.testing.assert_allclose(marginal.cumulative(values), ndtr(z), rtol=1e-5, atol=1e-9)
    step = 1e-3
    at = [marginal.from_normal(z + k * step)[0] for k in (-2, -1, 1, 2)]
    differences = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step)
    np.testing.assert_allclose(slopes, differences, rtol=1e-4, atol=1e-6 * marginal.moments[1])
    bell = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(marginal.density(values) * slopes, bell, rtol=1e-5)


@pytest.mark.unit
@pytest.mark.parametrize(
    "build",
    [
        lambda: Uniform(lower=1.0, upper=1.0 + 1e-12),
        lambda: Normal(mean=1e5, std=1e-8),
        lambda: LogNormal(mean=1.0, std=1e-13),
        lambda: Beta(a=2.0, b=3.0, lower=1e6, upper=1e6 + 1e-5),
        lambda: TruncatedNormal(mean=0.0, std=1.0, lower=1e6, upper=2e6),
        lambda: Gamma(shape=2.0, scale=1e-9, shift=100.0),
        lambda: Triangular(lower=7.0, mode=7.0, upper=7.0 + 1e-13),
        lambda: LogUniform(lower=3.0, upper=3.0 + 1e-13),
    ],
)
def test_distributions_too_narrow_for_numbers_are_refused(build):
    with pytest.raises(ValueError, match="too narrow for double precision"):
        build()


@pytest.mark.unit
@pytest.mark.parametrize("dimension", [1, 2, 7, 40, 300])
def test_sobol_points_are_those_of_scipy_before_they_are_scrambled(dimension, monkeypatch):
    """A scramble by the unit matrix and no shift leaves them."""
    monkeypatch.setattr("uq.inputs.sampling._scramble", lambda found, _: (np.zeros(dimension, np.uint64), found))
    expected = stats.qmc.Sobol(dimension, scramble=False, bits=52).random(2**9)
    np.testing.assert_array_equal(sobol_points(1, 0, 0, 2**9, dimension) - 2.0**-53, expected)


@pytest.mark.unit
def test_more_dimensions_than_sobol_points_have():
    with pytest.raises(ValueError, match="30000 dimensions, expected at most 21201"):
        even_points(8, 30000)


@pytest.mark.unit
def test_the_points_of_a_rule_are_found_once(monkeypatch):
    """A method asks for the same rule hundreds of times; to find its points took three quarters of all its time."""
    panels([0.0, 1.0])
    monkeypatch.setattr(np.polynomial.legendre, "leggauss", None)
    x, w = panels([0.0, 1.0, 3.0])
    np.testing.assert_allclose((w @ x**2, w.sum()), (9, 3), rtol=1e-13)
