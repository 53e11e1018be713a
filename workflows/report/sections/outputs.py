"""Outputs: moments, quantiles and distributions, and what the parameters do to them: derivatives, indices, bounds."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product

import numpy as np

from forward.readable import NONE, and_error, margin, number, per, percent, size, with_unit
from uq.estimators.estimate import estimate_of, part, single
from uq.estimators.moments import half_width
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pictures, Table, Text
from workflows.report.plots.outputs import WORDS
from workflows.report.section import Results, section, written

SPREAD = "Distribution and convergence"


@section("mean", "nominal", heading="Mean and standard deviation")
def moments(results: Results) -> Iterator[Block]:
    """Mean and standard deviation of the outputs, with their errors."""
    yield Text("± is one standard error; a 95\u00a0% interval is about twice as wide on either side.")
    kinds = {str(name): word for name, word in WORDS.items()}
    kinds |= {part(name, "corrected"): f"{word}, error of the mesh added" for name, word in WORDS.items()}
    kinds |= {f"plain_{name}": f"{word}, plain Monte Carlo" for name, word in WORDS.items()}
    yield results.estimates({name: word for name, word in kinds.items() if name in results.dataset})


@section("bias_error", heading="Total errors", level=3)
def total_errors(results: Results) -> Iterator[Block]:
    """Errors of means and standard deviations by source."""
    yield Text("The error of the mesh is estimated from the differences between meshes.")
    rows = []
    for output, (name, word) in product(results.outputs, WORDS.items()):
        one, bias = single(results.of(output), name), "bias_error" if name == "mean" else "std_bias_error"
        errors = (one.error, float(results.of(output)[bias]), one.total)
        rows.append((f"{word} of {output}", *(margin(error, results.unit(output)) for error in errors)))
    yield Table(("estimate", "sampling", "mesh", "total"), rows)


@section("quantiles", heading="Quantiles", level=3)
def quantiles(results: Results) -> Iterator[Block]:
    """Quantiles of the outputs."""
    rows = []
    for output in results.outputs:
        found, unit = estimate_of(results.of(output), "quantiles"), results.unit(output)
        told = [(output, found.value, found.error)]
        if np.isfinite(found.corrected).all():
            told.append((f"{output}, corrected for the mesh", found.corrected, found.left))
        for said, values, errors in told:
            rows.append((said, *(and_error(*one, unit) for one in zip(values, errors, strict=True))))
    yield Table(("output", *(f"{100 * p:g} %" for p in results.dataset["quantile"].to_numpy())), rows)


@section("nominal", heading="Outputs at the mean parameters")
def nominal(results: Results) -> Iterator[Block]:
    """The outputs at the mean parameters."""
    rows = [(output, size(float(results.of(output)["nominal"]), results.unit(output), 6)) for output in results.outputs]
    yield Table(("output", "value"), rows)


@section("values", "nominal", heading=SPREAD, when=lambda results: "density" not in results.dataset)
def distribution(results: Results) -> Iterator[Block]:
    """Samples of the outputs, and how their estimates converge."""
    of = results.dataset
    for output in results.drawn:
        yield Heading(output, level=3)
        samples = plots.histogram(of, output), f"Samples of {output}: density, mean and quantiles."
        mean = plots.convergence(of, output), f"Running mean of {output} with its 95 % confidence band."
        yield Pictures.of(samples, mean, small=True)


@section("density", heading=SPREAD)
def density(results: Results) -> Iterator[Block]:
    """Densities of the outputs by an expansion."""
    drawn = ((plots.histogram(results.dataset, output), output) for output in results.drawn)
    said = ((ax, f"Density of {output} by the expansion, mean and quantiles.") for ax, output in drawn)
    yield Pictures.of(*said, small=True)


@section("variance_ratio")
def control_variate(results: Results) -> Iterator[Block]:
    """What the control variate, or quasi-random points, gain, output by output."""
    dataset, means = results.dataset, "the control variate"
    if "scramble" in dataset:
        means = f"Sobol' points{' and the control variate' if 'coefficient' in dataset else ''}"
        R = int(dataset["scramble"].max()) + 1
        spread = number(100 * (2 / (R - 1)) ** 0.5, 2)
        yield Text(
            f"Errors come from the scatter of {R} independent scrambles, so that their squares are known to about "
            f"{spread} %; a 95 % interval is ± {number(half_width(dataset), 3)} of them."
        )
    if "control_samples" in dataset:
        error, fitted = number(float(dataset["loo_error"].max()), 2), int(dataset["control_samples"])
        yield Text(
            f"The control variate is an expansion fitted to {fitted} separate samples, with a leave-one-out "
            f"error of at most {error} standard deviations."
        )
    for output in results.outputs:
        of = results.of(output)
        ratios = {"mean": float(of["variance_ratio"]), "standard deviation": float(of["std_variance_ratio"])}
        mean, std = (number(ratio, 3) for ratio in ratios.values())
        text = f"{output}: with {means}, one sample is worth {mean} plain samples for the mean and {std} for the"
        worse = " and the ".join(word for word, ratio in ratios.items() if ratio < 1)
        better = f" For the {worse}, plain Monte Carlo is better." if worse else ""
        yield Text(f"{text} standard deviation.{better}", "warning" if worse else "")


@section("multi_index", heading="Polynomial chaos")
def expansion(results: Results) -> Iterator[Block]:
    """The polynomials of an expansion, and their errors."""
    yield Text("The leave-one-out error is that at each sample of the expansion fitted to the others.")
    dataset = results.dataset
    sizes = (f"{int(dataset['order'])}", f"{dataset.sizes['term']}", f"{int(dataset['ok'].sum())}")
    errors = [number(float(error), 2) for error in dataset["loo_error"].sel(output=results.outputs)]
    rows = [(output, *sizes, error) for output, error in zip(results.outputs, errors, strict=True)]
    yield Table(("output", "order", "terms", "samples", "leave-one-out error / standard deviation"), rows)


@section("derivative", heading="Local sensitivities")
def local_sensitivities(results: Results) -> Iterator[Block]:
    """Effects of parameters, to first order."""
    dataset = results.dataset
    yield Text("Derivatives at the mean parameters: the effect of a parameter to first order.")
    for output in results.drawn:
        yield Heading(output, level=3)
        unit, slopes, rows = results.unit(output), results.of(output), []
        for name in results.leading(slopes["derivative_per_std"]):
            one, by = slopes.sel(parameter=name), per(unit, results.parameter_unit(name))
            slope = with_unit(number(float(one["derivative"]), 5), by)
            _, *corrected = results.cells(("derivative",), {"output": output, "parameter": name}, by)
            scaled = (size(float(one[f"derivative_per_{spread}"]), unit, 4) for spread in ("std", "range"))
            rows.append((name, slope, *corrected, *scaled))
        heads = results.heads({"derivative": "derivative"})
        yield Table(("parameter", *heads, "× standard deviation", "× range"), rows)
    drawn = {output: plots.tornado(dataset, output) for output in results.drawn}
    yield Pictures.of(*((ax, f"Change of {o}, to first order{largest_of(results)}.") for o, ax in drawn.items()))


def largest_of(results: Results) -> str:
    """Say that not all parameters have bars."""
    count = len(results.parameters)
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
        kinds = ("field_derivative_rms", "parameter_std", "parameter_range")
        rms, std, wide = (float(dataset[key].sel(parameter=name)) for key in kinds)
        slope = with_unit(number(rms, 5), per("m", results.parameter_unit(name)))
        rows.append((name, slope, size(rms * std, "m", 4), size(rms * wide, "m", 4)))
    yield Table(("parameter", "root mean square of the derivative", "× standard deviation", "× range"), rows)


@section("sobol_first", heading="Sobol' indices")
def sobol_indices(results: Results) -> Iterator[Block]:
    """Sobol' indices: tables and pictures by output, shares of all outputs side by side, and those of the field."""
    dataset, words = results.dataset, {"sobol_first": "first order", "sobol_total": "total"}
    yield Text("The share of the variance due to a parameter alone, and with all its interactions.")
    for output in results.drawn:
        yield Heading(output, level=3)
        leading = results.leading(results.of(output)["sobol_total"])
        groups = map(str, dataset["group"].values if "group" in dataset.coords else ())
        grouped = ("sobol_group_first", "sobol_group_total")
        rows = [(name, *results.cells(words, {"output": output, "parameter": name})) for name in leading]
        rows += [(f"group {name}", *results.cells(grouped, {"output": output, "group": name})) for name in groups]
        yield Table(("parameter", *results.heads(words)), rows)
        if "sobol_second" in dataset:
            second, rows = {"sobol_second": "second order"}, []
            for a, b in combinations(results.parameters, 2):
                rows.append((a, b, *results.cells(second, {"output": output, "parameter": a, "partner": b})))
            yield Table(("parameter", "with", *results.heads(second)), rows, text={0, 1})
        caption = f"Indices of {output} with 95 % confidence intervals{largest_of(results)}."
        pictures = [(plots.index_bars(dataset, output), caption)]
        if dataset.sizes.get("index_round", 0) > 1:
            caption = f"Indices of {output} against the number of samples, with 95 % confidence bands."
            pictures.append((plots.index_convergence(dataset, output), caption))
        yield Pictures.of(*pictures)
    caption = "Shares of the variance: parameters alone, and the rest."
    yield Pictures.of((plots.index_shares(dataset, results.drawn), caption))


