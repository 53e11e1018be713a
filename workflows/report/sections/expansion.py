"""The polynomials of an expansion."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import number
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section


class Expansion(Section):
    """The polynomials of an expansion, and their errors."""

    def applies(self, results: Results) -> bool:
        """Whether there is one."""
        return "multi_index" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Polynomial chaos")
        yield Text("The leave-one-out error is that at each sample of the expansion fitted to the others.")
        yield expansion(results)


def expansion(results: Results) -> Table:
    """The polynomials of an expansion and their errors, output by output."""
    dataset = results.dataset
    used, order = int(dataset["ok"].sum()), int(dataset["order"])
    rows = [
        (
            output,
            f"{order}",
            f"{dataset.sizes['term']}",
            f"{used}",
            number(float(dataset["loo_error"].sel(output=output)), 2),
        )
        for output in results.outputs
    ]
    return Table(("output", "order", "terms", "samples", "leave-one-out error / standard deviation"), rows)
