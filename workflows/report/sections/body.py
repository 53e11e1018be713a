"""The body: deformed by its loads, or with what an inversion found in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from forward.model import SolveError
from forward.readable import size
from workflows.report.blocks import Block, Heading, Picture, Pictures, Text, Viewer
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr

    from workflows.report.scene.scene import Scene

STILLS = 2  # pictures for paper
NO_BODY = (
    "The mesh could not be drawn on this machine: that needs pyvista (pip install 'tissuq[vtk]') and OpenGL without a "
    "display (Debian: libegl1)."
)


class Body(Section):
    """A body to turn: coloured by its displacement, or by the stiffness that was found in it."""

    def applies(self, results: Results) -> bool:
        """Whether one body was deformed, with or without a stored displacement, or specimens were inverted."""
        if "stiffness_mean" in results.dataset:
            return bool(results.dataset["ok"].any()) and "cell_nodes" in results.dataset
        if _file(results) is not None:
            return True
        if "estimator" in results.dataset.dims:  # a comparison of methods, which is not about the body
            return False
        return "nominal" in results.dataset and (bool(results.study.spec.meshed) or "cell_nodes" in results.dataset)

    def content(self, results: Results) -> Iterator[Block]:
        """The body, or why there is none."""
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
            from workflows.report.scene.of_reduced import expanded

            try:
                dataset = expanded(reduced, results.study).assign_attrs(config=dataset.attrs["config"])
            except SolveError as error:
                yield Text(f"The reduced model has no answer: {error}.", "warning")
                return
        if "cell_nodes" not in dataset:
            yield Text("This study stores no displacement field.")
            return
        scene = forward_scene(dataset, results.study)
        by = f"{scene.motion_name}, {largest(dataset)}" + (", by the reduced model" if reduced is not None else "")
        yield turning(scene, f"The body, deformed by {scene.motion_name}", largest(dataset))
        yield Text(f"Deformed by {by}, to scale. Drag to turn it.")


def _file(results: Results) -> Path | None:
    """Return the reduced model that was made, if it is still there."""
    if "reduced" not in results.summary or results.directory is None:
        return None
    path = results.directory / results.summary["reduced"]["file"]
    return path if path.exists() else None


def specimen(one: xr.Dataset, results: Results) -> Viewer:
    """A specimen that was inverted, with its inclusions, and measured points."""
    from workflows.report.scene.scene import posterior_scene

    scene = posterior_scene(one, results.study)
    return turning(scene, "The undeformed specimen, with what was found inside")


def turning(scene: Scene, label: str, also: str = "") -> Viewer:
    """A body that turns, with pictures of its first quantities for paper."""
    from workflows.report.scene.scene import packed
    from workflows.report.scene.still import still

    told, data = packed(scene)
    stills = []
    for k, quantity in enumerate(scene.quantities[:STILLS]):
        stills.append(Picture.of(still(scene, quantity), quantity.name + (f", {also}." if also and not k else ".")))
    return Viewer(label, told, data, Pictures(stills))


def largest(dataset: xr.Dataset) -> str:
    """Say how far the body moves at most."""
    field = dataset["field_mean" if "field_mean" in dataset else "field_nominal"].to_numpy()
    return f"at most {size(float(np.linalg.norm(field, axis=1).max()), 'm', 4)}"
