"""Random inputs: moments, quantiles, copula."""

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy import stats

from uq.distributions import (
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
from uq.inputs import Inputs
from uq.sampling import random_points

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


@pytest.mark.parametrize(("block", "reference"), PAIRS, ids=lambda p: getattr(p, "kind", ""))
def test_distribution_agrees_with_scipy(block, reference):
    p = np.array([1e-6, 0.01, 0.3, 0.5, 0.9, 1 - 1e-6])
    np.testing.assert_allclose(block.quantile(p), reference.ppf(p), rtol=1e-6)
    np.testing.assert_allclose(block.moments, (reference.mean(), reference.std()), rtol=1e-5)


@pytest.mark.parametrize("block", [block for block, _ in PAIRS], ids=lambda b: b.kind)
def test_distribution_survives_its_own_dump(block):
    assert TypeAdapter(Distribution).validate_python(block.model_dump()) == block


def test_log_normal_is_given_by_its_own_moments():
    assert LogNormal(mean=2.0, std=0.5).moments == pytest.approx((2.0, 0.5))


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


def test_correlation_keeps_the_marginals():
    inputs = Inputs({"a": Uniform(lower=0, upper=1), "b": Uniform(lower=0, upper=1)}, (("a", "b", 0.9),))
    points = inputs.points(random_points(5, 0, 20_000, 2))
    assert stats.kstest(points[:, 1], "uniform").pvalue > 1e-3


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
