"""Levels of the solver, of meshes, and meshes that are refined."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uq.estimators.estimate import estimate_of
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, PLAIN, axes, quantity, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


def levels(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the residuals of the samples and the change of the moments, level by level."""
    ax = ax or axes()
    places = dataset["level"].to_numpy()
    for name, label, colour, dash in (
        ("level_residual", "largest residual", CONTROLLED, "-"),
        ("level_residual_median", "median residual", CONTROLLED, ":"),
        ("level_change", "change of the moments", HIGH, "-"),
    ):
        values = dataset[name].to_numpy()
        ax.plot(places, np.where(values > 0, values, np.nan), dash, color=colour, marker="o", markersize=4, label=label)
    if bool((dataset["level_residual"] > 0).any() | (dataset["level_change"] > 0).any()):
        ax.set_yscale("log")
    ax.set_xticks(places)
    ax.set_xlabel("level")
    ax.set_ylabel("relative residual, relative change")
    ax.legend()
    return ax


def mesh_variance(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw log₂ of the variances of an output and of its differences between meshes, plain and controlled."""
    found = _levels(dataset, output)
    ax = _level_axis(dataset, ax)
    levels = dataset["level"].to_numpy()
    _log2(ax, levels, found["mesh_variance"], DARK, "output")
    _log2(ax, levels[1:], found["difference_variance"][1:], PLAIN, "difference")
    controlled = found["difference_variance"] / found["difference_variance_ratio"]
    if (controlled != found["difference_variance"]).any():
        _log2(ax, levels, found["mesh_variance"] / found["mesh_variance_ratio"], HIGH, "output, controlled")
        _log2(ax, levels[1:], controlled[1:], CONTROLLED, "difference, controlled")
    ax.set_ylabel(f"log₂ variance of {text_of(output)}")
    ax.legend()
    return ax


def mesh_mean(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw log₂ of the means of an output and of its differences between meshes."""
    found = _levels(dataset, output)
    ax = _level_axis(dataset, ax)
    levels = dataset["level"].to_numpy()
    _log2(ax, levels, found["mesh_mean"], DARK, "output")
    _log2(ax, levels[1:], found["difference_mean"][1:], CONTROLLED, "difference")
    _log2(ax, levels[1:], np.diff(found["mesh_nominal"]), HIGH, "difference at the mean parameters", linestyle="--")
    ax.set_ylabel(f"log₂ |mean of {text_of(output)}|")
    ax.legend()
    return ax


def mesh_samples(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the samples on every mesh, and the optimal numbers for other relative errors of sampling."""
    from uq.methods.multilevel import optimal

    ax = _level_axis(dataset, ax)
    levels, (variances, costs) = dataset["level"].to_numpy(), _sampling(dataset, output)
    error = float(dataset["mean_error"].sel(output=output))
    for i, target in enumerate([] if error == 0 else [4 * error, 2 * error, error, error / 2]):
        numbers = np.maximum(optimal(variances, costs, target**2), 1)
        relative = target / abs(float(dataset["mean"].sel(output=output)))
        ax.plot(levels, numbers, color=CONTROLLED, alpha=0.3 + 0.2 * i, marker=".", label=f"error {relative:.2g}, best")
    ax.plot(levels, dataset["mesh_samples"].to_numpy(), color=DARK, marker="o", linestyle="", label="taken")
    ax.set_yscale("log")
    ax.set_ylabel("samples")
    ax.legend()
    return ax


def mesh_cost(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the predicted time of sampling against the error of the mean, over all meshes and on the finest only."""
    ax = ax or axes()
    found, (variances, costs) = _levels(dataset, output), _sampling(dataset, output)
    finest = float(dataset["mesh_cost"][-1])
    plain, ratio = found["difference_variance"], found["difference_variance_ratio"]
    works = {"all meshes": (CONTROLLED, "-", np.sqrt(variances * costs).sum() ** 2)}
    single = found["mesh_variance"][-1] * finest
    if (ratio != 1).any():
        works["all meshes, no control"] = (CONTROLLED, "--", np.sqrt(plain * costs).sum() ** 2)
        works["finest mesh"] = (HIGH, "-", single / found["mesh_variance_ratio"][-1])
    works["finest mesh, no control"] = (HIGH, "--", single)
    error = float(dataset["mean_error"].sel(output=output)) or np.sqrt(np.finfo(float).tiny)
    errors = error * np.array([0.25, 4.0])
    for label, (colour, style, work) in works.items():
        ax.plot(errors, work / errors**2, color=colour, linestyle=style, label=label)
    taken = float(dataset["mesh_samples"].to_numpy() @ costs)
    ax.plot([error], [taken], color=DARK, marker="o", linestyle="", label="taken")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(f"standard error of {quantity(dataset, output)}")
    ax.set_ylabel("predicted time (s)")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, fontsize="small")
    return ax


def _levels(dataset: xr.Dataset, output: str) -> dict[str, NDArray[np.float64]]:
    """Return the results for an output on every mesh."""
    return {str(n): v.sel(output=output).to_numpy() for n, v in dataset.items() if v.dims == ("level", "output")}


def _sampling(dataset: xr.Dataset, output: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return variance and predicted time (s) of one sample on every mesh."""
    found, each = _levels(dataset, output), dataset["mesh_cost"].to_numpy()
    return found["difference_variance"] / found["difference_variance_ratio"], each + np.append(0.0, each[:-1])


def _level_axis(dataset: xr.Dataset, ax: Axes | None) -> Axes:
    ax = ax or axes()
    ax.set_xticks(dataset["level"].to_numpy())
    ax.set_xlabel("level (0 is the coarsest mesh)")
    return ax


def _log2(
    ax: Axes,
    levels: NDArray[np.int64],
    values: NDArray[np.float64],
    colour: str,
    label: str,
    linestyle: str = "-",
) -> None:
    some = values != 0
    ax.plot(levels[some], np.log2(np.abs(values[some])), color=colour, marker="o", linestyle=linestyle, label=label)


def refinement(dataset: xr.Dataset, outputs: Sequence[str], tolerance: float, ax: Axes | None = None) -> Axes:
    """Draw the estimated relative errors of outputs against the unknowns of the meshes, and the tolerance."""
    ax = ax or axes()
    unknowns = dataset["cycle_unknowns"].to_numpy()
    for output, colour in zip(outputs, cycle(COLOURS), strict=False):
        found = dataset.sel(output=output)
        at = estimate_of(found, "cycle_value")
        error, size = at.mesh, np.abs(at.value + at.mesh)
        relative = np.divide(np.abs(error), size, out=np.full(len(size), np.nan), where=size > 0)
        ax.plot(
            unknowns, np.where(relative > 0, relative, np.nan), "o-", color=colour, markersize=4, label=text_of(output)
        )
    ax.axhline(tolerance, color=PLAIN, linestyle=":", label="tolerance")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("unknowns")
    ax.set_ylabel("estimated relative error of the mesh")
    ax.legend()
    return ax
