"""What the summary holds of tables of variables."""

import numpy as np
import pytest
import xarray as xr

from workflows.results.summary import summarise


@pytest.mark.unit
def test_tables_are_by_output_whatever_the_order_of_dimensions():
    """Numbers that are not finite are none; probabilities are written short; errors stand beside their values."""
    dataset = xr.Dataset(
        {
            "sobol_first": (("parameter", "output"), [[0.5, 0.1], [0.25, np.nan]]),
            "sobol_first_error": (("output", "parameter"), [[0.1, 0.2], [0.3, 0.4]]),
            "sobol_total": (("output", "parameter"), [[0.6, 0.7], [0.8, 0.9]]),
            "quantiles": (("quantile", "output"), [[1.0, 2.0]]),
            "quantiles_corrected": (("quantile", "output"), [[1.5, np.inf]]),
            "mean": ("output", [0.0, 0.0]),
        },
        coords={"output": ["u", "v"], "parameter": ["a", "b"], "quantile": [0.05]},
    )
    told = summarise(dataset)
    assert told["sobol"]["u"]["a"] == {"first": 0.5, "first_error": 0.1, "total": 0.6}
    assert told["sobol"]["v"]["b"] == {"first": None, "first_error": 0.4, "total": 0.9}
    assert told["quantiles"] == {
        "u": {"0.05": {"value": 1.0, "corrected": 1.5}},
        "v": {"0.05": {"value": 2.0, "corrected": None}},
    }


@pytest.mark.unit
def test_pairs_are_of_two_parameters():
    """An index of second order of a parameter with itself is nothing."""
    dataset = xr.Dataset(
        {"sobol_second": (("output", "parameter", "partner"), [[[np.nan, 0.1], [0.2, np.nan]]])},
        coords={"output": ["a"], "parameter": ["a", "b"], "partner": ["a", "b"]},
    )
    assert summarise(dataset) == {"sobol_second": {"a": {"a": {"b": {"second": 0.1}}, "b": {"a": {"second": 0.2}}}}}


@pytest.mark.unit
def test_derivatives_are_numbers_and_their_errors_stand_apart():
    """As derivatives have always stood in the summary: `local`, `local_mesh_error` and so on, without names within."""
    by = ("output", "parameter")
    dataset = xr.Dataset(
        {"derivative": (by, [[2.0]]), "derivative_mesh_error": (by, [[0.5]]), "derivative_error": (by, [[0.1]])},
        coords={"output": ["u"], "parameter": ["a"]},
    )
    assert summarise(dataset) == {"local": {"u": {"a": 2.0}}, "local_mesh_error": {"u": {"a": 0.5}}}
