"""Outputs that are zero but for rounding, such as a displacement across a plane of symmetry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding, entries
from uq.findings import add, withdraw

if TYPE_CHECKING:
    import xarray as xr

ROUNDING = 1e-9  # of the largest quantity of the same unit: what is zero by symmetry is smaller
NUMBER = "1"  # unit of ratios, which differ in size
LENGTH = "m"  # unit of the displacement field


def only_rounding(dataset: xr.Dataset, units: Mapping[str, str]) -> NDArray[np.bool_]:
    """Say which outputs (m,) are rounding beside others of the same unit, or beside the displacement field.

    Parameters
    ----------
    dataset
        Results: values at the mean parameters, moments where there are some, fields where there are some.
    units
        Of the outputs.
    """
    known = [units.get(str(name), "1") for name in dataset["output"].values]
    sizes = np.zeros(len(known))
    for name in ("nominal", "mean", "std"):
        if name in dataset and dataset[name].dims == ("output",):
            sizes = np.fmax(sizes, np.abs(dataset[name].to_numpy()))
    largest = {unit: float(sizes[[other == unit for other in known]].max()) for unit in known}
    for name in ("field_nominal", "field_mean"):
        if name in dataset and LENGTH in largest and dataset[name].size:
            largest[LENGTH] = max(largest[LENGTH], float(np.nanmax(np.abs(dataset[name].to_numpy()))))
    comparable = np.array([unit != NUMBER for unit in known])
    return np.asarray(comparable & (sizes <= ROUNDING * np.array([largest[unit] for unit in known])))


def settled(dataset: xr.Dataset, units: Mapping[str, str]) -> None:
    """Withdraw what was said of outputs that are rounding, of which nothing can be explained, and say that they are."""
    names = [str(name) for name in dataset["output"].values[only_rounding(dataset, units)]]
    if names:
        withdraw(dataset, names)
        be = "is" if len(names) == 1 else "are"
        add(
            dataset,
            Finding("only-rounding", "note", {"be": be}, about=entries(names)),
        )
