"""Errors of estimates by source."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import margin
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section


class TotalErrors(Section):
    """Errors of means and standard deviations by source."""

    def applies(self, results: Results) -> bool:
        """Whether the error of the mesh is known."""
        return "bias_error" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Total errors", level=3)
        yield Text("The error of the mesh is estimated from the differences between meshes.")
        yield total_errors(results)


def total_errors(results: Results) -> Table:
    """Errors of means and standard deviations by where they come from."""
    rows = []
    for output in results.outputs:
        of_output = results.of(output)
        for word, first in (("mean", ""), ("standard deviation", "std_")):
            names = (f"{first or 'mean_'}error", f"{first}bias_error", f"{first}total_error")
            errors = [margin(float(of_output[name]), results.unit(output)) for name in names]
            rows.append((f"{word} of {output}", *errors))
    return Table(("estimate", "sampling", "mesh", "total"), rows)
