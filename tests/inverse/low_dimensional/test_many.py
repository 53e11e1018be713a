"""Posteriors of 10 to 60 unknowns: Gaussian ones and others bent a little, against closed forms and NumPy."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from forward.pointwise import FunctionModel
from inverse.criticism.assessment import Assessment, answer, by_gaussian, counts, gaussian_points
from inverse.criticism.chains import BUDGET, Lengths, gradient_chains
from inverse.criticism.verdict import verdict_on_few
from inverse.criticism.weights import distinct, effective_sample_size, fewest, quality, usual
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import Elliptical, Mixture, about, first, laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.low_dimensional.surrogate import affordable
from tests.problems import examine_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points

NOISE = 0.25


def bent(size, curvature, seed=7):
    """`size` unknowns seen through u + c u², u = A x, by twice as many data; and A."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2 * size, size)) / np.sqrt(size) * np.exp(-2.5 * np.arange(size) / size)
    u = A @ rng.normal(size=size)
    data = u + curvature * u**2 + NOISE * rng.normal(size=2 * size)
    names, outputs = tuple(f"x{k}" for k in range(size)), tuple(f"y{k}" for k in range(2 * size))

    def values(x):
        return A @ x + curvature * (A @ x) ** 2

    model = FunctionModel(values, names, outputs, lambda x: A * (1 + 2 * curvature * (A @ x))[:, None])
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in names})
    return Posterior(inputs, SerialEvaluate(model), data, Noise(np.full(2 * size, NOISE))), A


def reference(posterior, A, curvature, gaussian, draws=60_000):
    """Mean, standard deviation and ln Z by plain importance sampling about the mode, by NumPy alone."""
    z = np.random.default_rng(1).normal(size=(draws, A.shape[1]))
    x = gaussian.mode + z @ gaussian.root.T
    u = x @ A.T
    r = (u + curvature * u**2 - posterior.data) / NOISE
    log = ((z**2).sum(axis=1) - (r**2).sum(axis=1) - (x**2).sum(axis=1)) / 2
    w = np.exp(log - log.max())
    mean = w @ x / w.sum()
    constant = np.linalg.slogdet(gaussian.root)[1] - r.shape[1] * np.log(NOISE * np.sqrt(2 * np.pi))
    return mean, np.sqrt(w @ (x - mean) ** 2 / w.sum()), log.max() + np.log(w.mean()) + constant


def verdict(posterior, gaussian, found):
    return verdict_on_few(gaussian, found, examine_few(posterior, gaussian))


@pytest.mark.parametrize("size", [10, 60])
def test_where_it_is_gaussian_everything_is_of_the_gaussian(size):
    posterior, A = bent(size, 0.0)
    H = np.eye(size) + A.T @ A / NOISE**2
    exact, covariance = np.linalg.solve(H, A.T @ posterior.data) / NOISE**2, np.linalg.inv(H)
    scatter = NOISE**2 * np.eye(2 * size) + A @ A.T
    y = posterior.data
    log_evidence = -(y @ np.linalg.solve(scatter, y) + np.linalg.slogdet(2 * np.pi * scatter)[1]) / 2
    gaussian = laplace(posterior, starts=1)
    found = evidence(posterior, gaussian, 256)
    assert found.route == "closed form"
    assert found.log_evidence == pytest.approx(log_evidence, abs=1e-7)
    assert verdict(posterior, gaussian, found).trust == "laplace"
    known = answer(posterior, Assessment(gaussian, found))
    assert known.source == "laplace"
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(known.mean, exact, atol=1e-9)
    np.testing.assert_allclose(known.covariance, covariance, atol=1e-9)
    np.testing.assert_allclose(known.quantiles((0.025, 0.5))[:, 0], exact - 1.959964 * std, atol=1e-6)
    points = gaussian_points(gaussian, 400)
    np.testing.assert_allclose(points.mean(axis=0), exact, atol=1e-9)
    np.testing.assert_allclose(np.cov(points.T, bias=True), covariance, atol=1e-9)
    assert found.ess > 200  # its points are draws of it


@pytest.mark.few(1)
@pytest.mark.parametrize(("size", "seed"), [(9, 7), (25, 7), (40, 7), pytest.param(40, 8, marks=pytest.mark.slow)])
def test_bent_a_little(size, seed):
    posterior, A = bent(size, 0.25, seed)
    gaussian = laplace(posterior, starts=1)
    found = evidence(posterior, gaussian, 320)
    mean, std, log_evidence = reference(posterior, A, 0.25, gaussian)
    assert verdict(posterior, gaussian, found).trust != "neither"
    known = answer(posterior, Assessment(gaussian, found))
    assert known.source == "points"
    assert np.abs((known.mean - mean) / std).max() < 0.15
    assert np.abs(known.std / std - 1).max() < 0.15
    assert abs(found.log_evidence - log_evidence) < 3 * found.error + 0.01
    assert found.error < 0.05


