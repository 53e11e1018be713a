"""Pressure under tools."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import number
from workflows.report.blocks import Block, Heading, Picture, Pictures
from workflows.report.plots.contact import pressure_map
from workflows.report.section import Results, Section


class Contact(Section):
    """A map of the pressure of each tool."""

    def applies(self, results: Results) -> bool:
        """Whether points under tools are known, and some are pressed."""
        return "contact_pressure" in results.dataset and bool((results.dataset["contact_pressure"] > 0).any())

    def content(self, results: Results) -> Iterator[Block]:
        """A map for each tool that touches the body."""
        dataset = results.dataset
        directions = {load.label: load.direction for load in results.study.spec.loads if load.contact}
        yield Heading("Pressure under the tool")
        drawn = []
        for tool, direction in directions.items():
            pressure = dataset["contact_pressure"].to_numpy()[dataset["contact_tool"].to_numpy() == tool]
            if not (pressure > 0).any():
                continue
            last = " at the last step" if "step" in dataset.coords else ""
            caption = (
                f"Pressure of {tool} at the mean of the inputs{last}, at most {number(float(pressure.max()))} Pa, on "
                "the undeformed boundary, per area of it; dots are the vertices of the mesh, between which it is drawn "
                "linearly."
            )
            drawn.append(Picture.drawn(pressure_map(dataset, tool, direction), caption))
        yield Pictures(drawn)
