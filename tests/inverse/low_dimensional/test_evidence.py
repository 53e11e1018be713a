"""Evidence: closed forms, brute force, nested sampling, and whether the stated errors are honest."""

from dataclasses import replace
from functools import cache
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import chi2

from forward.materials.admissible import Materials
from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.assessment import own_seconds
from inverse.criticism.weights import pareto_shape
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence, nested
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.low_dimensional.surrogate import _regression, _tempered, fit, operations, sample
from inverse.methods.selection import _rescaled
from inverse.methods.selection import posterior as assemble
from tests.problems import FOUR, ridge, slopes_of_four, two_of_four
from tests.rubber import CONFIGS, CURVED, FACTOR, LINEAR, on_treloar, treloar
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from workflows.config.study import load

remembered = cache(sobol_points)


def brute_force(posterior, draws=2**19):
    """Ln of the mean likelihood over points of the prior."""
    points = posterior.inputs.points(remembered(5, 0, 0, draws, 4))
    misfit = (((two_of_four(points) - posterior.data) / posterior.noise.sigma) ** 2).sum(axis=1) / 2
    return logsumexp(-misfit) - np.log(draws) - np.log(2 * np.pi * posterior.noise.sigma.prod())


@pytest.mark.few(1)
@pytest.mark.flags
@pytest.mark.parametrize(
    ("noise", "allowed", "repeats"), [(0.3, 0.03, 4), pytest.param(0.1, 0.1, 4, marks=pytest.mark.slow), (0.03, 0.3, 4)]
)
def test_curved_ridge(noise, allowed, repeats):
    posterior = ridge(noise)
    truth = brute_force(posterior)
    gaussian = laplace(posterior)
    assert abs(gaussian.log_evidence - truth) > 0.3
    found = [evidence(posterior, gaussian, 256, seed=seed) for seed in range(repeats)]
    errors = np.array([one.log_evidence - truth for one in found])
    stated = np.array([one.error for one in found])
    assert np.sqrt((errors**2).mean()) < allowed
    # The sum of squared errors over stated ones is χ² with as many degrees of freedom; one in a thousand is outside.
    low, high = chi2(repeats).ppf([0.0005, 0.9995])
    assert low < ((errors / stated) ** 2).sum() < high
    assert all(one.trusted and one.density.x.shape[0] <= 256 for one in found)
    assert {one.route for one in found} <= {"surrogate", "importance"}


def test_route_and_reason_are_stated():
    wide = on_treloar("mooney-rivlin", LINEAR["mooney-rivlin"])  # to where there is no material, nor a Gaussian
    assert evidence(wide, laplace(wide), 64).route != "closed form"
    narrow = {"C1": Normal(mean=2e5, std=2e4), "C2": Normal(mean=0.0, std=1e4)}
    linear = on_treloar("mooney-rivlin", narrow)
    found = evidence(linear, laplace(linear), 64)
    assert (found.route, found.log_evidence) == ("closed form", laplace(linear).log_evidence)
    assert found.error < 1e-8
    one = on_treloar("neo-hookean", {"C1": LogNormal(mean=2e5, std=1e5)})
    found = evidence(one, laplace(one), 256)
    assert found.route == "importance"
    assert "even weights" in found.why
    posterior = ridge(0.03)
    found = evidence(posterior, laplace(posterior), 64)
    assert found.route == "surrogate"
    assert "the first 16 points are worth" in found.why


@pytest.mark.parametrize("first", [0, 1])
def test_copies_of_few_points_of_a_polynomial_are_not_solved(monkeypatch, first):
    """One point of a polynomial that goes wrong outweighs all others: after the first quarter, or after the second."""
    posterior, clouds, solved = ridge(0.03), [], []
    values = posterior.evaluate.model.function
    gaussian = laplace(posterior)

    def counted(point):
        solved.append(point)
        return values(point)

    def wrong(*given):
        cloud = sample(*given)
        if len(clouds) >= first:
            cloud = replace(cloud, log_weights=np.where(np.arange(len(cloud.x)) == 7, 1e3, cloud.log_weights))
        clouds.append(cloud)
        return cloud

    monkeypatch.setattr("inverse.low_dimensional.evidence.sample", wrong)
    evaluate = SerialEvaluate(replace(posterior.evaluate.model, function=counted))
    found = evidence(replace(posterior, evaluate=evaluate), gaussian, 64)
    assert len(found.density.x) == len(solved) == 64
    assert len(np.unique(found.density.x, axis=0)) == 64
    assert found.route == ("surrogate" if first else "importance")
    assert first or "many points by a polynomial are worth 1" in found.why


