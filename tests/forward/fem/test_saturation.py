"""What part of an error is seen, from three degrees."""

import numpy as np
import pytest

from forward.fem.solution import LEAST, MOST, factors

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("degree", [1, 2])
def test_powers_of_the_degree_are_found(degree):
    rates = np.array([1.5, 2.0, 3.1, 8.0])
    errors = [float(p) ** -rates for p in (degree, degree + 1, degree + 2)]
    found = factors(errors[0] - errors[1], errors[0] - errors[2], degree)
    np.testing.assert_allclose(found * (errors[0] - errors[1]), errors[0], rtol=1e-3)


def test_what_is_no_power_is_bounded():
    seen = np.array([1.0, 1.0, 1.0, 1.0, -2.0, np.nan, 0.0, np.inf])
    more = np.array([1.0, 1.8, 0.8, -3.0, -2.6, 1.0, 0.0, 1.0])
    found = factors(seen, more, 2)
    np.testing.assert_allclose(found[[0, 1, 2, 3, 6, 7]], [1, MOST, 0.8, LEAST, 1, 1])
    assert 1.3 < found[4] < 2.0
    assert np.isnan(found[5])
