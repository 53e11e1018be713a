"""The report of an inversion: its tables and pictures, data set by data set."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.words import number, settings, with_error
from workflows.report import plots
from workflows.report.tables import Table
from workflows.report.words import unit_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from workflows.config.study import AnyStudy

DIRECTIONS = 10  # of few parameters that a table lists
MARGINALS = 12  # parameters whose densities are drawn
RESOLUTION = 80  # points along the edge of a slice
SMALL = 1e-3  # volume (m³) that is rather written in cm³
TRUSTED = ("Laplace's", "corrected", "not to be trusted", "doubtful")
DRAWN = 8  # data sets that have more than a row of the table
Density = tuple[FloatArray, FloatArray]
SEEN = 1.0  # λ above which the data say more of a direction than the prior


def context(dataset: xr.Dataset, study: AnyStudy) -> dict[str, Any]:
    """Return what the template shows beside what all reports have."""
    if "clean" in dataset:
        return {"lines": made(dataset), "batch": None, "priors": None, "sets": []}
    several = dataset.sizes["data_set"] > 1
    drawn = dataset.data_set.values[dataset["ok"]][:DRAWN]
    priors_of = _prior_densities(study)
    return {
        "lines": [],
        "batch": batch(dataset) if several else None,
        "priors": priors(dataset, study),
        "sets": [_of_set(dataset.sel(data_set=name), priors_of, several=several) for name in drawn],
    }


def _prior_densities(study: AnyStudy) -> dict[str, Density]:
    """Curves (values, density) of the priors by the names of the parameters; those of a field have none."""
    from workflows.studies.inversion import Inversion

    assert isinstance(study, Inversion)
    if study.field:
        return {}
    known = dict(study.inputs.marginals)
    if study.method.noise is not None:
        known["noise"] = study.method.noise
    z = np.linspace(-6, 6, 1201)
    curves = {}
    for name, distribution in known.items():
        values, slopes = distribution.from_normal(z)
        density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) / np.maximum(slopes, 1e-300)
        seen = np.exp(-(z**2) / 2) > 1e-7  # beyond, slopes of bounded distributions are rounding
        curves[name] = values[seen], density[seen]
    return curves


def _of_set(one: xr.Dataset, before: dict[str, Density], *, several: bool) -> dict[str, Any]:
    return {
        "name": str(one.data_set.item()),
        "verdict": str(one["why"].item()) if several else None,
        "trusted": int(one["trust"]) <= 1,
        "amounts": list(amounts(one)),
        "posterior": posterior(one),
        "cases": cases(one),
        "directions": directions(one) if "direction_parameter" in one else None,
        "iterations": iterations(one),
        "pictures": list(pictures(one, before)),
    }


def made(dataset: xr.Dataset) -> list[str]:
    """Say what synthetic data were made."""
    counts = np.isfinite(dataset["values"].to_numpy()).sum(axis=1)
    sets = f"{len(counts)} data sets" if len(counts) > 1 else "1 data set"
    return [f"{sets} of {', '.join(map(str, counts))} components, in the folder data."]


# --- tables ----------------------------------------------------------------------------------------------------------


def priors(dataset: xr.Dataset, study: AnyStudy) -> Table:
    """What was believed before."""
    config = tomllib.loads(dataset.attrs["config"])
    rows = [
        (path, f"{block['kind']}: {settings(block, 'kind')}", _unit(path))
        for path, block in config.get("parameters", {}).items()
    ]
    rows += [
        (f"fields.{block.get('name') or block['of']}", f"log-normal field: {settings(block, 'of', 'name')}", "1")
        for block in config["model"].get("fields", ())
    ]
    noise = config["method"].get("noise")
    if noise is not None:
        rows.append(("factor on all sigma", f"{noise['kind']}: {settings(noise, 'kind')}", "1"))
    return Table(("unknown", "prior", "unit"), rows, text=frozenset(range(3)))


def batch(dataset: xr.Dataset) -> Table:
    """A row for each data set."""
    names = [str(name) for name in dataset.parameter.values]
    rows = []
    for label in dataset.data_set.values:
        one = dataset.sel(data_set=label)
        if not bool(one["ok"]):
            rows.append((str(label), "", "failed", *[""] * (len(names) + 3)))
            continue
        values = [_estimate(one.sel(parameter=name)) for name in names]
        rows.append(
            (
                str(label),
                f"{int(np.isfinite(one['measured']).sum()):,}",
                TRUSTED[int(one["trust"])],
                *values,
                number(float(one["determined"]), 3),
                number(float(one["residual_probability"]), 2),
                number(float(one["log_evidence"]), 6),
            )
        )
    units = map(_with_unit, names)
    head = ("data set", "data", "posterior", *units, "directions determined", "p of larger residuals", "ln Z")
    return Table(head, rows, text=frozenset({0, 2}))


def amounts(one: xr.Dataset) -> Iterator[tuple[str, str]]:
    """What was measured, and what it took."""
    yield "data", f"{int(np.isfinite(one['measured']).sum()):,} components of displacements"
    moved = int(one["points_moved"])
    if moved:
        yield (
            "outside the body",
            f"{moved} points, up to {number(float(one['largest_move']), 2)} m, moved to its surface",
        )
    seen = int((one["eigenvalue"] > SEEN).sum())
    of = one.sizes["direction"] if "direction_parameter" in one else one.sizes["node"]
    yield "directions that the data say more of than the prior", f"{seen} of {of:,}"
    yield "directions determined", number(float(one["determined"]), 3)
    if np.isfinite(one["log_evidence_error"]):
        yield "ln Z", f"{number(float(one['log_evidence']), 7)} ± {number(float(one['log_evidence_error']), 2)}"
    yield "ln Z by Laplace", number(float(one["laplace_log_evidence"]), 7)
    square, degrees = (number(float(one[f"residual_{name}"]), 4) for name in ("square", "degrees"))
    chance = number(float(one["residual_probability"]), 2)
    yield "residuals", f"|r|² = {square} where {degrees} is expected: probability {chance} of larger ones"
    if np.isfinite(one["agreement_probability"]):
        yield (
            "neighbouring residuals",
            f"probability {number(float(one['agreement_probability']), 2)} of more alike ones",
        )
    if np.isfinite(one["effective"]):
        words = f"worth {number(float(one['effective']), 3)}, k̂ = {number(float(one['tail']), 2)}"
        yield "weighted points", words
    if np.isfinite(one["chain_rhat"]):
        words = "they have mixed" if int(one["chains"]) else "they have not mixed"
        said = f"R̂ up to {float(one['chain_rhat']):.3f}, effective draws from {float(one['chain_effective']):.0f}"
        yield "chains", f"{said}: {words}"
    yield "solves", f"{int(one['solves']):,}"
    if "products" in one:
        yield "Hessian products", f"{int(one['products']):,}"
    if np.isfinite(one["stiffness_true"]).all() and "draw" not in one:
        inside = float((np.abs(one["stiffness_mean"] - one["stiffness_true"]) < 2 * one["stiffness_std"]).mean())
        yield "true ln stiffness within two standard deviations", f"at {100 * inside:.0f} % of the nodes"


def posterior(one: xr.Dataset) -> Table:
    """Prior and posterior of every parameter, with the truth where it is known."""
    known = bool(np.isfinite(one["true"]).any())
    laplace = "laplace_std" in one
    rows = [
        _row(one.sel(parameter=name), str(name), _unit(str(name)), laplace=laplace, known=known)
        for name in one.parameter.values
    ]
    for label in one["inclusion"].values if "inclusion" in one else ():
        of = one.sel(inclusion=label)
        unit, per_unit = ("cm³", 1e6) if float(of["volume_mean"]) < SMALL else ("m³", 1.0)
        volumes = [str(key) for key in of.data_vars if str(key).startswith("volume_")]
        numbers = {key.removeprefix("volume_"): per_unit * of[key] for key in volumes}
        rows.append(_row(numbers, f"inclusions.{label}.volume", unit, laplace=laplace, known=known))
    head = ["", "prior", "mode", "posterior", "95 %", *(["± by Laplace"] if laplace else [])]
    return Table([*head, *(["truth", "inside"] if known else [])], rows)


def _row(of: Any, name: str, unit: str, *, laplace: bool, known: bool) -> list[str]:
    """Name, prior, mode, posterior, interval; width by Laplace where there is one, truth where it is known."""
    row = [name if unit == "1" else f"{name} ({unit})", with_error(float(of["prior_mean"]), float(of["prior_std"]))]
    row += [_shown(of["mode"]), _estimate(of), f"{_shown(of['lower'])} to {_shown(of['upper'])}"]
    if laplace:
        row.append(_shown(of["laplace_std"], 2) if "laplace_std" in of else "")
    if known:
        inside = float(of["lower"]) <= float(of["true"]) <= float(of["upper"])
        row += [_shown(of["true"]), "yes" if inside else "no" if np.isfinite(of["true"]) else ""]
    return row


def cases(one: xr.Dataset) -> Table:
    """Misfit of each load case, and what it alone would have said."""
    few = "alone_std" in one
    names = [str(name) for name in one.parameter.values] if few else []
    rows = []
    for case in one.case.values:
        of = one.sel(case=case)
        row = [
            str(case),
            f"{int(of['misfit_count']):,}",
            f"{_shown(of['misfit'])} of {_shown(of['misfit_degrees'])}",
            str(int((of["alone_eigenvalue"] > SEEN).sum())),
            _shown(of["alone_determined"], 3),
        ]
        if few:
            row += [_shown(of["alone_std"].sel(parameter=name), 2) for name in names if name != "noise"]
        else:
            row.append(_shown(of["alone_stiffness_std"].mean(), 3))
        rows.append(row)
    together = ["all together", f"{int(one['misfit_count'].sum()):,}"]
    together += [f"{_shown(one['misfit'].sum())} of {_shown(one['misfit_degrees'].sum())}"]
    together += [str(int((one["eigenvalue"] > SEEN).sum())), _shown(one["determined"], 3)]
    if few:
        together += [_shown(one["together_std"].sel(parameter=name), 2) for name in names if name != "noise"]
    else:
        together.append(_shown(one["stiffness_std"].mean(), 3))
    head = ["load case", "data", "|r|², expected", "directions with λ > 1", "determined"]
    head += [f"± {_with_unit(name)}" for name in names if name != "noise"] if few else ["mean ± of ln stiffness"]
    return Table(head, [*rows, together])


def directions(one: xr.Dataset) -> Table:
    """The directions of the parameters, in whitened coordinates, from what the data constrain most to the least."""
    names = [str(name) for name in one.parameter.values if name != "noise"]
    rows = []
    for i, value in enumerate(one["eigenvalue"].to_numpy()[:DIRECTIONS]):
        vector = one["direction_parameter"].isel(direction=i).to_numpy()[: len(names)]
        rows.append((f"{i + 1}", number(value, 3), number((1 + value) ** -0.5, 2), *(f"{x:+.2f}" for x in vector)))
    return Table(("direction", "λ", "posterior over prior width", *names), rows)


def iterations(one: xr.Dataset) -> Table:
    """The search for the mode."""
    table = one["step"].to_numpy()
    table = table[np.isfinite(table).any(axis=1)]
    names = [str(name) for name in one.column.values]
    whole = {"start", "pairs", "products", "solves"}
    rows = [
        [str(int(x)) if name in whole else number(float(x), 5) for name, x in zip(names, row, strict=True)]
        for row in table
    ]
    return Table([name.replace("_", " ") for name in names], rows, text=frozenset())


def _shown(value: Any, digits: int = 4) -> str:
    return number(float(value), digits)


def _estimate(of: Any) -> str:
    return with_error(float(of["mean"]), float(of["std"]))


def _unit(path: str) -> str:
    return "1" if path == "noise" else unit_of(path)


def _with_unit(path: str) -> str:
    unit = _unit(path)
    return path if unit == "1" else f"{path} ({unit})"


# --- pictures --------------------------------------------------------------------------------------------------------


def pictures(one: xr.Dataset, before: dict[str, Density]) -> Iterator[tuple[Axes, str]]:
    """Draw what was found for one data set, each with what it shows."""
    cut = Cut.of(one)
    where = f"the plane {'xyz'[cut.axis]} = {cut.level:.4g} m"
    if float(one["stiffness_prior_std"].max()) > 0:
        yield slices(one, cut), f"ln of the stiffness factor on {where}: {', '.join(_panels(one))}."
    yield spectrum(one), "λ of all load cases together and of each alone; above 1 the data say more than the prior."
    if "draw" in one:
        yield (
            marginals(one, before),
            "Prior and posterior of each parameter; Laplace's Gaussian, and the truth where it is known.",
        )
    else:
        words = "The directions that the data constrain most, and the last that were found"
        yield direction_slices(one, cut), f"{words}, on {where}."
        yield alone_slices(one, cut), f"Standard deviation of ln stiffness by each load case alone, on {where}."
        words = "Prior and posterior of ln stiffness where it is found to be least and most, and where least is known"
        yield node_marginals(one), f"{words}; the truth where it is known."
    yield misfits(one), "|r|² of each load case, and what is expected: mean and two standard deviations."
    if "draw" in one:
        if np.isfinite(one["true"]).any():
            yield errors(one), "Mean less truth over the posterior standard deviation; 95 % lie in the grey band."
    elif np.isfinite(one["stiffness_true"]).all():
        yield (
            coverage(one),
            "Error at the nodes over the posterior standard deviation, and the standard normal density.",
        )


@dataclass(frozen=True)
class Cut:
    """A plane across the body, with what it takes to draw fields on it.

    Attributes
    ----------
    axis, level
        The plane: a coordinate, and its value (m).
    along
        The other two axes.
    lines
        Coordinates (m) of the points along each of these.
    vertices, weights
        Numbers (n, 4) of the nodes around each point, and weights; NaN outside the body.
    """

    axis: int
    level: float
    along: tuple[int, int]
    lines: tuple[FloatArray, FloatArray]
    vertices: NDArray[np.int64]
    weights: FloatArray

    @classmethod
    def of(cls, one: xr.Dataset) -> Cut:
        """Cut across y where truth or recovered field stand out."""
        from scipy.spatial import Delaunay

        places = one["node_position"].to_numpy()
        shown = one["stiffness_true"] if np.isfinite(one["stiffness_true"]).all() else one["stiffness_mean"]
        far = np.abs(shown.to_numpy() - np.median(shown))
        weights = np.where(far >= 0.7 * far.max(), far, 0.0) + 1e-300
        level = float(weights @ places[:, 1] / weights.sum())
        first, second = (np.linspace(places[:, a].min(), places[:, a].max(), RESOLUTION) for a in (0, 2))
        x, z = np.meshgrid(first, second, indexing="xy")
        points = np.column_stack([x.ravel(), np.full(x.size, level), z.ravel()])
        mesh = Delaunay(places)
        found = mesh.find_simplex(points, tol=1e-9)
        map_ = mesh.transform[found]
        inner = np.einsum("nij,nj->ni", map_[:, :3], points - map_[:, 3])
        shares = np.column_stack([inner, 1 - inner.sum(axis=1)])
        shares[found < 0] = np.nan
        return cls(1, level, (0, 2), (first, second), mesh.simplices[found], shares)

    def values(self, field: FloatArray) -> FloatArray:
        """Return a field (N,) at the points of the plane."""
        return np.asarray((field[self.vertices] * self.weights).sum(axis=1).reshape(RESOLUTION, RESOLUTION))


def _panels(one: xr.Dataset) -> dict[str, FloatArray]:
    panels = {}
    if np.isfinite(one["stiffness_true"]).all():
        panels["true"] = one["stiffness_true"].to_numpy()
    panels["recovered"] = one["stiffness_mean"].to_numpy()
    panels["standard deviation"] = one["stiffness_std"].to_numpy()
    panels["prior standard deviation"] = one["stiffness_prior_std"].to_numpy()
    return panels


def slices(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw truth, mean and standard deviations of ln stiffness on a plane."""
    panels = _panels(one)
    shown = [values for name, values in panels.items() if "deviation" not in name]
    ends = min(float(v.min()) for v in shown), max(float(v.max()) for v in shown)
    widest = max(float(values.max()) for name, values in panels.items() if "deviation" in name)
    found = plots.grid(len(panels), columns=2)
    for ax, (name, values) in zip(found, panels.items(), strict=True):
        spread = "deviation" in name
        limits = (0.0, widest) if spread else ends
        _draw(ax, cut, values, name, "plasma" if spread else "viridis", limits)
    return found[0]


