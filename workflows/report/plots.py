"""Pictures of results: one function each, from the dataset of `read_dataset` to labelled axes.

Functions that take `ax` draw there, or on a new figure that needs no display: in a notebook,
``plots.histogram(dataset, "uy_max").figure``. Bodies are drawn by `workflows.report.bodies`.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from uq.estimators.moments import Coefficient, Moments, estimate, half_width, monomials

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

Estimated = Literal["mean", "std"]
Cost = Literal["solves", "cpu_seconds"]
FIRST_SHOWN = 8  # estimates from fewer samples say nothing
BARS = 15  # parameters that a tornado chart shows
MOST_BINS = 200
SHARES = 8  # parameters that have a colour of their own in stacked bars

PLAIN, CONTROLLED, DARK = "#8a97a6", "#0b6bb8", "#1d2733"
METHOD_COLOURS = ("#8a97a6", "#0b6bb8", "#d1622b", "#2a8c4a", "#8a4fbf", "#c23b6b", "#b08900", "#1d9aa8", "#5b4636")
LOW, HIGH = "#0b6bb8", "#d1622b"
COLOURS = ("#0b6bb8", "#d1622b", "#2f8f4e", "#8e5bb5", "#8a97a6", "#b5962d", "#1d2733", "#c2477f")  # of models


def running_estimates(
    dataset: xr.Dataset, output: str, counts: Sequence[int], *, controlled: bool = False
) -> list[Moments]:
    """Estimate the moments of an output from the first samples that have an answer, for several numbers of them.

    Parameters
    ----------
    dataset
        Results of a Monte Carlo study.
    output
        Name of the output.
    counts
        Numbers of samples, each at least 2.
    controlled
        With the tangent at the mean parameters as control variate (for the mean; the standard deviation is then not
        to be used), or plain.
    """
    ok = dataset["ok"].to_numpy()
    nominal = np.asarray(dataset["nominal"].sel(output=output).to_numpy())
    deviations = dataset["values"].sel(output=output).to_numpy()[ok] - nominal
    if not controlled:
        sums = monomials(deviations, None).cumsum(axis=1)
        return [estimate(sums[:, n - 1], n, nominal) for n in counts]
    steps = (dataset["points"] - dataset["parameter_mean"]).transpose("sample", "parameter").to_numpy()[ok]
    sums = monomials(deviations, steps @ dataset["derivative"].sel(output=output).to_numpy()).cumsum(axis=1)
    coefficient: Coefficient = "one" if bool((dataset["coefficient"] == 1).all()) else "optimal"
    unused = np.zeros_like(nominal)  # the variance of the control, which the mean does not depend on
    return [estimate(sums[:, n - 1], n, nominal, unused, coefficient) for n in counts]


def convergence(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the running mean of an output with its 95 % confidence band, plain and controlled."""
    ax = ax or axes()
    series = _series(dataset, output)
    for label, colour, counts, mean, error in series:
        half = half_width(dataset) * error
        ax.fill_between(counts, mean - half, mean + half, color=colour, alpha=0.22, linewidth=0)
        ax.plot(counts, mean, color=colour, label=label)
    _count_axis(ax, *(int(series[0][2][i]) for i in (0, -1)))
    ax.set_ylabel(f"running mean of {_quantity(dataset, output)}")
    ax.legend(title="mean, 95 % band")
    return ax


def standard_error(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the standard error of the mean of an output against the number of samples, plain and controlled."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    ax = ax or axes()
    series = _series(dataset, output)
    for label, colour, counts, _, error in series:
        ax.plot(counts, error, color=colour, label=label)
        ax.plot(counts, error[-1] * np.sqrt(counts[-1] / counts), color=colour, linewidth=0.8, linestyle=":")
    ax.plot([], [], color=DARK, linewidth=0.8, linestyle=":", label="proportional to 1/√samples")
    _count_axis(ax, *(int(series[0][2][i]) for i in (0, -1)))
    if any((error > 0).any() for *_, error in series):  # an output that does not vary has none
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:.4g}"))
        ax.yaxis.set_minor_locator(NullLocator())
    ax.set_ylabel(f"standard error of {_quantity(dataset, output)}")
    ax.legend()
    return ax


