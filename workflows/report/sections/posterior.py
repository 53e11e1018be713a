"""Posteriors of a few parameters and of fields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.bodies.geometry import AXES
from forward.readable import interval, margin, named, number, rounded, scale, size, spoken, with_error
from workflows.report.blocks import Block, Folded, Heading, Pairs, Pictures, Table, Text
from workflows.report.plots import inversion as plots
from workflows.report.plots import places as maps
from workflows.report.plots.outputs import measured_over_path
from workflows.report.plots.posterior import told_by_case
from workflows.report.section import Results, section
from workflows.report.sections.bodies import MISSES, first, misses, specimen
from workflows.results.points import has_points

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from uq.inputs.distributions import Distribution

SMALL = 1e-3  # volume (m³) below which it is written in cm³
SEEN_MOVE = 1e-5  # of the extent of the body: moves of points that are drawn
PAIRABLE = 20  # draws from which on densities are drawn
CASES_DRAWN = 24  # load cases and parameters that a map has
LEAST = 0.005  # of a component that is not written as 0


def _of_outputs(one: xr.Dataset) -> bool:
    """Whether the data are outputs of a model; otherwise they are those of load cases of a specimen."""
    return bool(one.attrs.get("quantity") == "output")


def _part(one: xr.Dataset) -> str:
    return "output" if _of_outputs(one) else "load case"


def measured_kind(of: xr.Dataset, study: Any) -> str:
    """Say what was measured of specimens: displacements, forces, or both."""
    axes = of["datum_axis"].to_numpy()[np.isfinite(of["measured"].to_numpy())] if "datum_axis" in of else np.zeros(1)
    if (axes < len(AXES)).all():
        return "components of displacements"
    units = {output.unit for case in study.model.cases for output in case.outputs}
    other = "forces" if units == {"N"} else "values of outputs"
    return other if (axes >= len(AXES)).all() else f"components of displacements and {other}"


@section("alone_eigenvalue", "draw")
def posterior(results: Results) -> Iterator[Block]:
    """The posterior of a few parameters for each data set."""
    from inverse.data.outputs import steps_of

    units = results.study.units_of("/")
    known = dict(results.study.inputs.marginals)
    if results.study.method.noise is not None:
        known["noise"] = results.study.method.noise
    before = {name: density_of(distribution) for name, distribution in known.items()}
    for one in first(results):
        yield from begun(results, one, one.sizes["direction"])
        if _of_outputs(one):
            yield measurements(one, {output.name: output.unit for output in results.study.model.returned})
            seen = {str(case).rpartition(".")[0] for case in one.case.values}
            if (steps := steps_of(results.study.model)) is not None and seen & set(steps.units):
                names = [name for name in steps.units if name in seen]
                drawn = [(measured_over_path(one, name, steps), f"{name}, measured and predicted.") for name in names]
                yield Pictures.of(*drawn)
        yield Pictures.of(*pictures(one, before, units))
        names = [str(name) for name in one.parameter.values if name != "noise"]
        alone = one["alone_std"].sel(parameter=names)
        sizes = results.columns(alone.median("case"))
        widths = [*alone.to_numpy(), one["together_std"].sel(parameter=names).to_numpy()]
        shown = [[number(x / size, 2) for x, (size, _) in zip(row, sizes.values(), strict=True)] for row in widths]
        yield from cases(one, [f"± {head}" for _, head in sizes.values()], shown)
        if one.sizes["case"] <= CASES_DRAWN and len(names) <= CASES_DRAWN:
            caption = (
                f"How many times narrower each {_part(one)} alone makes what was known of each parameter "
                "before the data, with the model linearised at the mode; empty where it tells nothing."
            )
            yield Pictures.of((told_by_case(one), caption))
        yield Heading("Directions", level=3)
        yield Text(
            "Unit vectors in standard normal coordinates of the prior; the first is what the data constrain "
            "most, the last what they constrain least."
        )
        rows = []
        for i, value in enumerate(one["eigenvalue"].to_numpy()):
            vector = one["direction_parameter"].isel(direction=i).to_numpy()[: len(names)]
            parts = (f"{x:+.2f}".replace("-", "−") if abs(x) >= LEAST else "0" for x in vector)
            rows.append((f"{i + 1}", number(value, 3), number((1 + value) ** -0.5, 2), *parts))
        yield Table(("direction", "λ", "posterior over prior width", *map(spoken, names)), rows)
        yield iterations(one)


def begun(results: Results, one: xr.Dataset, directions: int, *more: tuple[str, str]) -> Iterator[Block]:
    """Name a data set, with amounts, given the number of directions, and its parameters.

    Of several, say whether it can be trusted, and show those that are not on the first screen.
    """
    yield Heading(str(one.data_set.item()))
    if results.dataset.sizes["data_set"] > 1:
        yield Text(str(one["why"].item()), "" if int(one["trust"]) <= 1 else "warning")
    shown = results.dataset.data_set.values[results.dataset["ok"]][0]
    if "stiffness_mean" in one and "cell_nodes" in one and one.data_set.item() != shown:
        yield specimen(one, results)
    yield Pairs.of(*amounts(one, directions, results.study), *more)
    yield parameters(one, results.study.units_of("/"))


def amounts(one: xr.Dataset, directions: int, study: Any) -> Iterator[tuple[str, str]]:
    """Amounts of data, information and work, given the total number of directions."""
    kind = "values of outputs" if _of_outputs(one) else measured_kind(one, study)
    yield "data", f"{int(np.isfinite(one['measured']).sum()):,} {kind}"
    if "points_moved" in one and (moved := int(one["points_moved"])):
        yield "outside the body", f"{moved} points, up to {size(float(one['largest_move']), 'm')}, moved to its surface"
    seen = int((one["eigenvalue"] > plots.SEEN).sum())
    yield "directions about which the data say more than the prior", f"{seen} of {directions:,}"
    yield "directions determined", number(float(one["determined"]), 3)
    by_laplace, error = float(one["laplace_log_evidence"]), float(one["log_evidence_error"])
    if np.isfinite(error):
        yield "ln Z", with_error(float(one["log_evidence"]), error)
    yield "ln Z by Laplace", rounded(by_laplace, error) if np.isfinite(error) else number(by_laplace, 6)
    square, degrees = (number(float(one[f"residual_{name}"]), 4) for name in ("square", "degrees"))
    chance = number(float(one["residual_probability"]), 2)
    yield "residuals", f"|r|² = {square} where {degrees} is expected: probability {chance} of larger ones"
    if np.isfinite(one["agreement_probability"]):
        chance = number(float(one["agreement_probability"]), 2)
        yield "neighbouring residuals", f"probability {chance} that neighbours agree more"
    if np.isfinite(one["effective"]):
        words = f"worth {number(float(one['effective']), 3)}, k̂ = {number(float(one['tail']), 2)}"
        yield "weighted points", words
    if np.isfinite(one["chain_rhat"]):
        words = "they have mixed" if int(one["chains"]) else "they have not mixed"
        said = f"R̂ up to {float(one['chain_rhat']):.3f}, effective draws from {float(one['chain_effective']):.0f}"
        yield "chains", f"{said}: {words}"
    if "expansion_error" in one and np.isfinite(one["expansion_error"]):
        off = number(float(one["expansion_error"]), 2)
        yield "expansion", f"of {int(one['expansion_solves'])} solves, which all data sets share; off by up to {off} σ"
    else:
        yield "solves", f"{int(one['solves']):,}"
    if "reduced_share" in one:
        share, solves = 100 * float(one["reduced_share"]), int(one["reduced_solves"])
        yield "reduced model", f"{solves:,} solves; its draws, solved in full, have weights worth {share:.0f} % of them"


def parameters(one: xr.Dataset, units: Mapping[str, str]) -> Table:
    """Prior and posterior of every parameter, with the truth if known."""
    known = bool(np.isfinite(one["true"]).any())
    laplace = "laplace_std" in one
    rows = [
        _row(one.sel(parameter=name), str(name), units.get(str(name), "1"), laplace=laplace, known=known)
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
    """Name, prior, mode, posterior, interval; width by Laplace if there is one, truth if known; in one unit."""
    one, unit = scale(float(of["mean"]), unit)
    kinds = ("prior_mean", "prior_std", "mode", "mean", "std", "lower", "upper", "true")
    before, wide, mode, mean, std, lower, upper, true = (float(of[kind]) / one for kind in kinds)
    row = [named(name, unit), with_error(before, wide), rounded(mode, std), with_error(mean, std)]
    row.append(interval(lower, upper, "1", 1.0))
    if laplace:
        row.append(margin(float(of["laplace_std"]) / one) if "laplace_std" in of else "")
    if known:
        row += [number(true, 4), "yes" if lower <= true <= upper else "no" if np.isfinite(true) else ""]
    return row


def cases(one: xr.Dataset, head: list[str], widths: list[list[str]]) -> Iterator[Block]:
    """Misfit of each load case, and widths from it alone, with their heads; all together in the last row."""
    parts = [(str(case), one.sel(case=case), "alone_") for case in one.case.values]
    rows = []
    for (name, of, alone), width in zip([*parts, ("all together", one, "")], widths, strict=True):
        count, misfit, degrees = (float(of[f"misfit{end}"].sum()) for end in ("_count", "", "_degrees"))
        seen = int((of[f"{alone}eigenvalue"] > plots.SEEN).sum())
        determined = number(float(of[f"{alone}determined"]), 3)
        rows.append((name, f"{int(count):,}", f"{number(misfit)} of {number(degrees)}", str(seen), determined, *width))
    yield Heading(f"{_part(one)}s".capitalize(), level=3)
    yield Text("The widths from each of them alone, with the model linearised at the mode.")
    yield Table([_part(one), "data", "|r|², expected", "directions with λ > 1", "determined", *head], rows)


def iterations(one: xr.Dataset) -> Block:
    """The search for the mode, folded."""
    steps = one["step"].to_numpy()
    names, whole = [str(name) for name in one.column.values], {"start", "pairs", "products", "solves"}
    rows = [
        [str(int(x)) if name in whole else number(float(x), 5) for name, x in zip(names, row, strict=True)]
        for row in steps[np.isfinite(steps).any(axis=1)]
    ]
    table = Table([name.replace("_", " ") for name in names], rows, text=())
    return Folded("Iterations of the search for the mode", [table], printed=False)


def density_of(distribution: Distribution) -> plots.Density:
    """Return values and the density there of a prior."""
    z = np.linspace(-6, 6, 1201)
    values, slopes = distribution.from_normal(z)
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) / np.maximum(slopes, 1e-300)
    seen = np.exp(-(z**2) / 2) > 1e-7  # beyond, slopes of bounded distributions are rounding errors
    return values[seen], density[seen]


def measurements(one: xr.Dataset, units: Mapping[str, str]) -> Table:
    """Measurements of each output, and predictions with the most probable parameters."""
    here = one.isel(datum=np.isfinite(one["measured"].to_numpy()))
    outputs = [str(one.case.values[k]) for k in here["datum_case"].to_numpy().astype(int)]
    of = np.array([units.get(output, "1") for output in outputs])
    sizes = np.abs(here["measured"].to_numpy())
    largest = [float(sizes[of == unit].max()) for unit in of]  # a column of one quantity is read in one unit
    rows = [(name, *misses(here.isel(datum=k), str(of[k]), largest[k])) for k, name in enumerate(outputs)]
    return Table(("output", *MISSES), rows)


def pictures(
    one: xr.Dataset, before: Mapping[str, plots.Density] | None = None, units: Mapping[str, str] | None = None
) -> Iterator[tuple[Axes, str]]:
    """Draw the results for one data set, each with a caption: of parameters with densities before, or of a field."""
    cut = None if _of_outputs(one) else plots.Cut.of(one)
    if cut is not None and float(one["stiffness_prior_std"].max()) > 0:
        yield plots.slices(one, cut), f"ln of the stiffness factor on {cut.words}: {', '.join(plots.panels(one))}."
    words = f"λ of all {_part(one)}s together and of each alone; above 1 the data say more than the prior."
    yield plots.spectrum(one), words
    if cut is not None and has_points(one):
        words = "Measured against predicted displacements, component by component; on the line both are equal."
        yield maps.agreement(one), words
        words = "Measured minus predicted displacements at the mode: as arrows, and over their errors, on the box of"
        yield maps.residuals(one), f"{words} the body; fields/points-{one.data_set.item()}.vtu for ParaView."
        if float(one["largest_move"]) > SEEN_MOVE * float(np.ptp(one["node_position"].to_numpy())):
            yield maps.distances(one), "How far points were from the body before they were moved onto it."
    if before is not None and units is not None:
        words = "Prior and posterior of each parameter, beside it the whole prior; Laplace's Gaussian, and the truth"
        yield plots.marginals(one, before, units), f"{words} if known."
        if one.sizes["parameter"] > 1 and np.isfinite(one["draw"].to_numpy()).all(axis=1).sum() >= PAIRABLE:
            known = " and the truth" if np.isfinite(one["true"]).any() else ""
            words = "Posterior of the parameters in pairs: contours hold 50 and 90 %; lines are at the most probable"
            yield plots.correlations(one, units), f"{words} values{known}."
    elif cut is not None:
        words = "What the data see: 0 where they determine the stiffness, 1 where it stays what the prior says,"
        yield plots.left_of_prior(one, cut), f"{words} on {cut.words}."
        words = "The directions that the data constrain most, and the last that were found"
        yield plots.direction_slices(one, cut), f"{words}, on {cut.words}."
        words = "Standard deviation of ln stiffness by each load case alone"
        yield plots.alone_slices(one, cut), f"{words}, on {cut.words}."
        words = "Prior and posterior of ln stiffness where it is smallest, largest, and least certain"
        yield plots.node_marginals(one), f"{words}; the truth if known."
    words = f"|r|² of each {_part(one)}, and what is expected: mean and two standard deviations."
    yield plots.misfits(one), words
    if before is None and np.isfinite(one["stiffness_true"]).all():
        words = "Error at the nodes over the posterior standard deviation, and the standard normal density."
        yield plots.coverage(one), words


@section("alone_stiffness_std")
def field_posterior(results: Results) -> Iterator[Block]:
    """The posterior of a field for each data set."""
    for one in first(results):
        more = [("Hessian products", f"{int(one['products']):,}")]
        if np.isfinite(one["stiffness_true"]).all():
            inside = float((np.abs(one["stiffness_mean"] - one["stiffness_true"]) < 2 * one["stiffness_std"]).mean())
            more.append(("true ln stiffness within two standard deviations", f"at {100 * inside:.0f} % of the nodes"))
        yield from begun(results, one, one.sizes["node"], *more)
        yield Pictures.of(*pictures(one))
        alone = [float(one["alone_stiffness_std"].sel(case=case).mean()) for case in one.case.values]
        widths = [[number(width, 3)] for width in (*alone, float(one["stiffness_std"].mean()))]
        yield from cases(one, ["mean ± of ln stiffness"], widths)
        yield iterations(one)
