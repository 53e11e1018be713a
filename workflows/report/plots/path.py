"""Curves of outputs over the steps of a path."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from uq.estimators.estimate import estimate_of, holds
from uq.estimators.moments import half_width
from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, PLAIN, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from inverse.data.curves import Steps

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
    if holds(there, "mean", "corrected"):
        ax.plot(
            x, estimate_of(there, "mean").corrected, color=HIGH, linestyle="--", label="mean, error of the mesh added"
        )
    _along(ax, along, unit)
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
    _by_parameter(ax, dataset, x, values, errors)
    _along(ax, along, unit)
    ax.set_ylabel(f"total Sobol' index of {text_of(output)}")
    ax.legend(frameon=False, fontsize="small")
    return ax


def slopes(dataset: xr.Dataset, output: str, along: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw what one standard deviation of each parameter does to an output, to first order, over a path."""
    ax = ax or axes()
    there = _steps(dataset, output)
    x = there[along].to_numpy()
    values = there["derivative_per_std"].transpose("parameter", "output").to_numpy()
    _by_parameter(ax, dataset, x, values, np.zeros_like(values))
    _along(ax, along, unit)
    ax.set_ylabel(f"change of {_labelled(output, str(there['unit'].to_numpy()[0]))}")
    ax.legend(title="by one standard deviation of", frameon=False, fontsize="small")
    return ax


def measured(one: xr.Dataset, output: str, steps: Steps, ax: Axes | None = None) -> Axes:
    """Draw a measured curve of a data set with the prediction of its most probable parameters."""
    ax = ax or axes()
    along, (unit, values) = next(iter(steps.numbers.items()))
    names = {f"{output}.{k}": value for k, value in enumerate(values, 1)}
    known = np.isfinite(one["measured"].to_numpy())
    parts = [
        str(one.case.values[int(part)]) if ok else "" for part, ok in zip(one["datum_case"].values, known, strict=True)
    ]
    here = one.isel(datum=[k for k, part in enumerate(parts) if part in names])
    x = np.array([names[part] for part in parts if part in names])
    order = np.argsort(x, kind="stable")
    mean, reach = (here[name].to_numpy()[order] for name in ("predicted", "predicted_std"))
    ax.fill_between(x[order], mean - 1.96 * reach, mean + 1.96 * reach, color=CONTROLLED, alpha=0.22, linewidth=0)
    ax.plot(x[order], mean, color=CONTROLLED, label="predicted, 95 % band of the parameters")
    error = 1.96 * here["sigma"].to_numpy()
    label = "measured, 95 % of its errors"
    ax.errorbar(x, here["measured"].to_numpy(), error, color=DARK, fmt="o", ms=4, capsize=3, label=label)
    _along(ax, along, unit)
    ax.set_ylabel(_labelled(output, steps.units[output]))
    ax.legend(frameon=False, fontsize="small")
    return ax


def _by_parameter(ax: Axes, dataset: xr.Dataset, x: FloatArray, values: FloatArray, errors: FloatArray) -> None:
    """Draw values (d, steps) of each parameter with their errors: the largest in colours, with names."""
    order = np.argsort(-np.abs(values).max(axis=1))
    for rank, i in enumerate(order):
        if rank < NAMED:
            name = text_of(str(dataset["parameter"].to_numpy()[i]))
            error = errors[i] if errors[i].any() else None
            ax.errorbar(x, values[i], error, color=f"C{rank}", marker="o", ms=4, capsize=3, label=name)
        else:
            ax.plot(x, values[i], color=PLAIN, linewidth=0.8)
    ax.axhline(0, color=DARK, linewidth=0.8)


def _steps(dataset: xr.Dataset, output: str) -> xr.Dataset:
    """Return the results of an output at every step, in their order."""
    here = dataset.isel(output=np.flatnonzero(dataset["output_of"].to_numpy() == output))
    return here.sortby("step")


def _along(ax: Axes, path: str, unit: str) -> None:
    """Label the axis of the number that has steps."""
    ax.locator_params(axis="x", nbins=5)
    ax.set_xlabel(_labelled(path, unit))


def _labelled(name: str, unit: str) -> str:
    return text_of(name) + ("" if unit == "1" else f" ({unit})")
