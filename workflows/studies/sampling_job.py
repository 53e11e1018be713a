"""The job of a study that samples a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.findings import Finding
from forward.machine import require
from forward.model import FloatArray, ForwardModel, SolveError, Stability
from uq.accuracy.budget import spare_for
from uq.estimators import failure_domain
from uq.estimators.estimate import holds, part
from uq.evaluation.block import merge
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import OWN, Evaluate, Evaluations
from uq.findings import add, keep_unknown, once_for_steps, settled
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise, linearised
from workflows.config.priors import ranges
from workflows.results.directory import label, read_dataset, with_random_fields, with_regions
from workflows.results.norms import node_volumes
from workflows.studies.job import Job, MethodJob
from workflows.studies.solves import at_mean, crossings, measured, of_answers, stressed, with_contact, with_stresses
from workflows.studies.study import never_estimable

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.sampling_blocks import SamplingBlocks

REALISATIONS = 3  # of random fields, to look at


def job(study: SamplingBlocks, ensemble: Ensemble, directory: Path) -> Job:
    """One model, and others that the method may want, at the points of a method; collective over the group."""
    inputs, units = study.inputs, {output.name: output.unit for output in study.model.returned}
    require(8 * study.planned * (len(inputs.names) + len(units)), f"to hold {study.planned:,} samples")
    recorders: dict[str, Recorder] = {}
    estimates: list[Evaluations] = []
    told, taken = dict[str, Any](), study.taken

    def task(evaluate: Evaluate) -> xr.Dataset:
        recorders["/"] = Recorder(evaluate)
        found = _sampled(study, evaluate, recorders, estimates, directory)
        if taken is not None:
            found = taken.with_changes(found, inputs.mean, evaluate.on(taken.label))
        told.update(_told(study, recorders["/"], estimates, directory))
        if not (study.spec.meshed and study.spec.touched):
            return found
        return with_contact(found, model, inputs, evaluate, recorders["/"].first)

    others: dict[str, Callable[[], ForwardModel]] = {
        name: partial(other.build, ensemble.group, inputs.names) for name, other in study.models.items()
    } | ({} if taken is None else {taken.label: partial(taken.build, ensemble.group)})
    model: Any = study.spec.build(ensemble.group, inputs.names)

    of_outputs = {name: units[name] for name in model.outputs}

    def finished(found: xr.Dataset, evaluations: Mapping[str, Evaluations]) -> xr.Dataset:
        return with_unknown_meshes(study, _with_stability(study, found, evaluations["/"], of_outputs))

    made = partial(MethodJob, model, others, task, recorders, told=told, finished=finished)
    if model.space is None or not model.space.displacements:  # a specimen has states, but no one field

        def described(found: xr.Dataset) -> xr.Dataset:
            found = label(found.drop_dims("node", errors="ignore"), units)
            if not study.spec.shareable:
                solved = zip(recorders["/"].log, recorders["/"].models, strict=True)
                add(found, *of_answers(model, inputs, [one for one, name in solved if name == OWN]))
            return found

        return made(labelled=described)

    # Rank 0 may leave the task by an exception: nothing collective may follow it.
    cells, kind = model.space.cells()
    regions = model.space.regions()
    factors: dict[str, FloatArray] = {}
    if ensemble.index == 0 and study.model.coefficients:  # in the first samples of Monte Carlo
        drawn = random_points(getattr(study.method, "seed", 0), 0, REALISATIONS, len(inputs.names))
        factors = model.space.factors(inputs.points(drawn))
    of_body = ensemble.index == 0 and study.spec.meshed
    locking = measured(model, inputs.mean, ranges(study.given)) if of_body else []
    tensors = stressed(model, inputs.mean) if of_body and getattr(study.spec, "stresses", False) else None

    def labelled(found: xr.Dataset) -> xr.Dataset:
        found = label(found, units, model.space.coordinates, cells, kind)
        places = {output.name: i for i, output in enumerate(study.model.returned)}
        at = [places[str(name)] for name in found["output"].values]
        axes = study.model.axes_of_outputs.items()  # as at which step of a path they are
        found = found.assign_coords(
            {name: ("output", np.array(of)[at], {"units": unit} if unit else {}) for name, (unit, of) in axes}
        )
        settled(found, units)
        add(found, *locking)
        if of_body:
            add(found, *_of_facets(study))
            solved, kind_of_cell = recorders["/"], model.spec.body.cell
            points = np.concatenate([one.points for one in solved.log])
            add(found, *crossings(solved.first, points, model.space.coordinates, cells, kind_of_cell))
        if "step" in found.coords:
            once_for_steps(found)
        found = with_regions(found, model.spec.body.regions, regions)
        return with_random_fields(with_stresses(found, tensors), factors, model.space.variance_kept)

    return made(labelled=labelled, node_volumes=partial(node_volumes, model.space.coordinates, cells))


def _of_facets(study: SamplingBlocks) -> Iterator[Finding]:
    """Say of several meshes of a curved body that their facets are those of the first."""
    body = study.spec.bodies[0].body
    if len(study.meshes) > 1 and body.kind == "mesh" and body.lifted() is not None:
        yield Finding("facets-uncounted", "warning")


def _sampled(
    study: SamplingBlocks,
    evaluate: Evaluate,
    recorders: dict[str, Recorder],
    estimates: list[Evaluations],
    directory: Path,
) -> xr.Dataset:
    """Run the method, estimate the error of the mesh at a few parameters, and add what it does to the results."""
    inputs, recorder = study.inputs, recorders["/"]
    method = study.method.with_sources(lambda place: read_dataset(Path(place)))
    if study.accuracy.tolerance is not None:
        from workflows.accuracy.tolerance import within

        return with_errors_of_draws(study, within(study, method, evaluate, recorders, estimates, directory))
    found = with_errors_of_draws(study, method.run(inputs, recorder))
    first = recorder.first
    if not study.estimates or "output" not in found.coords or first is None:  # a method from outside
        return found
    from uq.accuracy.doubts import failed
    from uq.accuracy.effects import with_mesh_errors
    from uq.accuracy.mesh_errors import estimate

    try:
        known = at_mean(inputs, first) is not None
        centre = linearised(inputs, evaluate, first) if known else linearise(inputs, evaluate)
    except SolveError as error:
        add(found, failed(f"{error}"), first=True)
        return found
    count, seed = study.estimates_of(recorder.solves), getattr(study.method, "seed", 0)
    errors = estimate(
        inputs, evaluate, centre, count, seed, fields="node" in found.dims, spare=spare_for(recorder.solves)
    )
    estimates.append(errors.evaluations)
    return with_mesh_errors(found, inputs, centre, errors, study.told)


def with_unknown_meshes(study: SamplingBlocks, dataset: xr.Dataset) -> xr.Dataset:
    """Keep which outputs have an error of a mesh that nobody knows, and add how a mesh was refined."""
    if (study.spec.meshed or study.spec.hidden) and "output" in dataset.coords:
        kind = next((name for name in ("mean", "nominal") if holds(dataset, name, "mesh")), None)
        errors = np.full(dataset.sizes["output"], np.nan) if kind is None else dataset[part(kind, "mesh")].to_numpy()
        names = [str(name) for name in dataset["output"].values[np.isnan(errors)]]
        keep_unknown(dataset, names, set(names) - set(never_estimable(study.spec, names)) if study.estimates else ())
    if not study.model.adaptive:
        return dataset
    from workflows.accuracy.tolerance import with_history

    return with_history(study, dataset)


def with_errors_of_draws(study: SamplingBlocks, found: xr.Dataset) -> xr.Dataset:
    """Add to the errors what draws are responsible for, if some parameters are given by draws."""
    if study.source is None:
        return found
    from uq.estimators import input_sample_error

    in_turn = found.sizes.get("sample", 0) if study.method.in_turn else 0
    return input_sample_error.with_errors_of_draws(found, study.inputs, in_turn)


def _with_stability(
    study: SamplingBlocks, dataset: xr.Dataset, evaluations: Evaluations, units: Mapping[str, str]
) -> xr.Dataset:
    """Add how the stability of each sample was tested, and say where there is no answer."""
    continued = "loo_error" in dataset or getattr(study.method, "control", None) == "chaos"
    add(dataset, *failure_domain.findings(study.inputs, evaluations, units, continued=continued))
    if not failure_domain.counts([evaluations]):
        return dataset
    if "points" in dataset and dataset.points.dims == ("sample", "parameter"):
        known = failure_domain.by_sample(dataset.points.to_numpy(), evaluations)
        meanings = ", ".join(f"{one.value}: {one.name.lower().replace('_', ' ')}" for one in Stability)
        dataset = dataset.assign(stability=("sample", known, {"meanings": meanings}))
        meanings = ", ".join(f"{number}: {name}" for number, name in enumerate(failure_domain.JOINED))
        joined = failure_domain.joined_by_sample(dataset.points.to_numpy(), evaluations)
        dataset = dataset.assign(joined=("sample", joined, {"meanings": meanings}))
    return dataset


def _told(
    study: SamplingBlocks, recorder: Recorder, estimates: Sequence[Evaluations], directory: Path
) -> dict[str, Any]:
    """Return what was solved on each mesh or of each model, if there are several, and what estimates and meshes took.

    Estimates of the error of the mesh are not among the evaluations. Solves stopped early are the model's.
    """
    ranks, told, seconds = study.parallel.ranks_per_model, dict[str, Any](), 0.0
    refined = before = None
    if study.model.adaptive or study.accuracy.tolerance is not None:
        from workflows.accuracy.tolerance import history, refinement

        refined, before = refinement(study) if study.model.adaptive else None, history(directory)
    if estimates:
        every = merge(estimates)
        seconds = float(every.seconds.sum()) * ranks
        told["mesh_error"] = {"estimates": len(every.points), "failed": len(every.failures), "cpu_seconds": seconds}
    if study.accuracy.tolerance is not None:
        # Estimates on the last mesh are those of the study.
        earlier = 0 if before is None else sum(one["seconds"] for one in before["meshes"][:-1])
        earlier += sum(one["cpu_seconds"] for one in (refined or {"cycles": ()})["cycles"])
        told["accuracy_seconds"] = {"sampling": recorder.seconds * ranks, "mesh": seconds + earlier * ranks}

    def solved(model: str) -> dict[str, Any]:
        parts = [part for part, name in zip(recorder.log, recorder.models, strict=True) if name == model]
        taken = float(sum(part.seconds.sum() for part in parts)) * ranks
        return {"solves": sum(len(part.points) for part in parts), "cpu_seconds": taken}

    if len(study.meshes) > 1:
        meshes = zip((OWN, *study.models), study.meshes, strict=True)
        needed = [(name, mesh) for name, mesh in meshes if name in recorder.models]
        told["meshes"] = [{"unknowns": mesh.unknowns, **solved(name)} for name, mesh in needed]
    if study.method.kind == "multifidelity":
        told["fidelities"] = [{"name": name or "model", **solved(name)} for name in (OWN, *study.models)]
    return told if refined is None else told | {"adapted": refined}
