"""Errors by their source, over meshes and levels, and against cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.readable import number
from uq.estimators.estimate import estimate_of
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, PLAIN, axes, finished, rows, text_of
from workflows.report.plots.outputs import WORDS, Estimated, quantity

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


PART_COLOURS = {"sampling": CONTROLLED, "mesh": HIGH, "solver": PLAIN, "total": DARK}
SHOWN = 12  # outputs that have bars
SPAN = 1e-5  # of the largest error: smaller ones have a number, but no bar, so that the others can be distinguished
Cost = Literal["solves", "cpu_seconds"]
METHOD_COLOURS = ("#8a97a6", "#0b6bb8", "#d1622b", "#2a8c4a", "#8a4fbf", "#c23b6b", "#b08900", "#1d9aa8", "#5b4636")


def error_budget(names: list[str], parts: Mapping[str, FloatArray], of: str, ax: Axes | None = None) -> Axes:
    """Draw the errors of an estimate (`of`, in words) of outputs by source (`PART_COLOURS`), relative to the estimate.

    NaN where they are not estimated.
    """
    from matplotlib.ticker import LogLocator, NullLocator

    names, parts = names[:SHOWN], {name: np.asarray(values)[:SHOWN] for name, values in parts.items()}
    ax = ax or axes(height=1.5 + (0.2 * len(parts) + 0.15) * len(names))
    places = rows(ax, names)
    height = 0.8 / len(parts)
    positive = [float(v) for values in parts.values() for v in values if np.isfinite(v) and v > 0]
    largest = max(positive, default=1.0)
    floor = max(min(positive, default=1.0), SPAN * largest)
    left = floor / 3
    beside: dict[str, Any] = {"xytext": (3, 0), "textcoords": "offset points", "va": "center", "fontsize": 8}
    for row, (name, values) in enumerate(parts.items()):
        at = places + 0.4 - (row + 0.5) * height
        drawn = np.where(values >= floor, values, left)
        ax.barh(at, drawn - left, left=left, height=0.9 * height, color=PART_COLOURS[name], label=name)
        for y, value, end in zip(at, values, drawn, strict=True):
            text = f"{number(100 * value, 2)} %" if np.isfinite(value) else "not estimated"
            text, colour = (text, DARK) if end > left else (f"{name} {text}", PART_COLOURS[name])
            ax.annotate(text, (end, y), color=colour, **beside)
    ax.set_xscale("log")
    ax.set_xlim(left, 8 * largest)
    ax.xaxis.set_major_locator(LogLocator(numticks=5))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(lambda x, _: f"{number(100 * x, 1)} %")
    return finished(ax, f"error of the {of}, relative to it", above=len(parts))


def mesh_variance(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw log₂ of the variances of an output and of its differences between meshes, plain and controlled."""
    found, levels, ax = _levels(dataset, output), dataset["level"].to_numpy(), _level_axis(dataset, ax)
    _log2(ax, levels, found["mesh_variance"], DARK, "output")
    _log2(ax, levels[1:], found["difference_variance"][1:], PLAIN, "difference")
    controlled = found["difference_variance"] / found["difference_variance_ratio"]
    if (controlled != found["difference_variance"]).any():
        _log2(ax, levels, found["mesh_variance"] / found["mesh_variance_ratio"], HIGH, "output, controlled")
        _log2(ax, levels[1:], controlled[1:], CONTROLLED, "difference, controlled")
    return finished(ax, y=f"log₂ variance of {text_of(output)}")


