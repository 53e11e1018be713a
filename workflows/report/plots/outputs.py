"""Outputs: densities and moments, over samples and the steps of a path; and what their parameters do to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.readable import named
from uq.estimators.estimate import estimate_of, holds, single
from uq.estimators.moments import Coefficient, Moments, estimate, estimate_from_samples, half_width, monomials
from uq.estimators.tails import skewed
from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, PLAIN, axes, finished, rows, stacked, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from inverse.data.outputs import Steps


Estimated = Literal["mean", "std"]
WORDS: dict[Estimated, str] = {"mean": "mean", "std": "standard deviation"}
FIRST_SHOWN = 8  # estimates from fewer samples are meaningless
MOST_BINS = 200
WIDEST = 40  # characters of a name beside a plot
NAMED = 8  # parameters that have a colour of their own
BARS = 15  # parameters that a tornado chart shows
PALE = "#c4cbd2"  # of what no parameter has alone
SHARES = 8  # parameters that have a colour of their own in stacked bars


def quantity(dataset: xr.Dataset, output: str) -> str:
    """Name and unit of an output."""
    return named(text_of(output), str(dataset["unit"].sel(output=output).item()))


def banded(
    ax: Axes, x: Any, middle: FloatArray, reach: FloatArray, colour: str, label: str, faint: float = 0.22, **line: Any
) -> None:
    """Draw a line with a band around it that reaches as far to both sides."""
    ax.fill_between(x, middle - reach, middle + reach, color=colour, alpha=faint, linewidth=0)
    ax.plot(x, middle, color=colour, label=label, **line)


def count_axis(ax: Axes, counts: NDArray[np.int64]) -> None:
    """Make the x axis one of numbers of samples, logarithmic."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    first, n = int(counts[0]), int(counts[-1])
    ax.set_xscale("log")
    ax.set_xlim(first, max(n, first + 1))
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if n < 3000 else (1,)))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlabel("samples")


def running_estimates(
    dataset: xr.Dataset, output: str, counts: Sequence[int], *, controlled: bool = False
) -> list[Moments]:
    """Estimate the moments of an output from the first samples that have an answer, for several numbers (≥ 2) of them.

    `controlled` with the tangent at the mean parameters as control variate: for the mean; do not use the standard
    deviation then. The skewness of the samples counts in the error of a mean, as in the study.
    """
    ok = dataset["ok"].to_numpy()
    nominal = np.asarray(dataset["nominal"].sel(output=output).to_numpy())
    deviations = dataset["values"].sel(output=output).to_numpy()[ok] - nominal
    if controlled:
        steps = (dataset["points"] - dataset["parameter_mean"]).transpose("sample", "parameter").to_numpy()[ok]
        controls = steps @ dataset["derivative"].sel(output=output).to_numpy()
        coefficient: Coefficient = "one" if bool((dataset["coefficient"] == 1).all()) else "optimal"
        unused = np.zeros_like(nominal)  # the variance of the control, on which the mean does not depend
        found = [estimate_from_samples(deviations[:n], controls[:n], nominal, unused, coefficient) for n in counts]
        left = [deviations[:n] - one.coefficient * controls[:n] for one, n in zip(found, counts, strict=True)]
    else:
        sums = monomials(deviations, None).cumsum(axis=1)
        found = [estimate(sums[:, n - 1], n, nominal) for n in counts]
        left = [deviations[:n] for n in counts]
    return [replace(one, mean_error=one.mean_error * skewed(first)) for one, first in zip(found, left, strict=True)]


