"""The sources of the errors of all results that follow."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.model import FloatArray
from forward.words import NONE, number, with_error, with_unit
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section

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
        budgets = {name: found for name in shown if len(found := relative(results, name)) > 1}
        if budgets:
            yield Pictures(
                [
                    Picture.drawn(
                        plots.error_budget(results.outputs, found, ESTIMATES[name]),
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
    """Return the errors of an estimate by source, for each output (m,); NaN if unknown."""
    dataset, first = results.dataset, {"std": "std_", "nominal": "nominal_"}.get(name, "")
    found = {}
    if f"{name}_error" in dataset:
        found["sampling"] = dataset[f"{name}_error"].to_numpy()
    if f"{first}mesh_error" in dataset:
        found["mesh"] = np.abs(dataset[f"{first}mesh_error"].to_numpy())
    tolerance = getattr(getattr(results.study.model, "solver", None), "tolerance", None)
    if tolerance is not None:
        found["solver"] = tolerance * np.abs(dataset[name].to_numpy())
    if f"{first}total_error" in dataset:
        found["total"] = dataset[f"{first}total_error"].to_numpy()
    return found


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
    words = []
    for i, output in enumerate(results.outputs):
        known = {source: float(errors[i]) for source, errors in found.items() if np.isfinite(errors[i])}
        if "mesh" not in known:
            words.append(f"{output} (the error of its mesh is not estimated)")
            continue
        largest = max(known, key=lambda source: known[source])
        whole = float(total[i]) if total is not None else known[largest]
        words.append(f"{output} is known to {100 * whole:.2g}\u00a0%, most of it by the {largest}")
    return f"Of the {ESTIMATES[name]}, {'; '.join(words)}."


def table(results: Results, names: list[str]) -> Table:
    """The errors of each estimate, and its corrected value."""
    rows = []
    for output in results.outputs:
        of_output, unit = results.dataset.sel(output=output), results.unit(output)
        for name in names:
            first = "std_" if name == "std" else ""
            error, doubt = (float(of_output[f"{first}mesh_error{end}"]) for end in ("", "_doubt"))
            corrected = (float(of_output[f"{name}_corrected{end}"]) for end in ("", "_error"))
            rows.append(
                (
                    f"{ESTIMATES[name]} of {output}",
                    with_unit(number(float(of_output[name]), 6), unit),
                    with_unit(number(float(of_output[f"{name}_error"]), 2), unit),
                    NONE if np.isnan(error) else with_unit(with_error(error, doubt), unit),
                    with_unit(number(float(of_output[f"{first}total_error"]), 2), unit),
                    NONE if np.isnan(error) else with_unit(with_error(*corrected), unit),
                )
            )
    head = ("estimate", "value", "sampling", "mesh", "total error", "corrected")
    return Table(head, rows)
