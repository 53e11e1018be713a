"""One tolerance for all errors: what they are relative to, and how they add up."""

from dataclasses import replace

import numpy as np
import pytest

from uq.accuracy.goal import LEFT, SMALL, Goal
from uq.estimators.moments import Z

pytestmark = pytest.mark.unit


def estimates(mean, std, mean_error=0.0, std_error=0.0):
    return {
        name: np.broadcast_to(np.asarray(value, dtype=float), np.shape(mean))
        for name, value in (("mean", mean), ("std", std), ("mean_error", mean_error), ("std_error", std_error))
    }


def test_sizes_are_those_of_the_estimates():
    sizes = Goal.of(0.01, ["m", "N"], 100).sizes(np.array([-2.0, 0.1]), np.array([0.5, 0.3]))
    np.testing.assert_allclose(sizes, [[2.0, 0.3], [0.5, 0.3]])  # a mean smaller than its standard deviation


def test_what_is_zero_is_held_to_a_part_of_its_kind():
    goal = Goal.of(0.01, ["m", "m", "N", "1", "1"], 100)
    mean, std = np.array([2.0, 1e-17, 5.0, 1e6, 1.0]), np.array([0.5, 1e-17, 1e-12, 0.0, 0.1])
    of_mean, of_std = goal.sizes(mean, std)
    np.testing.assert_allclose(of_mean, [2.0, SMALL * 2.0, 5.0, 1e6, 1.0])  # numbers without a unit need not be alike
    np.testing.assert_allclose(of_std, [0.5, SMALL**2 * 2.0, SMALL * 5.0, SMALL * 1e6, 0.1])
    assert goal.reached(estimates(mean, std)) == 0.0


def test_errors_add_up_in_squares_on_the_scale_of_intervals():
    goal = replace(Goal.of(0.1, ["m"], 100), mesh=np.array([[0.003], [0.001]]), solver=1e-3)
    parts = goal.parts(estimates([1.0], [0.5], [0.004], [0.002]), 2.13)
    np.testing.assert_allclose(parts["sampling"], [[2.13 * 0.04], [2.13 * 0.04]])
    np.testing.assert_allclose(parts["mesh"], [[Z * 0.03], [Z * 0.02]])
    np.testing.assert_allclose(parts["solver"], 0.01)
    np.testing.assert_allclose(parts["total"], np.hypot(parts["sampling"], parts["mesh"]) + 0.01)


@pytest.mark.parametrize("doubt", [0.0, 0.03, 0.045])
def test_sampling_is_enough_where_the_total_is(doubt):
    goal = replace(Goal.of(0.1, ["m"], 100), mesh=np.array([[doubt], [0.0]]), solver=1e-3)
    errors = np.linspace(1e-4, 0.1, 200)
    for error in errors:
        found = estimates([1.0], [1.0], [error], [0.0])
        assert (goal.reached(found) <= 1) == (goal.parts(found)["total"][0, 0] <= 1)


def test_a_mesh_that_takes_more_than_all_does_not_ask_for_endless_sampling():
    goal = replace(Goal.of(0.1, ["m"], 100), mesh=np.array([[0.2], [0.0]]))
    assert goal.reached(estimates([1.0], [1.0], [0.99 * LEFT * 0.2], [0.0])) <= 1
    assert goal.reached(estimates([1.0], [1.0], [1.01 * LEFT * 0.2], [0.0])) > 1


def test_estimates_that_are_no_numbers_are_never_enough():
    assert Goal.of(0.1, ["m"], 100).reached(estimates([1.0], [1.0], [np.nan], [0.0])) == np.inf
