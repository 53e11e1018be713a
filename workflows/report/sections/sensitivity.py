"""Sobol' indices, Shapley effects, bounds by derivatives, local sensitivities."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from forward.readable import percent, size
from forward.words import NONE, number, per, with_unit
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pictures, Table, Text
from workflows.report.section import Results, section, written

if TYPE_CHECKING:
    import xarray as xr


@section("derivative", heading="Local sensitivities")
def local_sensitivities(results: Results) -> Iterator[Block]:
    """Effects of parameters, to first order."""
    dataset = results.dataset
    yield Text("Derivatives at the mean parameters: the effect of a parameter to first order.")
    for output in results.drawn:
        yield Heading(output, level=3)
        yield sensitivities(results, output)
    drawn = {output: plots.tornado(dataset, output) for output in results.drawn}
    yield Pictures.of(*((ax, f"Change of {o}, to first order{largest_of(dataset)}.") for o, ax in drawn.items()))


def sensitivities(results: Results, output: str) -> Table:
    """Derivatives of an output, in physical units and times the standard deviation and the range of the parameter."""
    unit, slopes = results.unit(output), results.of(output)
    rows = []
    for name in results.leading(slopes["derivative_per_std"]):
        of_parameter = slopes.sel(parameter=name)
        by = per(unit, results.parameter_unit(name))
        slope = with_unit(number(float(of_parameter["derivative"]), 5), by)
        _, *corrected = results.cells(("derivative",), {"output": output, "parameter": name}, by)
        scaled = [float(of_parameter[f"derivative_per_{spread}"]) for spread in ("std", "range")]
        rows.append((name, slope, *corrected, *(size(value, unit, 4) for value in scaled)))
    head = results.heads({"derivative": "derivative"})
    return Table(("parameter", *head, "× standard deviation", "× range"), rows)


def largest_of(dataset: xr.Dataset) -> str:
    """Say that not all parameters have bars."""
    count = dataset.sizes["parameter"]
    return f", the {plots.BARS} largest of {count}" if count > plots.BARS else ""


@section("field_derivative_rms", heading="Displacement field", level=3)
def local_field(results: Results) -> Iterator[Block]:
    """Effects of parameters on the displacement field, to first order."""
    yield Text(
        "Root mean square of the derivative of the displacement over the body: its L² norm over the root of the volume."
    )
    dataset = results.dataset
    rows = []
    for name in results.leading(dataset["field_derivative_rms"] * dataset["parameter_std"]):
        of_parameter = dataset.sel(parameter=name)
        rms, std, wide = (
            float(of_parameter[key]) for key in ("field_derivative_rms", "parameter_std", "parameter_range")
        )
        slope = with_unit(number(rms, 5), per("m", results.parameter_unit(name)))
        rows.append((name, slope, size(rms * std, "m", 4), size(rms * wide, "m", 4)))
    yield Table(("parameter", "root mean square of the derivative", "× standard deviation", "× range"), rows)


@section("sobol_first", heading="Sobol' indices")
def sobol_indices(results: Results) -> Iterator[Block]:
    """Sobol' indices: tables and pictures by output, shares of all outputs side by side, and those of the field."""
    dataset = results.dataset
    yield Text("The share of the variance due to a parameter alone, and with all its interactions.")
    for output in results.drawn:
        yield Heading(output, level=3)
        yield sobol(results, output)
        if "sobol_second" in dataset:
            yield second_order(results, output)
        caption = f"Indices of {output} with 95 % confidence intervals{largest_of(dataset)}."
        pictures = [(plots.index_bars(dataset, output), caption)]
        if dataset.sizes.get("index_round", 0) > 1:
            caption = f"Indices of {output} against the number of samples, with 95 % confidence bands."
            pictures.append((plots.index_convergence(dataset, output), caption))
        yield Pictures.of(*pictures)
    caption = "Shares of the variance: parameters alone, and the rest."
    yield Pictures.of((plots.index_shares(dataset, results.drawn), caption))


