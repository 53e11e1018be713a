"""Regression in many parameters: the functions to choose from, and how they are selected."""

import tracemalloc
from itertools import product

import numpy as np
import pytest

from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import DICTIONARY, Candidate, candidates_of, hyperbolic, hyperbolic_count, orthonormal
from uq.surrogates.least_squares import Data, _Products, _select
from uq.surrogates.regression import Regression


def inputs_of(d):
    return Inputs({f"x{i}": Uniform(lower=-1, upper=1) for i in range(d)})


@pytest.mark.unit
@pytest.mark.parametrize("q", [0.5, 0.75, 1.0])
@pytest.mark.parametrize(("d", "order"), [(1, 4), (2, 6), (3, 5), (5, 3)])
def test_hyperbolic_sets_are_those_of_their_definition(d, order, q):
    everything = np.array(list(product(range(order + 1), repeat=d)))
    inside = everything[(everything**q).sum(axis=1) <= order**q * (1 + 1e-12)]
    found = hyperbolic(d, order, q)
    assert len(found) == hyperbolic_count(d, order, q) == len(inside)
    assert set(map(tuple, found)) == set(map(tuple, inside))
    assert found.tolist() == sorted(found.tolist(), key=lambda a: (sum(a), *(-k for k in a)))


def test_sets_of_a_hundred_parameters_are_counted_before_they_are_made():
    assert hyperbolic_count(100, 6, 1.0) == 1_705_904_746
    tracemalloc.start()
    for d in (30, 50, 100):
        candidates = candidates_of(inputs_of(d), 6, 64 * (d + 1), DICTIONARY)
        assert all(one.which.size <= DICTIONARY for one in candidates.sets)
        assert len(candidates.basis.indices) > d
    assert tracemalloc.get_traced_memory()[1] < 50 * 2**20
    tracemalloc.stop()


def by_projections(columns, right, held, steps):
    """Orthogonal least squares as it is defined, without the samples of a number: projections of all columns."""
    rows = np.repeat(held, right.shape[1])
    picks = []
    for number in [*range(held.max() + 1), -1]:
        matrix, rest = columns[rows != number], right.reshape(len(rows), -1)[rows != number]
        taken = [0]
        while len(taken) < steps:
            q = np.linalg.qr(matrix[:, taken])[0]
            left = matrix - q @ (q.T @ matrix)
            size = (left**2).sum(axis=0)
            gains = np.where(size > 1e-8, ((left.T @ rest) ** 2).sum(axis=1) / np.where(size > 1e-8, size, 1), -1)
            taken.append(int(gains.argmax()))
        picks.append(taken)
    return np.array(picks).T


@pytest.mark.unit
def test_selection_by_inner_products_is_that_by_projections():
    inputs = inputs_of(6)
    basis = orthonormal(inputs, hyperbolic(6, 3, 0.75))
    points = inputs.points(sobol_points(3, 0, 0, 40, 6))
    values = np.column_stack(
        [np.exp(points @ np.arange(6) / 6), points[:, 0] * points[:, 1] + np.sin(3 * points[:, 2])]
    )
    data = Data.at(points, values, None, inputs)
    held = np.arange(40) // 4
    left = data.left(basis)
    everything = Candidate(3, 0.75, np.arange(left.shape[2]), sparse=True)
    _, chosen, folds, _ = _select(_Products.of(left, data.right, held), data, everything, 12, slice(None))
    scaled = data.right / np.linalg.norm(data.right - data.right.mean(axis=0), axis=(0, 1))
    expected = by_projections(left.reshape(40, -1), scaled, held, chosen.which.size)
    assert chosen.which.tolist() == expected[:, -1].tolist()
    assert folds.which.tolist() == expected[:, :-1].T.tolist()
    for k, which in enumerate(folds.which):
        fit = np.linalg.lstsq(left[held != k][:, 0, which], data.right[held != k][:, 0], rcond=None)[0]
        errors = data.right[held == k][:, 0] - left[held == k][:, 0, which] @ fit
        np.testing.assert_allclose(folds.errors[held == k][:, 0], errors, atol=1e-9)


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("d", [2, 6])
def test_outputs_that_nothing_explains_leave_the_others_theirs(d, gradients):
    """What is zero by symmetry is rounding that no polynomial follows."""
    inputs = inputs_of(d)
    points = inputs.points(sobol_points(3, 0, 0, 24, d))
    rng = np.random.default_rng(0)
    smooth = np.exp(points[:, [0]] + points[:, [1]] / 2)
    slopes = np.zeros((24, 1, d))
    slopes[:, 0, 0], slopes[:, 0, 1] = smooth[:, 0], smooth[:, 0] / 2
    noise, its = 1e-17 * rng.standard_normal((24, 2)), 1e-17 * rng.standard_normal((24, 2, d))
    alone = Regression.of(inputs, points, smooth, slopes if gradients else None, 4)
    values, tangents = np.hstack([smooth, noise]), np.concatenate([slopes, its], axis=1)
    both = Regression.of(inputs, points, values, tangents if gradients else None, 4)
    assert both.fit.chosen.order == alone.fit.chosen.order > 1
    assert both.fit.relative[0] == pytest.approx(alone.fit.relative[0], rel=1e-6)
    assert (both.fit.relative[1:] > 0.8).all()


def test_rounding_that_few_samples_explain_by_chance_decides_nothing():
    """A plane through eight samples leaves 0.6 of one rounding in a hundred, which a parabola would not follow."""
    inputs = inputs_of(2)
    points = inputs.points(sobol_points(3, 0, 0, 8, 2))
    smooth = np.exp(points[:, [0]] + points[:, [1]] / 2)
    alone = Regression.of(inputs, points, smooth, None, 2)
    rng = np.random.default_rng(0)
    chances = [np.hstack([smooth, 1e-17 * rng.standard_normal((8, 1))]) for _ in range(100)]
    found = [Regression.of(inputs, points, values, None, 2).fit for values in chances]
    assert min(fit.relative[1] for fit in found) < 0.8
    assert {fit.chosen.order for fit in found} == {alone.fit.chosen.order}
    np.testing.assert_allclose([fit.relative[0] for fit in found], alone.fit.relative[0], rtol=1e-6)


def test_few_values_in_ten_parameters():
    """The weight of a wing (A. Forrester, A. Sóbester, A. Keane, Engineering Design via Surrogate Modelling, 2008)."""
    lower = (150, 220, 6, -10, 16, 0.5, 0.08, 2.5, 1700, 0.025)
    upper = (200, 300, 10, 10, 45, 1, 0.18, 6, 2500, 0.08)
    inputs = Inputs({f"x{i}": Uniform(lower=a, upper=b) for i, (a, b) in enumerate(zip(lower, upper, strict=True))})

    def weight(x):
        S, fuel, A, sweep, q, taper, thickness, load, gross, paint = x.T
        c = np.cos(np.deg2rad(sweep))
        return (
            0.036 * S**0.758 * fuel**0.0035 * (A / c**2) ** 0.6 * q**0.006 * taper**0.04
            * (100 * thickness / c) ** -0.3 * (load * gross) ** 0.49 + S * paint
        )  # fmt: skip

    truth = weight(inputs.points(sobol_points(9, 0, 0, 2**17, 10)))
    for seed in range(2):
        points = inputs.points(sobol_points(seed, 0, 0, 64, 10))
        estimates = Regression.of(inputs, points, weight(points)[:, None], None, 6).estimates()
        assert estimates["std"][0] == pytest.approx(truth.std(), rel=0.02)
        assert abs(estimates["std"][0] - truth.std()) < 2.6 * estimates["std_error"][0]
