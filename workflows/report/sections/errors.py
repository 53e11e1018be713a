"""Errors by their source: sampling, meshes, tolerances."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.readable import NONE, and_error, duration, margin, number, size, spoken
from uq.estimators.estimate import PARTS, estimate_of, holds, single
from uq.findings import NOT_KNOWN, only_rounding
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pairs, Pictures, Table, Text
from workflows.report.section import Results, section, written

MANY = 10.0  # times a value: percentages beyond say nothing
LISTED = 8  # outputs that the sentence names
BY = {"sampling": "sampling", "mesh": "the mesh", "solver": "the solver"}
ESTIMATES = {"mean": "mean", "std": "standard deviation", "nominal": "value at the mean parameters"}


@section("nominal", heading="Error budget", when=lambda results: bool(results.study.spec.meshed))
def error_budget(results: Results) -> Iterator[Block]:
    """The errors of sampling, the mesh and the solver in each estimate."""
    shown = [name for name in ESTIMATES if name in results.dataset]
    shown = shown if shown == ["nominal"] else [name for name in shown if name != "nominal"]
    yield Text(sentence(results, shown[0]))
    counts = counting(results)
    some = counts & np.isin(results.outputs, results.drawn)
    outputs, drawn = np.array(results.outputs), []
    for name in shown:
        found = {by: errors[some] for by, errors in relative(results, name).items()}
        if len(found) > 1 and some.any():
            ax = plots.error_budget(outputs[some].tolist(), found, ESTIMATES[name])
            drawn.append((ax, f"Errors of the {ESTIMATES[name]} by source."))
    if drawn:
        yield Pictures.of(*drawn)
    if any(holds(results.dataset, name, "corrected") for name in shown):
        yield Text(
            "The error of the mesh is the estimated exact minus the computed value, ± its uncertainty. The total "
            "error is √(sampling² + (mesh + uncertainty)²); that of the corrected value, to which the error of the "
            "mesh is added, is √(sampling² + uncertainty²). All are on the scale of standard errors."
        )
        rows = []
        for output, name in product(outputs[counts].tolist(), shown):
            one, unit = single(results.of(output), name), results.unit(output)
            total = abs(one.mesh) + one.doubt if name == "nominal" else one.total  # where nothing is sampled
            value = results.value(output, one.value, total if np.isfinite(total) else one.error)
            sampling, whole = (margin(error, unit, like=one.value) for error in (one.error, total))
            of_mesh, corrected = "not known", NONE
            if np.isfinite(one.mesh):
                of_mesh = and_error(one.mesh, one.doubt, unit, like=one.value)
                corrected = and_error(one.corrected, one.left, unit)
            rows.append((f"{ESTIMATES[name]} of {output}", value, sampling, of_mesh, whole, corrected))
        yield Table(("estimate", "value", "sampling", "mesh", "total error", "corrected"), rows)


def parts_of(results: Results, name: str) -> dict[str, FloatArray]:
    """Return the errors of an estimate by source, for each output (m,); NaN where they are not estimated."""
    one, tolerance = estimate_of(results.dataset, name), results.study.model.solver_tolerance
    there = {which for which in PARTS if holds(results.dataset, name, which)}
    found = {"sampling": one.error} if "error" in there else {}
    if "mesh" in there:  # as it is in the total
        found["mesh"] = np.abs(one.mesh) + (one.doubt if "doubt" in there else 0.0)
    if tolerance is not None:
        found["solver"] = tolerance * np.abs(one.value)
    return found | ({"total": one.total} if "total" in there else {})


def counting(results: Results) -> NDArray[np.bool_]:
    """Say which outputs (m,) are more than rounding."""
    return ~only_rounding(results.dataset, {output: results.unit(output) for output in results.outputs})


def relative(results: Results, name: str) -> dict[str, FloatArray]:
    """Return the errors relative to the estimate, or to the standard deviation if that is larger than a mean."""
    size = np.abs(results.dataset[name].to_numpy())
    if name == "mean":
        size = np.maximum(size, results.dataset["std"].to_numpy())
    size = np.where(size > 0, size, np.nan)
    return {source: errors / size for source, errors in parts_of(results, name).items()}


def sentence(results: Results, name: str) -> str:
    """Say which source is the largest for each output."""
    found = relative(results, name)
    total = found.pop("total", None)
    if "mesh" not in found:
        asked = results.study.accuracy.mesh_error
        why = "is not known here" if asked else "was not estimated, as asked (accuracy.mesh_error = false)"
        return f"The error of the mesh {why}: the numbers after ± do not include it."
    words, zero, counts = [], [], counting(results)
    for i, output in enumerate(results.outputs):
        if output not in results.drawn:
            continue
        known = {source: float(errors[i]) for source, errors in found.items() if np.isfinite(errors[i])}
        if not counts[i]:
            zero.append(output)
        elif "mesh" not in known:
            words.append(f"{output} ({NOT_KNOWN})")
        else:
            largest = max(known, key=known.__getitem__)
            whole = float(total[i]) if total is not None else known[largest]
            share = f"to {100 * whole:.2g}\u00a0%" if whole < MANY else f"to no better than {MANY:.0f} times its size"
            words.append(f"{output} is known {share}, most of it by {BY[largest]}")
    if len(words) > LISTED + 1:
        words = [*words[:LISTED], f"the other {len(words) - LISTED} are in the table"]
    said = [f"Of the {ESTIMATES[name]}, {'; '.join(words)}."] if words else []
    if zero:
        said.append(f"Zero but for rounding: {', '.join(zero)}.")
    return " ".join(said)


@section(heading="Tolerance", when=lambda results: "accuracy" in results.summary)
def tolerance(results: Results) -> Iterator[Block]:
    """The budget of a tolerance."""
    told = results.summary["accuracy"]
    worst = f"the {told['worst']['of']} of {told['worst']['output']}"
    asked, reached = number(100 * told["tolerance"]), number(100 * told["reached"], 2)
    yield Text(
        f"Asked for: {asked} % of every mean and standard deviation, all errors together, at 95 %. "
        f"{'Kept' if told['kept'] else 'Not kept'}: {worst} is known to {reached} %, no other less well.",
        "lead" if told["kept"] else "warning",
    )
    for name, share in told.get("unmet", {}).items():
        missed = f"what happens in up to {number(100 * share, 2)} % of all cases may be missed"
        yield Text(f"All samples of {name} are the same: {missed}.", "warning")
    if told["mesh"] is not None and not told["mesh"]["estimated"]:
        yield Text("The error of the mesh is not known, and not counted.", "warning")
    seconds = results.summary.get("accuracy_seconds", {})
    costs = [f"{source}: {number(value, 3)} s of processor time" for source, value in seconds.items()]
    yield Pairs([("why", told["reasons"]), *([("what it took", costs)] if costs else [])])
    rows = []
    for name, estimate, of in ((n, e, of) for n, estimates in told["outputs"].items() for e, of in estimates.items()):
        shares = (f"{100 * of[source]:.2g} %" for source in ("mesh", "sampling", "total"))
        value = and_error(of["value"], of["error"], results.unit(name))
        rows.append((f"{ESTIMATES[estimate]} of {name}", value, *shares))
    yield Table(("estimate", "value ± 95 %", "mesh", "sampling", "in all"), rows)
    if told["mesh"] is not None:
        yield Text("Values are corrected by the estimated error of the mesh. Shares are of the tolerance.")


@section("mesh_samples", heading="Meshes")
def meshes(results: Results) -> Iterator[Block]:
    """The meshes of a multilevel method, and the contribution of each."""
    dataset, told = results.dataset, results.summary["meshes"]
    seconds = [one["cpu_seconds"] / max(one["solves"], 1) for one in told]
    yield Table.of(
        range(len(told)),
        {
            "level": lambda i: f"{dataset['level'].values[i]}",
            "unknowns": lambda i: f"{told[i]['unknowns']:,}",
            "samples": lambda i: f"{int(dataset['mesh_samples'][i]):,}",
            "failed": lambda i: f"{int(dataset['mesh_failed'][i]):,}",
            "solves": lambda i: f"{told[i]['solves']:,}",
            "a solve, predicted": lambda i: f"{float(dataset['mesh_cost'][i]):.2g} s",
            "a solve, measured (with the linearisation)": lambda i: duration(seconds[i]),
        },
    )
    for output in results.outputs:
        yield Heading(output, level=3)
        of = results.of(output)
        weak, strong, cost = (float(of[f"{name}_rate"]) for name in ("weak", "strong", "cost"))
        yield Text(
            f"From one mesh to the next, the mean difference falls by 2^{weak:.2f}, its variance by 2^{strong:.2f}, "
            f"and the predicted cost of a solve grows by 2^{cost:.2f}. A consistency below 1 confirms that the sum "
            "over the meshes telescopes."
        )
        rest = {
            "variance": "mesh_variance",
            "variance of the difference": "difference_variance",
            "÷ by the control": "difference_variance_ratio",
            "kurtosis": "difference_kurtosis",
            "consistency": "consistency",
        }
        rows = []
        for level in dataset["level"].to_numpy():
            here = of.sel(level=level)
            text = written(here, "difference_mean", results.unit(output))
            rows.append((f"{level}", text, *(number(float(here[name]), 3) for name in rest.values())))
        yield Table(("level", "mean of the difference", *rest), rows)
        yield Pictures.of(
            (plots.mesh_variance(dataset, output), f"Variance of {output} and of its difference between meshes."),
            (plots.mesh_mean(dataset, output), f"Mean of {output} and of its difference between meshes."),
            (plots.mesh_samples(dataset, output), "Samples on every mesh: taken, and optimal for other errors."),
            (plots.mesh_cost(dataset, output), "Predicted time of sampling, without linearisations."),
        )


@section("probability", "mesh_checked", heading="Effect of a finer mesh", level=3)
def finer_meshes(results: Results) -> Iterator[Block]:
    """The effect of a finer mesh on data, evidence and unknowns of each candidate."""
    from inverse.criticism.doubts import change_in_words

    dataset = results.dataset
    yield Text(
        "Solves of each candidate at its mode on finer meshes, with thinner cells at the faces that are held: the "
        "error of its mesh, and what correcting it does. Where a candidate is corrected, evidence and unknowns "
        "above are those of the corrected one; elsewhere it is what correcting it would do, to first order."
    )
    rows = []
    for model in dataset.model.values:
        one = dataset.sel(model=model).isel(group=0)
        if not bool(one["mesh_checked"]):
            rows.append((str(model), "no", NONE, NONE, NONE, f"not checked: {one['mesh_why'].item()}"))
            continue
        error, shift = one["mesh_error"].to_numpy(), one["mesh_shift"].dropna("parameter")
        shifts = [(spoken(str(name)), float(shift.sel(parameter=name))) for name in shift.parameter.values]
        listed = [f"{name} {by:+.2g}".replace(" -", " −") for name, by in shifts]
        size, most = (f"{value:.2g}" for value in (float(np.sqrt(np.nanmean(error**2))), float(np.nanmax(abs(error)))))
        moved = change_in_words(float(one["mesh_log_evidence"]), float(abs(shift).max()))
        corrected = "yes" if bool(one["mesh_corrected"]) else "no"
        rows.append((str(model), corrected, moved, size, most, ", ".join(listed)))
    unknowns = "unknowns, in deviations of the posterior"
    head = ("model", "corrected", "ln Z", "data, over the errors", "at most", unknowns)
    yield Table(head, rows, text={0, 1, 5}, long={5})


@section("mesh_indicator", heading="The mesh")
def adapted_mesh(results: Results) -> Iterator[Block]:
    """How the mesh was refined, what errors are left, and where they come from."""
    from workflows.report.bodies import refined

    dataset, adapt = results.dataset, results.study.model.adapt
    by = "their contributions to these errors" if adapt.indicator == "dual-weighted" else "the jumps of stresses"
    yield Text(
        "Solved at the mean of the parameters, and refined where cells have most of the estimated error, by "
        f"{by}. An error is the exact minus the discrete value, estimated with elements of one degree higher; it "
        "is not a bound. It does not include the part of a curved body that a coarse mesh cuts off."
    )
    rows = []
    for k, told in enumerate(results.summary["adapted"]["cycles"]):
        found = []
        for output in results.outputs:
            here = dataset.isel(cycle=k).sel(output=output)
            at, unit = single(here, "cycle_value"), results.unit(output)
            sign = "+" if at.mesh > 0 else ""
            found += [size(at.value, unit, 4), NONE if np.isnan(at.mesh) else sign + size(at.mesh, unit, like=at.value)]
        rows.append((f"{told['cells']:,}", f"{told['unknowns']:,}", duration(told["cpu_seconds"]), *found))
    head = ("cells", "unknowns", "processor time")
    yield Table((*head, *(word for output in results.outputs for word in (output, "error"))), rows, text=())
    named = [results.study.model.outputs[i].name for i in adapt.named(results.study.model)]
    yield Pictures.of((plots.refinement(dataset, named, adapt.tolerance), "Estimated errors, mesh by mesh."))
    whole = "The mesh; cells in bright colours contribute most to the error, for their volume."
    behind = "What is behind the cell that contributes most."
    yield Pictures.of((refined(dataset), whole), (refined(dataset, cut=True), behind))
