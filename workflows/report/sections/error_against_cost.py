"""Errors of methods against their costs."""

from __future__ import annotations

import math
from collections.abc import Iterator

from forward.readable import size
from forward.words import NONE, duration, number, with_error, with_unit
from uq.estimators.scores import gains, plain_samples
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section


class ErrorAgainstCost(Section):
    """Errors of several methods against their cost."""

    def applies(self, results: Results) -> bool:
        """Whether methods were compared."""
        return "row_method" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """The reference, and pictures and a table for each estimate of each output."""
        yield Heading("Error against cost")
        yield Text(
            "The reference, with its own standard errors; the error due to the tolerance of the solver (against the "
            "textbook solver, on some draws); the error of the mesh, by estimate or (method.mesh_error) by a "
            "mesh of twice the cells in each direction at the mean parameters."
        )
        yield references(results)
        yield Text(
            "RMSE is the root mean square error of the repeats against the reference, “claimed” the standard error "
            "that the method itself gives, coverage the share of its 95\u00a0% intervals that contain the reference. "
            "Errors below twice that of the reference are not resolved. A gain is the cost of plain Monte Carlo at "
            "equal error (by its exact rate) over the cost of the method, with its set-up: in solves, in processor "
            "time, and in processor time if plain Monte Carlo uses the textbook solver. The rate is the slope of "
            "ln RMSE over ln solves. Rows with the textbook solver are derived from the solves of plain Monte Carlo."
        )
        costs: dict[str, plots.Cost] = {"the number of solves": "solves", "processor time": "cpu_seconds"}
        words: dict[str, plots.Estimated] = {"mean": "mean", "standard deviation": "std"}
        for output in results.outputs:
            for word, estimated in words.items():
                yield Heading(f"{output}: {word}", level=3)
                yield Pictures(
                    [
                        Picture.drawn(
                            plots.errors(results.dataset, output, estimated, against),
                            f"Error of the {word} of {output} against {cost}.",
                        )
                        for cost, against in costs.items()
                    ]
                )
                yield errors(results, output, estimated)


def references(results: Results) -> Table:
    """The references, and the errors of the solver and the mesh."""
    rows = []
    for output in results.outputs:
        of_output, unit = results.of(output), results.unit(output)
        floors = (size(abs(float(of_output[f"{name}_error"])), unit) for name in ("solver", "mesh"))
        rows.append((output, *(results.estimate(output, name) for name in ("mean", "std")), *floors))
    return Table(("output", "mean", "standard deviation", "error of the solver", "error of the mesh"), rows)


def errors(results: Results, output: str, estimated: str) -> Table:
    """Error and cost of each method at each budget, for one estimate of an output."""
    dataset = results.of(output)
    scale = abs(float(dataset[estimated]))
    plain, gained = plain_samples(dataset, estimated).to_numpy(), gains(dataset, estimated)
    methods = dataset["row_method"].to_numpy().tolist()
    rates = {}
    for name in dataset["estimator"].to_numpy().tolist():
        of_method = dataset.sel(estimator=name)
        rates[name] = with_error(*(float(of_method[f"{estimated}_rate{end}"]) for end in ("", "_error")))
    rows = []
    for i, name in enumerate(methods):
        row = dataset.isel(row=i)
        rmse, resolved = float(row[f"{estimated}_rmse"]), bool(row[f"{estimated}_resolved"])
        coverage = NONE
        if resolved:
            coverage = f"{100 * float(row[f'{estimated}_coverage']):.0f} %"
            coverage += " (understated)" if bool(row[f"{estimated}_understated"]) else ""
        bound = "" if resolved else "≥ "
        ratios = [plain[i], *(float(gain[i]) for gain in gained.values())]
        rows.append(
            (
                name,
                f"{int(row['budget']):,}",
                f"{int(row['solves']):,}",
                duration(float(row["cpu_seconds"])),
                number(rmse, 2) + ("" if resolved else " (not resolved)"),
                number(rmse / scale if scale else float("nan"), 2),
                number(float(row[f"{estimated}_claimed"]), 2),
                coverage,
                *(NONE if math.isnan(ratio) else bound + number(ratio, 2) for ratio in ratios),
                rates[name] if name not in methods[i + 1 :] else "",
            )
        )
    head = (
        "method",
        "samples",
        "solves",
        "CPU time",
        with_unit("RMSE", f"({results.unit(output)})"),
        "relative",
        "claimed",
        "coverage",
        "plain samples for this error",
        "gain in solves",
        "gain in CPU time",
        "gain over the textbook",
        "rate",
    )
    return Table(head, rows)
