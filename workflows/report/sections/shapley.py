"""Shapley effects of outputs, where parameters depend on each other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from forward.words import with_error
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr


class ShapleyEffects(Section):
    """Shares of the variance that parameters are responsible for, a column for each output."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "shapley" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        outputs, of = results.drawn, results.dataset
        yield Heading("Shapley effects")
        yield Text(
            "The share of the variance that a parameter is responsible for, with what it shares with others split "
            "evenly: parameters that are given by the same draws depend on each other, and have no Sobol' indices."
        )
        rows = [
            (name, *(_cell(of.sel(output=output, parameter=name)) for output in outputs)) for name in results.parameters
        ]
        yield Table(("parameter", *outputs), rows)


def _cell(one: xr.Dataset) -> str:
    return with_error(float(one["shapley"]), float(one["shapley_error"]))
