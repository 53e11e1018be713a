"""Effects of parameters on the displacement field, to first order."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import size
from forward.words import number, per, with_unit
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section


class LocalField(Section):
    """Effects of parameters on the displacement field, to first order."""

    def applies(self, results: Results) -> bool:
        """Whether its derivatives are known."""
        return "field_derivative_rms" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Displacement field", level=3)
        yield Text(
            "Root mean square of the derivative of the displacement over the body: its L² norm over the root of the "
            "volume."
        )
        yield field_norms(results)


def field_norms(results: Results) -> Table:
    """Root mean squares over the body of the derivatives of the displacement field."""
    dataset = results.dataset
    rows = []
    for name in results.leading(dataset["field_derivative_rms"] * dataset["parameter_std"]):
        of_parameter = dataset.sel(parameter=name)
        rms, std, wide = (
            float(of_parameter[key]) for key in ("field_derivative_rms", "parameter_std", "parameter_range")
        )
        slope = with_unit(number(rms, 5), per("m", results.parameter_unit(name)))
        rows.append((name, slope, size(rms * std, "m", 4), size(rms * wide, "m", 4)))
    return Table(("parameter", "root mean square of the derivative", "× standard deviation", "× range"), rows)
