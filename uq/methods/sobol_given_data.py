"""Results of another study, as data for Sobol' indices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uq.evaluation.request import Evaluate
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr


def checked(source: xr.Dataset, directory: str, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
    """Return the results of another study, which must have the same parameters and outputs.

    Raises
    ------
    FileNotFoundError
        If they are of others.
    """
    for what, expected in (("parameter", inputs.names), ("output", evaluate.outputs)):
        theirs = tuple(source[what].values)
        if theirs != expected:
            message = f"{directory}: holds results of {what}s {', '.join(theirs)}, expected {', '.join(expected)}"
            raise FileNotFoundError(message)
    if not ("multi_index" in source or "values" in source):
        message = f"{directory}: holds neither samples nor an expansion, expected results of chaos or of sampling"
        raise FileNotFoundError(message)
    ours, written = _as_written(inputs), _distributions(source.attrs.get("config"))
    if not (
        np.allclose(source["parameter_mean"], inputs.mean, rtol=1e-10, atol=0)
        and np.allclose(source["parameter_std"], inputs.std, rtol=1e-10, atol=0)
        and all(ours[name] == value for name, value in written.items())  # coefficients of fields are not written
    ):
        message = f"{directory}: holds results of other distributions, expected those of this study"
        raise FileNotFoundError(message)
    return source


def _distributions(config: str | None) -> dict[str, Any]:
    """Return the distributions of a recorded study, if there is a record."""
    import tomllib

    return dict(tomllib.loads(config or "").get("parameters", {}))


def _as_written(inputs: Inputs) -> dict[str, Any]:
    return {name: marginal.model_dump(mode="json", exclude_none=True) for name, marginal in inputs.marginals.items()}