def direction_slices(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw directions of a field on a plane."""
    shown = [i for i, n in enumerate(one["shown_number"].to_numpy()) if n >= 0]
    found = plots.grid(len(shown), columns=4, height=2.7, width=2.1)
    for ax, i in zip(found, shown, strict=True):
        values = one["direction_stiffness"].isel(shown=i).to_numpy()
        n = int(one["shown_number"][i])
        largest = float(np.abs(values).max())
        label = f"{n + 1}: λ = {float(one['eigenvalue'][n]):.3g}"
        _draw(ax, cut, values, label, "RdBu_r", (-largest, largest))
    for part in found[0].figure.axes:
        part.tick_params(labelsize="x-small")
    return found[0]


def alone_slices(one: xr.Dataset, cut: Cut) -> Axes:
    """Draw the standard deviation by each load case alone, and by all, on a plane."""
    panels = {str(case): one["alone_stiffness_std"].sel(case=case).to_numpy() for case in one.case.values}
    panels["all together"] = one["stiffness_std"].to_numpy()
    widest = float(one["stiffness_prior_std"].max())
    found = plots.grid(len(panels), columns=2)
    for ax, (name, values) in zip(found, panels.items(), strict=True):
        _draw(ax, cut, values, name, "plasma", (0.0, widest))
    return found[0]


def _draw(ax: Axes, cut: Cut, values: FloatArray, title: str, colours: str, ends: tuple[float, float]) -> None:
    from matplotlib.ticker import MaxNLocator

    low, high = ends if ends[1] > ends[0] else (ends[0] - 1e-3, ends[1] + 1e-3)
    drawn = ax.pcolormesh(*cut.lines, cut.values(values), cmap=colours, vmin=low, vmax=high, shading="gouraud")
    ax.set_aspect("equal")
    ax.set_title(title, fontsize="medium")
    ax.set_xlabel(f"{'xyz'[cut.along[0]]} (m)")
    ax.set_ylabel(f"{'xyz'[cut.along[1]]} (m)")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(3))
    bar = ax.figure.colorbar(drawn, ax=ax, orientation="horizontal", shrink=0.9)
    bar.ax.xaxis.set_major_locator(MaxNLocator(4))


def spectrum(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw λ of all load cases and of each alone."""
    from matplotlib.ticker import MaxNLocator

    ax = ax or plots.axes()
    rows = {"all together": one["eigenvalue"].to_numpy()}
    rows |= {str(case): one["alone_eigenvalue"].sel(case=case).to_numpy() for case in one.case.values}
    for i, (name, row) in enumerate(rows.items()):
        values = row[np.isfinite(row) & (row > 1e-6 * rows["all together"][0])]
        colour = plots.DARK if i == 0 else plots.COLOURS[i - 1]
        ax.plot(np.arange(1, len(values) + 1), values, ".-", color=colour, label=name, linewidth=1, markersize=4)
    ax.axhline(SEEN, color=plots.PLAIN, linestyle="--", linewidth=1)
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("direction")
    ax.set_ylabel("λ")
    ax.legend(fontsize="small", frameon=False)
    return ax


def marginals(one: xr.Dataset, before: dict[str, Density]) -> Axes:
    """Draw prior and posterior densities of the parameters, of many those that the data narrow most."""
    narrowed = (one["std"] / one["prior_std"]).to_numpy()
    chosen = np.sort(np.argsort(narrowed, kind="stable")[:MARGINALS])
    names = [str(one.parameter.values[i]) for i in chosen]
    found = plots.grid(len(names), columns=min(len(names), 2), height=2.2)
    for ax, name in zip(found, names, strict=True):
        of = one.sel(parameter=name)
        draws = of["draw"].to_numpy()
        draws = draws[np.isfinite(draws)]
        mean, std = float(of["mode"]), float(of["laplace_std"])
        low, high = _span(draws, mean, min(std, 3 * float(of["std"])), float(of["true"]))
        values, density = before[name]
        x = np.linspace(max(low, values[0]), min(high, values[-1]), 300)
        ax.fill_between(x, _smooth(draws, float(of["std"]), _worth(one), x), **_FILLED)
        ax.plot(x, _bell(x, mean, std), color=plots.DARK, linewidth=1, label="Laplace")
        ax.plot(x, np.interp(x, values, density), color=plots.PLAIN, linestyle="--", label="prior")
        if np.isfinite(of["true"]):
            ax.axvline(float(of["true"]), color=plots.HIGH, label="truth")
        _finish(ax, _with_unit(name), x)
    _legend(found)
    return found[0]


def _span(draws: FloatArray, mode: float, std: float, true: float) -> tuple[float, float]:
    """Ends of an axis that holds a posterior, its Gaussian, and the truth unless that is far away."""
    low, high = mode - 4 * std, mode + 4 * std
    if len(draws):
        ends = plots.span(draws, np.ones(len(draws)))
        low, high = min(low, ends[0]), max(high, ends[1])
    wide = high - low
    if low - 2 * wide < true < high + 2 * wide:
        low, high = min(low, true - 0.1 * wide), max(high, true + 0.1 * wide)
    return low, high


_FILLED: dict[str, Any] = {"color": plots.CONTROLLED, "alpha": 0.45, "linewidth": 0, "label": "posterior"}


def _worth(one: xr.Dataset) -> float:
    """How many independent draws the draws are worth."""
    return float(one["chain_effective"] if int(one["chains"]) else one["effective"])


def _smooth(draws: FloatArray, std: float, worth: float, x: FloatArray) -> FloatArray:
    """Density at x of draws that are worth so many independent ones, by normal kernels (Silverman's width)."""
    width = max(std, 1e-300) * (4 / (3 * max(min(worth, len(draws)), 2.0))) ** 0.2
    z = (x[:, None] - draws) / width
    return np.asarray(np.exp(-(z**2) / 2).mean(axis=1) / (width * np.sqrt(2 * np.pi)))


def _finish(ax: Axes, label: str, x: FloatArray) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(bottom=0)
    ax.set_yticks([])
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlabel(label, fontsize="small")
    ax.tick_params(labelsize="small")
    ax.spines[["top", "right", "left"]].set_visible(False)


def _legend(found: list[Axes]) -> None:
    handles, labels = found[0].get_legend_handles_labels()
    found[0].figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small", frameon=False)


def node_marginals(one: xr.Dataset) -> Axes:
    """Draw prior and posterior of ln stiffness at three nodes: the softest, the stiffest, that which is known least."""
    mean, std = one["stiffness_mean"].to_numpy(), one["stiffness_std"].to_numpy()
    before = one["stiffness_prior_std"].to_numpy()
    centre = float(one["prior_mean"][0])
    nodes = list(dict.fromkeys((int(mean.argmin()), int(mean.argmax()), int((std / before).argmax()))))
    found = plots.grid(len(nodes), columns=len(nodes), height=2.6, width=2.2)
    for ax, node in zip(found, nodes, strict=True):
        x = np.linspace(*_span(np.zeros(0), mean[node], std[node], float(one["stiffness_true"][node])), 300)
        ax.fill_between(x, _bell(x, mean[node], std[node]), **_FILLED)
        ax.plot(x, _bell(x, centre, before[node]), color=plots.PLAIN, linestyle="--", label="prior")
        if np.isfinite(one["stiffness_true"][node]):
            ax.axvline(float(one["stiffness_true"][node]), color=plots.HIGH, label="truth")
        place = ", ".join(f"{x + 0.0:.3g}" for x in one["node_position"].to_numpy()[node].round(9))
        _finish(ax, f"ln stiffness at\n({place}) m", x)
        ax.xaxis.label.set_fontsize("x-small")
    _legend(found)
    return found[0]


def _bell(x: FloatArray, mean: float, std: float) -> FloatArray:
    return np.asarray(np.exp(-(((x - mean) / std) ** 2) / 2) / (std * np.sqrt(2 * np.pi)))


def errors(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw errors of the parameters whose truth is known, over their standard deviations."""
    names = [str(name) for name in one.parameter.values if np.isfinite(one["true"].sel(parameter=name))]
    ax = ax or plots.axes(height=1.2 + 0.35 * len(names))
    known = one.sel(parameter=names)
    z = ((known["mean"] - known["true"]) / known["std"]).to_numpy()
    places = np.arange(len(names))[::-1]
    ax.axvspan(-1.96, 1.96, color=plots.DARK, alpha=0.08, linewidth=0)
    ax.errorbar(z, places, xerr=1, fmt="o", color=plots.CONTROLLED, capsize=4)
    ax.axvline(0, color=plots.HIGH, linewidth=1)
    ax.set_yticks(places, names)
    ax.set_ylim(-0.6, len(names) - 0.4)
    farthest = max(3.0, float(np.abs(z).max()) + 1.3)
    ax.set_xlim(-farthest, farthest)
    ax.set_xlabel("(mean − truth)/standard deviation")
    return ax


def misfits(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw |r|² of each load case beside what is expected."""
    ax = ax or plots.axes()
    names = [str(case) for case in one.case.values]
    places = np.arange(len(names))
    degrees = one["misfit_degrees"].to_numpy()
    ax.bar(places, one["misfit"].to_numpy(), color=plots.CONTROLLED, width=0.55)
    ax.errorbar(places, degrees, yerr=2 * np.sqrt(2 * degrees), fmt="_", color=plots.DARK, markersize=18, capsize=5)
    ax.set_xticks(places, names)
    ax.set_ylabel("|r|²")
    return ax


def coverage(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw errors at the nodes over their standard deviations."""
    ax = ax or plots.axes()
    std = np.maximum(one["stiffness_std"].to_numpy(), 1e-12)
    z = (one["stiffness_mean"].to_numpy() - one["stiffness_true"].to_numpy()) / std
    edges = np.linspace(-5, 5, 41)
    ax.hist(np.clip(z, -5, 5), bins=edges.tolist(), density=True, color=plots.CONTROLLED, alpha=0.45)
    x = np.linspace(-5, 5, 200)
    ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=plots.DARK)
    for end in (-2, 2):
        ax.axvline(end, color=plots.PLAIN, linestyle="--", linewidth=1)
    ax.set_xlabel(f"error/standard deviation; {100 * (np.abs(z) < 2).mean():.0f} % of the nodes within 2")
    ax.set_ylabel("density")
    return ax
