"""Weights and numbers of samples of several models, against closed forms and other optimisers."""

import numpy as np
import pytest

from uq.estimators.blue import Problem, informations, subsets, weights

C = np.array([[1.0, 0.99, 0.9], [0.99, 1.1, 0.89], [0.9, 0.89, 1.2]])
GROUPS = subsets(3)
COSTS = np.array([sum((1, 0.05, 0.002)[k] for k in group) for group in GROUPS])


@pytest.mark.unit
def test_groups_are_all_sets():
    assert GROUPS == [(0, 1, 2), (0, 1), (0, 2), (1, 2), (0,), (1,), (2,)]


@pytest.mark.unit
def test_weights_are_those_of_least_squares():
    rng = np.random.default_rng(0)
    counts = np.array([5.0, 0, 3, 40, 0, 0, 100])
    a = weights(informations(GROUPS, C), counts)
    np.testing.assert_allclose(a.sum(axis=0), [1, 0, 0], atol=1e-9)
    assert not a[[1, 4, 5]].any()
    # generalised least squares of the means of the groups, written out
    rows, blocks = [], []
    for group, n in zip(GROUPS, counts, strict=True):
        if n:
            rows.append(np.eye(3)[list(group)])
            blocks.append(C[np.ix_(group, group)] / n)
    H, S = np.vstack(rows), np.zeros((len(np.vstack(rows)),) * 2)
    at = 0
    for block in blocks:
        S[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    best = np.linalg.solve(H.T @ np.linalg.solve(S, H), H.T @ np.linalg.inv(S))[0]
    mine = np.concatenate([a[g, list(group)] for g, group in enumerate(GROUPS) if counts[g]])
    np.testing.assert_allclose(mine, best, rtol=1e-6, atol=1e-8)
    assert best @ S @ best == pytest.approx(Problem(informations(GROUPS, C)[None], COSTS, counts).variances(counts)[0])
    for _ in range(20):  # others without bias vary more
        other = best + (np.eye(len(best)) - H @ np.linalg.pinv(H)) @ rng.normal(size=len(best)) * 0.01
        assert other @ S @ other > best @ S @ best


@pytest.mark.unit
def test_two_models_are_shared_as_is_known():
    """Approximate control variate with a cheap model: N_1/N_0 = √(c_0 ρ²/(c_1 (1 − ρ²))) in closed form."""
    rho, cost = 0.95, 0.01
    groups = subsets(2)
    problem = Problem(
        informations(groups, np.array([[1, rho], [rho, 1]]))[None], np.array([1 + cost, 1, cost]), np.zeros(3)
    )
    n = problem.best(1000.0)
    assert n[1] < 0.02 * n[0]
    ratio = (n[0] + n[2]) / n[0]
    assert ratio == pytest.approx(np.sqrt(rho**2 / (cost * (1 - rho**2))), rel=0.1)
    least = (np.sqrt(1 - rho**2) + np.sqrt(cost * rho**2)) ** 2 / 1000
    assert least * (1 - 1e-6) <= problem.variances(n)[0] <= 1.02 * least


@pytest.mark.parametrize("several", [False, True])
def test_no_other_optimiser_finds_better_numbers(several):
    from scipy.optimize import minimize

    other = np.array([[1, 0.5, 0.95], [0.5, 1, 0.4], [0.95, 0.4, 1]])
    told = np.array([informations(GROUPS, one) for one in ((C, other) if several else (C,))])
    problem = Problem(told, COSTS, np.array([16.0, 0, 0, 0, 0, 0, 0]))

    def largest(x):
        shares = np.exp(x) / np.exp(x).sum()
        return problem.variances(problem.taken + 100 * shares / COSTS).max()

    found = problem.variances(problem.taken + problem.best(100.0)).max()
    options = {"maxiter": 4000, "maxfev": 4000, "xatol": 1e-6, "fatol": 1e-12}
    starts = np.random.default_rng(1).normal(size=(3, 7))
    assert found <= 1.02 * min(minimize(largest, x, method="Nelder-Mead", options=options).fun for x in starts)
    target = found / 3
    cost = problem.needed(target, 1e6)
    assert problem.variances(problem.taken + problem.best(cost)).max() <= 1.02 * target
    assert problem.variances(problem.taken + problem.best(0.8 * cost)).max() > target


@pytest.mark.unit
def test_models_that_are_the_same_do_no_harm():
    same = np.ones((3, 3))
    a = weights(informations(GROUPS, same), np.array([8.0, 0, 0, 0, 0, 0, 1000]))
    assert np.isfinite(a).all()
    np.testing.assert_allclose(a.sum(axis=0), [1, 0, 0], atol=1e-5)
    assert np.isfinite(weights(informations(GROUPS, np.zeros((3, 3))), np.ones(7))).all()
