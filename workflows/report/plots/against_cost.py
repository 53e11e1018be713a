"""Errors of methods against their cost."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from workflows.report.plots.figure import DARK, PLAIN, axes, quantity, text_of
from workflows.report.plots.moments import Estimated

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

Cost = Literal["solves", "cpu_seconds"]
METHOD_COLOURS = ("#8a97a6", "#0b6bb8", "#d1622b", "#2a8c4a", "#8a4fbf", "#c23b6b", "#b08900", "#1d9aa8", "#5b4636")


def errors(
    dataset: xr.Dataset,
    output: str,
    estimated: Estimated = "mean",
    against: Cost = "solves",
    ax: Axes | None = None,
) -> Axes:
    """Draw the root mean square error of each method of a comparison against its cost, both logarithmic.

    Hollow markers are errors that the reference cannot resolve; dashed lines over the solves are the fitted rates.

    Parameters
    ----------
    dataset
        Results of ``method.kind = "compare"``.
    output
        Name of the output.
    estimated
        The mean or the standard deviation.
    against
        The number of solves, or the processor time, with the plain method by the textbook solver too.
    ax
        Where to draw.
    """
    ax = ax or axes(height=4.2, width=8.6)
    of_output = dataset.sel(output=output)
    costs, rmse, rows = (of_output[name].to_numpy() for name in (against, f"{estimated}_rmse", "row_method"))
    resolved, scatter = (of_output[f"{estimated}_{name}"].to_numpy() for name in ("resolved", "rmse_error"))
    names = [
        name
        for name in of_output["estimator"].to_numpy().tolist()
        if against == "cpu_seconds" or not of_output["derived"].to_numpy()[rows == name].all()
    ]
    for i, name in enumerate(names):
        colour = METHOD_COLOURS[i % len(METHOD_COLOURS)]
        mine = (rows == name) & (rmse > 0)
        good = mine & resolved
        ax.errorbar(costs[mine], rmse[mine], yerr=scatter[mine], fmt="none", ecolor=colour, capsize=2)
        ax.plot(costs[mine], rmse[mine], color=colour, linewidth=0, marker="o", markerfacecolor="white")
        label = text_of(name)
        if against == "cpu_seconds":
            ax.plot(costs[mine], rmse[mine], color=colour, linewidth=1)
        elif good.sum() > 1:
            rate = float(of_output[f"{estimated}_rate"].sel(estimator=name))
            logarithms = np.log(costs[good])
            fitted = np.exp(np.log(rmse[good]).mean() + rate * (logarithms - logarithms.mean()))
            ax.plot(costs[good], fitted, color=colour, linestyle="--", linewidth=1)
            label += f" (rate {rate:.2f})".replace("-", "−")
        ax.plot(costs[good], rmse[good], color=colour, linewidth=0, marker="o", label=label)
    shown = costs[np.isin(rows, names)]
    ends = np.array([shown.min() / 1.3, shown.max() * 1.3])
    each = 1.0 if against == "solves" else float(of_output["plain_seconds"])
    if np.isfinite(each):
        line = float(of_output[f"{estimated}_single"]) * np.sqrt(each / ends)
        ax.plot(ends, line, color=DARK, linewidth=0.8, linestyle=":", label="plain Monte Carlo, exactly")
    reference = float(of_output[f"{estimated}_error"])
    lowest = min([*rmse[rmse > 0], *([reference] if reference > 0 else [])], default=1.0) / 3
    if reference > 0:
        ax.axhspan(lowest, reference, color=PLAIN, alpha=0.25, linewidth=0, label="error of the reference")
    floors = {"solver_error": "error of the solver", "mesh_error": "error of the mesh, of the mean"}
    for (floor, label), style in zip(floors.items(), ("-.", "-"), strict=True):
        size = abs(float(of_output[floor]))
        if size > lowest and (estimated == "mean" or floor == "solver_error"):
            ax.axhline(size, color=DARK, linewidth=1, linestyle=style, label=label)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(*ends)
    ax.set_ylim(bottom=lowest)
    ax.set_xlabel({"solves": "solves, set-up charged", "cpu_seconds": "processor time (s), set-up charged"}[against])
    word = {"mean": "mean", "std": "standard deviation"}[estimated]
    ax.set_ylabel(f"RMSE of the {word} of {quantity(dataset, output)}")
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1), frameon=False, fontsize="small")
    return ax
