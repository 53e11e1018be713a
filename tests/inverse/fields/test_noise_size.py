"""Noise of unknown size in the data of fields: closed forms of linear models, and coverage."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.newton_cg import Marginal, find_mode, infer_noise
from tests.problems import DATA, Linear, N, curved, solved
from uq.inputs.distributions import LogNormal, LogUniform, Normal

PRIORS = [LogUniform(lower=0.1, upper=20.0), LogNormal(mean=1.5, std=1.0), Normal(mean=1.0, std=1.0)]


def _of(posterior, prior):
    """The same with errors of unknown size."""
    return replace(posterior, noise=replace(posterior.noise, factor=prior))


def density(problem, prior):
    """Ln p(y, x) over the normal coordinate of s, by dense matrices."""
    K = problem.G[problem.seen]
    gap = (problem.data - problem.G @ problem.m_0)[problem.seen]

    def log_density(x):
        s = prior.from_normal(np.array([x]))[0][0]
        if s <= 0:
            return -np.inf
        scatter = K @ problem.prior_covariance @ K.T + s**2 * np.diag(problem.sigma[problem.seen] ** 2)
        return stats.multivariate_normal(np.zeros(len(gap)), scatter).logpdf(gap) + stats.norm.logpdf(x)

    return log_density


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: prior.kind)
def test_linear_models(prior):
    problem = Linear(holes=7)
    found = infer_noise(_of(problem.posterior, prior), tolerance=1e-6, cutoff=1e-12)
    assert found.converged
    log_density = density(problem, prior)
    start = max(np.linspace(-3, 3, 61), key=log_density)
    best = optimize.minimize_scalar(
        lambda x: -log_density(x), bracket=(start - 0.1, start, start + 0.1), options={"xtol": 1e-9}
    )
    assert found.factor == pytest.approx(prior.from_normal(np.array([best.x]))[0][0], rel=1e-5)
    x = np.linspace(-4, 4, 401)
    values = np.array([log_density(at) for at in x])
    w = np.exp(values - values.max())
    assert found.log_evidence == pytest.approx(values.max() + np.log(w.sum() * (x[1] - x[0])), abs=2e-6)
    log_s = np.log(np.maximum(prior.from_normal(x)[0], 1e-300))
    w /= w.sum()
    assert found.log_std == pytest.approx(np.sqrt(w @ (log_s - w @ log_s) ** 2), rel=1e-4)
    np.testing.assert_allclose(found.mode.point.posterior.noise.sigma, found.factor * problem.sigma)


@pytest.mark.unit
def test_the_density_of_the_factor_is_that_of_the_model():
    problem = Linear(holes=7)
    mode, found = solved(problem, cutoff=1e-12)
    marginal = Marginal.at(mode.point, found.spectrum)
    K = problem.G[problem.seen]
    gap = (problem.data - problem.G @ problem.m_0)[problem.seen]
    for s in (0.3, 1.0, 4.0):
        scatter = K @ problem.prior_covariance @ K.T + s**2 * np.diag(problem.sigma[problem.seen] ** 2)
        expected = stats.multivariate_normal(np.zeros(len(gap)), scatter).logpdf(gap)
        assert marginal.log_density(np.array([s]))[0] == pytest.approx(expected, rel=1e-8)
    assert marginal.log_density(np.ones(1))[0] == pytest.approx(found.log_evidence, rel=1e-8)
    assert marginal.log_density(np.array([0.0, -1.0])).tolist() == [-np.inf, -np.inf]


def test_the_factor_lies_within_its_standard_deviations(monkeypatch):
    monkeypatch.setattr("inverse.fields.newton_cg.ROUNDS", 4)
    problem = Linear()
    prior = LogUniform(lower=0.05, upper=50.0)
    scores = []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        truth = problem.m_0 + problem.posterior.prior.root(rng.standard_normal(N))
        s = float(np.exp(rng.uniform(-1, 1)))
        data = problem.G @ truth + s * problem.sigma * rng.standard_normal(DATA)
        noise = Noise(problem.sigma, factor=prior)
        posterior = FieldPosterior(problem.posterior.model, data, noise, problem.posterior.prior, problem.m_0)
        found = infer_noise(posterior)
        assert found.converged
        scores.append(np.log(found.factor / s) / found.log_std)
    assert (np.square(scores)).sum() == pytest.approx(15, abs=3 * np.sqrt(30))


@pytest.mark.unit
def test_models_that_are_not_linear():
    exact = curved()
    truth_sigma = 0.05
    noise = Noise(np.full(25, 0.01), factor=LogUniform(lower=0.1, upper=100.0))
    found = infer_noise(FieldPosterior(exact.model, exact.data, noise, exact.prior))
    assert found.converged
    assert abs(np.log(found.factor * 0.01 / truth_sigma)) < 3 * found.log_std
    again = find_mode(found.mode.point.posterior, tolerance=1e-8).point.whitened
    np.testing.assert_allclose(found.mode.point.whitened, again, atol=0.02)


@pytest.mark.unit
def test_noise_that_cannot_be_is_refused():
    problem = Linear()
    with pytest.raises(ValueError, match="median of the prior of the noise is -100"):
        infer_noise(_of(problem.posterior, Normal(mean=-100.0, std=1.0)))
