"""Sobol' indices as labelled variables: by output, by round, and as maps of the displacement field."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray
from uq.estimators.indices import field_indices, partial_variances
from uq.surrogates.least_squares import NOTHING

if TYPE_CHECKING:
    import xarray as xr

DIMENSIONS = {
    "sobol_first": ("output", "parameter"),
    "sobol_total": ("output", "parameter"),
    "sobol_group_first": ("output", "group"),
    "sobol_group_total": ("output", "group"),
    "sobol_second": ("output", "parameter", "partner"),
}
RUNNING = ("sobol_first", "sobol_total")
Variables = dict[str, tuple[tuple[str, ...], Any]]


def by_output(found: dict[str, FloatArray]) -> Variables:
    """Return indices and their errors as variables."""
    return {
        f"{name}{end}": (dimensions, found[f"{name}{end}"])
        for name, dimensions in DIMENSIONS.items()
        for end in ("", "_error")
        if name in found
    }


def by_round(rounds: dict[int, dict[str, FloatArray]]) -> Variables:
    """Return the indices of first order and total of several rounds as variables."""
    return {
        f"running_{name}{end}": (
            ("index_round", "output", "parameter"),
            np.array([found[f"{name}{end}"] for found in rounds.values()]),
        )
        for name in RUNNING
        for end in ("", "_error")
    }


def with_maps(dataset: xr.Dataset, volumes: FloatArray | None) -> xr.Dataset:
    """Add the indices of an expanded field.

    Errors of the whole field's indices come with the expansion; there are none if it explains nothing of the field.
    Maps are empty at nodes of which it explains nothing.
    """
    if "field_coefficients" not in dataset:
        return dataset
    squares = (dataset["field_coefficients"].to_numpy() ** 2).sum(axis=2).T
    indices = dataset["multi_index"].to_numpy()
    variance, first, total = partial_variances(squares, indices, np.eye(indices.shape[1], dtype=bool))
    nothing = "field_loo_error" in dataset and float(dataset["field_loo_error"]) > NOTHING
    dataset = dataset.assign(field_indices(variance, first.T, total.T, volumes))
    if "node_loo_error" in dataset:
        known = (dataset["node_loo_error"] <= NOTHING) & (not nothing)
        maps = {f"node_{name}": dataset[f"node_{name}"].where(known) for name in RUNNING}
        dataset = dataset.assign({**maps, "dominating": dataset["dominating"].where(known, -1)})
    for name in RUNNING:
        if nothing:
            dataset[f"field_{name}"] = dataset[f"field_{name}"] * np.nan
        if f"field_{name}_error" not in dataset:  # results of an earlier version
            dataset[f"field_{name}_error"] = dataset[f"field_{name}"] * np.nan
    return dataset