@pytest.mark.unit
def test_copies_count_once():
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(40, 3))
    which = rng.choice(40, 256, p=np.r_[0.5, np.full(39, 0.5 / 39)])
    even = np.full(256, 1 / 256)
    shares = np.bincount(which, minlength=40) / 256
    assert effective_sample_size(even) == pytest.approx(256)
    np.testing.assert_allclose(np.sort(distinct(cloud[which], even)), np.sort(shares[shares > 0]))
    ess, pareto_k = quality(cloud[which], even)
    assert ess == pytest.approx(1 / (shares**2).sum())
    assert ess < 5
    assert pareto_k > 0.7
    # A few pairs among even weights say nothing of a tail.
    paired = np.vstack([rng.normal(size=(246, 3)), np.repeat(cloud[:5], 2, axis=0)])
    assert quality(paired, even)[0] == pytest.approx(256**2 / (246 + 5 * 4))
    assert [fewest(size) for size in (1, 10, 40)] == [20, 20, 80]


def test_few_points_replace_nothing():
    """Points of which one counts: what is printed is Laplace's, with its moments, and not trusted."""
    posterior, _ = bent(12, 0.0)
    gaussian = laplace(posterior, starts=1)
    found = evidence(posterior, gaussian, 256)
    one = np.repeat(found.density.x[:1], 256, axis=0)
    alike = replace(found, route="surrogate", density=replace(found.density, x=one), log_weights=np.zeros(256), ess=1.0)
    assert not alike.trusted
    assert not counts(alike)
    judged = verdict(posterior, gaussian, alike)
    assert judged.trust == "neither"
    assert "more of them will not do: run chains" in judged.why
    known = answer(posterior, Assessment(gaussian, alike))
    assert known.source == "laplace"
    np.testing.assert_allclose(known.std, np.sqrt(np.diag(gaussian.covariance)), rtol=1e-9)
    fewer = replace(found, route="importance", ess=22.0, pareto_k=0.1)
    assert fewer.trusted
    assert (
        "fewer than the 24 that stand in place of a Gaussian of 12 unknowns" in verdict(posterior, gaussian, fewer).why
    )


@pytest.mark.unit
def test_moments_of_other_priors_by_a_gaussian():
    """Of a log-normal parameter in a Gaussian of its logarithm: mean, deviation and quantiles are those of theory."""
    prior = LogNormal(mean=2.0, std=1.0)
    s = np.sqrt(np.log(1.25))
    names = ("a", "b")
    model = FunctionModel(lambda p: [np.log(p[0]), p[1]], names, ("u", "v"), lambda p: [[1 / p[0], 0.0], [0.0, 1.0]])
    inputs = Inputs({"a": prior, "b": Normal(mean=0.0, std=1.0)}, (("a", "b", 0.5),))
    posterior = Posterior(inputs, SerialEvaluate(model), np.array([1.0, 0.3]), Noise(np.array([0.2, 0.5])))
    gaussian = laplace(posterior, starts=1)
    known = by_gaussian(posterior, gaussian)
    mu, tau = np.log(2) - s**2 / 2 + s * gaussian.mode[0], s * np.sqrt(gaussian.covariance[0, 0])
    assert known.mean[0] == pytest.approx(np.exp(mu + tau**2 / 2), rel=1e-5)
    assert known.std[0] == pytest.approx(known.mean[0] * np.sqrt(np.expm1(tau**2)), rel=1e-3)
    np.testing.assert_allclose(known.quantiles((0.025, 0.975))[0], np.exp(mu + tau * np.array([-1.959964, 1.959964])))


@pytest.mark.unit
@pytest.mark.parametrize("degrees", [np.inf, 5.0])
def test_proposals_have_the_density_they_are_drawn_from(degrees):
    """Of two coordinates: the mean over its points of another density over it is one, and so are shares of it."""
    root = np.array([[0.5, 0.0], [0.3, 0.2]])
    one = Elliptical(np.array([0.4, -0.2]), root, degrees)
    x = one.draw(sobol_points(0, 0, 0, 2**14, 3))
    other = Elliptical(np.array([0.5, -0.2]), 0.8 * root)
    ratio = np.exp(other.log_over_prior(x) - one.log_over_prior(x))
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    near = ratio[x[:, 0] < 0.5].sum() / len(x)
    assert near == pytest.approx(0.5, abs=0.01)


@pytest.mark.unit
def test_what_is_tried_first_follows_from_what_its_points_would_be_worth():
    few, many = (laplace(bent(size, 0.0)[0], starts=1) for size in (3, 30))
    assert isinstance(first(*about(few)), Mixture)
    assert isinstance(first(*about(many)), Elliptical)
    assert affordable(30)
    assert not affordable(31)


