"""Outputs that cannot be negative."""

import numpy as np
import pytest

from inverse.data import signs
from inverse.data.table import DataError


@pytest.mark.unit
def test_most_of_the_data_of_an_output_decide():
    names, labels = ["force"] * 5 + ["ux"] * 2, [f"a.csv: line {k}" for k in range(7)]
    may = [False] * 5 + [True] * 2
    signs.check(names, np.array([-1e-3, 2, 3, -1e-4, 5, -1, -1]), labels, may)
    signs.check(names, np.array([-1.0] * 7), labels, [True] * 7)
    signs.check([], np.zeros(0), [], [])
    with pytest.raises(DataError) as caught:
        signs.check(names, np.array([1e-3, -2, -3, -4, -5, -1, -1]), labels, may)
    (line,) = caught.value.args
    assert line.startswith("a.csv: line 1: 'force' is -2, and 4 of 5 are below 0, which it cannot be: ")
