"""Pictures of a comparison of models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from forward.words import named, with_error
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, axes, span
from workflows.studies.findings_selection import by_probability, ranking

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


def evidence_bars(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw ln Z of each model minus the largest, with three standard errors."""
    order = ranking(dataset["log_evidence"])[::-1]
    ax = ax or axes(height=1.2 + 0.5 * len(order))
    values = dataset["log_evidence"].sel(model=order).values
    errors = dataset["log_evidence_error"].sel(model=order).values
    places = np.arange(len(order))
    below = values - values.max()
    # The first has no length: its place is marked.
    colours = [HIGH if z == 0 else CONTROLLED for z in below]
    ax.barh(places, below, xerr=3 * errors, color=colours, ecolor=DARK, capsize=4, height=0.6)
    ax.plot(0, places[int(np.argmax(below))], "o", color=HIGH)
    # Next to hopeless models the differences of the others are invisible: the numbers are written with the names.
    labels = [f"{model}\n{with_error(float(z), float(e))}" for model, z, e in zip(order, below, errors, strict=True)]
    ax.set_yticks(places, labels, fontsize="small")
    ax.set_xlim(1.15 * min(below.min(), -1.0), 0.05 * abs(below.min()) + 3 * errors.max())
    ax.set_xlabel("ln Z − ln Z of the most probable")
    return ax


def probability_bars(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the models side by side, a bar for each variant."""
    names = [str(variant) for variant in dataset.variant.values]
    ax = ax or axes(height=1.6 + 0.36 * len(names))
    places = np.arange(len(names))[::-1]
    left = np.zeros(len(names))
    best = by_probability(dataset, dataset["log_evidence"])[0]
    muted = [colour for colour in COLOURS if colour != HIGH]
    for k, model in enumerate(dataset.model.values):
        share = dataset["variant_probability"].sel(model=model).values
        ax.barh(
            places,
            share,
            left=left,
            color=HIGH if model == best else muted[k % len(muted)],
            label=str(model),
            height=0.6,
        )
        left = left + share
    ax.set_yticks(places, names)
    ax.set_xlim(0, 1)
    ax.set_xlabel("probability")
    ax.figure.legend(loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return ax


def corner(dataset: xr.Dataset, model: str, group: str, units: Mapping[str, str] | None = None) -> Axes:
    """Draw the posterior of the constants of a model, each alone and in pairs; large points have large weights.

    Units of the constants (``study.units_of(model)``) are shown where they are given.
    """
    labels = {name: named(str(name), (units or {}).get(str(name), "1")) for name in dataset.parameter.values}
    one = dataset.sel(model=model, group=group)
    names = [
        str(name) for name in dataset.parameter.values if np.isfinite(float(one["constant_mode"].sel(parameter=name)))
    ]
    n = len(names)
    first = axes(height=1.0 + 1.25 * n, width=1.4 + 1.45 * n)
    figure = first.get_figure(root=True)
    assert figure is not None
    first.remove()
    grid = figure.subplots(n, n, squeeze=False, sharex="col")
    weights = one["point_weight"].values
    used = weights > 1e-6 * weights.max()
    weights = weights[used]
    columns = [one["point"].sel(parameter=name).values[used] for name in names]
    modes = [float(one["constant_mode"].sel(parameter=name)) for name in names]
    ends = [span(x, weights) for x in columns]
    colour = COLOURS[list(dataset.model.values).index(model) % len(COLOURS)]
    for i, j in np.ndindex(n, n):
        ax = grid[i, j]
        if j > i:
            ax.remove()
            continue
        if i == j:
            ax.hist(columns[i], bins=24, range=ends[i], weights=weights, color=colour, alpha=0.6)
            ax.axvline(modes[i], color=DARK, linewidth=1)
            ax.set_yticks([])
        else:
            ax.scatter(columns[j], columns[i], s=300 * weights / weights.max() / np.sqrt(len(weights)), color=colour)
            ax.plot(modes[j], modes[i], "+", color=DARK)
            ax.set_ylim(ends[i])
        ax.set_xlim(ends[j])
        ax.ticklabel_format(style="sci", scilimits=(-2, 3), useMathText=True)
        ax.tick_params(labelsize="x-small")
        ax.xaxis.get_offset_text().set_fontsize("x-small")
        ax.yaxis.get_offset_text().set_fontsize("x-small")
        ax.spines[["top", "right"]].set_visible(False)
        if i == n - 1:
            ax.set_xlabel(labels[names[j]], fontsize="small")
        if j == 0 and i > 0:
            ax.set_ylabel(labels[names[i]], fontsize="small")
        elif j > 0:
            ax.tick_params(labelleft=False)
    corner_axes: Axes = grid[0, 0]
    return corner_axes


def residuals(dataset: xr.Dataset, test: str, ax: Axes | None = None, of: str = "displacement (m)") -> Axes:
    """Draw the residuals of each model for a test, over the stated errors, against the measurements.

    `of` says what was measured, with its unit.
    """
    from matplotlib.ticker import MaxNLocator

    ax = ax or axes(height=3.4)
    one = dataset.isel(output=np.flatnonzero(dataset["output_test"].values == test))
    measured = one["measured"].values
    for k, model in enumerate(dataset.model.values):
        left = (measured - one["prediction_mean"].sel(model=model).values) / one["sigma"].values
        P = float(dataset["probability"].sel(model=model))
        colour = COLOURS[k % len(COLOURS)]
        ax.plot(measured, left, ".", markersize=4, color=colour, label=f"{model} ({P:.2g})")
    ax.axhspan(-2, 2, color=DARK, alpha=0.08, linewidth=0)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(f"measured {of}")
    ax.set_ylabel("residual / σ")
    ax.legend(fontsize="small", frameon=False)
    return ax


def curves(dataset: xr.Dataset, group: str, test: str, ax: Axes | None = None) -> Axes:
    """Draw the posterior curves of all models over the data of a test."""
    ax = ax or axes(height=3.4)
    chosen = (dataset["output_group"].values == group) & (dataset["output_test"].values == test)
    one = dataset.isel(output=np.flatnonzero(chosen))
    one = one.isel(output=np.argsort(one["output_at"].values, kind="stable"))
    at = one["output_at"].values
    for k, model in enumerate(dataset.model.values):
        low, high = one["prediction_quantiles"].sel(model=model).values
        ax.fill_between(at, low, high, color=COLOURS[k % len(COLOURS)], alpha=0.25, linewidth=0)
        P = float(dataset["probability"].sel(model=model))
        ax.plot(
            at,
            one["prediction_mean"].sel(model=model).values,
            color=COLOURS[k % len(COLOURS)],
            label=f"{model} ({P:.2g})",
        )
    ax.errorbar(at, one["measured"].values, yerr=one["sigma"].values, fmt=".", color=DARK, label="measured")
    ax.set_xlabel(f"{test}: stretch or amount of shear")
    ax.set_ylabel("stress (Pa)")
    ax.legend(fontsize="small", frameon=False)
    return ax
