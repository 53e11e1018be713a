"""The mesh that was refined before the study."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.readable import size
from forward.words import NONE, duration
from workflows.report import bodies, plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section
from workflows.report.sections.body import NO_BODY


class AdaptedMesh(Section):
    """How the mesh was refined, what errors are left, and where they come from."""

    def applies(self, results: Results) -> bool:
        """Whether a mesh was refined."""
        return "mesh_indicator" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table of meshes, a picture of their errors, and the last one."""
        dataset, adapt = results.dataset, results.study.model.adapt
        yield Heading("The mesh")
        by = "their contributions to these errors" if adapt.indicator == "dual-weighted" else "the jumps of stresses"
        yield Text(
            "Solved at the mean of the parameters, and refined where cells have most of the estimated error, by "
            f"{by}. An error is the exact minus the discrete value, estimated with elements of one degree higher; it "
            "is not a bound. It does not include the part of a curved body that a coarse mesh cuts off."
        )
        yield cycles(results)
        named = [results.study.model.outputs[i].name for i in adapt.named(results.study.model)]
        yield Pictures(
            [Picture.drawn(plots.refinement(dataset, named, adapt.tolerance), "Estimated errors, mesh by mesh.")]
        )
        captions = {
            "mesh": "The mesh; cells in bright colours contribute most to the error, for their volume.",
            "mesh cut": "What is behind the cell that contributes most.",
        }
        drawn = bodies.pictures(dataset, list(captions))
        if drawn is None:
            yield Text(NO_BODY)
        else:
            yield Pictures([Picture.of(drawn[name], caption) for name, caption in captions.items()])


def cycles(results: Results) -> Table:
    """The meshes, with the outputs and their estimated errors."""
    dataset, rows = results.dataset, []
    for k, told in enumerate(results.summary["adapted"]["cycles"]):
        found = []
        for output in results.outputs:
            here = dataset.isel(cycle=k).sel(output=output)
            value, error = float(here["cycle_value"]), float(here["cycle_mesh_error"])
            unit = results.unit(output)
            sign = "+" if error > 0 else ""
            estimated = NONE if np.isnan(error) else sign + size(error, unit, like=value)
            found += [size(value, unit, 4), estimated]
        rows.append((f"{told['cells']:,}", f"{told['unknowns']:,}", duration(told["cpu_seconds"]), *found))
    head = ["cells", "unknowns", "processor time"]
    for output in results.outputs:
        head += [output, "error"]
    return Table(head, rows, text=frozenset())
