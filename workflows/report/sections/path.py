"""Outputs over the steps of a path."""

from __future__ import annotations

from collections.abc import Iterator

from forward.path import Path
from forward.readable import spoken
from workflows.report.blocks import Block, Heading, Picture, Pictures, Text
from workflows.report.plots import path as plots
from workflows.report.section import Results, Section


class Curve(Section):
    """Curves with bands, and which parameters matter at which step."""

    def applies(self, results: Results) -> bool:
        """Whether there are steps."""
        drawn = {"mean", "nominal"} & set(results.dataset.variables)
        return "output_of" in results.dataset.coords and bool(drawn) and isinstance(results.study.model, Path)

    def content(self, results: Results) -> Iterator[Block]:
        """For each output a curve and, where they were computed, indices or derivatives."""
        dataset, spec = results.dataset, results.study.model
        along = spec.leading
        unit = spec.unit_of(along)
        yield Heading("Over the path")
        yield Text(f"{spoken(along)}: {spec.in_words(along)}; every step is solved from the one before.")
        drawn = []
        for output in dict.fromkeys(dataset["output_of"].to_numpy().tolist()):
            caption = f"Over the path: {output}."
            drawn.append(Picture.drawn(plots.curve(dataset, output, along, unit), caption))
            if "sobol_total" in dataset:
                caption = f"Which parameters the variance of {output} is due to, step by step; 95 % intervals."
                drawn.append(Picture.drawn(plots.shares(dataset, output, along, unit), caption))
            elif "derivative_per_std" in dataset:
                caption = f"What moves {output}, step by step."
                drawn.append(Picture.drawn(plots.slopes(dataset, output, along, unit), caption))
        yield Pictures(drawn)
