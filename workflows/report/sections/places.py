"""Forces of load cases, and what tools at several places tell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.bodies.geometry import AXES
from forward.readable import and_error
from forward.specimen import Specimen
from forward.words import named, number
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import places as plots
from workflows.report.section import Results, Section
from workflows.report.sections.posterior import first

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from forward.model import FloatArray

LEAST = 3  # places that make a map


class Places(Section):
    """Measured and predicted forces, and a map of what each place tells."""

    def applies(self, results: Results) -> bool:
        """Whether outputs of load cases of a specimen were inverted."""
        there = results.dataset.get("datum_axis")
        return there is not None and isinstance(results.study.model, Specimen) and bool((there >= len(AXES)).any())

    def content(self, results: Results) -> Iterator[Block]:
        """For each of the first data sets pictures and a table."""
        model: Specimen = results.study.model
        yield Heading("Forces")
        several = results.dataset.sizes["data_set"] > 1
        for one in first(results):
            drawn = [Picture.drawn(ax, words) for ax, words in _measured(one, model)]
            tools = places_of(model)
            if len(tools) >= LEAST and "draw" in one:
                lump = next((item.label for item in model.inclusions), "")
                ax = plots.told(one, tools, model.body.bounds, lump)
                drawn.append(Picture.drawn(ax, "What the force at each place tells, in nat, by the model at the mode."))
            if several:
                yield Text(str(one.data_set.item()))
            yield Pictures(drawn)
            yield _table(one, model, tools)


def places_of(model: Specimen) -> dict[str, FloatArray]:
    """Return where the tool is in each load case that has one (m), by its name."""
    found = {}
    for case in model.cases:
        tools = [load for load in case.loads if load.contact and hasattr(load, "at")]
        if len(tools) == 1:
            found[case.name] = np.array(tools[0].at, dtype=float)
    return found


def _outputs(one: xr.Dataset, model: Specimen) -> Iterator[tuple[int, str, str, str]]:
    """Go through data that are outputs: number, load case, name and unit."""
    for k in np.flatnonzero(one["datum_axis"].to_numpy() >= len(AXES)):
        case = model.cases[int(one["datum_case"][k])]
        output = case.outputs[int(one["datum_axis"][k]) - len(AXES)]
        yield int(k), case.name, output.name, output.unit


def _measured(one: xr.Dataset, model: Specimen) -> Iterator[tuple[Axes, str]]:
    """A picture for each name and unit."""
    found = list(_outputs(one, model))
    for name, unit in dict.fromkeys((name, unit) for *_, name, unit in found):
        mine = [(k, case) for k, case, *kind in found if tuple(kind) == (name, unit)]
        ax = plots.forces(one, [k for k, _ in mine], [case for _, case in mine], named(name, unit))
        yield ax, f"{name} by load case, measured and predicted with the most probable parameters."


def _table(one: xr.Dataset, model: Specimen, tools: dict[str, FloatArray]) -> Table:
    """Measured and predicted values, and what each load case tells alone."""
    alone = dict(zip(tools, plots.information(one, tools), strict=True)) if tools and "draw" in one else {}
    rows = []
    for k, case, name, unit in _outputs(one, model):
        of = one.isel(datum=k)
        pairs = (("measured", "sigma"), ("predicted", "predicted_std"))
        shown = [and_error(float(of[value]), float(of[error]), unit) for value, error in pairs]
        told = [number(float(alone[case]), 3) if case in alone else ""] if alone else []
        rows.append((case, name, *shown, number(float(of["residual"]), 3), *told))
    head = ["load case", "output", "measured", "predicted", "residual over its error"]
    return Table([*head, *(["information alone (nat)"] if alone else [])], rows, text=frozenset({0, 1}))