def convergence(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the running mean of an output with its 95 % confidence band, plain and controlled."""
    ax = ax or axes()
    if "running_mean" in dataset:
        counts = dataset["round"].to_numpy()
        mean, error = (dataset[f"running_{name}"].sel(output=output).to_numpy() for name in ("mean", "mean_error"))
        series = [("scrambled Sobol' points", CONTROLLED, mean, error)]
    else:
        n = int(dataset["ok"].sum())
        counts = np.unique(np.geomspace(max(2, min(FIRST_SHOWN, n // 2)), n, 160).round().astype(np.int64))
        kinds = {"plain": PLAIN} | ({"with sensitivity derivatives": CONTROLLED} if "variance_ratio" in dataset else {})
        series = []
        for label, colour in kinds.items():
            running = running_estimates(dataset, output, counts.tolist(), controlled=label != "plain")
            series.append((label, colour, *np.array([(one.mean, one.mean_error) for one in running]).T))
    for label, colour, mean, error in series:
        banded(ax, counts, mean, half_width(dataset) * error, colour, label)
    count_axis(ax, counts)
    return finished(ax, y=f"running mean of {quantity(dataset, output)}", title="mean, 95 % band")


def histogram(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the density of an output, from its expansion or its samples, with its mean and quantiles."""
    ax, one = ax or axes(), dataset.sel(output=output)
    if "density" in dataset:
        density, edges = one["density"].to_numpy(), estimate_of(one, "density_edge")
        ax.stairs(density, edges.value, fill=True, color=CONTROLLED, alpha=0.4)
        # Without the error of the mesh: as much of it between ends that have moved.
        widths = np.diff(edges.corrected)
        if np.isfinite(edges.corrected).all() and (widths > 0).all():
            moved = density * np.diff(edges.value) / widths
            ax.stairs(moved, edges.corrected, color=DARK, linewidth=1, label="corrected for the mesh")
    else:
        values, bins = one["values"].to_numpy()[dataset["ok"].to_numpy()], 1
        whole, width = np.ptp(values), 2 * np.subtract(*np.percentile(values, [75, 25])) / len(values) ** (1 / 3)
        if whole > 1e-12 * np.abs(values).max():  # as of NumPy's "auto", but no more: one outlier makes millions
            bins = int(np.ceil(min(max(np.log2(len(values)) + 1, whole / width if width > 0 else 0), MOST_BINS)))
        ax.hist(values, bins=bins, density=True, color=CONTROLLED, alpha=0.4, edgecolor="white")
    mean = single(one, "mean")
    ax.axvline(mean.value, color=DARK, label="mean")
    if np.isfinite(mean.corrected):
        ax.axvline(mean.corrected, color=DARK, linestyle=":", label="corrected mean")
    above: dict[str, Any] = {"xytext": (0, 3), "textcoords": "offset points", "ha": "center", "fontsize": "small"}
    for i, (probability, place) in enumerate(zip(one["quantile"].values, one["quantiles"].values, strict=True)):
        ax.axvline(place, color=HIGH, linestyle="--", linewidth=1, label=None if i else "quantiles")
        ax.annotate(f"{100 * probability:g} %", (place, 1), xycoords=ax.get_xaxis_transform(), color=HIGH, **above)
    unit, place = str(one["unit"].item()), {"loc": "lower center", "bbox_to_anchor": (0.5, 1.06), "ncols": 4}
    return finished(ax, quantity(dataset, output), named("density", unit if unit == "1" else f"1/{unit}"), **place)


def comparison(
    datasets: Mapping[str, xr.Dataset], output: str, estimated: Estimated = "mean", ax: Axes | None = None
) -> Axes:
    """Draw an estimate of an output by those studies that have it, with 95 % confidence intervals."""
    shown = {name: d.sel(output=output) for name, d in datasets.items() if "mean" in d and output in d.output.values}
    ax = ax or axes(height=1.2 + 0.42 * len(shown))
    short = [name if len(name) <= WIDEST else f"…{name[1 - WIDEST :]}" for name in shown]  # a long path leaves no room
    places = rows(ax, short)
    values = [float(d[estimated]) for d in shown.values()]
    errors = [half_width(d) * float(d[f"{estimated}_error"]) for d in shown.values()]
    ax.errorbar(values, places, xerr=errors, fmt="o", color=CONTROLLED, ecolor=DARK, capsize=4)
    ax.locator_params(axis="x", nbins=6)
    quantities = {quantity(datasets[name], output) for name in shown}
    return finished(ax, f"{WORDS[estimated]} of {' or '.join(sorted(quantities)) or output}, 95 % interval")


def over_path(dataset: xr.Dataset, output: str, along: str, unit: str, ax: Axes | None = None) -> Axes:
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
        corrected = estimate_of(there, "mean").corrected
        ax.plot(x, corrected, color=HIGH, linestyle="--", label="mean, error of the mesh added")
    return _along(ax, along, unit, named(text_of(output), str(there["unit"].to_numpy()[0])))


def effects_over_path(dataset: xr.Dataset, output: str, along: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw over a path what parameters do to an output: the largest in colours, with names.

    Total Sobol' indices with their 95 % intervals, or what one standard deviation of each does to first order.
    """
    ax = ax or axes()
    there = _steps(dataset, output)
    shares, x = "sobol_total" in dataset, there[along].to_numpy()
    there = there.transpose("parameter", "output", ...)
    values = there["sobol_total" if shares else "derivative_per_std"].to_numpy()
    errors = half_width(dataset) * there["sobol_total_error"].to_numpy() if shares else np.zeros_like(values)
    for rank, i in enumerate(np.argsort(-np.abs(values).max(axis=1))):
        if rank < NAMED:
            name = text_of(str(dataset["parameter"].to_numpy()[i]))
            error = errors[i] if errors[i].any() else None
            ax.errorbar(x, values[i], error, color=f"C{rank}", marker="o", ms=4, capsize=3, label=name)
        else:
            ax.plot(x, values[i], color=PLAIN, linewidth=0.8)
    ax.axhline(0, color=DARK, linewidth=0.8)
    if shares:
        return _along(ax, along, unit, f"total Sobol' index of {text_of(output)}")
    changed = named(text_of(output), str(there["unit"].values[0]))
    return _along(ax, along, unit, f"change of {changed}", title="by one standard deviation of")


def measured_over_path(one: xr.Dataset, output: str, steps: Steps, ax: Axes | None = None) -> Axes:
    """Draw a measured curve of a data set with the prediction of its most probable parameters."""
    ax = ax or axes()
    along, (unit, values) = next(iter(steps.numbers.items()))
    names = {f"{output}.{k}": value for k, value in enumerate(values, 1)}
    known = np.flatnonzero(np.isfinite(one["measured"].to_numpy())).tolist()
    at = {k: names.get(str(one.case.values[int(one["datum_case"][k])])) for k in known}
    here = one.isel(datum=[k for k, place in at.items() if place is not None])
    x = np.array([place for place in at.values() if place is not None])
    order = np.argsort(x, kind="stable")
    mean, reach = (here[name].to_numpy()[order] for name in ("predicted", "predicted_std"))
    banded(ax, x[order], mean, 1.96 * reach, CONTROLLED, "predicted, 95 % band of the parameters")
    error = 1.96 * here["sigma"].to_numpy()
    label = "measured, 95 % of its errors"
    ax.errorbar(x, here["measured"].to_numpy(), error, color=DARK, fmt="o", ms=4, capsize=3, label=label)
    return _along(ax, along, unit, named(text_of(output), steps.units[output]))


def _steps(dataset: xr.Dataset, output: str) -> xr.Dataset:
    """Return the results of an output at every step, in their order."""
    return dataset.isel(output=np.flatnonzero(dataset["output_of"].to_numpy() == output)).sortby("step")


def _along(ax: Axes, path: str, unit: str, y: str, **legend: Any) -> Axes:
    """Label the axes, the first of which is the number that has steps."""
    ax.locator_params(axis="x", nbins=5)
    return finished(ax, named(text_of(path), unit), y, **legend)


def tornado(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw how much an output changes, to first order, with each parameter one standard deviation from its mean."""
    effects = dataset["derivative_per_std"].sel(output=output).to_numpy()
    order = np.argsort(-np.abs(effects))[:BARS]
    ax = ax or axes(height=1.3 + 0.42 * len(order))
    places = rows(ax, dataset["parameter"].to_numpy()[order].tolist())
    for sign, colour, label in ((-1, CONTROLLED, "one standard deviation below its mean"), (1, HIGH, "above")):
        ax.barh(places, sign * effects[order], height=0.6, color=colour, label=label)
    ax.axvline(0, color=DARK, linewidth=0.8)
    ax.locator_params(axis="x", nbins=6)
    return finished(ax, f"change of {quantity(dataset, output)}", above=2)


def index_bars(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the Sobol' indices of an output with 95 % confidence intervals, the parameter with the largest on top."""
    of, scale = dataset.sel(output=output), half_width(dataset)
    of = of.isel(parameter=np.argsort(-of["sobol_total"].to_numpy())[:BARS])
    ax = ax or axes(height=1.3 + 0.5 * of.sizes["parameter"])
    places = rows(ax, of["parameter"].values.tolist())
    look: dict[str, Any] = {"height": 0.36, "ecolor": DARK, "capsize": 2}
    for which, label, colour, side in (("first", "first order", CONTROLLED, 0.19), ("total", "total", HIGH, -0.19)):
        values, errors = (of[f"sobol_{which}{end}"].to_numpy() for end in ("", "_error"))
        ax.barh(places + side, values, xerr=scale * errors, color=colour, label=label, **look)
    if "total_bound" in dataset:
        ax.plot(of["total_bound"], places, "|", color=DARK, markersize=16, label="bound from derivatives")
    ax.axvline(0, color=DARK, linewidth=0.8)
    return finished(ax, f"Sobol' index of {text_of(output)}, 95 % interval", above=3)


def index_shares(dataset: xr.Dataset, outputs: Sequence[str] | None = None, ax: Axes | None = None) -> Axes:
    """Draw the first-order shares of parameters in the variance of outputs (all) and of the field, as stacked bars."""
    names = [str(name) for name in dataset["output"].to_numpy()] if outputs is None else list(outputs)
    first = dataset["sobol_first"].sel(output=names).transpose("output", "parameter").to_numpy()
    if "field_sobol_first" in dataset:
        first = np.vstack([first, dataset["field_sobol_first"].to_numpy()])
        names.append("displacement field")
    ax, order = ax or axes(height=1.7 + 0.42 * len(names)), np.argsort(-first.mean(axis=0))[:SHARES]
    own = {text_of(str(dataset["parameter"].values[i])): np.clip(first[:, i], 0, 1) for i in order}
    rest = np.clip(1 - sum(own.values(), np.zeros(len(names))), 0, None)
    colours = [*(f"C{rank}" for rank in range(len(own))), PALE]
    stacked(ax, names, own | {"interactions and the rest": rest}, colours)
    return finished(ax, "share of the variance", above=2)


def index_convergence(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the total Sobol' indices of an output against the number of samples, with 95 % confidence bands."""
    ax = ax or axes()
    counts, of = dataset["index_round"].to_numpy(), dataset.sel(output=output)
    for rank, i in enumerate(np.argsort(-of["sobol_total"].to_numpy())[:SHARES]):
        one = of.isel(parameter=int(i))
        for which, style, label in (("first", "--", ""), ("total", "-", text_of(str(one["parameter"].item())))):
            mean, error = (one[f"running_sobol_{which}{end}"].to_numpy() for end in ("", "_error"))
            banded(ax, counts, mean, half_width(dataset) * error, f"C{rank}", label, faint=0.12, linestyle=style)
    ax.set_ylim(-0.1, 1.1)
    count_axis(ax, counts)
    return finished(ax, y=f"indices of {text_of(output)}", title="total; dashed: first order")


def active_summary(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw an output against the leading direction of its active subspace, sample by sample."""
    ax, ok, of = ax or axes(), dataset["ok"].to_numpy(), dataset.sel(output=output)
    steps = (dataset["points"] - dataset["parameter_mean"]) / dataset["parameter_std"]
    along = steps.transpose("sample", "parameter").to_numpy()[ok] @ of["active_direction"].to_numpy()
    ax.scatter(along, of["values"].to_numpy()[ok], s=9, color=CONTROLLED, alpha=0.6, linewidth=0)
    return finished(ax, "leading direction (standard deviations)", quantity(dataset, output))
