"""Pictures of a comparison of models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle, islice
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray
from forward.readable import named, percent, with_error
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, axes, finished, grid, stacked, text_of
from workflows.report.plots.posterior import pairs
from workflows.results.comparison import by_probability, ranking

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

WIDE = 2  # tests side by side
SHOWN = 12  # outputs that have bars


def evidence_bars(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw ln Z of each model minus the largest, with three standard errors."""
    order = ranking(dataset["log_evidence"])[::-1]
    ax, places = ax or axes(height=1.2 + 0.5 * len(order)), np.arange(len(order))
    values, errors = (dataset[name].sel(model=order).values for name in ("log_evidence", "log_evidence_error"))
    below = values - values.max()
    # The first has no length: its place is marked.
    colours = [HIGH if z == 0 else CONTROLLED for z in below]
    ax.barh(places, below, xerr=3 * errors, color=colours, ecolor=DARK, capsize=4, height=0.6)
    ax.plot(0, places[int(np.argmax(below))], "o", color=HIGH)
    # Next to hopeless models the differences of the others are invisible: the numbers are written with the names.
    labels = [f"{model}\n{with_error(float(z), float(e))}" for model, z, e in zip(order, below, errors, strict=True)]
    ax.set_yticks(places, labels, fontsize="small")
    ax.set_xlim(1.15 * min(below.min(), -1.0), 0.05 * abs(below.min()) + 3 * errors.max())
    return finished(ax, "ln Z − ln Z of the most probable")