@section("field_sobol_first", heading="Displacement field", level=3)
def sobol_field(results: Results) -> Iterator[Block]:
    """Generalised Sobol' indices of the displacement field."""
    yield Text("Generalised indices: the variances of all nodes and components together.")
    of, kinds = results.dataset, ("field_sobol_first", "field_sobol_total")
    rows = [(name, *(written(of.sel(parameter=name), kind) for kind in kinds)) for name in results.parameters]
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
        of, rows = results.of(output), []
        for name in results.parameters:
            one = of.sel(parameter=name)
            slope = per(results.unit(output), results.parameter_unit(name))
            squared = with_unit(written(one, "dgsm"), slope if slope == "1" else f"({slope})²")
            total = written(one, "sobol_total") if "sobol_total" in one else NONE
            bound = results.cells(("total_bound",), {"output": output, "parameter": name})
            share, constant = number(float(one["local_share"])), number(float(one["poincare"]))
            rows.append((name, share, squared, constant, total, *bound))
        head = ("parameter", "share of the local variance", "mean squared derivative", "Poincaré constant")
        heads = results.heads({"total_bound": "is at most"})
        yield Table((*head, "total index (expansion)", *heads), rows)
        rows = [(name, written(of.sel(parameter=name), "active_direction")) for name in results.parameters]
        yield Table(("parameter", "leading direction"), rows)
        values, lower, upper = (of[f"active_eigenvalue{end}"].to_numpy() for end in ("", "_lower", "_upper"))
        whole = max(float(of["active_eigenvalue"].sum()), 1e-300)
        rows = [
            (str(i + 1), number(value), f"{number(lower[i])} to {number(upper[i])}", percent(value / whole))
            for i, value in enumerate(values)
        ]
        yield Table(("direction", "eigenvalue", "95 % range", "share of their sum"), rows)
        caption = f"{output} against its leading direction: a curve if only that direction matters."
        yield Pictures.of((plots.active_summary(dataset, output), caption))
