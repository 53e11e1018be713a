"""Pictures of one data set that was inverted: ``one = dataset.isel(data_set=0)``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray
from forward.readable import named, number, size
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, PLAIN, axes, finished, grid, text_of
from workflows.report.plots.posterior import density as density_of
from workflows.report.plots.posterior import holding, pairs, span

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from scipy.spatial import Delaunay

DECADES = 30.0  # ratio of the ends of a prior above which its axis is logarithmic
CURVE, PRIOR = 160, 200  # points of curves
PAIRED = 6  # parameters that are drawn in pairs
MARGINALS = 12  # parameters whose densities are drawn
RESOLUTION = 80  # points along the edge of a slice
AROUND_SLICE = 0.65, 0.15, 0.15, 0.3  # inches: to the left, below (its colours take of it what they need), right, above
AROUND_DENSITY = 0.15, 0.6, 0.15, 0.25
SEEN = 1.0  # λ above which the data say more about a direction than the prior
Density = tuple[FloatArray, FloatArray]
Panel = tuple[FloatArray, str, tuple[float, float]]  # a field, its colours and their ends
_FILLED: dict[str, Any] = {"color": CONTROLLED, "alpha": 0.45, "linewidth": 0, "label": "posterior"}


@dataclass(frozen=True)
class Cut:
    """A plane across y at a level (m), and the places on it, on lines at x and z (m), at which fields are drawn."""

    level: float
    lines: tuple[FloatArray, FloatArray]
    mesh: Delaunay

    @classmethod
    def of(cls, one: xr.Dataset) -> Cut:
        """Cut across y where the truth or the recovered field varies most."""
        from scipy.spatial import Delaunay

        places = one["node_position"].to_numpy()
        shown = one["stiffness_true"] if np.isfinite(one["stiffness_true"]).all() else one["stiffness_mean"]
        far = np.abs(shown.to_numpy() - np.median(shown))
        weights = np.where(far >= 0.7 * far.max(), far, 0.0) + 1e-300
        level = float(weights @ places[:, 1] / weights.sum())
        first, second = (np.linspace(places[:, a].min(), places[:, a].max(), RESOLUTION) for a in (0, 2))
        return cls(level, (first, second), Delaunay(places))

    @property
    def words(self) -> str:
        """The plane in words."""
        return f"the plane y = {size(self.level, 'm', 3)}"

    def values(self, field: FloatArray) -> FloatArray:
        """Return a field (N,) at the places on the plane, linear in each tetrahedron; NaN outside the body."""
        from scipy.interpolate import LinearNDInterpolator

        x, z = np.meshgrid(*self.lines, indexing="xy")
        return np.asarray(LinearNDInterpolator(self.mesh, field)(x, self.level, z))


def panels(one: xr.Dataset) -> dict[str, FloatArray]:
    """Return the fields (N,) of ln stiffness that are drawn on a plane, by name."""
    names = {"true": "true", "recovered": "mean", "standard deviation": "std", "prior standard deviation": "prior_std"}
    found = {name: one[f"stiffness_{of}"].to_numpy() for name, of in names.items()}
    return {name: values for name, values in found.items() if name != "true" or np.isfinite(values).all()}


def left_of_prior(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw on a plane the standard deviation over the prior's: 1 where the data say nothing."""
    std, prior = (one[name].to_numpy() for name in ("stiffness_std", "stiffness_prior_std"))
    left = np.divide(std, prior, out=np.ones_like(std), where=prior > 0)
    return _panels(cut, {"standard deviation over the prior's": (left, "plasma", (0.0, 1.0))}, 1, (4.5, 3.0))