def test_same_seed_same_bits():
    posterior = ridge(0.1)
    one, other, third = (evidence(posterior, laplace(posterior), 64, seed=s) for s in (3, 3, 4))
    assert one.log_evidence == other.log_evidence
    np.testing.assert_array_equal(one.log_weights, other.log_weights)
    assert one.log_evidence != third.log_evidence


def test_polynomial_models_are_fitted_exactly():
    posterior = ridge(0.1)
    x = np.random.default_rng(1).normal(size=(64, 4))
    surrogate = fit(posterior, posterior.at(x, derivatives=True))
    other = 0.7 * x[::-1]
    np.testing.assert_allclose(surrogate.at(other).outputs, posterior.at(other).outputs, rtol=1e-6)
    derived, true = (p.at(other, derivatives=True) for p in (surrogate, posterior))
    np.testing.assert_allclose(derived.gradient, true.gradient, rtol=1e-4, atol=1e-4)


def test_wider_priors_by_the_same_points():
    """For normal priors of a linear model, the answer is that of the study with these priors."""
    posterior = on_treloar("yeoh", LINEAR["yeoh"])
    found = evidence(posterior, laplace(posterior), 256)
    for width in (0.5, 2.0):
        priors = {name: Normal(mean=p.mean, std=width * p.std) for name, p in LINEAR["yeoh"].items()}
        exact = laplace(on_treloar("yeoh", priors)).log_evidence
        x = found.density.x
        change = -(x**2).sum(axis=1) / 2 * (1 / width**2 - 1) - 3 * np.log(width)
        value, error = found.reweighted(change)
        assert abs(value - exact) < 4 * error + 1e-6
        assert error < 0.1


@pytest.mark.unit
def test_pareto_shapes_are_those_of_arviz():
    """Values of psislw of ArviZ 0.21 for the same weights."""
    for n, k, expected in (
        (1000, 0.3, 0.4814277852303459),
        (256, 0.8, 1.236827414482715),
        (4000, 0.6, 0.7003246300733824),
        (128, -0.2, -0.14748732811851475),
    ):
        u = np.random.default_rng([n]).random(n)
        assert pareto_shape(((1 - u) ** -k - 1) / k + 0.1) == pytest.approx(expected, abs=1e-10)
    assert pareto_shape(np.ones(20)) == np.inf


@pytest.mark.unit
def test_where_there_is_no_answer():
    model = FunctionModel(two_of_four, FOUR, ("u", "v"), slopes_of_four)
    good = ridge(0.1)
    gaussian = laplace(good)

    def refuse(point):
        raise SolveError("never")

    posterior = Posterior(
        good.inputs, SerialEvaluate(FunctionModel(refuse, FOUR, ("u", "v"), slopes_of_four)), good.data, good.noise
    )
    with pytest.raises(SolveError, match="no answer at any of the points"):
        evidence(posterior, gaussian, 64)
    with pytest.raises(ValueError, match="16 samples, expected at least 32"):
        evidence(good, gaussian, 16)
    assert model.differentiable


def test_models_that_end_somewhere_are_weighted_by_nothing_there():
    """Half of the prior has no answer; the evidence is that of brute force over the other half."""

    def ends(point):
        if point[0] < 1.25:
            raise SolveError("ends")
        return two_of_four(point)

    whole = ridge(0.1)
    posterior = Posterior(
        whole.inputs, SerialEvaluate(FunctionModel(ends, FOUR, ("u", "v"), slopes_of_four)), whole.data, whole.noise
    )
    points = whole.inputs.points(sobol_points(5, 0, 0, 2**18, 4))
    misfit = (((two_of_four(points) - whole.data) / whole.noise.sigma) ** 2).sum(axis=1) / 2
    misfit[points[:, 0] < 1.25] = np.inf
    truth = logsumexp(-misfit) - np.log(2**18) - np.log(2 * np.pi * whole.noise.sigma.prod())
    found = evidence(posterior, laplace(posterior), 256)
    assert abs(found.log_evidence - truth) < 4 * found.error
    assert found.error < 0.15


