"""What data say of parameters and predictions: joint densities, load cases, populations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from forward.readable import named, number
from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, ON_DEEP, ON_PALE, PLAIN, axes, finished, rows, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


HELD = (0.9, 0.5)  # of the probability: within the contours
LATTICE = 40  # points along an axis at which densities are computed
DOTS = 160  # draws shown in each pair
CURVE = 120  # points of a density on the diagonal
Ends = Sequence[tuple[float, float]]  # of axes
PALE = 0.55  # shades above it are written on in white
SAID = 1.05  # times narrower from which it is written
LEAST = 4.0  # times narrower that the darkest shade stands for, at least
OUTPUTS = 12  # that have intervals
SPECIMENS = 40  # that have a row
RATIO = 30.0  # of the ends of an axis above which it is logarithmic


def pairs(
    columns: Mapping[str, FloatArray],
    weights: FloatArray,
    colour: str,
    *,
    worth: float | None = None,
    modes: Sequence[float] = (),
    truths: Sequence[float] = (),
) -> Axes:
    """Draw the densities of parameters by draws (n,), by what is written at the axes, with weights (n,).

    They are `worth` so many independent draws, if the weights do not tell it. Modes and truths, if known (NaN
    otherwise), are in the order of the columns.
    """
    from matplotlib.figure import Figure

    names, n = list(columns), len(columns)
    # Places by hand: a layout that looks at every label takes longer than all densities.
    wide, high = 1.4 + 1.45 * n, 1.0 + 1.25 * n
    figure = Figure(figsize=(wide, high))
    figure.subplots_adjust(0.75 / wide, 0.55 / high, 1 - 0.1 / wide, 1 - 0.1 / high, 0.12, 0.12)
    places = figure.add_gridspec(n, n)
    tops: list[Axes] = []  # of the columns, which share their axis
    used = weights > 1e-6 * weights.max()
    shares = weights[used] / weights[used].sum()
    draws = [values[used] for values in columns.values()]
    true = truths or [np.nan] * n
    ends = [holding(*span(x, shares), truth, 1, 0.05) for x, truth in zip(draws, true, strict=True)]
    for i, j in [(row, column) for row in range(n) for column in range(row + 1)]:
        ax = figure.add_subplot(places[i, j], sharex=tops[j] if j < i else None)
        tops += [ax] * (i == j)
        if i == j:
            at = np.linspace(*ends[i], CURVE)
            heights = density(draws[i][:, None], shares, at[:, None], worth)
            ax.fill_between(at, heights, color=colour, alpha=0.5, linewidth=0)
            ax.set_yticks([])
            ax.set_ylim(bottom=0)
        else:
            _contours(ax, np.stack([draws[j], draws[i]], axis=1), shares, worth, (ends[j], ends[i]), colour)
            ax.set_ylim(ends[i])
            ax.locator_params(axis="y", nbins=4)
        for values, line in ((modes, DARK), (truths, HIGH)):
            if len(values) and np.isfinite(values[j]):
                ax.axvline(values[j], linewidth=0.9, color=line)
                if i != j:
                    ax.axhline(values[i], linewidth=0.9, color=line)
        ax.set_xlim(ends[j])
        ax.locator_params(axis="x", nbins=3)
        ax.tick_params(labelsize="x-small", labelbottom=i == n - 1)
        ax.spines[["top", "right"]].set_visible(False)
        if i == n - 1:
            ax.set_xlabel(names[j], fontsize="small")
        if j == 0 and i > 0:
            ax.set_ylabel(names[i], fontsize="small")
        elif j > 0:
            ax.tick_params(labelleft=False)
    return tops[0]


def density(draws: FloatArray, shares: FloatArray, at: FloatArray, worth: float | None = None) -> FloatArray:
    """Return the density (m,) at points (m, d) of draws (n, d) with shares (n,) that add up to one.

    Gaussian kernels with Scott's share of the covariance of the draws, counted by their effective number, or by
    `worth`, the number of independent ones that they stand for.
    """
    d = draws.shape[1]
    off = draws - shares @ draws
    covariance = (shares[:, None] * off).T @ off
    scales = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    covariance = covariance / np.outer(scales, scales) + 1e-9 * np.eye(d)
    width = (float((shares**2).sum()) if worth is None else 1 / max(worth, 2.0)) ** (1 / (d + 4))
    root = np.linalg.cholesky(covariance) * width
    whitened, places = (np.linalg.solve(root, ((x - shares @ draws) / scales).T).T for x in (draws, at))
    square = (places**2).sum(axis=1)[:, None] + (whitened**2).sum(axis=1) - 2 * places @ whitened.T
    norm = np.sqrt(2 * np.pi) ** d * np.prod(np.diag(root)) * np.prod(scales)
    return np.asarray(np.exp(-square / 2) @ shares / norm)


def levels(values: FloatArray) -> list[float]:
    """Return the heights of a density (any shape) on a lattice above which it has the shares `HELD` of its integral."""
    ordered = np.sort(values.ravel())[::-1]
    reached = np.cumsum(ordered) / ordered.sum()
    return [float(height) for height in ordered[np.searchsorted(reached, HELD).clip(max=len(ordered) - 1)]]


def _contours(ax: Axes, draws: FloatArray, shares: FloatArray, worth: float | None, ends: Ends, colour: str) -> None:
    first, second = (np.linspace(*end, LATTICE) for end in ends)
    lattice = np.stack([one.ravel() for one in np.meshgrid(first, second)], axis=1)
    found = density(draws, shares, lattice, worth).reshape(LATTICE, LATTICE)
    heights = levels(found)
    top = 1.01 * float(found.max())
    if heights[0] < heights[1] < top:
        ax.contourf(first, second, found, levels=[*heights, top], colors=[colour, colour], alpha=0.3)
        ax.contour(first, second, found, levels=heights, colors=[colour], linewidths=1)
    # As many dots as can be told apart, by their weights: the first of a fixed, evenly spread order.
    at = np.searchsorted(np.cumsum(shares), (np.arange(DOTS) + 0.5) / DOTS).clip(max=len(draws) - 1)
    ax.plot(*draws[np.unique(at)].T, ".", color=colour, markersize=2, alpha=0.5)


def span(values: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Return the ends of an axis that holds a posterior, of values (n,) with weights (n,): 99.6 % of it, and a margin.

    A point far out with almost no weight, as with a wide prior, does not move an end.
    """
    order, whole = np.argsort(values), weights.sum()
    reached = np.cumsum(weights[order]) / whole
    low, high = values[order[np.searchsorted(reached, (0.002, 0.998)).clip(max=len(values) - 1)]].tolist()
    mean = float(weights @ values / whole)
    std = float(np.sqrt(weights @ (values - mean) ** 2 / whole))
    low, high = max(low, mean - 6 * std), min(high, mean + 6 * std)
    margin = max(0.1 * (high - low), 1e-9 * abs(low), 1e-300)
    return low - margin, high + margin