def sobol(results: Results, output: str) -> Table:
    """Sobol' indices of an output, and what they are without the error of the mesh."""
    leading = results.leading(results.of(output)["sobol_total"])
    groups = map(str, results.dataset["group"].values if "group" in results.dataset.coords else ())
    words = {"sobol_first": "first order", "sobol_total": "total"}
    grouped = ("sobol_group_first", "sobol_group_total")
    rows = [(name, *results.cells(list(words), {"output": output, "parameter": name})) for name in leading]
    rows += [(f"group {name}", *results.cells(grouped, {"output": output, "group": name})) for name in groups]
    return Table(("parameter", *results.heads(words)), rows)


def second_order(results: Results, output: str) -> Table:
    """Shares of the variance of an output due to interactions of two parameters."""
    names = results.parameters
    rows = []
    for i, name in enumerate(names):
        for partner in names[i + 1 :]:
            at = {"output": output, "parameter": name, "partner": partner}
            rows.append((name, partner, *results.cells(("sobol_second",), at)))
    head = results.heads({"sobol_second": "second order"})
    return Table(("parameter", "with", *head), rows, text={0, 1})


@section("field_sobol_first", heading="Displacement field", level=3)
def sobol_field(results: Results) -> Iterator[Block]:
    """Generalised Sobol' indices of the displacement field."""
    yield Text("Generalised indices: the variances of all nodes and components together.")
    rows = []
    for name in results.parameters:
        of = results.dataset.sel(parameter=name)
        rows.append((name, *(written(of, f"field_sobol_{which}") for which in ("first", "total"))))
    yield Table(("parameter", "first order", "total"), rows)


@section("shapley", heading="Shapley effects")
def shapley_effects(results: Results) -> Iterator[Block]:
    """Shares of the variance that parameters are responsible for, a column for each output."""
    outputs, of = results.drawn, results.dataset
    yield Text(
        "The share of the variance that a parameter is responsible for, with what it shares with others split "
        "evenly: parameters that are given by the same draws depend on each other, and have no Sobol' indices."
    )
    rows = [
        (name, *(written(of.sel(output=output, parameter=name), "shapley") for output in outputs))
        for name in results.parameters
    ]
    yield Table(("parameter", *outputs), rows)


@section("total_bound", heading="Sensitivity from derivatives")
def derivative_based(results: Results) -> Iterator[Block]:
    """Bounds on total indices, and active subspaces."""
    dataset = results.dataset
    yield Text(
        "The total index of a parameter is at most its mean squared derivative times the Poincaré constant of its "
        "distribution over the variance of the output. The active subspace is spanned by the directions along "
        "which the output changes most, in parameters over their standard deviations."
    )
    for output in results.drawn:
        yield Heading(output, level=3)
        yield bounds(results, output)
        of = results.of(output)
        rows = [(name, written(of.sel(parameter=name), "active_direction")) for name in results.parameters]
        yield Table(("parameter", "leading direction"), rows)
        values = zip(*(of[f"active_eigenvalue{end}"].to_numpy() for end in ("", "_lower", "_upper")), strict=True)
        whole = max(float(of["active_eigenvalue"].sum()), 1e-300)
        spectrum = [
            (str(i), number(value), f"{number(lower)} to {number(upper)}", percent(value / whole))
            for i, (value, lower, upper) in enumerate(values, start=1)
        ]
        yield Table(("direction", "eigenvalue", "95 % range", "share of their sum"), spectrum)
        yield Pictures.of(
            (
                plots.active_summary(dataset, output),
                f"{output} against its leading direction: a curve if only that direction matters.",
            ),
            (plots.spectrum(dataset, output), f"Eigenvalues of the active subspace of {output} with 95 % ranges."),
        )


def bounds(results: Results, output: str) -> Table:
    """Derivative-based measures of an output and the bounds on total indices, beside local and total indices."""
    of_output = results.of(output)
    rows = []
    for name in results.parameters:
        of = of_output.sel(parameter=name)
        slope = per(results.unit(output), results.parameter_unit(name))
        squared = with_unit(written(of, "dgsm"), slope if slope == "1" else f"({slope})²")
        total = written(of, "sobol_total") if "sobol_total" in of else NONE
        bound = results.cells(("total_bound",), {"output": output, "parameter": name})
        share, constant = number(float(of["local_share"])), number(float(of["poincare"]))
        rows.append((name, share, squared, constant, total, *bound))
    head = ("parameter", "share of the local variance", "mean squared derivative", "Poincaré constant")
    bound = results.heads({"total_bound": "is at most"})
    return Table((*head, "total index (expansion)", *bound), rows)