SYMMETRIC = {  # outputs, their slopes, means of the parameters, data, mean and standard deviation of each, ln Z
    "squares": (lambda p: p**2, lambda p: np.diag(2 * p), 0.0, (1.0, 1.0), (0.0, 0.99493), -2.82263),
    "sum and product": (
        lambda p: np.array([p.sum(), p.prod()]), lambda p: np.array([[1.0, 1.0], p[::-1]]), 1.0, (3.0, 1.5),
        (1.48431, 0.83085), -2.62137),
    "cubic": (lambda p: p**3 - 3 * p, lambda p: np.diag(3 * p**2 - 3), 0.0, (0.3,), (-0.12801, 0.73639), -1.80655),
}  # fmt: skip


@pytest.mark.parametrize("name", SYMMETRIC)
def test_all_modes_count(name):
    """Of two to four modes, by quadrature on a grid; where few searches have found two, more find the others."""
    function, slopes, centre, data, (mean, std), log_evidence = SYMMETRIC[name]
    names = tuple("ab"[: len(data)])
    inputs = Inputs({one: Normal(mean=centre, std=1.0) for one in names})
    model = FunctionModel(function, names, tuple("uv"[: len(data)]), slopes)
    for seed in range(2):
        whole = Posterior(inputs, SerialEvaluate(model), np.array(data), Noise(np.full(len(data), 0.1)))
        mode = laplace(whole, starts=4, seed=seed)
        found = evidence(whole, mode, 256, seed=seed)
        assert found.trusted
        assert len(mode.others[0]) + 1 >= {"squares": 4, "sum and product": 2, "cubic": 3}[name]
        assert abs(found.log_evidence - log_evidence) < 4 * found.error < 0.4
        x, weights = found.points
        values = whole.physical(x)
        np.testing.assert_allclose(weights @ values, mean, atol=0.06)
        np.testing.assert_allclose(np.sqrt(weights @ (values - weights @ values) ** 2), std, rtol=0.05)


def test_nested_sampling_agrees():
    pytest.importorskip("dynesty")
    model = FunctionModel(lambda p: [p[0], p[0] + p[1]], ("a", "b"), ("u", "v"), lambda p: [[1.0, 0.0], [1.0, 1.0]])
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in ("a", "b")})
    posterior = Posterior(inputs, SerialEvaluate(model), np.array([0.3, 0.9]), Noise(np.array([0.2, 0.3])))
    value, error = nested(posterior, live=60)
    assert abs(value - laplace(posterior).log_evidence) < 4 * error


@pytest.mark.slow
def test_nested_sampling_agrees_on_treloar():
    pytest.importorskip("dynesty")
    study = treloar()
    cases = [(name, candidate.parameters) for name, candidate in study.candidates.items()]
    for kind, priors in [*cases, ("demiray", CURVED["demiray"])]:
        posterior = on_treloar(kind, priors, FACTOR)
        found = evidence(posterior, laplace(posterior), 256)
        value, error = nested(posterior)
        assert abs(found.log_evidence - value) < 3 * np.hypot(found.error, error), kind


