"""The sources of the errors of all results that follow."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.readable import and_error, margin, quantity, size
from forward.words import NONE
from uq.estimators.rounding import only_rounding
from uq.findings import DIGITS, NOT_KNOWN
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr

FIRST = {"std": "std_", "nominal": "nominal_"}  # of the names of an estimate's mesh and total error
MANY = 10.0  # times a value: percentages beyond say nothing
LISTED = 8  # outputs that the sentence names
BY = {"sampling": "sampling", "mesh": "the mesh", "solver": "the solver"}
ESTIMATES = {"mean": "mean", "std": "standard deviation", "nominal": "value at the mean parameters"}


class ErrorBudget(Section):
    """The errors of sampling, the mesh and the solver in each estimate."""

    def applies(self, results: Results) -> bool:
        """Whether outputs of one body were estimated."""
        return "nominal" in results.dataset and bool(results.study.spec.meshed)

    def content(self, results: Results) -> Iterator[Block]:
        """A sentence, a picture and a table."""
        shown = [name for name in ESTIMATES if name in results.dataset]
        shown = shown if shown == ["nominal"] else [name for name in shown if name != "nominal"]
        yield Heading("Error budget")
        yield Text(sentence(results, shown[0]))
        counts = counting(results) & np.isin(results.outputs, results.drawn)
        outputs = [output for output, one in zip(results.outputs, counts, strict=True) if one]
        budgets = {name: found for name in shown if len(found := relative(results, name)) > 1}
        if budgets and outputs:
            yield Pictures(
                [
                    Picture.drawn(
                        plots.error_budget(outputs, {by: e[counts] for by, e in found.items()}, ESTIMATES[name]),
                        f"Errors of the {ESTIMATES[name]} by source.",
                    )
                    for name, found in budgets.items()
                ]
            )
        if any(f"{name}_corrected" in results.dataset for name in shown):
            yield Text(
                "The error of the mesh is the estimated exact minus the computed value, ± its uncertainty. The total "
                "error is √(sampling² + (mesh + uncertainty)²); that of the corrected value, to which the error of the "
                "mesh is added, is √(sampling² + uncertainty²). All are on the scale of standard errors."
            )
            yield table(results, shown)


def parts_of(results: Results, name: str) -> dict[str, FloatArray]:
    """Return the errors of an estimate by source, for each output (m,); NaN where they are not estimated."""
    dataset, first = results.dataset, FIRST.get(name, "")
    found = {}
    if f"{name}_error" in dataset:
        found["sampling"] = dataset[f"{name}_error"].to_numpy()
    if f"{first}mesh_error" in dataset:
        found["mesh"] = np.abs(dataset[f"{first}mesh_error"].to_numpy())
        if f"{first}mesh_error_doubt" in dataset:  # as it is in the total
            found["mesh"] += dataset[f"{first}mesh_error_doubt"].to_numpy()
    tolerance = getattr(getattr(results.study.model, "solver", None), "tolerance", None)
    if tolerance is not None:
        found["solver"] = tolerance * np.abs(dataset[name].to_numpy())
    if f"{first}total_error" in dataset:
        found["total"] = dataset[f"{first}total_error"].to_numpy()
    return found


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
        why = "is not known here"
        if not getattr(results.study, "accuracy", None) or not results.study.accuracy.mesh_error:
            why = "was not estimated, as asked (accuracy.mesh_error = false)"
        return f"The error of the mesh {why}: the numbers after ± do not include it."
    words, zero = [], []
    for i, (output, counts) in enumerate(zip(results.outputs, counting(results), strict=True)):
        if output not in results.drawn:
            continue
        known = {source: float(errors[i]) for source, errors in found.items() if np.isfinite(errors[i])}
        if not counts:
            zero.append(output)
        elif "mesh" not in known:
            words.append(f"{output} ({NOT_KNOWN})")
        else:
            largest = max(known, key=lambda source: known[source])
            whole = float(total[i]) if total is not None else known[largest]
            share = f"to {100 * whole:.2g}\u00a0%" if whole < MANY else f"to no better than {MANY:.0f} times its size"
            words.append(f"{output} is known {share}, most of it by {BY[largest]}")
    if len(words) > LISTED + 1:
        words = [*words[:LISTED], f"the other {len(words) - LISTED} are in the table"]
    said = [f"Of the {ESTIMATES[name]}, {'; '.join(words)}."] if words else []
    if zero:
        said.append(f"Zero but for rounding: {', '.join(zero)}.")
    return " ".join(said)


def table(results: Results, names: list[str]) -> Table:
    """The errors of each estimate, and its corrected value."""
    rows = []
    for output in np.array(results.outputs)[counting(results)].tolist():
        of_output, unit = results.of(output), results.unit(output)

        def known(name: str, of_output: xr.Dataset = of_output) -> float:
            return float(of_output[name]) if name in of_output else np.nan

        for name in names:
            value, first = known(name), FIRST.get(name, "")
            error, doubt = (known(f"{first}mesh_error{end}") for end in ("", "_doubt"))
            corrected, its_error = known(f"{name}_corrected"), known(f"{name}_corrected_error")
            total = known(f"{first}total_error")
            if name == "nominal":  # where nothing is sampled
                its_error, total = doubt, abs(error) + doubt
            rows.append(
                (
                    f"{ESTIMATES[name]} of {output}",
                    size(value, unit, DIGITS)
                    if results.meshes_unknown.get(output)
                    else quantity(value, total if np.isfinite(total) else known(f"{name}_error"), unit),
                    margin(known(f"{name}_error"), unit, like=value),
                    "not known" if np.isnan(error) else and_error(error, doubt, unit, like=value),
                    margin(total, unit, like=value),
                    NONE if np.isnan(error) else and_error(corrected, its_error, unit),
                )
            )
    head = ("estimate", "value", "sampling", "mesh", "total error", "corrected")
    return Table(head, rows)
