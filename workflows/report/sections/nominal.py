"""The outputs at the mean parameters."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import size
from workflows.report.blocks import Block, Heading, Table
from workflows.report.section import Results, Section


class Nominal(Section):
    """The outputs at the mean parameters."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "nominal" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Outputs at the mean parameters")
        yield nominal(results)


def nominal(results: Results) -> Table:
    """Outputs at the mean parameters."""
    values = results.dataset["nominal"].to_numpy()
    rows = [(o, size(float(v), results.unit(o), 6)) for o, v in zip(results.outputs, values, strict=True)]
    return Table(("output", "value"), rows)