@pytest.mark.slow
def test_nested_sampling_agrees_on_brain():
    pytest.importorskip("dynesty")
    study = load(CONFIGS / "brain.toml")
    for kind in study.candidates:
        it = SerialEvaluate(study.build(kind, "cortex"))
        whole = assemble(study.models[kind], study.data_groups["cortex"], study.method.noise, it)
        found = evidence(whole, laplace(whole), 256)
        value, error = nested(whole)
        assert abs(found.log_evidence - value) < 3 * np.hypot(found.error, error), kind


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("correlated", "by_nested_sampling"),
    [(False, False), (True, False), pytest.param(False, True, marks=pytest.mark.slow)],
)
def test_evidence_of_priors_with_inadmissible_tails(correlated, by_nested_sampling):
    """Gaussian priors of C1 and C2 reach where C1 + C2 < 0: ln Z is that of quadrature over what is left of them.

    The widened and narrowed priors are restricted anew.
    """
    priors = {"C1": Normal(mean=100.0, std=200.0), "C2": Normal(mean=0.0, std=200.0)}
    pairs = (("C1", "C2", 0.6),) if correlated else ()
    materials = Materials("mooney-rivlin", {"material": {"C1": "C1", "C2": "C2"}})
    inputs = Inputs(priors, pairs, materials)
    tests = [MaterialTest(mode="uniaxial", at=(0.8, 1.2, 1.5))]
    model = HomogeneousModel("mooney-rivlin", {}, tests, ("C1", "C2"))
    data, sigma = model.stresses(np.array([[80.0, -20.0]]))[0], np.full(3, 150.0)
    x = np.linspace(-8, 8, 1601)
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    points = inputs.from_normals(grid)[0]
    good = points.sum(axis=1) > 0
    stresses = points @ model.stresses(np.eye(2))  # linear in the constants
    misfit = (((stresses - data) / sigma) ** 2).sum(axis=1) / 2 + np.log(2 * np.pi * sigma**2).sum() / 2
    exact = {}
    for width in (1.0, 0.5, 2.0):
        prior = -((grid / width) ** 2).sum(axis=1) / 2
        exact[width] = logsumexp((prior - misfit)[good]) - logsumexp(prior[good])
    whole = Posterior(inputs, SerialEvaluate(model), data, Noise(sigma))
    share = np.exp(logsumexp(-(grid[good] ** 2).sum(axis=1) / 2) - logsumexp(-(grid**2).sum(axis=1) / 2))
    assert inputs.admitted == pytest.approx(share, abs=2e-3)
    found = evidence(whole, laplace(whole), 1024)
    assert found.route != "closed form"
    assert abs(found.log_evidence - exact[1.0]) < max(4 * found.error, 5e-3)
    assert found.error < 0.05
    for width in (0.5, 2.0):
        value, error = found.reweighted(_rescaled(inputs, range(2), width, found.density.x))
        assert abs(value - exact[width]) < max(4 * error, 5e-3)
    assert not found.weights[found.density.parameters.sum(axis=1) <= 0].any()
    if by_nested_sampling and find_spec("dynesty"):
        value, error = nested(whole, live=200)
        assert abs(value - exact[1.0]) < 4 * error


@pytest.mark.unit
def test_weights_of_points_where_a_polynomial_has_no_answer():
    """They are nothing at any power, also where fewer points are left than are asked for."""
    logs = np.array([-np.inf, 0.0, -3.0, -np.inf])
    np.testing.assert_allclose(_tempered(logs, 8), [0, 0.5, 0.5, 0])
    np.testing.assert_allclose(_tempered(logs, 1), [0, 1 / (1 + np.exp(-3)), 1 / (1 + np.exp(3)), 0])
    with pytest.raises(SolveError, match="no answer at any point"):
        _tempered(np.full(3, -np.inf), 2)


@pytest.mark.unit
def test_copies_of_points_do_not_raise_the_degree():
    """12 points with derivatives are enough for the ten polynomials of degree 2, 12 copies of two of them are not."""
    points = np.random.default_rng(0).normal(size=(12, 3))
    outputs, tangents, even = (points**2).sum(axis=1)[:, None], 2 * points[:, None, :], np.full(12, 1 / 12)
    assert len(_regression(points, outputs, tangents, even)[1].indices) >= 10
    which = np.arange(12) % 2
    assert len(_regression(points[which], outputs[which], tangents[which], even)[1].indices) == 4


@pytest.mark.unit
def test_own_work_is_predicted():
    """It grows with unknowns, data and solves, and is nothing where no polynomial is fitted."""
    few, more, many = (operations(size, 2 * size, 256) for size in (5, 10, 31))
    assert 0 < few < more
    assert many == 0
    assert operations(10, 20, 256) < operations(10, 40, 256) < operations(10, 40, 512)
    assert own_seconds(31, 60, 256) == 0
    of_chains = own_seconds(2, 60, 256, "hmc") - own_seconds(2, 60, 256)
    assert own_seconds(31, 60, 256, "hmc") == pytest.approx(of_chains)