def slices(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw truth, mean and standard deviations of ln stiffness on a plane, each kind with the same colours."""
    drawn, looks = panels(one), {}
    for kind, colours in ((True, "plasma"), (False, "viridis")):
        shown = np.stack([values for name, values in drawn.items() if ("deviation" in name) == kind])
        looks[kind] = colours, (0.0 if kind else float(shown.min()), float(shown.max()))
    return _panels(cut, {name: (values, *looks["deviation" in name]) for name, values in drawn.items()})


def direction_slices(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw directions of a field on a plane."""
    drawn: dict[str, Panel] = {}
    numbers = one["shown_number"].to_numpy().astype(int)
    for n, values in zip(numbers, one["direction_stiffness"].to_numpy(), strict=True):
        if n >= 0:
            largest = float(np.abs(values).max())
            drawn[f"{n + 1}: λ = {number(float(one['eigenvalue'][n]), 3)}"] = values, "RdBu_r", (-largest, largest)
    first = _panels(cut, drawn, 4, (2.1, 2.7))
    for part in first.figure.axes:
        part.tick_params(labelsize="x-small")
        part.locator_params(axis="x", nbins=2)
    return first


def alone_slices(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw the standard deviation by each load case alone, and by all, on a plane."""
    drawn = {str(case): one["alone_stiffness_std"].sel(case=case).to_numpy() for case in one.case.values}
    drawn["all together"] = one["stiffness_std"].to_numpy()
    widest = float(one["stiffness_prior_std"].max())
    return _panels(cut, {name: (values, "plasma", (0.0, widest)) for name, values in drawn.items()})


def _panels(cut: Cut, drawn: Mapping[str, Panel], columns: int = 2, size: tuple[float, float] = (2.9, 3.3)) -> Axes:
    """Draw fields on a plane, each in a panel (inches) with its name above and its colours below."""
    # Pictures of the points, which are small and drawn at once; browsers and printers smooth them.
    half = [(line[-1] - line[0]) / (len(line) - 1) / 2 for line in cut.lines]
    extent: Any = [end for line, d in zip(cut.lines, half, strict=True) for end in (line[0] - d, line[-1] + d)]
    found = grid(len(drawn), columns, size, AROUND_SLICE)
    for ax, (title, (values, colours, (low, high))) in zip(found, drawn.items(), strict=True):
        ends = (low, high) if high > low else (low - 1e-3, high + 1e-3)
        at = cut.values(values)
        shown = ax.imshow(at, colours, clim=ends, origin="lower", extent=extent, interpolation="none")
        ax.set(xlim=cut.lines[0][[0, -1]], ylim=cut.lines[1][[0, -1]])
        ax.set_title(title, fontsize="medium")
        finished(ax, "x (m)", "z (m)").locator_params(nbins=3)
        bar = ax.figure.colorbar(shown, ax=ax, orientation="horizontal", shrink=0.9, pad=0.22, fraction=0.2, aspect=15)
        bar.ax.locator_params(axis="x", nbins=4)
    return found[0]


def spectrum(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw λ of all load cases and of each alone."""
    from matplotlib import colormaps

    ax = ax or axes()
    found = {"all together": one["eigenvalue"].to_numpy()}
    found |= {str(case): one["alone_eigenvalue"].sel(case=case).to_numpy() for case in one.case.values}
    for i, (name, row) in enumerate(found.items()):
        values = row[np.isfinite(row) & (row > 1e-6 * found["all together"][0])]
        many = len(found) - 1 > len(COLOURS)  # the first and the last are named, as of the steps of a path
        shade = colormaps["viridis"]((i - 1) / max(len(found) - 2, 1)) if many else COLOURS[i - 1]
        label = None if many and 1 < i < len(found) - 1 else name
        colour = DARK if i == 0 else shade
        ax.plot(np.arange(1, len(values) + 1), values, ".-", color=colour, label=label, linewidth=1, markersize=4)
    ax.axhline(SEEN, color=PLAIN, linestyle="--", linewidth=1)
    ax.locator_params(axis="x", integer=True)
    if len(found["all together"]) == 1:
        ax.set_xlim(0, 2)
    return finished(ax, "direction", "λ", log="y")


def marginals(one: xr.Dataset, before: Mapping[str, Density], units: Mapping[str, str] | None = None) -> Axes:
    """Draw prior and posterior densities of the parameters; if there are many, those that the data narrow most.

    Of each parameter, the posterior as wide as it is, and beside it the whole prior with the posterior in it. Units of
    the parameters (``study.units_of("/")``) are shown if given.
    """
    names = _narrowed(one, MARGINALS)
    found = grid(2 * len(names), 4 if len(names) > 1 else 2, (2.1, 1.9), AROUND_DENSITY, legend=1)
    for close, whole, name in zip(found[::2], found[1::2], names, strict=True):
        of = one.sel(parameter=name)
        draws = of["draw"].to_numpy()
        draws = draws[np.isfinite(draws)]
        mean, std = float(of["mode"]), float(of["laplace_std"])
        low, high = _span(draws, mean, min(std, 3 * float(of["std"])), float(of["true"]))
        every = slice(None, None, max(1, len(before[name][0]) // PRIOR))
        values, density = (one_[every] for one_ in before[name])
        x = np.linspace(*_cut(low, high, np.append(draws, mean), values[[0, -1]]), CURVE)
        shares = np.full(len(draws), 1 / max(len(draws), 1))
        posterior = density_of(draws[:, None], shares, x[:, None], min(_worth(one), len(draws)))
        close.fill_between(x, posterior, **_FILLED)
        close.plot(x, _bell(x, mean, std), color=DARK, linewidth=1, label="Laplace")
        close.plot(x, np.interp(x, values, density, left=0.0, right=0.0), color=PLAIN, linestyle="--", label="prior")
        if np.isfinite(of["true"]):
            close.axvline(float(of["true"]), color=HIGH, label="truth")
        label = named(text_of(name), (units or {}).get(name, "1"))
        _finish(close, label, x)
        _beside(whole, values, density, x, posterior)
        _finish(whole, label, np.array(whole.get_xlim()))
    found[1].set_title("the whole prior", fontsize="small")
    return finished(found[0], below=4 if len(names) > 1 else 2)


def _beside(ax: Axes, values: FloatArray, density: FloatArray, x: FloatArray, posterior: FloatArray) -> None:
    """Draw the middle 99 % of a prior, with the posterior in it, each to its own height."""
    reached = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(values))])
    low, high = (float(v) for v in np.interp((0.005, 0.995), reached / reached[-1], values))
    low, high = min(low, float(x[0])), max(high, float(x[-1]))
    if low > 0 and high > DECADES * low:  # as wide as this, equal lengths are equal factors
        ax.set_xscale("log")
        density, posterior = density * values, posterior * x
    ax.fill_between(values, density / max(float(density.max()), 1e-300), color=PLAIN, alpha=0.35, linewidth=0)
    ax.fill_between(x, posterior / max(float(posterior.max()), 1e-300), **_FILLED)
    middle = float(x[int(posterior.argmax())])
    ax.plot([middle] * 2, [0, 1], color=_FILLED["color"], linewidth=1)  # seen also where it is very narrow
    ax.set_xlim(low, high)


def correlations(one: xr.Dataset, units: Mapping[str, str]) -> Axes:
    """Draw the posterior of the parameters in pairs; of many, those that the data narrow most."""
    names = _narrowed(one, PAIRED)
    here = one.sel(parameter=names)
    draws = here["draw"].transpose("parameter", "sample").to_numpy()
    kept = np.isfinite(draws).all(axis=0)
    columns = {named(text_of(name), units.get(name, "1")): row[kept] for name, row in zip(names, draws, strict=True)}
    modes, truths = (here[which].to_numpy().tolist() for which in ("mode", "true"))
    return pairs(columns, np.ones(kept.sum()), CONTROLLED, worth=_worth(one), modes=modes, truths=truths)


def _narrowed(one: xr.Dataset, most: int) -> list[str]:
    """Name so many parameters, in their order: those that the data narrow most."""
    narrowed = (one["std"] / one["prior_std"]).to_numpy()
    return [str(one.parameter.values[i]) for i in np.sort(np.argsort(narrowed, kind="stable")[:most])]


def _span(draws: FloatArray, mode: float, std: float, true: float) -> tuple[float, float]:
    """Ends of an axis that holds a posterior, its Gaussian, and the truth unless that is far away."""
    low, high = mode - 4 * std, mode + 4 * std
    if len(draws):
        ends = span(draws, np.ones(len(draws)))
        low, high = min(low, ends[0]), max(high, ends[1])
    return holding(low, high, true, 2, 0.1)


def _cut(low: float, high: float, posterior: FloatArray, prior: FloatArray) -> tuple[float, float]:
    """Limit an axis to the range of the prior (2,), unless points (n,) of the posterior are beyond."""
    slack = 1e-6 * (prior[1] - prior[0])
    low = max(low, float(prior[0])) if posterior.min() > prior[0] - slack else low
    return low, min(high, float(prior[1])) if posterior.max() < prior[1] + slack else high


def _worth(one: xr.Dataset) -> float:
    """Effective sample size of the draws."""
    return float(one["chain_effective"] if int(one["chains"]) else one["effective"])


def _finish(ax: Axes, label: str, x: FloatArray) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(bottom=0)
    ax.set_yticks([])
    if ax.get_xscale() == "linear":
        ax.xaxis.set_major_locator(MaxNLocator(3))
    ax.set_xlabel(label, fontsize="small")
    ax.tick_params(labelsize="small")
    ax.spines[["top", "right", "left"]].set_visible(False)


def node_marginals(one: xr.Dataset) -> Axes:
    """Draw prior and posterior of ln stiffness at three nodes: the softest, the stiffest, the least certain."""
    mean, std = one["stiffness_mean"].to_numpy(), one["stiffness_std"].to_numpy()
    before = one["stiffness_prior_std"].to_numpy()
    centre = float(one["prior_mean"][0])
    nodes = list(dict.fromkeys((int(mean.argmin()), int(mean.argmax()), int((std / before).argmax()))))
    found = grid(len(nodes), len(nodes), (2.2, 2.2), AROUND_DENSITY, legend=1)
    for ax, node in zip(found, nodes, strict=True):
        x = np.linspace(*_span(np.zeros(0), mean[node], std[node], float(one["stiffness_true"][node])), 300)
        ax.fill_between(x, _bell(x, mean[node], std[node]), **_FILLED)
        ax.plot(x, _bell(x, centre, before[node]), color=PLAIN, linestyle="--", label="prior")
        if np.isfinite(one["stiffness_true"][node]):
            ax.axvline(float(one["stiffness_true"][node]), color=HIGH, label="truth")
        place = ", ".join(f"{x + 0.0:.3g}" for x in one["node_position"].to_numpy()[node].round(9))
        _finish(ax, f"ln stiffness at\n({place}) m", x)
        ax.xaxis.label.set_fontsize("x-small")
    return finished(found[0], below=4 if len(nodes) > 2 else 2)


def _bell(x: FloatArray, mean: float, std: float) -> FloatArray:
    return np.asarray(np.exp(-(((x - mean) / std) ** 2) / 2) / (std * np.sqrt(2 * np.pi)))


def misfits(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw |r|² of each load case beside what is expected."""
    ax = ax or axes()
    names = [str(case) for case in one.case.values]
    places = np.arange(len(names))
    degrees = one["misfit_degrees"].to_numpy()
    ax.bar(places, one["misfit"].to_numpy(), color=CONTROLLED, width=0.55)
    reach = 2 * np.sqrt(2 * degrees)
    down = np.minimum(reach, degrees)
    ax.errorbar(places, degrees, yerr=[down, reach], fmt="_", color=DARK, markersize=18, capsize=5)
    ax.set_xticks(places, names, rotation=45 if len(names) > len(COLOURS) else 0)
    return finished(ax, y="|r|²")


def coverage(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw errors at the nodes over their standard deviations."""
    ax = ax or axes()
    std = np.maximum(one["stiffness_std"].to_numpy(), 1e-12)
    z = (one["stiffness_mean"].to_numpy() - one["stiffness_true"].to_numpy()) / std
    edges = np.linspace(-5, 5, 41)
    ax.hist(np.clip(z, -5, 5), bins=edges.tolist(), density=True, color=CONTROLLED, alpha=0.45)
    x = np.linspace(-5, 5, 200)
    ax.plot(x, _bell(x, 0.0, 1.0), color=DARK)
    for end in (-2, 2):
        ax.axvline(end, color=PLAIN, linestyle="--", linewidth=1)
    within = f"{100 * (np.abs(z) < 2).mean():.0f} % of the nodes within 2"
    return finished(ax, f"error/standard deviation; {within}", "density")
