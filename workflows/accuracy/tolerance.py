"""How one tolerance for all errors is reached: a loop that moves levers until errors are within it.

Results have one mesh: `on_fine_mesh` moves it (`workflows.accuracy.levers`), and the number of estimates of its error,
before anything is sampled. What is then not known of the error of means and standard deviations, which is left when
they are corrected, is held against the tolerance. `within` then moves the method, its degree and its samples, until
sampling takes no more than what the mesh leaves (`Goal`), which is known better once outputs are sampled.

All of this depends on the study only. Blocks of solves are those of the study on that mesh, which finds them again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.bodies.tetrahedra import indicators_of, packed
from forward.findings import Finding
from forward.machine import StopError, write_text, write_whole
from forward.model import FloatArray, SolveError
from forward.registry import named
from uq.accuracy.consequences import has
from uq.accuracy.doubts import failed
from uq.accuracy.effects import with_mesh_errors
from uq.accuracy.mesh_errors import MeshErrors, estimate
from uq.estimators.doubts import equal, unmet
from uq.estimators.estimate import ESTIMATED, estimate_of, part
from uq.estimators.moments import ESTIMATES, Z, half_width
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.evaluate import Recorder
from uq.findings import add
from uq.inputs.sampling import sobol_points
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from workflows.accuracy import tolerance_words as words
from workflows.accuracy.levers import COUNTS, Assessed, MeshLever, cells, goal
from workflows.config.blocks import HISTORY, MESH, TOLERANCE

if TYPE_CHECKING:
    import xarray as xr

    from forward.fem.adapt import Adapted
    from forward.spec import ModelSpec
    from uq.accuracy.goal import Goal
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate, Evaluations
    from uq.inputs.random_parameters import Inputs
    from uq.methods.method import Method
    from workflows.studies.sampling_blocks import S, SamplingBlocks

POINTS = 4096  # at which tangents are drawn
ATTEMPTS = 3  # at sampling, as what is known of the mesh changes by it
TRIED = ("unknowns", "cells", "estimates", "share")  # of a mesh
IN_WORDS = {"mean": "mean", "std": "standard deviation"}

# --- the mesh, before anything is sampled ----------------------------------------------------------------------------


def on_fine_mesh(
    study: S, ensemble: Ensemble, directory: Path, say: Callable[[str], None], identity: Callable[[S], str]
) -> S:
    """Return the study on a mesh that is fine enough, or on the finest that there may be; collective.

    By its `identity`, which is all that evaluations depend on, blocks on disk are found. A StopError says that memory
    ends far from the tolerance, by the meshes seen so far.
    """
    world, first, lever = ensemble.world, study, MeshLever.of(study)
    found = world.bcast(history(directory) if world.rank == 0 else None)
    if found is not None and not found["body"]:
        return study
    if found is not None:
        return on_adapted_mesh(study.of(_moved(lever, found["body"])), ensemble, directory, say)
    _forget(first, world, directory)
    meshes, count = list[Assessed](), COUNTS[0]
    while True:
        meshes.append(_assessed(study, ensemble, Checkpoint(directory, identity(study)), count))
        say(words.line(meshes[-1]))
        step = lever.step(study, meshes)
        if step.model is None:
            break
        if step.model is not study.model and (reach := lever.out_of_reach(meshes)) is not None:
            raise StopError(words.out_of_reach(study, meshes[-1], reach))
        if step.model.unrefined:
            _forget(first, world, directory)
        study, count = on_adapted_mesh(study.of(step.model), ensemble, directory, say), step.estimates
    if world.rank == 0:
        found = {
            "meshes": [one.document for one in meshes],
            "why": words.taken(study, lever, meshes, step),
            "body": {} if study.model is first.model else _changed(study),
            "estimates": step.estimates,
        }
        write_text(directory.resolve() / TOLERANCE, json.dumps(found, indent=2, ensure_ascii=False) + "\n")
    return study


def _changed(study: SamplingBlocks) -> dict[str, Any]:
    """Return what of the body was changed."""
    adapt, body = study.solid.adapt, study.solid.body
    if adapt is not None:
        return {"adapt": adapt.tolerance}
    return {"cells": body.cells} if body.structured else {"levels": body.levels}


def _moved(lever: MeshLever, changed: dict[str, Any]) -> ModelSpec:
    """Return the model with what was changed."""
    if "adapt" in changed:
        return lever.adapting(changed["adapt"], lever.most_unknowns)
    body = lever.first.solid.body
    body = body.model_validate(body.model_dump(exclude={"contents"}) | changed)
    return lever.first.model.model_copy(update={"body": body})


def _forget(first: SamplingBlocks, world: Any, directory: Path) -> None:
    """Remove the mesh of an attempt that was given up or interrupted, unless the study itself asked for it."""
    if world.rank == 0 and not first.model.adaptive:
        for name in (MESH, HISTORY):
            (directory / name).unlink(missing_ok=True)


def history(directory: Path) -> dict[str, Any] | None:
    """Return how the mesh of a study was found, which stands beside its results; None where it was not looked for."""
    return written(directory.resolve() / TOLERANCE)


def estimated(
    study: SamplingBlocks, inputs: Inputs, evaluate: Evaluate, centre: Linearisation, count: int
) -> tuple[MeshErrors, xr.Dataset]:
    """Return the error of the mesh at so many parameters, and means and standard deviations by tangents, with it."""
    fields = getattr(study.method, "fields", True) and centre.state.size > 0
    errors = estimate(inputs, evaluate, centre, count, getattr(study.method, "seed", 0), fields=fields)
    drawn = centre.middle + centre.predicted(inputs.points(sobol_points(0, 0, 0, POINTS, len(inputs.names))))
    zero = np.zeros(len(centre.outputs))
    moments = zip(ESTIMATES, (drawn.mean(axis=0), zero, drawn.std(axis=0), zero), strict=True)
    dataset = local_dataset(inputs, evaluate, centre, fields=False)
    dataset = dataset.assign({name: (("output",), values) for name, values in moments})
    return errors, with_mesh_errors(dataset, inputs, centre, errors, study.told)


def doubts(dataset: xr.Dataset) -> FloatArray:
    """Return what is not known of the error of the mesh in means and standard deviations (2, m); zero without one."""
    return np.nan_to_num([estimate_of(dataset, name).doubt for name in ESTIMATED])


def _assessed(study: SamplingBlocks, ensemble: Ensemble, checkpoint: Checkpoint, count: int) -> Assessed:
    """Estimate what the mesh of a study takes of the tolerance; collective."""
    model = ensemble.together(lambda: study.spec.build(ensemble.group, study.inputs.names))

    def task(evaluate: Evaluate) -> Assessed | Exception:
        recorder, inputs = Recorder(evaluate), study.inputs
        try:
            centre = linearise(inputs, recorder)
        except (SolveError, ValueError) as error:  # for all ranks, which wait for what comes of it
            return error
        found = None
        with suppress(SolveError):
            found = estimated(study, inputs, recorder, centre, count)
        shares, relative, means = np.full((2, 1), np.inf), np.inf, list[tuple[str, float, float, float]]()
        left: list[list[list[float]]] = [[], []]
        if found is not None and found[0].evaluations.ok.sum() > 1:
            asked, data = goal(study), found[1]
            sizes = asked.sizes(data["mean"].to_numpy(), data["std"].to_numpy())
            errors = np.abs([estimate_of(data, name).mesh for name in ESTIMATED])
            known = doubts(data), np.nan_to_num(data["mesh_error_unknown"].to_numpy() * errors)
            shares, close = (Z * part / (asked.tolerance * sizes) for part in known)
            left = [close.tolist(), np.sqrt(np.maximum(shares**2 - close**2, 0.0)).tolist()]
            mean = estimate_of(data, "mean")
            rows = zip(recorder.outputs, *(x.tolist() for x in (mean.value, mean.mesh, mean.doubt)), strict=True)
            means = [row for row in rows if np.isfinite(row[2])]
            relative = float((np.nan_to_num(np.abs(estimate_of(data, "nominal").mesh)) / sizes[0]).max())
        row, column = np.unravel_index(int(np.argmax(shares)), shares.shape)
        of = recorder.outputs[column], IN_WORDS[ESTIMATED[row]]
        mesh = study.spec.unknowns, cells(study), count, float(shares.max()), len(inputs.names)
        return Assessed(*mesh, *of, left[0], left[1], relative, means, recorder.solves, recorder.seconds)

    found = ensemble.run(model, task, checkpoint=checkpoint, blocks=study.parallel.blocks)
    result: Assessed | Exception = ensemble.world.bcast(found)
    if isinstance(result, Exception):
        raise result
    return result


# --- the method, its degree and its samples, on that mesh ------------------------------------------------------------


def within(
    study: SamplingBlocks,
    method: Method,
    evaluate: Evaluate,
    recorders: dict[str, Recorder],
    estimates: list[Evaluations],
    directory: Path,
) -> xr.Dataset:
    """Sample until mean and standard deviation of every output are within the tolerance, with their mesh errors.

    It finds its solves where they are stored, and keeps evaluations in the recorders and estimates of the job; how the
    mesh was found stands in the directory of the results.
    """
    inputs, unknown = study.inputs, tuple[Finding, ...]()
    asked, mesh, before = goal(study), None, history(directory)
    if study.estimates and before is not None:
        try:
            centre = linearise(inputs, evaluate)
            mesh, by_tangents = estimated(study, inputs, evaluate, centre, before["estimates"])
        except SolveError as error:
            unknown = (failed(f"{error}"),)
        else:
            estimates.append(mesh.evaluations)
            asked = replace(asked, mesh=doubts(by_tangents))
    for _ in range(ATTEMPTS):
        recorders["/"] = Recorder(evaluate)
        found = method.until(inputs, recorders["/"], asked)
        if mesh is None:
            break
        found = with_mesh_errors(found, inputs, centre, mesh, study.told)
        asked = replace(asked, mesh=doubts(found))
        if asked.reached(_moments(found), half_width(found)) <= 1:
            break
    add(found, *unknown, first=True)
    told = _told(study, found, asked, before)
    found.attrs["accuracy"] = json.dumps(told, ensure_ascii=False)
    meshes = [] if before is None else before["meshes"]
    add(found, *words.missed(study, told), *words.contradictions(meshes, told["outputs"]))
    return found


def _moments(dataset: xr.Dataset) -> dict[str, FloatArray]:
    return {name: dataset[name].to_numpy() for name in ESTIMATES}


def _told(study: SamplingBlocks, found: xr.Dataset, asked: Goal, before: dict[str, Any] | None) -> dict[str, Any]:
    """Return what was asked for and reached, by what, and why; nothing that depends on the machine."""
    names = [str(name) for name in found["output"].values]
    chosen = json.loads(found.attrs.pop("chosen", "{}")) or {"method": study.method.kind, "reasons": []}
    parts = asked.parts(_moments(found), half_width(found))
    sizes = asked.sizes(found["mean"].to_numpy(), found["std"].to_numpy())
    row, column = np.unravel_index(int(np.argmax(np.nan_to_num(parts["total"]))), parts["total"].shape)
    estimates = {name: estimate_of(found, name) for name in ESTIMATED}
    corrected = np.isfinite(estimates["mean"].corrected)  # the outputs of which the error of the mesh was estimated
    if before is None:  # nothing to be known, or not asked for; else it was too much
        known = not (study.spec.meshed or study.spec.hidden) or not study.accuracy.mesh_error
    else:
        known = all(corrected[i] for i, name in enumerate(names) if name not in study.told.never)
    missed: dict[str, float] = {}  # share of all cases that samples may have missed, by output where all are the same
    if has(found, "values", "sample", "output") and found["ok"].any():
        values = found["values"].to_numpy()[found["ok"].to_numpy()]
        missed = dict.fromkeys(np.array(names)[equal(values)].tolist(), unmet(len(values)))
    tried = [] if before is None else [{name: one[name] for name in TRIED} for one in before["meshes"]]
    mesh = {"unknowns": study.spec.unknowns, "estimated": known and before is not None, "tried": tried}
    return {
        "tolerance": asked.tolerance,
        "reached": float(asked.tolerance * parts["total"][row, column]),
        "kept": known and not missed and bool((parts["total"] <= 1).all()),
        "unmet": missed,
        "seen": int(found["ok"].sum()),
        "worst": {"output": names[column], "of": IN_WORDS[ESTIMATED[row]]},
        "shares": {source: float(parts[source][row, column]) for source in words.SOURCES},
        "method": chosen["method"],
        "reasons": [*([] if before is None else [words.of_mesh(before)]), *chosen["reasons"]],
        "mesh": mesh if study.spec.meshed else None,
        "outputs": {
            name: {
                estimate: {
                    "value": float(one.corrected[i] if corrected[i] else one.value[i]),
                    "error": float(asked.tolerance * parts["total"][k, i] * sizes[k, i]),
                    "relative_to": float(sizes[k, i]),
                    **{source: float(parts[source][k, i]) for source in words.SOURCES},
                }
                for k, (estimate, one) in enumerate(estimates.items())
            }
            for i, name in enumerate(names)
        },
    }


# --- a mesh that is refined where its errors arise: once, whatever the ranks, and kept with the results --------------


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
    assert found.mesh is not None
    assert found.indicators is not None
    cycles = [asdict(cycle) for cycle in found.cycles]
    for one in cycles:
        one["errors"] = [None if np.isnan(error) else error for error in one["errors"]]
        one["cpu_seconds"] = one.pop("seconds")
    names = [output.name for output in study.model.outputs]
    found_by = {"outputs": names, "cycles": cycles, "stopped": found.stopped}
    write_text(path.with_name(HISTORY), json.dumps(found_by, indent=2, ensure_ascii=False) + "\n")
    write_whole(path, packed(found.mesh, found.indicators))


def refinement(study: SamplingBlocks) -> dict[str, Any] | None:
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
    told = refinement(study)
    if told is None:
        return dataset
    cycles = told["cycles"]
    mesh, shares = study.solid.body.load(), indicators_of(Path(study.solid.body.file))

    def of_outputs(name: str) -> tuple[tuple[str, str], Any]:
        return ("cycle", "output"), np.array([cycle[name] for cycle in cycles], dtype=float)

    adapt, first, last = study.solid.adapt, cycles[0], cycles[-1]
    asked = [told["outputs"][i] for i in adapt.named(study.model)]
    left = []
    for name, value, error in zip(told["outputs"], last["values"], last["errors"], strict=True):
        if name in asked and error is None:
            left.append(f"{name} unknown")
        elif name in asked:
            size = max(abs(value + error), abs(error))
            left.append(f"{name} {100 * abs(error) / size:.2g} %" if size else f"{name} 0")
    values = {"first": first["unknowns"], "last": last["unknowns"], "left": ", ".join(left)}
    if told["stopped"] is None:
        add(dataset, Finding("mesh-refined", "note", values))
    else:
        values |= {"tolerance": adapt.tolerance, "why": told["stopped"]}
        add(dataset, Finding("mesh-refined-too-little", "warning", values))
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
