"""What observations tell: closed forms, and nested Monte Carlo of the information of a nonlinear model."""

import numpy as np
import pytest
from scipy.special import logsumexp

from inverse.designs.criteria import Information, Variance, conditioned, grouped, told, told_along
from inverse.designs.greedy import choose
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs


def problem(seed=0, draws=2, count=8, k=2, r=4):
    rng = np.random.default_rng(seed)
    sizes = 10.0 ** rng.uniform(-1, 1, (count, 1, 1))
    return [sizes * rng.standard_normal((count, k, r)) for _ in range(draws)]


def information(rows, chosen):
    """½ ln det(I + AᵀA) of the chosen ones, in the unknowns."""
    A = rows[list(chosen)].reshape(-1, rows.shape[-1])
    return np.linalg.slogdet(np.eye(rows.shape[-1]) + A.T @ A)[1] / 2


@pytest.mark.unit
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_what_a_set_tells_is_the_determinant(scale):
    rows = scale * problem(draws=1)[0]
    criterion, order = Information([rows]), [3, 0, 5, 1]
    expected = np.array([information(rows, order[: n + 1]) for n in range(4)])
    np.testing.assert_allclose(list(criterion.along(order)), expected, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(told_along(rows[order]), expected, rtol=1e-7, atol=1e-14)
    np.testing.assert_allclose(told(rows[order].reshape(-1, 4)), expected[-1], rtol=1e-7, atol=1e-14)


@pytest.mark.unit
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e7])
def test_covariances_are_those_that_are_left(scale):
    R = scale * np.random.default_rng(1).standard_normal((3, 5))
    root = conditioned(conditioned(np.eye(5), R[:1]), R[1:])
    s, V = np.linalg.svd(R)[1:]
    right = np.eye(5) - (V[:3].T * (s**2 / (1 + s**2))) @ V[:3]
    np.testing.assert_allclose(root @ root.T, right, atol=1e-9)


@pytest.mark.unit
def test_what_an_observation_adds_never_grows():
    criterion = Information(problem())
    every = np.arange(8)
    before = criterion.gains(every)
    for one in (2, 7, 4):
        criterion.take(one)
        after = criterion.gains(every)
        assert (after <= before + 1e-12).all()
        before = after


@pytest.mark.unit
def test_variances_of_goals_are_those_of_the_posterior():
    rows, G = problem(draws=2), np.random.default_rng(2).standard_normal((3, 4))
    goals = [G.T @ G, 4 * np.eye(4)]
    criterion = Variance(rows, goals)
    worth = list(criterion.along([1, 6, 2]))
    taken = []
    for A, Q in zip(rows, goals, strict=True):
        chosen = A[[1, 6, 2]].reshape(-1, 4)
        taken.append(np.trace(Q @ (np.eye(4) - np.linalg.inv(np.eye(4) + chosen.T @ chosen))))
    assert worth[-1] == pytest.approx(np.mean(taken), rel=1e-10)
    np.testing.assert_allclose(criterion.left, [np.trace(goals[0]) - taken[0], 16 - taken[1]], rtol=1e-9)


@pytest.mark.unit
def test_values_that_are_measured_together_are_one_candidate():
    rows = np.arange(24.0).reshape(8, 3)
    which = np.array([1, -1, 0, 1, 1, 1, 1, 0])
    found = grouped(rows, which, 2)
    assert found.shape == (2, 3, 3)
    for number in (0, 1):
        mine = rows[which == number]
        np.testing.assert_allclose(found[number].T @ found[number], mine.T @ mine, rtol=1e-12)