def probability_bars(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the models side by side, a bar for each variant."""
    names, of = [str(variant) for variant in dataset.variant.values], colours(dataset)
    ax = ax or axes(height=1.6 + 0.36 * len(names))
    shares = {model: dataset["variant_probability"].sel(model=model).values for model in of}
    stacked(ax, names, shares, list(of.values()))
    ax.set_xlim(0, 1)
    return finished(ax, "probability", below=3)


def corner(dataset: xr.Dataset, model: str, group: str, units: Mapping[str, str] | None = None) -> Axes:
    """Draw the posterior of the constants of a model, each alone and in pairs: contours hold 50 and 90 %.

    Units of the constants (``study.units_of(model)``) are shown where they are given.
    """
    one = dataset.sel(model=model, group=group)
    own = one.isel(parameter=np.flatnonzero(np.isfinite(one["constant_mode"])))
    points = own["point"].transpose("parameter", ...).to_numpy()
    heads = (named(text_of(str(name)), (units or {}).get(str(name), "1")) for name in own["parameter"].values)
    columns, modes = dict(zip(heads, points, strict=True)), own["constant_mode"].to_numpy().tolist()
    return pairs(columns, one["point_weight"].to_numpy(), colours(dataset)[model], modes=modes)


def colours(dataset: xr.Dataset) -> dict[str, str]:
    """Return the colour of each model: a strong one for the most probable."""
    best = by_probability(dataset, dataset["log_evidence"])[0]
    muted = [colour for colour in COLOURS if colour != HIGH]
    names = [str(model) for model in dataset.model.values]
    return {model: HIGH if model == best else muted[k % len(muted)] for k, model in enumerate(names)}


def residuals(dataset: xr.Dataset, test: str, ax: Axes | None = None, of: str = "displacement (m)") -> Axes:
    """Draw the residuals of each model for a test, over the stated errors, against measurements `of` something."""
    ax = ax or axes(height=3.4)
    one = dataset.isel(output=np.flatnonzero(dataset["output_test"].values == test))
    measured = one["measured"].values
    for model, style, label in _styles(dataset):
        left = (measured - one["prediction_mean"].sel(model=model).values) / one["sigma"].values
        ax.plot(measured, left, ".", markersize=4, color=style["color"], zorder=style["zorder"], label=label)
    ax.axhspan(-2, 2, color=DARK, alpha=0.08, linewidth=0)
    ax.locator_params(axis="x", nbins=5)
    return finished(ax, f"measured {of}", "residual / σ")


def curves(dataset: xr.Dataset, group: str, test: str, ax: Axes | None = None) -> Axes:
    """Draw the posterior curves of all models over the data of a test, the most probable one in front."""
    chosen = (dataset["output_group"].values == group) & (dataset["output_test"].values == test)
    one = dataset.isel(output=np.flatnonzero(chosen))
    return _over(dataset, one, one["output_at"].to_numpy(), f"{test}: stretch or amount of shear", "stress (Pa)", ax)


def fits(dataset: xr.Dataset, tests: Sequence[tuple[str, str]]) -> Axes:
    """Draw the curves of all tests, given with their groups, side by side, with one legend below."""
    several = len({group for group, _ in tests}) > 1
    panels = grid(len(tests), min(len(tests), WIDE + several), (3.7, 2.9), (0.75, 0.55, 0.1, 0.3), legend=2)
    for panel, (group, test) in zip(panels, tests, strict=True):
        panel.set_title(text_of(group) if several else "", fontsize="medium")
        if legend := curves(dataset, group, test, panel).get_legend():
            legend.remove()
    return finished(panels[-1], below=3)


def along(dataset: xr.Dataset, places: Mapping[str, float], over: str, of: str, ax: Axes | None = None) -> Axes:
    """Draw the posterior curves of all models over measured outputs, by their places on a path.

    `over` and `of` say what is drawn at the two axes.
    """
    one = dataset.isel(output=[k for k, test in enumerate(dataset["output_test"].values) if str(test) in places])
    return _over(dataset, one, np.array([places[str(test)] for test in one["output_test"].values]), over, of, ax)


def _over(dataset: xr.Dataset, one: xr.Dataset, at: FloatArray, over: str, of: str, ax: Axes | None) -> Axes:
    ax, order = ax or axes(height=3.4), np.argsort(at, kind="stable")
    one, at = one.isel(output=order), at[order]
    for model, style, label in _styles(dataset):
        mine, faint = one.sel(model=model), 0.3 if style["zorder"] > 2 else 0.1
        band = mine["prediction_quantiles"].values
        ax.fill_between(at, *band, color=style["color"], alpha=faint, linewidth=0, zorder=style["zorder"])
        ax.plot(at, mine["prediction_mean"].values, label=label, **style)
    ax.errorbar(at, one["measured"].values, one["sigma"].values, fmt=".", color=DARK, label="measured", zorder=4)
    ax.locator_params(axis="x", nbins=6)
    return finished(ax, over, of)


def _styles(dataset: xr.Dataset) -> list[tuple[str, dict[str, Any], str]]:
    """Return names of models from the most probable, how they are drawn, and what is written beside them."""
    of, found = colours(dataset), []
    for rank, model in enumerate(by_probability(dataset, dataset["log_evidence"])):
        style = {"color": of[model], "linewidth": 1.0 if rank else 2.4, "zorder": 2.0 if rank else 3.0}
        found.append((model, style, f"{model} ({percent(float(dataset['probability'].sel(model=model)))})"))
    return found


def parts_of_variance(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw a bar for each output: the share of its variance within each candidate, and that between them."""
    some = dataset.isel(output=slice(SHOWN))
    outputs = [str(name) for name in some["output"].values]
    within = (some["candidate_probability"] * some["candidate_std"] ** 2).transpose("candidate", "output").to_numpy()
    parts = np.vstack([within, some["between"]])
    names = [*(f"within {text_of(str(name))}" for name in some["candidate"].values), "between"]
    whole = sum(parts, np.zeros(len(outputs)))
    shares = np.divide(parts, whole, out=np.zeros(parts.shape), where=whole > 0)
    ax = ax or axes(height=1.3 + 0.35 * len(outputs), width=7.0)
    stacked(ax, outputs, dict(zip(names, shares, strict=True)), [*islice(cycle(COLOURS), len(within)), DARK])
    ax.set_xlim(0, 1)
    return finished(ax, "share of the variance", above=3)
