"""Mean and standard deviation of the outputs, with their errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    pass

CORRECTED = ("mean_corrected", "std_corrected")  # with the estimated error of the mesh


class Moments(Section):
    """Mean and standard deviation of the outputs, with their errors."""

    def applies(self, results: Results) -> bool:
        """Whether the outputs vary."""
        return "mean" in results.dataset and "nominal" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Mean and standard deviation")
        yield Text("± is one standard error; a 95\u00a0% interval is about twice as wide on either side.")
        yield moments(results)


def moments(results: Results) -> Table:
    """Mean and standard deviation of the outputs, with those of plain Monte Carlo beside controlled ones."""
    names = [n for n in ("mean", "std", *CORRECTED, "plain_mean", "plain_std") if n in results.dataset]
    words = {
        "mean": "mean",
        "std": "standard deviation",
        "mean_corrected": "mean, error of the mesh added",
        "std_corrected": "standard deviation, error of the mesh added",
        "plain_mean": "mean, plain Monte Carlo",
        "plain_std": "standard deviation, plain Monte Carlo",
    }
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", *(words[name] for name in names)), rows)
