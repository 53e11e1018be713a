"""What a fit lacks in tails, and what that does to its standard deviations, where both are known."""

import numpy as np
import pytest

from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import gaps, neighbours
from uq.surrogates.regression import Regression

INPUTS = Inputs({name: Normal(mean=0.0, std=1.0) for name in "ab"})
SIZE = 0.02  # of the cubic function that an expansion of order 2 lacks


def fitted(seed):
    """1 + a + b/2 + 0.3 ab with a cubic function of norm `SIZE`, orthogonal to these."""
    points = INPUTS.points(sobol_points(seed, 0, 0, 24, 2))
    a, b = points.T
    cubic = SIZE / 6**0.5
    values = 1 + a + b / 2 + 0.3 * a * b + cubic * (a**3 - 3 * a)
    slopes = np.stack([1 + 0.3 * b + cubic * (3 * a**2 - 3), 0.5 + 0.3 * a], axis=1)
    return Regression.of(INPUTS, points, values[:, None], slopes[:, None, :], 2)


def test_what_a_missing_function_does_to_the_standard_deviation_is_claimed_and_not_its_norm():
    found = [fitted(seed) for seed in range(8)]
    missing = np.array([one.missing()[0] for one in found])
    np.testing.assert_array_less(0.95 * SIZE, missing)
    claims = np.array([one.hidden(norm[None])[0] for one, norm in zip(found, missing, strict=True)])
    off = np.array([one.estimates()["std"][0] for one in found]) - (1 + 0.25 + 0.09 + SIZE**2) ** 0.5
    assert (abs(off) < 1.96 * claims).all()
    assert abs(off).max() > 0.2 * claims.max()
    assert (claims < 0.8 * missing).all()


@pytest.mark.unit
def test_powers_that_a_basis_lacks():
    basis = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [1, 1]])
    tails, both = np.array([True, False]), np.arange(2)
    assert [tuple(one) for one in neighbours(basis, tails, both)] == [(3, 0), (4, 0), (3, 1)]
    found = {tuple(one) for one in neighbours(basis, np.array([True, True]), both)}
    assert found == {(3, 0), (4, 0), (3, 1), (2, 1), (0, 2), (0, 3), (1, 2)}


def test_powers_between_those_that_few_samples_have_chosen_are_claimed():
    """An even wave by powers up to 20, of which a handful are chosen: others would look the same at the samples."""
    inputs, exact = Inputs({"z": Normal(mean=0.0, std=1.0)}), (1 - np.exp(-4.0)) / 2**0.5
    held, some = [], []
    for seed in range(6):
        for n in (5, 6, 8):
            points = inputs.points(sobol_points(seed, 0, 0, n, 1))
            found = Regression.of(inputs, points, np.cos(2 * points), -2 * np.sin(2 * points)[:, :, None], 20)
            known = found.estimates()
            held.append(abs(known["std"][0] - exact) < 1.96 * known["std_error"][0])
            some.append(len(gaps(found.basis.indices, 0)))
    assert min(some) > 0
    assert np.mean(held) > 0.9


def of_values(function, d, samples, seeds):
    """Mean, std and their errors (seeds, 4) from values at points of d normal quantities; whether fits are rough."""
    inputs = Inputs({f"z{i}": Normal(mean=0.0, std=1.0) for i in range(d)})
    rows, rough = [], []
    for seed in range(seeds):
        points = inputs.points(sobol_points(seed, 0, 0, samples, d))
        fitted = Regression.of(inputs, points, function(points)[:, None], None, None)
        found = fitted.estimates()
        rough.append(fitted.controlled[0])
        rows.append([found[name][0] for name in ("mean", "mean_error", "std", "std_error")])
    return np.array(rows), np.array(rough)


@pytest.mark.slow
@pytest.mark.unit
@pytest.mark.parametrize("rate", [1.0, 0.1])  # of their expansions 0.7 and 0.02 are left
def test_deviations_of_many_normals_are_claimed_within_ten_errors(rate):
    d, seeds = 30, 5
    direction = np.arange(1, d + 1) ** -0.5
    direction *= rate / np.linalg.norm(direction)
    _, _, std, error = of_values(lambda z: np.sin(z @ direction + 0.5), d, 120, seeds)[0].T
    shrunk = np.exp(-(rate**2))
    off = std - np.sqrt((1 - shrunk**2 * np.cos(1.0)) / 2 - shrunk * np.sin(0.5) ** 2)
    assert (abs(off) < 1.96 * error).all()
    assert np.median(error) < 10 * np.sqrt((off**2).mean())


def test_a_fit_that_goes_wrong_beyond_its_samples_gives_way_to_these():
    found, rough = of_values(lambda z: z[:, 0] * np.sin(3 * z[:, 0]), 1, 32, 16)
    mean, mean_error, std, std_error = found[rough].T
    assert rough.sum() > 12
    second = 0.5 * (1 + 35 * np.exp(-18.0))  # E[z² (1 − cos 6z)]/2
    exact = 3 * np.exp(-4.5)
    assert (abs(mean - exact) < 1.96 * mean_error).mean() > 0.8
    off = std - np.sqrt(second - exact**2)
    assert (abs(off) < 1.96 * std_error).mean() > 0.8
    assert abs(off).max() < 0.5
