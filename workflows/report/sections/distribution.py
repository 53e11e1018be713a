"""Samples of the outputs, and how their estimates converge."""

from __future__ import annotations

from collections.abc import Iterator

from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures
from workflows.report.section import Results, Section


class Distribution(Section):
    """Samples of the outputs, and how their estimates converge."""

    def applies(self, results: Results) -> bool:
        """Whether there are samples, and no expansion."""
        return {"values", "nominal"} <= set(results.dataset) and "density" not in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Pictures of each output."""
        dataset = results.dataset
        yield Heading("Distribution and convergence")
        for output in results.drawn:
            yield Heading(output, level=3)
            samples = f"Samples of {output}: density, mean and quantiles."
            running = f"Running mean of {output} with its 95 % confidence band."
            pictures = [
                Picture.drawn(plots.histogram(dataset, output), samples),
                Picture.drawn(plots.convergence(dataset, output), running),
                Picture.drawn(plots.standard_error(dataset, output), f"Standard error of the mean of {output}."),
            ]
            yield Pictures(pictures, small=True)
