"""The body, what touches it, its path under load, and what was measured where."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from forward.bodies.geometry import AXES
from forward.hyperelastic import Path as PathOfLoads
from forward.model import FloatArray, SolveError
from forward.readable import and_error, named, number, size, spoken
from workflows.report.blocks import Block, Heading, Pictures, Table, Text, Viewer
from workflows.report.plots import outputs
from workflows.report.plots import places as maps
from workflows.report.section import Results, section

if TYPE_CHECKING:
    import xarray as xr

    from forward.specimen import Specimen
    from workflows.report.scene.scene import Scene

DRAWN = 8  # data sets that have more than a row in the table
STILLS = 2  # pictures for paper
LEAST = 3  # places that make a map
MISSES = ("measured", "predicted", "residual over its error")


def _body_applies(results: Results) -> bool:
    """Whether one body was deformed, with or without a stored displacement, or specimens were inverted."""
    if "stiffness_mean" in results.dataset:
        return bool(results.dataset["ok"].any()) and "cell_nodes" in results.dataset
    if _file(results) is not None:
        return True
    if "estimator" in results.dataset.dims:  # a comparison of methods, which is not about the body
        return False
    return "nominal" in results.dataset and (bool(results.study.spec.meshed) or "cell_nodes" in results.dataset)


@section(when=_body_applies)
def body(results: Results) -> Iterator[Block]:
    """A body to turn: coloured by its displacement, or by the stiffness that was found in it."""
    from workflows.report.scene.scene import forward_scene

    dataset = results.dataset
    if "stiffness_mean" in dataset:
        one = dataset.sel(data_set=dataset.data_set.values[dataset["ok"]][0])
        yield Heading("What is inside" + (f" {one.data_set.item()}" if dataset.sizes["data_set"] > 1 else ""))
        yield specimen(one, results)
        return
    yield Heading("The deformed body")
    reduced = _file(results)
    if reduced is not None:
        from workflows.report.scene.sliders import expanded

        try:
            dataset = expanded(reduced, results.study).assign_attrs(config=dataset.attrs["config"])
        except SolveError as error:
            yield Text(f"The reduced model has no answer: {error}.", "warning")
            return
    if "cell_nodes" not in dataset:
        yield Text("This study stores no displacement field.")
        return
    scene = forward_scene(dataset, results.study)
    most = f"at most {size(float(np.linalg.norm(scene.motion, axis=1).max()), 'm', 4)}"
    by = f"{scene.motion_name}, {most}" + (", by the reduced model" if reduced is not None else "")
    yield turning(scene, f"The body, deformed by {scene.motion_name}", most)
    yield Text(f"{by[0].upper()}{by[1:]}, to scale. Drag to turn it.")


def _file(results: Results) -> Path | None:
    """Return the reduced model that was made, if it is still there."""
    if "reduced" not in results.summary or results.directory is None:
        return None
    path = results.directory / results.summary["reduced"]["file"]
    return path if path.exists() else None


def first(results: Results) -> Iterator[xr.Dataset]:
    """Go through the first data sets that could be inverted."""
    dataset = results.dataset
    for name in dataset.data_set.values[dataset["ok"]][:DRAWN]:
        yield dataset.sel(data_set=name)


def specimen(one: xr.Dataset, results: Results) -> Viewer:
    """A specimen that was inverted, with its inclusions, and measured points."""
    from workflows.report.scene.scene import posterior_scene

    return turning(posterior_scene(one, results.study), "The undeformed specimen, with what was found inside")


def turning(scene: Scene, label: str, also: str = "") -> Viewer:
    """A body that turns, with pictures of its first quantities for paper."""
    from workflows.report.bodies import still
    from workflows.report.scene.scene import packed

    captions = [of.name for of in scene.quantities[:STILLS]]
    captions[0] += f", {also}" if also else ""
    stills = zip(scene.quantities, captions, strict=False)
    return Viewer(label, *packed(scene), Pictures.of(*((still(scene, of), f"{words}.") for of, words in stills)))


@section("contact_pressure", when=lambda results: bool((results.dataset["contact_pressure"] > 0).any()))
def contact(results: Results) -> Iterator[Block]:
    """A map of the pressure of each tool."""
    yield Heading("Pressure under the tool")
    dataset, drawn = results.dataset, []
    last = " at the last step" if "step" in dataset.coords else ""
    for tool, direction in {load.label: load.direction for load in results.study.spec.loads if load.contact}.items():
        pressure = dataset["contact_pressure"].to_numpy()[dataset["contact_tool"].to_numpy() == tool]
        if (pressure > 0).any():
            caption = (
                f"Pressure of {tool} at the mean of the inputs{last}, at most {number(float(pressure.max()))} Pa, on "
                "the undeformed boundary, per area of it; dots are the vertices of the mesh, between which it is drawn "
                "linearly."
            )
            drawn.append((maps.pressure_map(dataset, tool, direction), caption))
    yield Pictures.of(*drawn)


def _estimated_over_a_path(results: Results) -> bool:
    return bool({"mean", "nominal"} & set(results.dataset)) and isinstance(results.study.model, PathOfLoads)


@section("output_of", heading="Over the path", when=_estimated_over_a_path)
def curve(results: Results) -> Iterator[Block]:
    """Curves with bands, and which parameters matter at which step."""
    dataset, spec = results.dataset, results.study.model
    along = spec.leading
    unit = spec.unit_of(along)
    yield Text(f"{spoken(along)}: {spec.in_words(along)}; every step is solved from the one before.")
    drawn = []
    for output in dict.fromkeys(dataset["output_of"].to_numpy().tolist()):
        drawn.append((outputs.over_path(dataset, output, along, unit), f"Over the path: {output}."))
        moves = f"What moves {output}, step by step."
        shares = f"Which parameters the variance of {output} is due to, step by step; 95 % intervals."
        if "sobol_total" in dataset or "derivative_per_std" in dataset:
            caption = shares if "sobol_total" in dataset else moves
            drawn.append((outputs.effects_over_path(dataset, output, along, unit), caption))
    yield Pictures.of(*drawn)


# If outputs of load cases of a specimen were inverted.
@section("datum_axis", heading="Forces", when=lambda results: bool((results.dataset["datum_axis"] >= len(AXES)).any()))
def places(results: Results) -> Iterator[Block]:
    """Measured and predicted forces, and a map of what each place tells."""
    model: Specimen = results.study.model
    several = results.dataset.sizes["data_set"] > 1
    tools = places_of(model)
    for one in first(results):
        found, drawn = [], []
        for k in np.flatnonzero(one["datum_axis"].to_numpy() >= len(AXES)).tolist():
            case = model.cases[int(one["datum_case"][k])]
            found.append((k, case.name, case.outputs[int(one["datum_axis"][k]) - len(AXES)]))
        for name, unit in dict.fromkeys((output.name, output.unit) for *_, output in found):
            mine = {k: of for k, of, output in found if (output.name, output.unit) == (name, unit)}
            ax = maps.forces(one, list(mine), list(mine.values()), named(name, unit))
            drawn.append((ax, f"{name} by load case, measured and predicted with the most probable parameters."))
        if len(tools) >= LEAST and "draw" in one:
            lump = next((item.label for item in model.inclusions), "")
            ax = maps.told(one, tools, model.body.bounds, lump)
            drawn.append((ax, "What the force at each place tells, in nat, by the model at the mode."))
        if several:
            yield Text(str(one.data_set.item()))
        yield Pictures.of(*drawn)
        rows = [[of, output.name, *misses(one.isel(datum=k), output.unit)] for k, of, output in found]
        head = ["load case", "output", *MISSES]
        if tools and "draw" in one:
            alone = dict(zip(tools, maps.information(one, tools), strict=True))
            rows = [[*row, number(float(alone[row[0]]), 3) if row[0] in alone else ""] for row in rows]
            head.append("information alone (nat)")
        yield Table(head, rows, text={0, 1})


def places_of(model: Specimen) -> dict[str, FloatArray]:
    """Return where the tool is in each load case that has one (m), by its name."""
    found = {}
    for case in model.cases:
        tools = [load for load in case.loads if load.contact and hasattr(load, "at")]
        if len(tools) == 1:
            found[case.name] = np.array(tools[0].at, dtype=float)
    return found


def misses(datum: xr.Dataset, unit: str, like: float | None = None) -> Iterator[str]:
    """Write what was measured and predicted of a datum, in the unit of `like` if given, and the residual."""
    for value, error in (("measured", "sigma"), ("predicted", "predicted_std")):
        yield and_error(float(datum[value]), float(datum[error]), unit, like)
    yield number(float(datum["residual"]), 3)
