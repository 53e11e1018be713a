"""Curves of outputs over the steps of a path."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uq.estimators.moments import half_width
from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, PLAIN, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

NAMED = 8  # parameters that have a colour of their own


def curve(dataset: xr.Dataset, output: str, along: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw the mean of an output over a path with the band of its quantiles and the error of the mean."""
    ax = ax or axes()
    there = _steps(dataset, output)
    x = there[along].to_numpy()
    if "quantiles" in there:
        levels = there["quantile"].to_numpy()
        low, high = (there["quantiles"].isel(quantile=int(i)).to_numpy() for i in (levels.argmin(), levels.argmax()))
        label = f"{100 * levels.min():g} to {100 * levels.max():g} % of the values"
        ax.fill_between(x, low, high, color=CONTROLLED, alpha=0.22, linewidth=0, label=label)
    elif "std" in there:
        mean, reach = there["mean"].to_numpy(), 2 * there["std"].to_numpy()
        ax.fill_between(x, mean - reach, mean + reach, color=CONTROLLED, alpha=0.22, linewidth=0, label="2 deviations")
    if "mean" in there:
        error = half_width(dataset) * there["mean_error"].to_numpy()
        ax.errorbar(x, there["mean"].to_numpy(), error, color=CONTROLLED, marker="o", ms=4, capsize=3, label="mean")
    else:
        ax.plot(x, there["nominal"].to_numpy(), color=CONTROLLED, marker="o", ms=4, label="at the mean parameters")
    if "mean_corrected" in there:
        corrected = there["mean_corrected"].to_numpy()
        ax.plot(x, corrected, color=HIGH, linestyle="--", label="mean, error of the mesh added")
    ax.set_xlabel(_labelled(along, unit))
    ax.set_ylabel(_labelled(output, str(there["unit"].to_numpy()[0])))
    ax.legend(frameon=False, fontsize="small")
    return ax


def shares(dataset: xr.Dataset, output: str, along: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw the total Sobol' index of each parameter over a path with its 95 % interval."""
    ax = ax or axes()
    there = _steps(dataset, output)
    x = there[along].to_numpy()
    values = there["sobol_total"].transpose("parameter", "output").to_numpy()
    errors = half_width(dataset) * there["sobol_total_error"].transpose("parameter", "output").to_numpy()
    order = np.argsort(-values.max(axis=1))
    for rank, i in enumerate(order[:NAMED]):
        name = text_of(str(dataset["parameter"].to_numpy()[i]))
        ax.errorbar(x, values[i], errors[i], color=f"C{rank}", marker="o", ms=4, capsize=3, label=name)
    for i in order[NAMED:]:
        ax.plot(x, values[i], color=PLAIN, linewidth=0.8)
    ax.axhline(0, color=DARK, linewidth=0.8)
    ax.set_xlabel(_labelled(along, unit))
    ax.set_ylabel(f"total Sobol' index of {text_of(output)}")
    ax.legend(frameon=False, fontsize="small")
    return ax


def slopes(dataset: xr.Dataset, output: str, along: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw what one standard deviation of each parameter does to an output, to first order, over a path."""
    ax = ax or axes()
    there = _steps(dataset, output)
    x = there[along].to_numpy()
    values = there["derivative_per_std"].transpose("parameter", "output").to_numpy()
    order = np.argsort(-np.abs(values).max(axis=1))
    for rank, i in enumerate(order[:NAMED]):
        name = text_of(str(dataset["parameter"].to_numpy()[i]))
        ax.plot(x, values[i], color=f"C{rank}", marker="o", ms=4, label=name)
    ax.axhline(0, color=DARK, linewidth=0.8)
    ax.set_xlabel(_labelled(along, unit))
    ax.set_ylabel(f"change of {_labelled(output, str(there['unit'].to_numpy()[0]))}")
    ax.legend(title="by one standard deviation of", frameon=False, fontsize="small")
    return ax


def _steps(dataset: xr.Dataset, output: str) -> xr.Dataset:
    """Return the results of an output at every step, in their order."""
    here = dataset.isel(output=np.flatnonzero(dataset["output_of"].to_numpy() == output))
    return here.sortby("step")


def _labelled(name: str, unit: str) -> str:
    return text_of(name) + ("" if unit == "1" else f" ({unit})")