def holding(low: float, high: float, truth: float, far: float, margin: float) -> tuple[float, float]:
    """Move the ends of an axis so that they hold the truth with a margin, unless it is far away, in its lengths."""
    wide = high - low
    if low - far * wide < truth < high + far * wide:
        return min(low, truth - margin * wide), max(high, truth + margin * wide)
    return low, high


def told_by_case(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw how many times narrower each load case alone makes each parameter, and all together.

    With the model linearised at the mode: σ before / σ after; 1 where that is wider than the prior.
    """
    own = one.sel(parameter=one.parameter != "noise")
    names = [str(name) for name in own.parameter.values]
    widths = np.vstack([own["alone_std"], own["together_std"]])
    factors = np.maximum(own["prior_std"].to_numpy() / widths, 1.0)
    shades = np.log(factors) / max(np.log(factors.max()), np.log(LEAST))
    parts = [*map(str, one.case.values), "all together"]
    ax = ax or axes(height=1.6 + 0.32 * len(parts), width=max(5.4, 1.6 + 0.85 * len(names)))
    ax.imshow(shades, cmap="Blues", vmin=0, vmax=1.1, aspect="auto")
    for (i, j), factor in np.ndenumerate(factors):
        colour = ON_DEEP if shades[i, j] > PALE else ON_PALE
        text = f"{number(float(factor), 2)} ×" if factor >= SAID else ""
        ax.annotate(text, (j, i), ha="center", va="center", fontsize="small", color=colour)
    ax.set_xticks(range(len(names)), [text_of(name) for name in names], rotation=25, ha="right")
    ax.set_yticks(range(len(parts)), [text_of(part) for part in parts])
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(length=0)
    return ax


def bands(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the interval of each output by the prior and by the posterior; 0 and 1 are the ends of that by the prior.

    Where nothing is known of the prior, those of the posterior are 0 and 1.
    """
    outputs = [str(name) for name in one["goal"].values][:OUTPUTS]
    ax = ax or axes(height=1.3 + 0.4 * len(outputs), width=7.0)
    some, ends = one.sel(goal=outputs), ("lower", "mean", "upper")
    before, after = (np.array([some[f"prediction_{of}{end}"] for end in ends]) for of in ("prior_", ""))
    frame = np.where(np.isfinite(before), before, after)
    size = frame[2] - frame[0]
    known = size > 0
    places = rows(ax, outputs)[known]
    drawn = ((before, HIGH, 0.7, "before the data"), (after, CONTROLLED, 0.35, "after"))
    for values, colour, height, label in drawn:
        lower, middle, upper = (values[:, known] - frame[0, known]) / size[known]
        ax.barh(places, upper - lower, left=lower, height=height, color=colour, alpha=0.6, label=label)
        ax.plot(middle, places, "|", color=colour, markersize=14, markeredgewidth=2)
    return finished(ax, "from the lower to the upper end of the interval before the data", above=2)


def specimens(of: xr.Dataset, name: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw a parameter of each specimen, by its own data and as one of the population, over what new ones are like."""
    names = [str(specimen) for specimen in of["specimen"].values][:SPECIMENS]
    ax = ax or axes(height=1.6 + 0.32 * len(names))
    here = of.sel(parameter=name)
    places = rows(ax, names)
    for of_kind, alpha, label in (("new", 0.15, "new specimens"), ("typical", 0.3, "the typical specimen")):
        low, _, high = here[f"{of_kind}_quantiles"].to_numpy()
        ax.axvspan(low, high, color=PLAIN, alpha=alpha, linewidth=0, label=f"{label}, 95 %")
    one = here.sel(specimen=names)
    mean, reach = one["own_mean"].to_numpy(), 1.96 * one["own_std"].to_numpy()
    ax.errorbar(mean, places + 0.14, xerr=reach, fmt="o", ms=4, color=CONTROLLED, capsize=3, label="by its own data")
    mean, low, high = (one[f"specimen_{end}"].to_numpy() for end in ("mean", "lower", "upper"))
    both = np.maximum([mean - low, high - mean], 0.0)
    ax.errorbar(mean, places - 0.14, xerr=both, fmt="s", ms=4, color=HIGH, capsize=3, label="of the population")
    (left, right), (lower, _, upper) = ax.get_xlim(), here["new_quantiles"].to_numpy()
    if lower > 0 and RATIO * lower < upper:
        ax.set_xscale("log")
    else:
        ax.set_xlim(max(left, min(lower, float(low.min())) - 0.3 * (upper - lower)), right)
        ax.locator_params(axis="x", nbins=5)
    return finished(ax, named(text_of(name), unit), below=2)
