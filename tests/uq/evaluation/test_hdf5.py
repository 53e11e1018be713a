"""netCDF files that are read without xarray's reader."""

import numpy as np
import pytest
import xarray as xr

from uq.evaluation.hdf5 import netcdf, stored_dataset


@pytest.fixture
def awkward():
    """Texts, truths, empty texts, scalars, a variable with the name of a dimension, attributes of each kind."""
    variables = {
        "z": (("b", "a"), [[1.0, np.nan, 3.0], [np.inf, 5.0, 6.0]], {"units": "m", "n": 72, "ends": [0.5, 2.0]}),
        "ok": (("b",), [True, False]),
        "why": (("b",), ["", "µ is far: 12 %"]),
        "point": (("a", "point"), np.arange(12).reshape(3, 4)),
        "whole": ((), 3.5),
        "said": ((), "a text"),
        "none": (("empty", "a"), np.zeros((0, 3))),
        "wide": (("a",), np.array([1, 2, 3], dtype=np.int32)),
    }
    coordinates = {"b": ["second", "first"], "unit": (("b",), ["m", "Pa"]), "a": [2.0, 1.0, 3.0]}
    return xr.Dataset(
        variables, coordinates, {"config": "x = 1\n", "count": 3, "list": [1.0, 2.0], "texts": ["m", "µ"]}
    )


def test_datasets_are_read_as_xarray_does(awkward, tmp_path):
    path = tmp_path / "file.nc"
    path.write_bytes(netcdf(awkward, {"posterior": awkward[["ok"]]}))
    expected, found = xr.load_dataset(path, engine="h5netcdf"), stored_dataset(path)
    xr.testing.assert_identical(found, expected)
    assert list(found.variables) == list(expected.variables)
    assert list(found.sizes) == list(expected.sizes)
    for name in found.variables:
        assert found[name].dtype.kind == expected[name].dtype.kind, name
        np.testing.assert_array_equal(found[name], awkward[name])
        assert found[name].dims == awkward[name].dims


def test_numbers_that_another_program_has_packed_are_unpacked(tmp_path):
    path = tmp_path / "file.nc"
    packed = xr.Dataset({"x": (("a",), [1.5, 2.5])})
    packed.to_netcdf(path, engine="h5netcdf", encoding={"x": {"dtype": "i2", "scale_factor": 0.5}})
    np.testing.assert_array_equal(stored_dataset(path)["x"], [1.5, 2.5])
