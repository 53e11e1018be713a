"""Effects of parameters on outputs: derivatives, Sobol' indices, active subspaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from uq.estimators.moments import half_width
from workflows.report.plots.figure import (
    CONTROLLED,
    DARK,
    HIGH,
    LOW,
    axes,
    count_axis,
    finished,
    quantity,
    rows,
    stacked,
    text_of,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


BARS = 15  # parameters that a tornado chart shows
PALE = "#c4cbd2"  # of what no parameter has alone
SHARES = 8  # parameters that have a colour of their own in stacked bars


def tornado(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw how much an output changes, to first order, with each parameter one standard deviation from its mean."""
    effects = dataset["derivative_per_std"].sel(output=output).to_numpy()
    order = np.argsort(-np.abs(effects))[:BARS]
    ax = ax or axes(height=1.3 + 0.42 * len(order))
    places = rows(ax, dataset["parameter"].to_numpy()[order].tolist())
    for sign, colour, label in ((-1, LOW, "one standard deviation below its mean"), (1, HIGH, "above")):
        ax.barh(places, sign * effects[order], height=0.6, color=colour, label=label)
    ax.axvline(0, color=DARK, linewidth=0.8)
    ax.locator_params(axis="x", nbins=6)
    return finished(ax, f"change of {quantity(dataset, output)}", above=2)


def index_bars(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the Sobol' indices of an output with 95 % confidence intervals, the parameter with the largest on top."""
    totals = dataset["sobol_total"].sel(output=output).to_numpy()
    order = np.argsort(-totals)[:BARS]
    ax = ax or axes(height=1.3 + 0.5 * len(order))
    places = rows(ax, dataset["parameter"].to_numpy()[order].tolist())
    for which, colour, side in (("first", CONTROLLED, 0.19), ("total", HIGH, -0.19)):
        values, errors = (dataset[f"sobol_{which}{end}"].sel(output=output).to_numpy()[order] for end in ("", "_error"))
        label = "first order" if which == "first" else "total"
        reach = half_width(dataset) * errors
        ax.barh(places + side, values, xerr=reach, height=0.36, color=colour, ecolor=DARK, capsize=2, label=label)
    if "total_bound" in dataset:
        limits = dataset["total_bound"].sel(output=output).to_numpy()[order]
        ax.plot(limits, places, "|", color=DARK, markersize=16, label="bound from derivatives")
    ax.axvline(0, color=DARK, linewidth=0.8)
    return finished(ax, f"Sobol' index of {text_of(output)}, 95 % interval", above=3)


def index_shares(dataset: xr.Dataset, outputs: Sequence[str] | None = None, ax: Axes | None = None) -> Axes:
    """Draw the first-order shares of parameters in the variance of outputs (all) and of the field, as stacked bars."""
    names = [str(name) for name in dataset["output"].to_numpy()] if outputs is None else list(outputs)
    first = dataset["sobol_first"].sel(output=names).transpose("output", "parameter").to_numpy()
    if "field_sobol_first" in dataset:
        first = np.vstack([first, dataset["field_sobol_first"].to_numpy()])
        names.append("displacement field")
    order = np.argsort(-first.mean(axis=0))
    ax = ax or axes(height=1.7 + 0.42 * len(names))
    own = {text_of(str(dataset["parameter"].values[i])): np.clip(first[:, i], 0, 1) for i in order[:SHARES]}
    rest = np.clip(1 - sum(own.values(), np.zeros(len(names))), 0, None)
    colours = [*(f"C{rank}" for rank in range(len(own))), PALE]
    stacked(ax, names, own | {"interactions and the rest": rest}, colours)
    return finished(ax, "share of the variance", above=2)


def index_convergence(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the total Sobol' indices of an output against the number of samples, with 95 % confidence bands."""
    ax = ax or axes()
    counts = dataset["index_round"].to_numpy()
    totals = dataset["sobol_total"].sel(output=output).to_numpy()
    for rank, i in enumerate(np.argsort(-totals)[:SHARES]):
        of_parameter = dataset.isel(parameter=int(i)).sel(output=output)
        colour = f"C{rank}"
        name = text_of(str(of_parameter["parameter"].item()))
        for which, style in (("first", "--"), ("total", "-")):
            mean, error = (of_parameter[f"running_sobol_{which}{end}"].to_numpy() for end in ("", "_error"))
            half = half_width(dataset) * error
            ax.fill_between(counts, mean - half, mean + half, color=colour, alpha=0.12, linewidth=0)
            ax.plot(counts, mean, style, color=colour, label=name if which == "total" else None)
    ax.set_ylim(-0.1, 1.1)
    count_axis(ax, int(counts[0]), int(counts[-1]))
    return finished(ax, y=f"indices of {text_of(output)}", title="total; dashed: first order")


def active_summary(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw an output against the leading direction of its active subspace, sample by sample."""
    ax = ax or axes()
    ok = dataset["ok"].to_numpy()
    steps = (dataset["points"] - dataset["parameter_mean"]) / dataset["parameter_std"]
    direction = dataset["active_direction"].sel(output=output).to_numpy()
    along = steps.transpose("sample", "parameter").to_numpy()[ok] @ direction
    ax.scatter(
        along, dataset["values"].sel(output=output).to_numpy()[ok], s=9, color=CONTROLLED, alpha=0.6, linewidth=0
    )
    return finished(ax, "leading direction (standard deviations)", quantity(dataset, output))


def spectrum(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the eigenvalues of the active subspace of an output with their 95 % ranges."""
    ax = ax or axes()
    of_output = dataset.sel(output=output)
    values, lower, upper = (of_output[f"active_eigenvalue{end}"].to_numpy() for end in ("", "_lower", "_upper"))
    reach = np.abs([np.minimum(lower - values, 0), np.maximum(upper - values, 0)])
    places = np.arange(1, len(values) + 1)
    ax.errorbar(places, values, yerr=reach, fmt="o", color=CONTROLLED, ecolor=DARK, capsize=4)
    if (values > 0).any():
        ax.set_yscale("log")
    ax.locator_params(axis="x", integer=True)
    return finished(ax, "number", f"eigenvalue for {text_of(output)}")
