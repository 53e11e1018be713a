"""Densities of the outputs by an expansion."""

from __future__ import annotations

from collections.abc import Iterator

from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures
from workflows.report.section import Results, Section


class Density(Section):
    """Densities of the outputs by an expansion."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "density" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A picture of each output."""
        yield Heading("Distribution and convergence")
        drawn = [
            Picture.drawn(
                plots.histogram(results.dataset, output), f"Density of {output} by the expansion, mean and quantiles."
            )
            for output in results.drawn
        ]
        yield Pictures(drawn, small=True)
