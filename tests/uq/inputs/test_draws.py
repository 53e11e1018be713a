"""Parameters given by draws: their map of the cube, their polynomials, and what methods make of them."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from forward.pointwise import FunctionModel
from tests.functions import AtOnce
from uq.estimators.input_sample_error import with_errors_of_draws
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points, sobol_points
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.multilevel_chaos import MultilevelChaos
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.methods.sobol import Sobol
from uq.surrogates.basis import hyperbolic, orthonormal
from uq.surrogates.expansion import Expansion

NAMES = ("x", "y", "z")
COVARIANCE = np.array([[1.0, 0.9, 0.2], [0.9, 1.0, 0.3], [0.2, 0.3, 1.0]])
SLOPES = np.array([1.0, 2.0, -1.0, 0.5])  # of a parameter of its own, and of the draws


pytestmark = pytest.mark.usefixtures("few_draws")


def normal_draws(count=500, seed=1, weighted=False):
    rng = np.random.default_rng(seed)
    values = 5 + rng.standard_normal((count, 3)) @ np.linalg.cholesky(COVARIANCE).T
    weights = rng.random(count) ** 2 if weighted else np.ones(count)
    weights /= weights.sum()
    return Draws(NAMES, values, weights, 1 / (weights**2).sum())


def value(p):
    return [SLOPES @ p, np.exp(0.1 * p[1]) * (1 + p[0] ** 2) + p[2] * p[3]]


def jacobian(p):
    e = np.exp(0.1 * p[1])
    return [SLOPES, [2 * p[0] * e, 0.1 * e * (1 + p[0] ** 2), p[3], p[2]]]


def problem(draws):
    inputs = Inputs({"own": Normal(mean=0.0, std=1.0)}, draws=draws)
    return inputs, AtOnce(FunctionModel(value, inputs.names, ("linear", "other"), jacobian))


def exact(draws):
    """Mean and standard deviation over the draws, with the own parameter integrated in closed form."""
    w, (x, y, z) = draws.weights, draws.values.T
    linear, e = draws.values @ SLOPES[1:], np.exp(0.1 * x)
    means = np.array([w @ linear, w @ (2 * e + y * z)])
    within = np.array([1.0, w @ (2 * e**2)])  # of a², a standard normal: variance 2
    between = np.array([w @ (linear - means[0]) ** 2, w @ (2 * e + y * z - means[1]) ** 2])
    return means, np.sqrt(within + between)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("count", [5, 300])
def test_the_map_of_the_cube_keeps_the_weights(count, weighted):
    draws = normal_draws(count, weighted=weighted)
    n = 2**16
    for cubes, error in ((sobol_points(0, 0, 0, n, 3), 2e-4), (random_points(0, 0, n, 3), 0.01)):
        points = draws.points(cubes)
        found = (points[:, None, 0] == draws.values[None, :, 0]).mean(axis=0)
        np.testing.assert_allclose(found, draws.weights, atol=error)


def test_equal_draws_are_one_with_their_weights_together():
    values = np.repeat(normal_draws(7).values, [1, 5, 2, 1, 1, 1, 1], axis=0)
    draws = Draws(NAMES, values, np.full(12, 1 / 12), 12.0)
    points = draws.points(sobol_points(0, 0, 0, 2**14, 3))
    assert (points[:, 0] == values[1, 0]).mean() == pytest.approx(5 / 12, abs=2e-4)


def test_neighbours_in_the_cube_are_neighbours_among_the_draws():
    draws = normal_draws(4096)
    for n, share in ((64, 0.2), (1024, 0.15)):  # of the error of independent points
        means = [draws.points(sobol_points(s, 0, 0, n, 3)).mean(axis=0) for s in range(20)]
        assert (np.std(means, axis=0) < share / np.sqrt(n)).all()


def test_draws_of_equal_weight_come_in_turn():
    draws = normal_draws(50)
    inputs = Inputs({"own": Uniform(lower=0.0, upper=1.0)}, draws=draws)
    points = inputs.random(3, 0, 120)
    for part in (points[:50], points[50:100]):
        assert np.array_equal(np.sort(part[:, 1]), np.sort(draws.values[:, 0]))
    assert not np.array_equal(points[:50, 1], points[50:100, 1])
    assert np.array_equal(points[37:104], inputs.random(3, 37, 104))


def test_polynomials_are_orthonormal_in_the_measure_of_strongly_dependent_draws():
    rng = np.random.default_rng(0)
    values = (
        rng.standard_normal((800, 2)) @ np.array([[1, 0.999], [0, 0.02]]) + 0.2 * rng.standard_normal((800, 2)) ** 2
    )
    weights = rng.random(800)
    draws = Draws(("p", "q"), values, weights / weights.sum(), 500.0)
    basis = orthonormal(Inputs({"a": Uniform(lower=0.0, upper=1.0)}, draws=draws), hyperbolic(3, 5, 1.0))
    alone = basis.subset(np.flatnonzero(basis.indices[:, 0] == 0))
    points = np.hstack([np.full((800, 1), 0.5), values])
    phi = alone.values(points)
    np.testing.assert_allclose(phi.T @ (draws.weights[:, None] * phi), np.eye(phi.shape[1]), atol=1e-12)
    t, h = basis.coordinates.of(points[:5]), 1e-6
    for i, slopes in enumerate(np.swapaxes(basis.derivatives(points[:5]), 0, 1)):
        step = h * np.eye(3)[i]
        ends = [basis.values(basis.coordinates.points(t + s * step)) for s in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), slopes, atol=1e-7 * np.abs(slopes).max())


METHODS = [
    MonteCarlo(samples=1024),
    SensitivityMonteCarlo(samples=512),
    QuasiMonteCarlo(samples=512, control="none"),
    QuasiMonteCarlo(samples=512),
    QuasiMonteCarlo(samples=512, control="quadratic"),
    QuasiMonteCarlo(samples=512, control="chaos"),
    Chaos(samples=50),
]


@pytest.mark.few(2)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("method", METHODS, ids=lambda one: f"{one.kind} {getattr(one, 'control', '')}")
def test_methods_integrate_over_the_draws(method, weighted):
    draws = normal_draws(weighted=weighted)
    inputs, evaluate = problem(draws)
    found = method.run(inputs, evaluate)
    means, stds = exact(draws)
    for name, right in (("mean", means), ("std", stds)):
        off = np.abs(found[name].to_numpy() - right)
        assert (off < 4 * found[f"{name}_error"].to_numpy() + 1e-12 * np.abs(right)).all(), (name, off)
    if method.kind == "chaos":
        np.testing.assert_allclose(found["mean"], means, rtol=1e-6)
        np.testing.assert_allclose(found["std"], stds, rtol=1e-6)


def shapley_of_normal(covariance, slopes):
    """A. B. Owen and C. Prieur, SIAM/ASA J. Uncertain. Quantif. 5 (2017) 986–1002, theorem 2, by all subsets."""
    d, variance = len(slopes), slopes @ covariance @ slopes

    def known(u):
        rest = [i for i in range(d) if i not in u]
        if not u or not rest:
            return variance if u else 0.0
        a, b = covariance[np.ix_(rest, u)], covariance[np.ix_(u, u)]
        left = covariance[np.ix_(rest, rest)] - a @ np.linalg.solve(b, a.T)
        return variance - slopes[rest] @ left @ slopes[rest]

    found = np.zeros(d)
    for i in range(d):
        for k in range(d):
            for u in itertools.combinations([j for j in range(d) if j != i], k):
                found[i] += (known([*u, i]) - known(list(u))) / math.comb(d - 1, k) / d
    return found / variance


def test_shapley_effects_are_those_of_the_closed_form():
    draws = normal_draws(2000)
    inputs, evaluate = problem(draws)
    found = Chaos(samples=40, max_order=4).run(inputs, evaluate)
    effects, errors = found["shapley"].to_numpy(), found["shapley_error"].to_numpy()
    np.testing.assert_allclose(effects.sum(axis=1), 1, atol=1e-12)
    whole = np.eye(4)
    for covariance, slack in ((np.cov(draws.values.T), 0.002), (COVARIANCE, 0.0)):
        whole[1:, 1:] = covariance
        off = np.abs(effects[0] - shapley_of_normal(whole, SLOPES))
        assert (off < slack + 4 * (not slack) * errors[0]).all(), off
    assert not [name for name in found if "sobol" in name]


def test_shapley_effects_of_independent_draws_lie_between_sobol_indices():
    rng = np.random.default_rng(4)
    values = rng.uniform(-1, 1, (4000, 3))
    draws = Draws(NAMES, values, np.full(4000, 1 / 4000), 4000.0)
    inputs = Inputs({}, draws=draws)
    model = FunctionModel(lambda p: [p[0] + p[0] * p[1] + 0.1 * p[2] ** 2], NAMES, ("f",))
    found = Chaos(samples=200, max_order=3).run(inputs, SerialEvaluate(model))
    alone, both = 1 / 3, 1 / 9  # variances of x and xy
    whole = alone + both + 0.01 * 4 / 45
    right = np.array([alone + both / 2, both / 2, 0.01 * 4 / 45]) / whole
    np.testing.assert_allclose(found["shapley"][0], right, atol=0.03)


def test_an_expansion_of_draws_can_be_called():
    draws = normal_draws()
    inputs, evaluate = problem(draws)
    expansion = Expansion.of(Chaos(samples=50).run(inputs, evaluate))
    points = np.hstack([np.full((20, 1), 0.3), draws.values[:20]])
    np.testing.assert_allclose(expansion.outputs(points), [value(p) for p in points], rtol=1e-5)
    np.testing.assert_allclose(expansion.tangents(points), [jacobian(p) for p in points], rtol=1e-3, atol=1e-3)


def test_few_draws_limit_the_degree():
    draws = normal_draws(60)
    inputs, evaluate = problem(draws)
    assert draws.largest_degree == 2  # ten functions of the fifteen that 60 draws tell apart
    found = Chaos(samples=50, quantiles=()).run(inputs, evaluate)
    assert found["joint_index"].to_numpy().sum(axis=1).max() == 2
    assert "degree 2" in MultilevelChaos(order=3).objection(inputs)


@pytest.mark.parametrize(
    ("method", "said"), [(Sobol(samples=64), "Shapley effects"), (Chaos(fit="projection", max_order=2), "Gauss")]
)
def test_methods_that_need_independent_parameters_say_so(method, said):
    inputs, _ = problem(normal_draws())
    assert said in method.objection(inputs)


def test_one_parameter_of_draws_is_independent():
    draws = normal_draws(1000)
    alone = Draws(("x",), draws.values[:, :1], draws.weights, 1000.0)
    inputs = Inputs({"a": Uniform(lower=-1.0, upper=1.0)}, draws=alone)
    found = Sobol(samples=512).run(inputs, SerialEvaluate(FunctionModel(lambda p: [p[0] + p[1]], inputs.names, ("f",))))
    share = (1 / 3) / (1 / 3 + draws.values[:, 0].var())
    np.testing.assert_allclose(found["sobol_total"][0], [share, 1 - share], atol=0.02)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "method",
    [
        MonteCarlo(samples=200),
        QuasiMonteCarlo(samples=256),
        Chaos(samples=12, max_order=2, quantiles=()),
        SensitivityMonteCarlo(samples=64),
    ],
)
def test_errors_count_that_draws_are_few(method):
    """95 % intervals of the mean and the standard deviation of the normal distribution that draws are of."""
    inside = {"mean": [], "std": []}
    whole = np.eye(4)
    whole[1:, 1:] = COVARIANCE
    right = {"mean": SLOPES[1:].sum() * 5, "std": np.sqrt(SLOPES @ whole @ SLOPES)}
    for seed in range(30):
        inputs, evaluate = problem(normal_draws(200, seed))
        found = method.run(inputs, evaluate)
        found = with_errors_of_draws(found, inputs, method.in_turn * found.sizes["sample"])
        for name, covered in inside.items():
            off = abs(float(found[name][0]) - right[name])
            covered.append(off < 1.96 * float(found[f"{name}_error"][0]))
    for name, covered in inside.items():
        assert np.sum(covered) >= stats.binom.ppf(0.005, 30, 0.95), name  # of 50 it would be 86 %


def test_few_samples_of_many_draws_do_not_claim_the_draws_beyond_them():
    """Rational and exponential functions of three dependent numbers: eight samples reach no end of 600 draws."""
    held = []
    for seed in range(6):
        values = np.random.default_rng(seed).standard_normal((600, 3)) @ np.linalg.cholesky(COVARIANCE).T
        draws = Draws(NAMES, values, np.full(600, 1 / 600), 600.0)
        e, r = np.exp(0.5 * values[:, :2].sum(axis=1)), 1 / (1 + 0.3 * (values[:, 0] - values[:, 2]) ** 2)

        def both(p):
            return [np.exp(0.5 * (p[0] + p[1])), 1 / (1 + 0.3 * (p[0] - p[2]) ** 2)]

        def slopes(p):
            x, inverse = p[0] - p[2], 1 / (1 + 0.3 * (p[0] - p[2]) ** 2)
            up, down = 0.5 * np.exp(0.5 * (p[0] + p[1])), -0.6 * x * inverse**2
            return [[up, up, 0], [down, 0, -down]]

        evaluate = SerialEvaluate(FunctionModel(both, NAMES, ("e", "r"), slopes))
        found = Chaos(samples=8, seed=seed, quantiles=()).run(Inputs({}, draws=draws), evaluate)
        held.append(np.abs(found["std"].to_numpy() - [e.std(), r.std()]) < 1.96 * found["std_error"].to_numpy())
    assert np.mean(held) >= 0.8
