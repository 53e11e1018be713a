"""Expected ln Bayes factors against dense formulas, and against Monte Carlo of ln Bayes factors."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from inverse.designs.criteria import Discrimination, predicted
from inverse.designs.greedy import choose

RNG = np.random.default_rng(0)
M = 12
MEANS = [0.7 * RNG.standard_normal(M) for _ in range(3)]
ROOTS = [RNG.standard_normal((M, r)) for r in (2, 3, 1)]
WHICH = np.array([0, 0, 1, 1, 1, 2, 3, -1, 4, 4, 5, 5])


def criterion(models=3, probabilities=(0.5, 0.3, 0.2)):
    return Discrimination(MEANS[:models], ROOTS[:models], probabilities[:models], WHICH, 6)


def dense(k, rows):
    return multivariate_normal(MEANS[k][rows], np.eye(len(rows)) + ROOTS[k][rows] @ ROOTS[k][rows].T)


def divergence(k, l, rows):
    (m, S), (n, T) = ((one.mean, one.cov_object.covariance) for one in (dense(k, rows), dense(l, rows)))
    inverse = np.linalg.inv(T)
    gap = m - n
    volumes = np.linalg.slogdet(T)[1] - np.linalg.slogdet(S)[1]
    return (np.trace(inverse @ S) - len(rows) + gap @ inverse @ gap + volumes) / 2


@pytest.mark.unit
def test_expected_ln_bayes_factors_are_divergences_of_dense_predictions():
    one = criterion()
    worth = list(one.along([4, 0, 1]))
    rows = np.flatnonzero(np.isin(WHICH, [4, 0, 1]))
    pairs = np.array([[0 if k == l else divergence(k, l, rows) for l in range(3)] for k in range(3)])
    np.testing.assert_allclose(one.pairs(), pairs, rtol=1e-9)
    p = np.array([0.5, 0.3, 0.2])
    right = sum(p[k] * p[l] / (1 - p[k]) * pairs[k, l] for k in range(3) for l in range(3) if k != l)
    assert worth[-1] == pytest.approx(right, rel=1e-9)
    assert (np.diff([0.0, *worth]) > 0).all()


@pytest.mark.unit
def test_expected_ln_bayes_factors_are_those_of_monte_carlo():
    one = criterion(2)
    for candidate in (0, 1, 4):
        one.take(candidate)
    rows = np.flatnonzero(np.isin(WHICH, [0, 1, 4]))
    for k, l in ((0, 1), (1, 0)):
        y = dense(k, rows).rvs(40_000, random_state=k)
        log_factors = dense(k, rows).logpdf(y) - dense(l, rows).logpdf(y)
        error = log_factors.std() / np.sqrt(len(y))
        assert one.pairs()[k, l] == pytest.approx(log_factors.mean(), abs=4 * error)
        assert error < 0.05 * log_factors.mean()


@pytest.mark.unit
def test_the_observation_that_differs_most_is_chosen_first():
    means = [np.zeros(4), np.array([0.1, 3.0, 3.0, 0.5])]
    roots = [np.zeros((4, 1)), np.array([[0.0], [9.0], [0.1], [0.0]])]
    made = lambda: Discrimination(means, roots, (1.0, 1.0), np.arange(4), 4)  # noqa: E731
    # The second model can explain the second value by its unknown, but not the third.
    assert choose(made, np.ones(4), number=1, budget=None).order in ((1,), (2,))
    np.testing.assert_allclose(made().gains(np.array([3])), [0.125], rtol=1e-12)


@pytest.mark.unit
def test_moments_of_draws():
    A, sigma = RNG.standard_normal((M, 2)), RNG.uniform(0.5, 2, M)
    outputs = 3 + RNG.standard_normal((500, 2)) @ A.T
    mean, root = predicted(outputs, sigma)
    assert root.shape == (M, 2)
    np.testing.assert_allclose(mean, outputs.mean(axis=0) / sigma, rtol=1e-12)
    np.testing.assert_allclose(root @ root.T, np.cov(outputs.T, bias=True) / sigma / sigma[:, None], atol=1e-10)
