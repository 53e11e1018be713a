"""The posterior of a field where everything has a closed form: linear models, normal priors."""

import numpy as np
import pytest
from scipy import stats

from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior, leading_pairs
from inverse.fields.newton_cg import find_mode
from tests.problems import DATA, Linear, N, curved, solved


def square_of(point):
    """χ² = |r|² + |ξ̂|² of the mode, of as many degrees of freedom as there are data."""
    return point.residual @ point.residual + point.whitened @ point.whitened


@pytest.mark.unit
@pytest.mark.parametrize("holes", [0, 7])
def test_everything_is_exact_with_all_pairs(holes):
    problem = Linear(holes=holes)
    mode, found = solved(problem, cutoff=1e-12)
    assert mode.converged
    scale = np.abs(problem.covariance).max()
    np.testing.assert_allclose(mode.point.values, problem.mean, atol=1e-8)
    np.testing.assert_allclose(found.covariance(np.eye(N)), problem.covariance, atol=1e-8 * scale)
    np.testing.assert_allclose(found.variance, np.diag(problem.covariance), atol=1e-8 * scale)
    np.testing.assert_allclose(found.std**2, np.diag(problem.covariance), atol=1e-8 * scale)
    root = found.samples(np.eye(N)) - found.mean  # samples are affine in the whitened coordinates
    np.testing.assert_allclose(root.T @ root, problem.covariance, atol=1e-8 * scale)
    np.testing.assert_allclose(found.spectrum.values, problem.values[: DATA - holes], rtol=1e-8, atol=1e-8)
    sign, determinant = np.linalg.slogdet(problem.covariance)
    assert sign == 1
    expected = determinant - np.linalg.slogdet(problem.prior_covariance)[1]
    assert found.log_determinant == pytest.approx(expected, rel=1e-8)
    gap = (problem.data - problem.G @ problem.m_0)[problem.seen]
    evidence = stats.multivariate_normal(np.zeros(len(gap)), problem.scatter).logpdf(gap)
    assert found.log_evidence == pytest.approx(evidence, rel=1e-9)
    assert square_of(mode.point) == pytest.approx(gap @ np.linalg.solve(problem.scatter, gap), rel=1e-8)
    prior, shift = problem.prior_covariance, found.mean - problem.m_0
    divergence = np.trace(np.linalg.solve(prior, problem.covariance)) - N + shift @ np.linalg.solve(prior, shift)
    assert found.information == pytest.approx((divergence - expected) / 2, rel=1e-8)


@pytest.mark.unit
def test_predictions_and_resolution_are_those_of_the_exact_posterior():
    problem = Linear(holes=7)
    mode, found = solved(problem, cutoff=1e-12)
    spread = np.sqrt(np.diag(problem.G @ problem.covariance @ problem.G.T))
    np.testing.assert_allclose(
        np.sqrt(found.spectrum.resolution[7:]) / mode.point.posterior.weights[7:], spread[7:], rtol=1e-7
    )
    K = problem.G[7:]
    influence = K @ problem.covariance @ K.T / problem.sigma[7:] ** 2  # of each datum on its prediction
    np.testing.assert_allclose(found.spectrum.resolution[7:], np.diag(influence), rtol=1e-7)
    assert found.spectrum.determined == pytest.approx(np.trace(influence), rel=1e-8)
    g = np.random.default_rng(1).standard_normal(N)
    centre, width = found.marginal(g)
    assert centre == pytest.approx(g @ problem.mean, rel=1e-8)
    assert width == pytest.approx(np.sqrt(g @ problem.covariance @ g), rel=1e-8)


@pytest.mark.parametrize("limit", [{"rank": 20}, {"cutoff": 1.0}, {"rank": 5}])
def test_the_error_of_a_truncation_is_that_of_the_first_neglected_pair(limit):
    problem = Linear()
    _, found = solved(problem, block=8, accuracy=1e-6, **limit)
    r = len(found.spectrum.values)
    first = problem.values[r]
    assert r == limit.get("rank", (problem.values >= 1).sum())
    assert found.spectrum.neglected == pytest.approx(first, rel=1e-3)
    np.testing.assert_allclose(found.spectrum.values, problem.values[:r], rtol=1e-9)
    whiten = np.linalg.inv(problem.posterior.prior.matrix)
    error = whiten @ (found.covariance(np.eye(N)) - problem.covariance) @ whiten.T
    # It is an equality: the rest is as wide as the prior.
    assert np.linalg.eigvalsh(error)[-1] == pytest.approx(first / (1 + first), rel=1e-6)
    assert np.linalg.eigvalsh(error)[0] > -1e-8
    V = found.directions
    np.testing.assert_allclose(V @ np.linalg.solve(problem.prior_covariance, V.T), np.eye(r), atol=1e-9)


