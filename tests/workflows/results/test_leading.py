"""Which of many outputs are told."""

import numpy as np
import xarray as xr

from workflows.results.summary import leading


def test_of_many_outputs_those_are_told_that_vary_most_beside_others_of_their_unit():
    names, std = ["a", "b", "c", "d"], [1e-3, 3e-3, 5.0, 1.0]
    units = ("output", ["m", "m", "N", "N"])
    dataset = xr.Dataset({"std": ("output", std)}, {"output": names, "unit": units})
    assert leading(dataset, names, 4) == names
    assert leading(dataset, names, 2) == ["b", "c"]
    assert leading(dataset.assign(std=("output", [np.nan] * 4)), names, 2) == ["a", "b"]
    assert leading(dataset.drop_vars("std"), names, 3) == ["a", "b", "c"]