def histogram(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the density of an output, of its expansion or else of its samples, with its mean and quantiles."""
    ax = ax or axes()
    if "density" in dataset:
        density, edges = (dataset[name].sel(output=output).to_numpy() for name in ("density", "density_edge"))
        ax.stairs(density, edges, fill=True, color=CONTROLLED, alpha=0.4)
    else:
        values = dataset["values"].sel(output=output).to_numpy()[dataset["ok"].to_numpy()]
        spread = np.ptp(values) > 1e-12 * np.abs(values).max()
        ax.hist(
            values, bins=_bins(values) if spread else 1, density=True, color=CONTROLLED, alpha=0.4, edgecolor="white"
        )
    ax.axvline(float(dataset["mean"].sel(output=output)), color=DARK, label="mean")
    for i, probability in enumerate(dataset["quantile"].to_numpy()):
        place = float(dataset["quantiles"].isel(quantile=i).sel(output=output))
        ax.axvline(place, color=HIGH, linestyle="--", linewidth=1, label=None if i else "quantiles")
        ax.annotate(
            f"{100 * probability:g} %",
            (place, 1),
            xycoords=ax.get_xaxis_transform(),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize="small",
            color=HIGH,
        )
    ax.set_xlabel(_quantity(dataset, output))
    unit = str(dataset["unit"].sel(output=output).item())
    ax.set_ylabel("density" if unit == "1" else f"density (1/{unit})")
    ax.legend()
    return ax


def _bins(values: NDArray[np.float64]) -> int:
    """Return the number of bins of NumPy's "auto", but no more than can be drawn: one value far off makes millions."""
    quarter, three_quarters = np.percentile(values, [25, 75])
    width = 2 * (three_quarters - quarter) / len(values) ** (1 / 3)
    fewest = np.log2(len(values)) + 1
    return int(np.ceil(min(max(fewest, np.ptp(values) / width if width > 0 else 0), MOST_BINS)))


def tornado(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw how much an output changes, to first order, with each parameter one standard deviation off its mean."""
    effects = dataset["derivative_per_std"].sel(output=output).to_numpy()
    order = np.argsort(np.abs(effects))[-BARS:]
    ax = ax or axes(height=1.3 + 0.42 * len(order))
    for sign, colour, label in ((-1, LOW, "one standard deviation below its mean"), (1, HIGH, "above")):
        ax.barh(np.arange(len(order)), sign * effects[order], height=0.6, color=colour, label=label)
    ax.axvline(0, color=DARK, linewidth=0.8)
    ax.set_yticks(np.arange(len(order)), [_text(str(name)) for name in dataset["parameter"].to_numpy()[order]])
    ax.set_ylim(-0.6, len(order) - 0.4)
    ax.locator_params(axis="x", nbins=6)
    ax.set_xlabel(f"change of {_quantity(dataset, output)}")
    ax.legend(loc="lower right", bbox_to_anchor=(1.02, 1), ncols=2, frameon=False, fontsize="small")
    return ax


def index_bars(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the Sobol' indices of an output with 95 % confidence intervals, the parameter with the largest on top."""
    totals = dataset["sobol_total"].sel(output=output).to_numpy()
    order = np.argsort(totals)[-BARS:]
    ax = ax or axes(height=1.3 + 0.5 * len(order))
    for which, colour, side in (("first", CONTROLLED, 0.19), ("total", HIGH, -0.19)):
        values, errors = (dataset[f"sobol_{which}{end}"].sel(output=output).to_numpy()[order] for end in ("", "_error"))
        label = "first order" if which == "first" else "total"
        places = np.arange(len(order)) + side
        reach = half_width(dataset) * errors
        ax.barh(places, values, xerr=reach, height=0.36, color=colour, ecolor=DARK, capsize=2, label=label)
    if "total_bound" in dataset:
        limits = dataset["total_bound"].sel(output=output).to_numpy()[order]
        ax.plot(limits, np.arange(len(order)), "|", color=DARK, markersize=16, label="bound from derivatives")
    ax.axvline(0, color=DARK, linewidth=0.8)
    ax.set_yticks(np.arange(len(order)), [_text(str(name)) for name in dataset["parameter"].to_numpy()[order]])
    ax.set_ylim(-0.6, len(order) - 0.4)
    ax.set_xlabel(f"Sobol' index of {_text(output)}, 95 % interval")
    ax.legend(loc="lower right", bbox_to_anchor=(1.02, 1), ncols=3, frameon=False, fontsize="small")
    return ax


def index_shares(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw what parameters have alone of the variance of every output, and of the field, as stacked bars."""
    first = dataset["sobol_first"].transpose("output", "parameter").to_numpy()
    names = [str(name) for name in dataset["output"].to_numpy()]
    if "field_sobol_first" in dataset:
        first = np.vstack([first, dataset["field_sobol_first"].to_numpy()])
        names.append("displacement field")
    order = np.argsort(-first.mean(axis=0))
    places = np.arange(len(names))[::-1]
    ax = ax or axes(height=1.7 + 0.42 * len(names))
    left = np.zeros(len(names))
    for rank, i in enumerate(order[:SHARES]):
        width = np.clip(first[:, i], 0, 1)
        name = _text(str(dataset["parameter"].to_numpy()[i]))
        ax.barh(places, width, left=left, height=0.6, color=f"C{rank}", label=name)
        left = left + width
    rest = np.clip(1 - left, 0, None)
    ax.barh(places, rest, left=left, height=0.6, color=PLAIN, alpha=0.5, label="interactions and the rest")
    ax.set_yticks(places, [_text(name) for name in names])
    ax.set_xlabel("share of the variance")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, fontsize="small")
    return ax


def index_convergence(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the total Sobol' indices of an output against the number of samples, with 95 % confidence bands."""
    ax = ax or axes()
    counts = dataset["index_round"].to_numpy()
    totals = dataset["sobol_total"].sel(output=output).to_numpy()
    for rank, i in enumerate(np.argsort(-totals)[:SHARES]):
        of_parameter = dataset.isel(parameter=int(i)).sel(output=output)
        colour = f"C{rank}"
        name = _text(str(of_parameter["parameter"].item()))
        for which, style in (("first", "--"), ("total", "-")):
            mean, error = (of_parameter[f"running_sobol_{which}{end}"].to_numpy() for end in ("", "_error"))
            half = half_width(dataset) * error
            ax.fill_between(counts, mean - half, mean + half, color=colour, alpha=0.12, linewidth=0)
            ax.plot(counts, mean, style, color=colour, label=name if which == "total" else None)
    ax.set_ylim(-0.1, 1.1)
    _count_axis(ax, int(counts[0]), int(counts[-1]))
    ax.set_ylabel(f"indices of {_text(output)}")
    ax.legend(title="total; dashed: first order", fontsize="small")
    return ax


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
    ax.set_xlabel("leading direction (standard deviations)")
    ax.set_ylabel(_quantity(dataset, output))
    return ax


def spectrum(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the eigenvalues of the active subspace of an output with their 95 % ranges."""
    from matplotlib.ticker import MaxNLocator

    ax = ax or axes()
    of_output = dataset.sel(output=output)
    values, lower, upper = (of_output[f"active_eigenvalue{end}"].to_numpy() for end in ("", "_lower", "_upper"))
    reach = np.abs([np.minimum(lower - values, 0), np.maximum(upper - values, 0)])
    places = np.arange(1, len(values) + 1)
    ax.errorbar(places, values, yerr=reach, fmt="o", color=CONTROLLED, ecolor=DARK, capsize=4)
    if (values > 0).any():
        ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("number")
    ax.set_ylabel(f"eigenvalue for {_text(output)}")
    return ax


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


def comparison(
    datasets: Mapping[str, xr.Dataset], output: str, estimated: Estimated = "mean", ax: Axes | None = None
) -> Axes:
    """Draw an estimate of several studies, each with its 95 % confidence interval.

    Parameters
    ----------
    datasets
        Results by the name that stands beside them.
    output
        Name of the output; studies without an estimate of it are left out.
    estimated
        The mean or the standard deviation.
    ax
        Where to draw.
    """
    shown = {name: d.sel(output=output) for name, d in datasets.items() if "mean" in d and output in d.output.values}
    ax = ax or axes(height=1.2 + 0.42 * len(shown))
    places = np.arange(len(shown))[::-1]
    values = [float(d[estimated]) for d in shown.values()]
    errors = [half_width(d) * float(d[f"{estimated}_error"]) for d in shown.values()]
    ax.errorbar(values, places, xerr=errors, fmt="o", color=CONTROLLED, ecolor=DARK, capsize=4)
    ax.set_yticks(places, [_text(name) for name in shown])
    ax.set_ylim(-0.6, len(shown) - 0.4)
    ax.locator_params(axis="x", nbins=6)
    word = {"mean": "mean", "std": "standard deviation"}[estimated]
    quantities = {_quantity(datasets[name], output) for name in shown}
    ax.set_xlabel(f"{word} of {' or '.join(sorted(quantities)) or output}, 95 % interval")
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
    ax.set_ylabel(f"log₂ variance of {_text(output)}")
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
    ax.set_ylabel(f"log₂ |mean of {_text(output)}|")
    ax.legend()
    return ax


def mesh_samples(dataset: xr.Dataset, output: str, ax: Axes | None = None) -> Axes:
    """Draw the samples on every mesh, and the numbers that are best for other relative errors of sampling."""
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
    """Draw the predicted time of sampling against the error of the mean, over meshes and on the finest mesh alone."""
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
    ax.set_xlabel(f"standard error of {_quantity(dataset, output)}")
    ax.set_ylabel("predicted time (s)")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, fontsize="small")
    return ax


def _levels(dataset: xr.Dataset, output: str) -> dict[str, NDArray[np.float64]]:
    """Return what belongs to an output on every mesh."""
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
        The number of solves, or the processor time, which has the plain method by the textbook too.
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
        label = _text(name)
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
        size = float(of_output[floor])
        if size > lowest and (estimated == "mean" or floor == "solver_error"):
            ax.axhline(size, color=DARK, linewidth=1, linestyle=style, label=label)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(*ends)
    ax.set_ylim(bottom=lowest)
    ax.set_xlabel({"solves": "solves, set-up charged", "cpu_seconds": "processor time (s), set-up charged"}[against])
    word = {"mean": "mean", "std": "standard deviation"}[estimated]
    ax.set_ylabel(f"RMSE of the {word} of {_quantity(dataset, output)}")
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1), frameon=False, fontsize="small")
    return ax


def png(ax: Axes) -> bytes:
    """Return the whole figure of axes as a PNG file."""
    file = io.BytesIO()
    whole = ax.get_figure(root=True)
    assert whole is not None
    whole.savefig(file, format="png", dpi=130)
    return file.getvalue()


def axes(height: float = 3.2, width: float = 5.4) -> Axes:
    """Return axes on a new figure (inches) that needs no display and that nothing else keeps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    ax: Axes = figure.add_subplot()
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def grid(count: int, columns: int, height: float = 3.0, width: float = 2.8) -> list[Axes]:
    """Return axes side by side on a new figure as of `axes`; height and width (inches) are those of each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return [figure.add_subplot(rows, columns, i + 1) for i in range(count)]


def _quantity(dataset: xr.Dataset, output: str) -> str:
    """Name and unit of an output."""
    unit = str(dataset["unit"].sel(output=output).item())
    return _text(output) + ("" if unit == "1" else f" ({unit})")


def _text(name: str) -> str:
    """Keep matplotlib from reading a name as a formula."""
    return name.replace("$", r"\$")


def _series(
    dataset: xr.Dataset, output: str
) -> list[tuple[str, str, NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
    """Label, colour, numbers of samples, running mean and its standard error of each estimator that the study has."""
    if "running_mean" in dataset:
        mean, error = (dataset[f"running_{name}"].sel(output=output).to_numpy() for name in ("mean", "mean_error"))
        return [("scrambled Sobol' points", CONTROLLED, dataset["round"].to_numpy(), mean, error)]
    n = int(dataset["ok"].sum())
    counts = np.unique(np.geomspace(_first(n), n, 160).round().astype(np.int64))
    kinds = [("plain", PLAIN, False)]
    if "variance_ratio" in dataset:
        kinds.append(("with sensitivity derivatives", CONTROLLED, True))
    series = []
    for label, colour, controlled in kinds:
        running = running_estimates(dataset, output, counts.tolist(), controlled=controlled)
        mean, error = np.array([m.mean for m in running]), np.array([m.mean_error for m in running])
        series.append((label, colour, counts, mean, error))
    return series


def _first(n: int) -> int:
    """Return the number of samples where running estimates of n samples begin."""
    return max(2, min(FIRST_SHOWN, n // 2))


def _count_axis(ax: Axes, first: int, n: int) -> None:
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    ax.set_xscale("log")
    ax.set_xlim(first, max(n, first + 1))
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if n < 3000 else (1,)))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlabel("samples")


def span(values: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[float, float]:
    """Return the ends of an axis that holds a posterior, of values (n,) with weights (n,): 99.6 % of it, and a margin.

    A point far out with next to no weight, as of a wide prior, moves no end.
    """
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / weights.sum()
    first, last = np.searchsorted(reached, (0.002, 0.998)).clip(max=len(values) - 1)
    low, high = float(values[order[first]]), float(values[order[last]])
    mean = weights @ values / weights.sum()
    std = float(np.sqrt(weights @ (values - mean) ** 2 / weights.sum()))
    low, high = max(low, float(mean) - 6 * std), min(high, float(mean) + 6 * std)
    margin = max(0.1 * (high - low), 1e-9 * abs(low), 1e-300)
    return low - margin, high + margin