def test_expected_information_of_a_nonlinear_model_is_that_of_nested_sampling():
    """y = x + x³/20 + error, x standard normal: ln p(y | x) − ln p(y), the evidence over a fine grid of x."""
    sigma, rng = 0.05, np.random.default_rng(3)
    x = rng.standard_normal(4000)
    y = x + x**3 / 20 + sigma * rng.standard_normal(len(x))
    grid = np.linspace(-7, 7, 1001)
    log_prior = -(grid**2) / 2 - np.log(2 * np.pi) / 2 + np.log(grid[1] - grid[0])
    misfit = -(((y[:, None] - grid - grid**3 / 20) / sigma) ** 2) / 2
    nested = -((y - x - x**3 / 20) ** 2) / sigma**2 / 2 - logsumexp(misfit + log_prior, axis=1)
    slopes = (1 + 3 * x[:, None, None, None] ** 2 / 20) / sigma
    linear = Information(list(slopes[:500])).gains(np.array([0]))[0]
    error = np.hypot(nested.std() / np.sqrt(len(x)), told(slopes[:500, 0]).std() / np.sqrt(500))
    assert linear == pytest.approx(nested.mean(), abs=3 * error)
    assert error < 0.03


@pytest.mark.unit
def test_parameters_are_whitened_by_their_prior():
    own = {"a": Normal(mean=2.0, std=3.0), "b": Uniform(lower=0.0, upper=1.0)}
    rng = np.random.default_rng(4)
    joint = np.exp(rng.standard_normal((500, 2)) @ np.array([[1.5, 0.3], [0.0, 0.1]]))
    draws = Draws(("c", "d"), joint, np.full(500, 1 / 500), 500.0)
    u = rng.uniform(0.01, 0.99, (6, 4))
    points, slopes = Inputs(own, draws=draws).whitened(u)
    alone = Inputs(own).whitened(u[:, :2])
    np.testing.assert_allclose(points[:, :2], alone[0], rtol=1e-12)
    np.testing.assert_allclose(slopes[:, :2, :2], alone[1], rtol=1e-12)
    assert not slopes[:, :2, 2:].any()
    assert not slopes[:, 2:, :2].any()
    assert np.isin(points[:, 2:], joint).all()
    # "c" spans decades: its logarithm is taken, and that of "d" is not.
    x = np.column_stack([np.log(joint[:, 0]), joint[:, 1]])
    for point, slope in zip(points[:, 2:], slopes[:, 2:, 2:], strict=True):
        scaled = slope / np.array([point[0], 1.0])[:, None]
        np.testing.assert_allclose(scaled @ scaled.T, np.cov(x.T, bias=True), rtol=1e-9)
    log_normal = Inputs({"e": LogNormal(mean=2.0, std=1.0)})
    points, slopes = log_normal.whitened(u[:, :1])
    np.testing.assert_allclose(slopes[:, 0, 0], points[:, 0] * np.sqrt(np.log(1.25)), rtol=1e-12)


@pytest.mark.unit
def test_unknowns_of_no_interest_are_errors_that_observations_share():
    """What they leave to the others is the determinant of these alone, whatever the order."""
    rows, order = problem(draws=2, r=6), [3, 0, 5, 1]

    def others(A, n):
        seen = A[order[:n]].reshape(-1, 6)
        C = np.linalg.inv(np.eye(6) + seen.T @ seen)[:4, :4]
        return -np.linalg.slogdet(C)[1] / 2

    expected = [np.mean([others(A, n) for A in rows]) for n in (1, 2, 3, 4)]
    criterion = Information(rows, 2)
    np.testing.assert_allclose(list(criterion.along(order)), expected, rtol=1e-9)
    np.testing.assert_allclose(np.mean([told_along(A[order], 2) for A in rows], axis=0), expected, rtol=1e-8)
    whole = rows[0][order].reshape(-1, 6)  # of errors with the covariance I + NNᵀ
    root = np.linalg.cholesky(np.eye(len(whole)) + whole[:, 4:] @ whole[:, 4:].T)
    assert told(np.linalg.solve(root, whole[:, :4])) == pytest.approx(others(rows[0], 4), rel=1e-9)


@pytest.mark.unit
def test_what_only_they_move_tells_something_once_others_depend_on_them():
    rows = np.array([[[1.0, 5.0]], [[0.0, 9.0]], [[0.1, 0.0]]])
    criterion = Information([rows], 1)
    before = criterion.gains(np.arange(3))
    assert before[1] == pytest.approx(0, abs=1e-12)
    criterion.take(0)
    assert criterion.gains(np.array([1]))[0] > 0.25
    chosen = choose(lambda: Information([rows], 1), np.ones(3), number=2, budget=None)
    assert chosen.order == (0, 1)
