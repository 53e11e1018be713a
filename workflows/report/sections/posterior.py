"""What was found for each data set."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.words import number, with_error
from workflows.report.blocks import Block, Folded, Heading, Pairs, Picture, Pictures, Table, Text
from workflows.report.plots import inversion as plots
from workflows.report.section import Results, Section
from workflows.report.words import named, unit_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from workflows.studies.inversion import Inversion

DIRECTIONS = 10  # of few parameters that a table lists
SMALL = 1e-3  # volume (m³) that is rather written in cm³
DRAWN = 8  # data sets that have more than a row of the table


class Posterior(Section):
    """What was found for each data set: estimates, pictures, load cases, directions, iterations."""

    def applies(self, results: Results) -> bool:
        """Whether data were inverted."""
        return "alone_eigenvalue" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """The same for each of the first data sets."""
        dataset = results.dataset
        several, before = dataset.sizes["data_set"] > 1, prior_densities(results.study)
        for name in dataset.data_set.values[dataset["ok"]][:DRAWN]:
            one = dataset.sel(data_set=name)
            yield Heading(str(name))
            if several:
                yield Text(str(one["why"].item()), "" if int(one["trust"]) <= 1 else "warning")
            yield Pairs([(word, [text]) for word, text in amounts(one)])
            yield posterior(one)
            yield Pictures([Picture.drawn(ax, caption) for ax, caption in pictures(one, before)])
            yield Heading("Load cases", level=3)
            yield Text("What each of them alone would have said, with the model linearised at the mode.")
            yield cases(one)
            if "direction_parameter" in one:
                yield Heading("Directions", level=3)
                yield Text(
                    "Unit vectors in standard normal coordinates of the prior; the first is what the data constrain "
                    "most, the last what they constrain least."
                )
                yield directions(one)
            yield Folded("Iterations of the search for the mode", [iterations(one)])


def amounts(one: xr.Dataset) -> Iterator[tuple[str, str]]:
    """What was measured, and what it took."""
    yield "data", f"{int(np.isfinite(one['measured']).sum()):,} components of displacements"
    moved = int(one["points_moved"])
    if moved:
        yield (
            "outside the body",
            f"{moved} points, up to {number(float(one['largest_move']), 2)} m, moved to its surface",
        )
    seen = int((one["eigenvalue"] > plots.SEEN).sum())
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
        _row(one.sel(parameter=name), str(name), unit_of(str(name)), laplace=laplace, known=known)
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
    row = [named(name, unit), with_error(float(of["prior_mean"]), float(of["prior_std"]))]
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
            str(int((of["alone_eigenvalue"] > plots.SEEN).sum())),
            _shown(of["alone_determined"], 3),
        ]
        if few:
            row += [_shown(of["alone_std"].sel(parameter=name), 2) for name in names if name != "noise"]
        else:
            row.append(_shown(of["alone_stiffness_std"].mean(), 3))
        rows.append(row)
    together = ["all together", f"{int(one['misfit_count'].sum()):,}"]
    together += [f"{_shown(one['misfit'].sum())} of {_shown(one['misfit_degrees'].sum())}"]
    together += [str(int((one["eigenvalue"] > plots.SEEN).sum())), _shown(one["determined"], 3)]
    if few:
        together += [_shown(one["together_std"].sel(parameter=name), 2) for name in names if name != "noise"]
    else:
        together.append(_shown(one["stiffness_std"].mean(), 3))
    head = ["load case", "data", "|r|², expected", "directions with λ > 1", "determined"]
    head += (
        [f"± {named(name, unit_of(name))}" for name in names if name != "noise"] if few else ["mean ± of ln stiffness"]
    )
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


def prior_densities(study: Inversion) -> dict[str, plots.Density]:
    """Curves (values, density) of the priors by the names of the parameters; those of a field have none."""
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


def pictures(one: xr.Dataset, before: dict[str, plots.Density]) -> Iterator[tuple[Axes, str]]:
    """Draw what was found for one data set, each with what it shows."""
    cut = plots.Cut.of(one)
    where = f"the plane {'xyz'[cut.axis]} = {cut.level:.4g} m"
    if float(one["stiffness_prior_std"].max()) > 0:
        yield plots.slices(one, cut), f"ln of the stiffness factor on {where}: {', '.join(plots.panels(one))}."
    yield (
        plots.spectrum(one),
        "λ of all load cases together and of each alone; above 1 the data say more than the prior.",
    )
    if "draw" in one:
        yield (
            plots.marginals(one, before),
            "Prior and posterior of each parameter; Laplace's Gaussian, and the truth where it is known.",
        )
    else:
        words = "The directions that the data constrain most, and the last that were found"
        yield plots.direction_slices(one, cut), f"{words}, on {where}."
        yield plots.alone_slices(one, cut), f"Standard deviation of ln stiffness by each load case alone, on {where}."
        words = "Prior and posterior of ln stiffness where it is found to be least and most, and where least is known"
        yield plots.node_marginals(one), f"{words}; the truth where it is known."
    yield plots.misfits(one), "|r|² of each load case, and what is expected: mean and two standard deviations."
    if "draw" in one:
        if np.isfinite(one["true"]).any():
            yield plots.errors(one), "Mean less truth over the posterior standard deviation; 95 % lie in the grey band."
    elif np.isfinite(one["stiffness_true"]).all():
        yield (
            plots.coverage(one),
            "Error at the nodes over the posterior standard deviation, and the standard normal density.",
        )
