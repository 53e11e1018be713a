"""Effects of parameters, to first order."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from forward.readable import size
from forward.words import number, per, with_unit
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr


class LocalSensitivities(Section):
    """Effects of parameters, to first order."""

    def applies(self, results: Results) -> bool:
        """Whether there are derivatives."""
        return "derivative" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Tables of each output, and tornado charts."""
        dataset = results.dataset
        yield Heading("Local sensitivities")
        yield Text("Derivatives at the mean parameters: the effect of a parameter to first order.")
        for output in results.drawn:
            yield Heading(output, level=3)
            yield sensitivities(results, output)
        captions = {output: f"Change of {output}, to first order{largest_of(dataset)}." for output in results.drawn}
        yield Pictures([Picture.drawn(plots.tornado(dataset, o), caption) for o, caption in captions.items()])


def sensitivities(results: Results, output: str) -> Table:
    """Derivatives of an output, in physical units and times the standard deviation and the range of the parameter."""
    unit, slopes = results.unit(output), results.of(output)
    rows = []
    for name in results.leading(slopes["derivative_per_std"]):
        of_parameter = slopes.sel(parameter=name)
        by = per(unit, results.parameter_unit(name))
        slope = with_unit(number(float(of_parameter["derivative"]), 5), by)
        corrected = results.corrected("derivative", {"output": output, "parameter": name}, by)
        scaled = [float(of_parameter[f"derivative_per_{spread}"]) for spread in ("std", "range")]
        rows.append((name, slope, *corrected, *(size(value, unit, 4) for value in scaled)))
    known = ("corrected for the mesh",) if "derivative_corrected" in results.dataset else ()
    return Table(("parameter", "derivative", *known, "× standard deviation", "× range"), rows)


def largest_of(dataset: xr.Dataset) -> str:
    """Say that not all parameters have bars."""
    count = dataset.sizes["parameter"]
    return f", the {plots.BARS} largest of {count}" if count > plots.BARS else ""