@pytest.mark.unit
def test_the_rank_follows_the_spectrum():
    problem = Linear()
    point = find_mode(problem.posterior).point
    for cutoff in (100.0, 1.0, 0.01):
        found = leading_pairs(point.jvp, point.vjp, N, cutoff=cutoff, block=8)
        assert len(found.values) == (problem.values >= cutoff).sum()
        assert found.products <= len(found.values) + 32
        left = point.product(found.vectors) - found.values[:, None] * found.vectors
        assert (np.linalg.norm(left, axis=1) <= 1e-2 * found.values).all()


@pytest.mark.unit
def test_equal_values_and_exhausted_spaces():
    rng = np.random.default_rng(0)
    Q, _ = np.linalg.qr(rng.standard_normal((40, 40)))
    values = np.array([5.0] * 12 + [2.0] * 3 + [0.0] * 25)
    A = np.sqrt(values)[:15, None] * Q[:15]
    for cutoff in (0.0, 0.1):
        found = leading_pairs(lambda x: x @ A.T, lambda y: y @ A, 40, block=12, cutoff=cutoff)
        np.testing.assert_allclose(found.values, values[:15], atol=1e-10)
        np.testing.assert_allclose(found.vectors @ found.vectors.T, np.eye(15), atol=1e-12)
        assert found.neglected == pytest.approx(0, abs=1e-10)
    everything = leading_pairs(lambda x: 3 * x, lambda y: 3 * y, 40, block=4)
    np.testing.assert_allclose(everything.values, np.full(40, 9.0))
    nothing = leading_pairs(lambda x: 0 * x, lambda y: 0 * y, 40, block=4)
    assert len(nothing.values) == 0


def test_calibration():
    """Credible intervals hold the truth as often as they say, and the residual test rejects as often as it says."""
    inside, probabilities = [], []
    for seed in range(36):
        problem = Linear(seed)
        rng = np.random.default_rng(1000 + seed)
        truth = problem.m_0 + problem.posterior.prior.root(rng.standard_normal(N))
        data = problem.G @ truth + problem.sigma * rng.standard_normal(DATA)
        posterior = FieldPosterior(
            problem.posterior.model, data, Noise(problem.sigma), problem.posterior.prior, problem.m_0
        )
        point = find_mode(posterior).point
        found = LowRankPosterior.at(point, cutoff=1e-3)
        inside.append((np.abs(truth - found.mean) <= stats.norm.ppf(0.9) * found.std).mean())
        probabilities.append(stats.chi2(DATA).sf(square_of(point)))
        assert np.abs(point.residual / np.sqrt(1 - found.spectrum.resolution)).max() < 6
    assert np.mean(inside) == pytest.approx(0.8, abs=3 * np.std(inside) / np.sqrt(36))
    assert stats.kstest(probabilities, "uniform").pvalue > 0.01


# --- models that are not linear --------------------------------------------------------------------------------------


@pytest.mark.unit
def test_gradient_and_product_are_derivatives():
    posterior = curved()
    rng = np.random.default_rng(0)
    whitened, direction = rng.standard_normal((2, 12))
    point = posterior.at(whitened)
    slope, steps = point.gradient @ direction, (1e-2, 1e-3)
    errors = [abs(posterior.at(whitened + h * direction).cost - point.cost - h * slope) for h in steps]
    assert np.log10(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)
    # Where nothing is left of the residual, the product is that of all second derivatives.
    exact = FieldPosterior(posterior.model, point.solution.outputs, posterior.noise, posterior.prior)
    point = exact.at(whitened)
    curve = direction + point.product(direction)
    moved = [(h, exact.at(whitened + h * direction).gradient - point.gradient) for h in (1e-3, 1e-4)]
    errors = [np.linalg.norm(change - h * curve) for h, change in moved]
    assert np.log10(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)


@pytest.mark.unit
@pytest.mark.parametrize("limit", [np.inf, 4.0])
def test_the_mode_is_stationary_also_where_steps_leave_what_can_be_solved(limit):
    posterior = curved(limit)
    mode = find_mode(posterior, tolerance=1e-10)
    assert mode.converged
    assert posterior.counts.solves == 1 + sum(row.solves for row in mode.iterations)
    assert np.linalg.norm(mode.point.gradient) <= 1e-8
    assert len(mode.iterations) < 25
    costs = [row.misfit + row.penalty for row in mode.iterations]
    assert (np.diff(costs) <= 1e-9).all()
    for scale in (1e-3, 1e-2):
        moves = scale * np.random.default_rng(0).standard_normal((20, 12))
        assert all(posterior.at(mode.point.whitened + move).cost > mode.point.cost for move in moves)


@pytest.mark.unit
def test_what_cannot_be_is_refused():
    posterior = curved()
    with pytest.raises(ValueError, match="expected 25 of each"):
        FieldPosterior(posterior.model, posterior.data[:3], posterior.noise, posterior.prior)
    with pytest.raises(ValueError, match="expected positive"):
        FieldPosterior(posterior.model, posterior.data, Noise(0 * posterior.noise.sigma), posterior.prior)
    with pytest.raises(ValueError, match="all data are NaN"):
        FieldPosterior(posterior.model, np.nan * posterior.data, posterior.noise, posterior.prior)
