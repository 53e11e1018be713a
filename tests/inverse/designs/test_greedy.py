"""Choices one after the other against all sets, with few looks, and with costs."""

from itertools import combinations

import numpy as np
import pytest

from inverse.designs.criteria import Information, Variance
from inverse.designs.greedy import choose
from tests.inverse.designs.test_criteria import information, problem


class Plain(Information):
    """The same, of which it is not known that gains never grow: all candidates are looked at in each step."""

    submodular = False


def mean_information(rows, chosen):
    return np.mean([information(one, chosen) for one in rows])


@pytest.mark.unit
@pytest.mark.parametrize("seed", range(8))
def test_choices_are_nearly_the_best_of_all_sets(seed):
    rows = problem(seed, draws=3, count=9, k=1 + seed % 3)
    found = choose(lambda: Information(rows), np.ones(9), number=3, budget=None)
    best = max(mean_information(rows, chosen) for chosen in combinations(range(9), 3))
    assert found.worth == pytest.approx(mean_information(rows, found.order), rel=1e-10)
    assert (1 - 1 / np.e) * best <= found.worth <= best * (1 + 1e-12)
    assert found.worth > 0.95 * best


@pytest.mark.unit
def test_orthogonal_observations_are_chosen_best():
    sizes = np.array([0.3, 2.0, 1.0, 0.1, 3.0])
    found = choose(lambda: Information([np.diag(sizes)[:, None, :]]), np.ones(5), number=3, budget=None)
    assert found.order == (4, 1, 2)
    np.testing.assert_allclose(found.gains, np.log1p(sizes[[4, 1, 2]] ** 2) / 2, rtol=1e-12)


@pytest.mark.unit
def test_few_candidates_are_looked_at_again():
    rng = np.random.default_rng(5)
    rows = [10 ** rng.uniform(-2, 1, (400, 1, 1)) * rng.standard_normal((400, 3, 6)) for _ in range(3)]
    lazy = choose(lambda: Information(rows), np.ones(400), number=20, budget=None)
    plain = choose(lambda: Plain(rows), np.ones(400), number=20, budget=None)
    assert lazy.order == plain.order
    np.testing.assert_allclose(lazy.gains, plain.gains, rtol=1e-9)
    assert lazy.looks < plain.looks / 5


@pytest.mark.unit
@pytest.mark.parametrize("seed", range(5))
def test_budgets_are_kept_and_nearly_used_best(seed):
    rows, rng = problem(seed, count=9), np.random.default_rng(seed)
    costs = rng.uniform(0.5, 3, 9)
    found = choose(lambda: Information(rows), costs, number=None, budget=5.0)
    assert costs[list(found.order)].sum() <= 5.0
    sets = [s for n in range(1, 9) for s in combinations(range(9), n) if costs[list(s)].sum() <= 5.0]
    assert found.worth > 0.9 * max(mean_information(rows, s) for s in sets)


@pytest.mark.unit
def test_one_that_tells_all_is_not_passed_over_for_a_cheap_one():
    rows = [np.array([[[0.2, 0.0]], [[0.0, 100.0]]])]
    found = choose(lambda: Information(rows), np.array([0.01, 5.0]), number=None, budget=5.0)
    assert found.order == (1,)


@pytest.mark.unit
def test_variances_are_reduced_most():
    rows, goals = problem(3, draws=2, count=9), [np.diag([1.0, 0, 0, 0]), np.diag([0.5, 0.5, 0, 0])]
    found = choose(lambda: Variance(rows, goals), np.ones(9), number=1, budget=None)
    alone = []
    for i in range(9):
        left = [np.linalg.inv(np.eye(4) + one[i].T @ one[i]) for one in rows]
        alone.append(np.mean([np.trace(Q - Q @ C) for Q, C in zip(goals, left, strict=True)]))
    assert found.order == (int(np.argmax(alone)),)
    assert found.worth == pytest.approx(max(alone), rel=1e-10)
