"""Sobol' indices of the displacement field."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import with_error
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section


class SobolField(Section):
    """Generalised Sobol' indices of the displacement field."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "field_sobol_first" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Displacement field", level=3)
        yield Text("Generalised indices: the variances of all nodes and components together.")
        yield field_sobol(results)


def field_sobol(results: Results) -> Table:
    """Generalised Sobol' indices of the displacement field."""
    rows = []
    for name in results.parameters:
        of = results.dataset.sel(parameter=name)
        pairs = [(of[f"field_sobol_{which}"], of[f"field_sobol_{which}_error"]) for which in ("first", "total")]
        rows.append((name, *(with_error(float(value), float(error)) for value, error in pairs)))
    return Table(("parameter", "first order", "total"), rows)
