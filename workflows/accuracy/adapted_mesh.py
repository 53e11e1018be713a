"""A mesh that is refined before a study samples on it: once, whatever the ranks, and kept with the results."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.findings import Finding
from forward.machine import write_text, write_whole
from forward.registry import named
from uq.estimators.estimate import part
from uq.findings import add

if TYPE_CHECKING:
    import xarray as xr

    from forward.fem.adapt import Adapted
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.sampling_blocks import S, SamplingBlocks

FILES = MESH, HISTORY = "mesh.npz", "mesh.json"


def on_adapted_mesh(study: S, ensemble: Ensemble, directory: Path, say: Callable[[str], None]) -> S:
    """Refine the mesh of a study at the mean of its parameters, or find what was refined before; collective.

    Where none is to be refined, the study is returned as it is. The first group of ranks refines; all read the file.
    """
    if not study.model.unrefined:
        return study
    named("forward.fem.adapt:adapt")  # PETSc begins on all ranks together
    world, path = ensemble.world, directory.resolve() / MESH

    if not world.bcast(path.exists() if world.rank == 0 else None):
        of = ensemble.group, study.inputs.names, study.inputs.mean, say
        found: Adapted | None = ensemble.together(lambda: study.spec.adapted(*of) if ensemble.index == 0 else None)
        if world.rank == 0 and found is not None:
            _keep(study, found, path)
    read = ensemble.together(lambda: study.model.on_mesh(str(path)) if world.rank == 0 else None)
    contents = world.bcast(None if read is None else read.bodies[0].body.contents)
    return study.of(study.model.on_mesh(str(path), contents))


def _keep(study: SamplingBlocks, found: Adapted, path: Path) -> None:
    """Write down the mesh, at last, and how it came about."""
    from forward.bodies.tetrahedra import packed

    assert found.mesh is not None
    assert found.indicators is not None
    cycles = [asdict(cycle) for cycle in found.cycles]
    for one in cycles:
        one["errors"] = [None if np.isnan(error) else error for error in one["errors"]]
        one["cpu_seconds"] = one.pop("seconds")
    names = [output.name for output in study.model.outputs]
    history = {"outputs": names, "cycles": cycles, "stopped": found.stopped}
    write_text(path.with_name(HISTORY), json.dumps(history, indent=2, ensure_ascii=False) + "\n")
    write_whole(path, packed(found.mesh, found.indicators))


def history(study: SamplingBlocks) -> dict[str, Any] | None:
    """Return how the mesh of a study came about, which stands beside it; None where that is not known."""
    return written(Path(study.solid.body.file).with_name(HISTORY))


def written(path: Path) -> dict[str, Any] | None:
    """Return what was written down of meshes; None where there is no such file."""
    with suppress(FileNotFoundError):
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found
    return None


def with_history(study: SamplingBlocks, dataset: xr.Dataset) -> xr.Dataset:
    """Add to results the mesh, what each cell adds to its errors, and what the meshes before were; and say it."""
    from forward.bodies.tetrahedra import indicators_of

    told = history(study)
    if told is None:
        return dataset
    cycles = told["cycles"]
    mesh, shares = study.solid.body.load(), indicators_of(Path(study.solid.body.file))

    def of_outputs(name: str) -> tuple[tuple[str, str], Any]:
        return ("cycle", "output"), np.array([cycle[name] for cycle in cycles], dtype=float)

    add(dataset, _finding(study, told))
    return dataset.assign(
        {
            "cycle_cells": ("cycle", [cycle["cells"] for cycle in cycles]),
            "cycle_unknowns": ("cycle", [cycle["unknowns"] for cycle in cycles]),
            "cycle_value": of_outputs("values"),
            part("cycle_value", "mesh"): of_outputs("errors"),
            "mesh_vertex_position": (("mesh_vertex", "axis"), mesh.points),
            "mesh_cell_vertices": (("mesh_cell", "mesh_corner"), mesh.cells),
            "mesh_indicator": ("mesh_cell", shares),
        }
    )


def _finding(study: SamplingBlocks, told: dict[str, Any]) -> Finding:
    """Say what errors are left, and why."""
    adapt = study.solid.adapt
    last, first = told["cycles"][-1], told["cycles"][0]
    named = [told["outputs"][i] for i in adapt.named(study.model)]
    left = []
    for name, value, error in zip(told["outputs"], last["values"], last["errors"], strict=True):
        if name in named and error is None:
            left.append(f"{name} unknown")
        elif name in named:
            size = max(abs(value + error), abs(error))
            left.append(f"{name} {100 * abs(error) / size:.2g} %" if size else f"{name} 0")
    values = {"first": first["unknowns"], "last": last["unknowns"], "left": ", ".join(left)}
    if told["stopped"] is None:
        return Finding("mesh-refined", "note", values)
    values |= {"tolerance": adapt.tolerance, "why": told["stopped"]}
    return Finding("mesh-refined-too-little", "warning", values)
