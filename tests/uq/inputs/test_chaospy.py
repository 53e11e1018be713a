"""Distributions of chaospy by their names: the same as SciPy's, or refused with the reason."""

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from tests.functions import higher_moments
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from uq.methods.derivative_based import poincare
from uq.surrogates.basis import hyperbolic, orthonormal

BLOCKS = TypeAdapter(Distribution)
PAIRS = [
    ({"name": "LogGamma", "shape": 2.0}, stats.loggamma(2.0)),
    ({"name": "Weibull", "shape": 1.7, "scale": 3.0}, stats.weibull_min(1.7, scale=3.0)),
    ({"name": "StudentT", "df": 9.0}, stats.t(9.0)),
    ({"name": "ChiSquared", "df": 3.0, "nc": 1.0}, stats.ncx2(3.0, 1.0)),
    ({"name": "GeneralizedGamma", "shape1": 1.5, "shape2": 2.5}, stats.gengamma(1.5, 2.5)),
    ({"name": "PowerLaw", "shape": 2.5, "lower": 2.0, "upper": 5.0}, stats.powerlaw(2.5, 2.0, 3.0)),
    ({"name": "Maxwell", "scale": 2.0}, stats.maxwell(scale=2.0)),
]


def made(**block):
    return BLOCKS.validate_python({"kind": "chaospy", **block})


@pytest.mark.parametrize(("block", "reference"), PAIRS, ids=lambda one: one["name"] if isinstance(one, dict) else "")
def test_they_are_what_scipy_says(block, reference):
    found = made(**block)
    p = np.array([1e-6, 0.01, 0.3, 0.5, 0.9, 1 - 1e-6])
    np.testing.assert_allclose(reference.cdf(found.quantile(p)), p, atol=1e-6)
    np.testing.assert_allclose(found.moments, (reference.mean(), reference.std()), rtol=1e-5, atol=1e-9)
    skewness, kurtosis = (float(one) for one in reference.stats("sk"))
    third, fourth = higher_moments(found)
    std = found.moments[1]
    assert third / std**3 == pytest.approx(skewness, abs=1e-3)
    assert fourth / std**4 == pytest.approx(kurtosis + 3, rel=1e-3)


def test_the_ends_are_those_of_the_constructor():
    assert made(name="Kumaraswamy", alpha=2, beta=3, lower=1.0, upper=4.0).support == (1.0, 4.0)
    assert made(name="Weibull", shape=2).support is None


def test_logarithms_are_taken_where_the_reciprocal_has_a_variance():
    assert made(name="GeneralizedGamma", shape1=1.5, shape2=2.5).logarithmic  # p ∝ ω^3.75 near zero
    assert not made(name="Weibull", shape=1.5).logarithmic  # p ∝ ω^1.5


@pytest.mark.parametrize("block", [{"name": "LogGamma", "shape": 2.0}, {"name": "Weibull", "shape": 3.0}])
def test_its_polynomials_are_orthonormal(block):
    one = made(**block)
    z, weights = np.polynomial.hermite_e.hermegauss(120)
    rows = orthonormal(Inputs({"a": one}), hyperbolic(1, 3, 1.0)).values(one.from_normal(z)[0][:, None])
    np.testing.assert_allclose((rows.T * weights / weights.sum()) @ rows, np.eye(4), atol=1e-4)


def test_it_survives_its_own_dump_and_numbers_are_checked():
    one = made(name="Weibull", shape=2, scale=3)
    assert BLOCKS.validate_python(one.model_dump()) == one
    assert hash(one) == hash(made(name="Weibull", shape=2, scale=3))
    assert one != made(name="Weibull", shape=2, scale=4)


@pytest.mark.parametrize(
    ("block", "said"),
    [
        ({"name": "Weibul", "shape": 2}, "no distribution 'Weibul'; did you mean 'Weibull'?"),
        ({"name": "Weibull", "shapes": 2}, "no number 'shapes'; did you mean 'shape'?"),
        ({"name": "PERT", "lower": 0, "upper": 1}, "needs a number 'mode'"),
        ({"name": "Weibull", "shape": "two"}, "valid number"),
        ({"name": "Cauchy"}, "too heavy"),
        ({"name": "StudentT", "df": 2}, "too heavy"),
        (
            {"name": "ChiSquared", "df": 3, "nc": 0},
            "not those of its distribution function",
        ),  # its density is no number
        ({"name": "Wald"}, "not those of its distribution function"),
        ({"name": "Binomial", "size": 3, "prob": 0.5}, "not one continuous number"),
        ({"name": "MvNormal", "mu": 1, "sigma": 2}, "MvNormal"),
        ({"name": "Iid", "dist": 1, "length": 2}, "no distribution 'Iid'"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_reason(block, said):
    with pytest.raises(ValidationError, match=said):
        made(**block)


def test_poincare_constants_are_those_of_our_own_kinds_and_none_of_heavy_tails():
    own = BLOCKS.validate_python({"kind": "normal", "mean": 1.0, "std": 2.0})
    same = made(name="Normal", mu=1.0, sigma=2.0)
    assert poincare(same, logarithm=False) == pytest.approx(poincare(own, logarithm=False), rel=1e-6)
    assert np.isinf(poincare(made(name="Weibull", shape=0.7), logarithm=False))
    assert np.isinf(poincare(made(name="LogNormal", mu=0.0, sigma=0.5), logarithm=False))
    assert np.isinf(poincare(made(name="StudentT", df=9), logarithm=False))
    # of exponential tails it is four times the square of the scale
    assert 3.0 < poincare(made(name="Laplace", mu=0.0, sigma=1.0), logarithm=False) <= 4.0 * (1 + 1e-6)
