"""Outputs that cannot be negative."""

import numpy as np
import pytest

from inverse.data.measurements import Measurements
from inverse.data.table import DataError


@pytest.mark.unit
def test_most_of_the_data_of_an_output_decide():
    names, labels = ["force"] * 5 + ["ux"] * 2, [f"a.csv: line {k}" for k in range(7)]
    may = [False] * 5 + [True] * 2

    def check(values, negative):
        n = len(values)
        found = Measurements.of(np.array(values), np.ones(n), [0] * n, [0] * n, names[:n], labels[:n])
        found.check_signs(names[:n], negative)

    check([-1e-3, 2, 3, -1e-4, 5, -1, -1], may)
    check([-1.0] * 7, [True] * 7)
    check([], [])
    with pytest.raises(DataError) as caught:
        check([1e-3, -2, -3, -4, -5, -1, -1], may)
    (line,) = caught.value.args
    assert line.startswith("a.csv: line 1: 'force' is -2, and 4 of 5 are below 0, which it cannot be: ")
