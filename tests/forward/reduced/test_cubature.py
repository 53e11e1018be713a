"""Points with weights that are not negative."""

import numpy as np
import pytest
from scipy.optimize import nnls

from forward.reduced.modes import enough, orthonormal
from forward.reduced.rules import Mixture, chosen

pytestmark = pytest.mark.unit


def integrands(rows, n, seed=0):
    x = np.linspace(0, 1, n)
    powers = np.arange(rows)[:, None]
    return np.cos(powers * np.pi * x) + 0.01 * np.random.default_rng(seed).standard_normal((rows, 1)), np.full(n, 1 / n)


def test_few_points_integrate_what_all_do():
    values, weights = integrands(12, 400)
    exact = values @ weights
    rule = chosen(values, exact, 1e-10, 400)
    assert (rule.weights > 0).all()
    assert len(rule.points) <= 13  # Tchakaloff: as many as there are integrals are enough
    np.testing.assert_allclose(values[:, rule.points] @ rule.weights, exact, atol=1e-9)
    assert rule.missed <= 1e-10


def test_where_nothing_fits_exactly_it_is_the_best_as_of_lawson_and_hanson():
    rng = np.random.default_rng(3)
    A, b = rng.standard_normal((30, 60)), rng.standard_normal(30) - 3 * rng.random(30)
    A = np.abs(A)  # b has negative parts that no weights can make
    rule = chosen(A, b, 1e-14, 60)
    _, best = nnls(A, b)
    assert rule.missed * np.linalg.norm(b) == pytest.approx(best, rel=1e-6)


def test_it_ends_at_the_tolerance_and_at_the_largest_number():
    values, weights = integrands(40, 300)
    exact = values @ weights
    rough, fine = chosen(values, exact, 1e-1, 300), chosen(values, exact, 1e-6, 300)
    assert len(rough.points) < len(fine.points)
    assert rough.missed <= 1e-1
    assert len(chosen(values, exact, 1e-6, 5).points) <= 6


def test_integrals_that_are_zero_need_no_points():
    assert len(chosen(np.ones((2, 5)), np.zeros(2), 1e-3, 5).points) == 0


def test_a_mixture_keeps_norms_on_average():
    rng = np.random.default_rng(4)
    mixture = Mixture(400, 7, 0)
    rows = rng.standard_normal((5, 100, 7))
    for part in rows:
        mixture.add(part, part @ np.ones(7))
    every = rows.reshape(-1, 7)
    for x in rng.standard_normal((3, 7)):
        assert np.linalg.norm(mixture.values @ x) == pytest.approx(np.linalg.norm(every @ x), rel=0.15)
    np.testing.assert_allclose(mixture.integrals, mixture.values @ np.ones(7), rtol=1e-10, atol=1e-10)


def test_modes_are_those_of_the_singular_value_decomposition_in_the_inner_product():
    rng = np.random.default_rng(5)
    S = rng.standard_normal((9, 9))
    K = S @ S.T + np.eye(9)
    rows = rng.standard_normal((6, 9)) * np.array([5, 3, 1, 0.5, 0.1, 0.01])[:, None]
    modes, squares = orthonormal(rows, lambda x: x @ K, np.zeros((0, 9)), 4)
    np.testing.assert_allclose(modes @ K @ modes.T, np.eye(4), atol=1e-12)
    L = np.linalg.cholesky(K)
    _, singular, Vt = np.linalg.svd(rows @ L)
    for mode, expected in zip(modes @ L, Vt, strict=False):
        assert abs(mode @ expected) == pytest.approx(1, abs=1e-8)
    np.testing.assert_allclose(squares, singular**2, rtol=1e-8)
    beside, _ = orthonormal(rng.standard_normal((3, 9)), lambda x: x @ K, modes, 3)
    np.testing.assert_allclose(beside @ K @ modes.T, 0, atol=1e-12)
    assert enough(np.array([1.0, 0.5, 1e-6, 1e-9]), 1e-2) == 2
