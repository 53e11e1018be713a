"""Moments and ends of intervals of skewed posteriors of few parameters, against quadrature."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from forward.pointwise import FunctionModel
from inverse.criticism.assessment import Assessment, answer, by_points, even
from inverse.criticism.doubts import HEAVY, heavy_tails, tails_cut
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import _corrected, evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs

CELLS = 2000
LEVELS = (0.025, 0.975)


def at_a_bound(p):
    return p[:1]


def saturating(p):
    return p[:1] / (1 + p[:1])


def bent(p):
    return np.exp(p[:1]) + 0.3 * p[1:]


CASES = {
    "at a bound": (at_a_bound, lambda p: [[1.0]], {"a": Uniform(lower=0, upper=1)}, 0.02, 0.05),
    "saturating": (saturating, lambda p: [[1 / (1 + p[0]) ** 2]], {"a": Uniform(lower=0, upper=50)}, 0.9, 0.05),
    "bent": (
        bent,
        lambda p: [[np.exp(p[0]), 0.3]],
        {"a": Normal(mean=0, std=1), "b": Normal(mean=0, std=1)},
        1.0,
        0.5,
    ),
}


def posterior(case, seed):
    """A posterior of one datum, and points of the prior with their weights in it."""
    function, slopes, priors, datum, sigma = CASES[case]
    data = np.array([datum + sigma * (np.random.default_rng(seed).normal() if seed else 0.0)])
    inputs = Inputs(priors)
    model = FunctionModel(function, tuple(priors), ("y",), lambda p: np.array(slopes(p)))
    middles = (np.arange(CELLS) + 0.5) / CELLS
    grid = np.stack(np.meshgrid(*[middles] * len(priors), indexing="ij"), axis=-1).reshape(-1, len(priors))
    points = inputs.points(grid)
    weights = np.exp(-0.5 * ((function(points.T)[0] - data[0]) / sigma) ** 2)
    weights /= weights.sum()
    return Posterior(inputs, SerialEvaluate(model), data, Noise(np.array([sigma]))), points, weights


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", range(3))
def test_moments_and_ends_are_those_of_the_posterior(case, seed):
    """Of 256 points six lie beyond an end; and points of the prior, with larger weights, look like a tail."""
    one, points, weights = posterior(case, seed)
    mean = weights @ points
    std = np.sqrt(weights @ (points - mean) ** 2)
    gaussian = laplace(one)
    found = evidence(one, gaussian, 256, seed=seed)
    known = answer(one, Assessment(gaussian, found))
    assert known.source == "points"
    assert np.abs((known.mean - mean) / std).max() < 0.1
    assert np.abs(known.std / std - 1).max() < 0.1
    for below, level in zip(known.quantiles(LEVELS).T, LEVELS, strict=True):
        assert np.abs(weights @ (points <= below) - level).max() < 0.0125  # half of what is outside an end


def test_a_polynomial_of_few_points_says_that_it_cuts_tails_off():
    """All points that are picked from it agree with it; deviations are a quarter too small."""
    one, points, weights = posterior("bent", 2)
    gaussian = laplace(one)
    few, usual = (evidence(one, gaussian, samples, seed=2) for samples in (32, 256))
    std = np.sqrt(weights @ (points - weights @ points) ** 2)
    assert (answer(one, Assessment(gaussian, few)).std / std).min() < 0.8
    (said,) = tails_cut(few.cut)
    assert said.severity == "warning"
    assert not tails_cut(usual.cut)


def test_what_a_polynomial_misses_is_not_believed():
    """With a jump that no polynomial follows, solved points are what counts."""
    one, *_ = posterior("at a bound", 0)
    jump = FunctionModel(lambda p: p[:1] + 0.1 * (p[0] > 0.03), ("a",), ("y",), lambda p: np.ones((1, 1)))
    torn = Posterior(one.inputs, SerialEvaluate(jump), one.data, one.noise)
    found = evidence(torn, laplace(torn), 256)
    assert not found.agreed


def test_deviations_that_rest_on_a_tail_are_doubted():
    """A datum that bounds nothing above leaves the tail of a log-normal prior; a normal quantity has 8 % out there."""
    z = ndtri((np.arange(100_000) + 0.5) / 100_000)
    known = by_points("points", np.column_stack([z, np.exp(0.58 * z), np.exp(1.5 * z)]), even(len(z)))
    edge = ndtri(0.995)
    normal = 2 * (edge * np.exp(-(edge**2) / 2) / np.sqrt(2 * np.pi) + ndtr(-edge))
    np.testing.assert_allclose(known.outermost[:2], [normal, HEAVY], atol=0.01)
    found = heavy_tails(["a", "b", "c"], known.outermost + np.array([0, 0.02, 0]))
    assert [(one.values["name"], one.severity) for one in found] == [("b", "note"), ("c", "warning")]
    priors = {"a": LogNormal(mean=5, std=20)}
    model = FunctionModel(saturating_at_five, ("a",), ("y",), lambda p: np.array([[5 / (5 + p[0]) ** 2]]))
    of = Posterior(Inputs(priors), SerialEvaluate(model), np.array([0.5]), Noise(np.array([0.4])))
    gaussian = laplace(of)
    (one,) = heavy_tails(of.names, answer(of, Assessment(gaussian, evidence(of, gaussian, 256))).outermost)
    assert one.severity == "warning"


def saturating_at_five(p):
    return p / (5 + p)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("far", "physical", "helps"),
    [(0.5, np.array, True), (3.0, np.array, False), (1.0, np.array, True), (1.0, lambda x: np.tanh(5 * x**9), False)],
)
def test_a_polynomial_that_leaves_a_negative_variance_is_no_help(far, physical, helps):
    """It gives half of its weight to points that the posterior does not have; near them that is a correction.

    Also where only the parameter, which lies near one of two ends, has a negative variance.
    """
    n, rng = 64, np.random.default_rng(0)
    x = np.concatenate([0.01 * rng.standard_normal((n // 2, 1)), far * rng.choice([-1.0, 1.0], (n // 2, 1))])
    found = SimpleNamespace(density=SimpleNamespace(x=x), weights=np.repeat([2 / n, 0.0], n // 2))
    flat = SimpleNamespace(at=lambda points: SimpleNamespace(log_likelihood=np.zeros(len(points))))
    cloud = SimpleNamespace(surrogate=flat, x=rng.standard_normal((4096, 1)), weights=even(4096))
    corrected = _corrected(SimpleNamespace(physical=physical), found, np.zeros(n), cloud)
    assert (corrected is not None) == helps