def mesh_mean(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw log₂ of the means of an output and of its differences between meshes."""
    found, levels, ax = _levels(dataset, output), dataset["level"].to_numpy(), _level_axis(dataset, ax)
    _log2(ax, levels, found["mesh_mean"], DARK, "output")
    _log2(ax, levels[1:], found["difference_mean"][1:], CONTROLLED, "difference")
    _log2(ax, levels[1:], np.diff(found["mesh_nominal"]), HIGH, "difference at the mean parameters", linestyle="--")
    return finished(ax, y=f"log₂ |mean of {text_of(output)}|")


def mesh_samples(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the samples on every mesh, and the optimal numbers for other relative errors of sampling."""
    ax, of = _level_axis(dataset, ax), dataset.sel(output=output)
    levels, (variances, costs) = dataset["level"].to_numpy(), _sampling(dataset, output)
    best = np.sqrt(variances / costs) * np.sqrt(variances * costs).sum()  # for an error of one
    mean, error = abs(float(of["mean"])), float(of["mean_error"])
    for i, target in enumerate([] if error == 0 else [4 * error, 2 * error, error, error / 2]):
        look: dict[str, Any] = {"color": CONTROLLED, "alpha": 0.3 + 0.2 * i, "marker": "."}
        ax.plot(levels, np.maximum(best / target**2, 1), label=f"error {target / mean:.2g}, best", **look)
    ax.plot(levels, dataset["mesh_samples"].to_numpy(), color=DARK, marker="o", linestyle="", label="taken")
    return finished(ax, y="samples", log="y")


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
    return finished(ax, f"standard error of {quantity(dataset, output)}", "predicted time (s)", log="xy", above=2)


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
    return finished(ax, "level (0 is the coarsest mesh)")


def _log2(
    ax: Axes, levels: NDArray[np.int64], values: FloatArray, colour: str, label: str, linestyle: str = "-"
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
        error, size = np.abs(at.mesh), np.abs(at.value + at.mesh)
        relative = np.divide(error, size, out=np.full(len(size), np.nan), where=(size > 0) & (error > 0))
        ax.plot(unknowns, relative, "o-", color=colour, markersize=4, label=text_of(output))
    ax.axhline(tolerance, color=PLAIN, linestyle=":", label="tolerance")
    return finished(ax, "unknowns", "estimated relative error of the mesh", log="xy")


def errors(
    dataset: xr.Dataset, output: str, estimated: Estimated = "mean", against: Cost = "solves", ax: Axes | None = None
) -> Axes:
    """Draw the root mean square error of each method of a comparison against its cost, both logarithmic.

    Hollow markers are errors that the reference cannot resolve; dashed lines over the solves are the fitted rates. Over
    the processor time there is the plain method by the textbook solver too.
    """
    ax = ax or axes(height=4.2, width=8.6)
    of_output, timed = dataset.sel(output=output), against == "cpu_seconds"
    costs, derived, methods = (of_output[name].to_numpy() for name in (against, "derived", "row_method"))
    kinds = ("rmse", "resolved", "rmse_error")
    rmse, resolved, scatter = (of_output[f"{estimated}_{kind}"].to_numpy() for kind in kinds)
    names = [str(n) for n in of_output["estimator"].values if timed or not derived[methods == n].all()]
    for name, colour in zip(names, cycle(METHOD_COLOURS), strict=False):
        mine = (methods == name) & (rmse > 0)
        good = mine & resolved
        ax.errorbar(costs[mine], rmse[mine], yerr=scatter[mine], fmt="none", ecolor=colour, capsize=2)
        ax.plot(costs[mine], rmse[mine], color=colour, linewidth=0, marker="o", markerfacecolor="white")
        label = text_of(name)
        if timed:
            ax.plot(costs[mine], rmse[mine], color=colour, linewidth=1)
        elif good.sum() > 1:
            rate = float(of_output[f"{estimated}_rate"].sel(estimator=name))
            logarithms = np.log(costs[good])
            fitted = np.exp(np.log(rmse[good]).mean() + rate * (logarithms - logarithms.mean()))
            ax.plot(costs[good], fitted, color=colour, linestyle="--", linewidth=1)
            label += f" (rate {rate:.2f})".replace("-", "−")
        ax.plot(costs[good], rmse[good], color=colour, linewidth=0, marker="o", label=label)
    shown = costs[np.isin(methods, names)]
    ends = np.array([shown.min() / 1.3, shown.max() * 1.3])
    each = float(of_output["plain_seconds"]) if timed else 1.0
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
    cost = "processor time (s)" if timed else "solves"
    rmse_of = f"RMSE of the {WORDS[estimated]} of {quantity(dataset, output)}"
    finished(ax, f"{cost}, set-up charged", rmse_of, log="xy", loc="upper left", bbox_to_anchor=(1.02, 1))
    ax.set(xlim=ends, ylim=(lowest, None))
    return ax


def estimates(found: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the estimated against the true errors of each output at unseen samples, over their root mean square."""
    ax = ax or axes(height=3.6)
    ends = [np.inf, 0.0]
    for colour, name in zip(COLOURS, found["output"].values, strict=False):
        of = found.sel(output=name)
        error, estimate = (np.abs(of[f"reduced_{what}"].to_numpy()) for what in ("error", "estimate"))
        good = (error > 0) & (estimate > 0)
        if not good.any():
            continue
        scale = np.sqrt((error[good] ** 2).mean())
        x, y = error[good] / scale, estimate[good] / scale
        ends = [min(ends[0], x.min(), y.min()), max(ends[1], x.max(), y.max())]
        ax.plot(x, y, ".", color=colour, markersize=4, alpha=0.7, label=text_of(str(name)))
    some = ends[0] < ends[1]
    if some:
        ax.plot(ends, ends, color=DARK, linewidth=0.8)
    log = "xy" if some else ""
    return finished(ax, "true error over its root mean square", "estimated error over the same", log=log)


def energies(found: xr.Dataset, kept: int, ax: Axes | None = None) -> Axes:
    """Draw what each number of modes leaves of the snapshots, relative, and how many were kept."""
    ax = ax or axes(height=3.6)
    energy = found["mode_energy"].to_numpy()
    left = np.sqrt(np.maximum(energy[::-1].cumsum()[::-1], 1e-300) / energy.sum())
    ax.plot(np.arange(len(left)), left, color=CONTROLLED)
    ax.axvline(kept, color=HIGH, linestyle="--", linewidth=1, label=f"{kept} kept")
    return finished(ax, "modes", "part that is left out", log="y")
