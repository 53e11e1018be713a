"""Several studies side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from forward.readable import size
from forward.words import NONE, duration
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pictures, Table, Text
from workflows.report.section import Results


def applies(results: Results) -> bool:
    """Whether a study estimates outputs of one model."""
    return "nominal" in results.dataset


def content(studies: Mapping[str, Results]) -> Iterator[Block]:
    """Costs, and then the estimates of each output."""
    yield costs(studies)
    yield Text("± is one standard error.")
    for output in dict.fromkeys(output for results in studies.values() for output in results.outputs):
        yield Heading(output)
        yield estimates(studies, output)
        datasets = {n: r.dataset for n, r in studies.items() if output in r.outputs and "mean" in r.dataset}
        if datasets:
            yield Pictures.of(
                (plots.comparison(datasets, output, "mean"), f"Mean of {output}, with 95 % confidence intervals."),
                (plots.comparison(datasets, output, "std"), f"Standard deviation of {output}, likewise."),
            )


def costs(studies: Mapping[str, Results]) -> Table:
    """Methods and costs of several studies."""
    told = {name: results.summary for name, results in studies.items()}
    return Table.of(
        told,
        {
            "study": str,
            "method": lambda name: str(told[name]["method"]),
            "solves": lambda name: f"{told[name]['evaluations']:,}",
            "failed": lambda name: f"{told[name]['failed']:,}",
            "CPU time": lambda name: duration(told[name]["cpu_seconds"]),
            "wall time": lambda name: duration(told[name]["wall_seconds"]),
        },
        text={0, 1},
    )


def estimates(studies: Mapping[str, Results], output: str) -> Table:
    """Estimates of an output by several studies."""
    rows: list[tuple[str, ...]] = []
    for name, results in studies.items():
        if output not in results.outputs:
            rows.append((name, NONE, NONE, NONE))
            continue
        central = size(float(results.dataset["nominal"].sel(output=output)), results.unit(output), 6)
        shown = [results.estimate(output, n) if n in results.dataset else NONE for n in ("mean", "std")]
        rows.append((name, *shown, central))
    return Table(("study", "mean", "standard deviation", "at the mean parameters"), rows)