@pytest.mark.parametrize("short", [0.03, 0.3, 0.9])
def test_the_mode_is_found_where_gauss_newton_crawls(short):
    """Data inside the circle that the outputs run on: each Gauss–Newton step leaves 1 − `short` of the distance."""
    at, sigma = np.array([0.5, -0.8]), 0.02

    def values(p):
        return np.column_stack([np.cos(p), np.sin(p)]).ravel()

    def slopes(p):
        rows = np.zeros((4, 2))
        rows[[0, 2], [0, 1]], rows[[1, 3], [0, 1]] = -np.sin(p), np.cos(p)
        return rows

    model = FunctionModel(values, ("a", "b"), tuple("stuv"), slopes)
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in ("a", "b")})
    data = short * values(at)
    found = laplace(Posterior(inputs, SerialEvaluate(model), data, Noise(np.full(4, sigma))))
    assert found.converged
    for k, start in enumerate(at):
        cost = minimize_scalar(
            lambda p, start=start: -short * np.cos(p - start) / sigma**2 + p**2 / 2,
            bounds=(start - 1, start + 1),
            method="bounded",
            options={"xatol": 1e-10},
        )
        width = np.sqrt(found.covariance[k, k])
        assert abs(found.mode[k] - cost.x) < 1e-3 * width
        assert width == pytest.approx((short * np.cos(cost.x - start) / sigma**2 + 1) ** -0.5, rel=0.01)


@pytest.mark.slow
def test_chains_that_follow_gradients():
    """Bent posteriors of 12 unknowns: moments and ln Z of weighted points; gradients are those of the density."""
    pytest.importorskip("mici")
    posterior, A = bent(12, 0.25)
    gaussian = laplace(posterior, starts=1)
    model = posterior.evaluate.model
    x = gaussian.mode + 0.3
    value, gradient = posterior.potential(x, model)
    there = posterior.at(x[None], derivatives=True)
    assert value == pytest.approx(-there.log_posterior[0], rel=1e-12)
    np.testing.assert_allclose(gradient, there.gradient[0], rtol=1e-9, atol=1e-9)
    found = gradient_chains(posterior, gaussian, model)
    assert found.mixed
    assert found.apart <= BUDGET
    mean, std, log_evidence = reference(posterior, A, 0.25, gaussian)
    assert np.abs((found.flat.mean(axis=0) - mean) / std).max() < 0.2
    assert np.abs(found.flat.std(axis=0) / std - 1).max() < 0.2
    assert abs(found.evidence[0] - log_evidence) < 4 * found.evidence[1] < 0.5
    alike = replace(evidence(posterior, gaussian, 64), pareto_k=2.0, ess=5.0)
    judged = verdict_on_few(gaussian, alike, examine_few(posterior, gaussian), found)
    assert judged.trust == "corrected"  # fewer points do not overrule chains
    assert answer(posterior, Assessment(gaussian, alike, found)).source == "chains"


def test_chains_come_back_to_their_starts_only(monkeypatch):
    """There the length of steps is looked for; so the solves, which the budget bounds, are as many in every run."""
    pytest.importorskip("mici")
    posterior, _ = bent(2, 0.25)
    asked, potential = Counter[bytes](), Posterior.potential

    def counted(self, x, model):
        asked[x.tobytes()] += 1
        return potential(self, x, model)

    monkeypatch.setattr(Posterior, "potential", counted)
    lengths = Lengths(2, 40, 20, 1)
    found = gradient_chains(
        posterior, laplace(posterior, starts=1), posterior.evaluate.model, lengths=lengths, budget=0
    )
    assert found.apart == asked.total()
    assert sum(times > 1 for times in asked.values()) <= lengths.chains


@pytest.mark.unit
def test_how_far_a_search_that_did_not_converge_is_from_its_end():
    posterior, _ = bent(5, 0.0)
    gaussian = laplace(posterior, starts=1)
    found = evidence(posterior, gaussian, 64)
    said = verdict(posterior, replace(gaussian, converged=False, left=0.31), found).why
    assert said.endswith("did not converge: its next step would move an unknown by up to 0.31 standard deviations")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("size", "seed"),
    [(25, 7), *(pytest.param(25, seed, marks=pytest.mark.slow) for seed in (8, 9)), (40, 7), (60, 7)],
)
def test_advice_on_the_number_of_points_holds_when_taken(size, seed):
    """From 32 points, of which one or two may count: the advice is a number, and enough."""
    posterior, _ = bent(size, 0.25, seed)
    gaussian = laplace(posterior, starts=1)
    first = verdict(posterior, gaussian, evidence(posterior, gaussian, 32))
    assert first.trust == "neither"
    samples = int(re.search(r"take method\.samples = (\d+), or run chains", first.why)[1])
    assert samples <= 8 * usual(size)
    assert verdict(posterior, gaussian, evidence(posterior, gaussian, samples)).trust != "neither"
