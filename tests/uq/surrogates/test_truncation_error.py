"""What a fit lacks in tails, and what that does to its standard deviations, where both are known."""

import numpy as np
import pytest

from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates import regression
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


@pytest.mark.unit
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
    tails = np.array([True, False])
    assert [tuple(one) for one in regression._neighbours(basis, tails)] == [(3, 0), (4, 0), (3, 1)]
    both = {tuple(one) for one in regression._neighbours(basis, np.array([True, True]))}
    assert both == {(3, 0), (4, 0), (3, 1), (2, 1), (0, 2), (0, 3), (1, 2)}
