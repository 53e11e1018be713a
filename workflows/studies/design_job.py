"""The job of a design: what could be measured, the solves, and the files that it leaves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.bodies.geometry import AXES
from forward.combine import Recorded
from forward.model import FloatArray, ModelError, SolveError
from forward.scalars import Mistake
from forward.specimen import Observed
from inverse.data.measurements import Measurements
from inverse.designs.fields import of_field
from inverse.methods.invert import derivable
from uq.evaluation.evaluate import Recorder
from uq.evaluation.kept import Kept, KeptSolves
from workflows.data.designs import files
from workflows.studies.job import MethodJob, TasksJob
from workflows.studies.predictions import has_mesh

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import ForwardModel, Solution
    from forward.spec import ModelSpec
    from inverse.methods.design import Design
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate, Evaluations
    from uq.evaluation.tasks import Outcome
    from uq.inputs.random_parameters import Inputs
    from workflows.studies.job import Job

SIDES = {f"{axis}-{side}": (k, end) for k, axis in enumerate(AXES) for side, end in (("min", 0), ("max", -1))}


# --- what could be measured, as far as that is known before the model is made ----------------------------------------


def mistakes(method: Design, spec: ModelSpec) -> Iterator[Mistake]:
    """Find what a design asks for that a model does not have; nothing where only its mesh knows."""
    values = known(spec) if spec.placed else of_outputs(spec)
    if values is None:
        return
    if not len(values):
        message = "nothing is observed, expected boundaries or points, or outputs of load cases"
        yield ("model", "observed"), message, ()
        return
    for key, message, given in method.mistakes(values):
        yield ("method", key), message, given


def of_outputs(spec: ModelSpec) -> Measurements:
    """Say what each output of a model is that is no specimen."""
    axes, names = dict(spec.axes_of_outputs), tuple(output.name for output in spec.returned)
    steps = [str(step) for step in axes["step"][1]] if "step" in axes else [""] * len(names)
    parts = [str(part) for part in axes["output_of"][1]] if "output_of" in axes else list(names)
    return Measurements.possible(names, np.full((len(names), 3), np.nan), steps, parts)


def known(spec: Any) -> Measurements | None:
    """Say what the values of a specimen are; None where nodes of a mesh from a file are observed."""
    names, places, cases, parts = list[str](), list[FloatArray](), list[str](), list[str]()
    for case in spec.cases:
        for item in spec.seen(case):
            points = _points(spec, item)
            if points is None:
                return None
            names += [f"{case.name}.{item.label}.{i}.{axis}" for i in range(len(points)) for axis in item.components]
            places += [point for point in points for _ in item.components]
            parts += [axis for _ in points for axis in AXES if axis in item.components]
        names += [f"{case.name}.{output.name}" for output in case.outputs]
        places += [np.full(3, np.nan) for _ in case.outputs]
        parts += [output.name for output in case.outputs]
        cases += [case.name] * (len(names) - len(cases))
    return Measurements.possible(names, np.array(places).reshape(-1, 3), cases, parts)


def _points(spec: Any, item: Observed) -> FloatArray | None:
    """Points (n, 3) at which displacements are measured: nodes of a side as they lie on a cube of cells of one size."""
    if item.on is None:
        return np.array(item.at)
    cells = getattr(spec.body, "cells", None)
    if cells is None or len(cells) != len(AXES) or item.on not in SIDES:
        return None
    lines = [np.linspace(0.0, 1.0, spec.body.degree * n + 1) for n in cells]
    axis, end = SIDES[item.on]
    lines[axis] = lines[axis][[end]]
    return np.asarray(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3))


# --- what is solved --------------------------------------------------------------------------------------------------


def job(
    method: Design, spec: ModelSpec, inputs: Inputs, ensemble: Ensemble, checkpoint: Checkpoint, *, field: bool
) -> Job:
    """Make the model, whose parameters or `field` of nodal values are unknown; collective over the group."""
    model = spec.build(ensemble.group, spec.coefficients if field else inputs.names)
    derivable(model, spec.kind)
    values = values_of(spec, model)
    if field:
        return _of_field(method, spec, ensemble, checkpoint, model, values)
    recorders: dict[str, Recorder] = {}

    def task(evaluate: Evaluate) -> xr.Dataset:
        recorders["/"] = Recorder(evaluate)
        return method.run(inputs, recorders["/"], values, evaluate if has_mesh(spec) else None)

    return MethodJob(model, {}, task, recorders, texts=lambda found: files(spec, found))


def job_of_models(
    method: Design,
    specs: Mapping[str, ModelSpec],
    inputs: Mapping[str, Inputs],
    weights: Mapping[str, float],
    ensemble: Ensemble,
) -> MethodJob:
    """Make the models, which are all observed at the places of the first one; collective over the group."""
    first, *others = specs
    model: Any = specs[first].build(ensemble.group, inputs[first].names)
    values = values_of(specs[first], model)
    recorders: dict[str, Recorder] = {}

    def made(name: str) -> ForwardModel:
        other: Any = specs[name].build(ensemble.group, inputs[name].names)
        if specs[name].placed and specs[first].placed:
            other = other.observing(model.places, model.axes.tolist(), model.cases.tolist())
        elif other.outputs != model.outputs:
            raise ModelError(f"{name} gives {', '.join(other.outputs[:3])}, …, expected the outputs of {first}")
        found: ForwardModel = other
        return found

    def task(evaluate: Evaluate) -> xr.Dataset:
        for name in specs:
            recorders[name] = Recorder(evaluate if name == first else evaluate.on(name))
        return method.run_models(inputs, weights, recorders, values)

    makers = {name: partial(made, name) for name in others}
    return MethodJob(model, makers, task, recorders, texts=lambda found: files(specs[first], found))


def _of_field(
    method: Design, spec: Any, ensemble: Ensemble, checkpoint: Checkpoint, model: ForwardModel, values: Measurements
) -> TasksJob:
    """Each draw of the field is a task of one group."""
    prior = spec.fields[0].prior(spec.body)
    names = [f"draw {number}" for number in range(method.draws)]
    solving: list[Kept] = []  # of the draw at hand
    goals = method.candidates(values)[1]

    def linearise(number: int, solved: list[Evaluations]) -> xr.Dataset:
        solving.append(Kept(checkpoint, ensemble.group, names[number]))
        kept = Recorded(model, KeptSolves(solving[-1], solved))
        whitened = method.whitened(number, len(model.parameters))
        try:
            solution = kept.solve(prior.root(whitened))
        except SolveError:
            ensemble.count(1, 1)
            raise
        ensemble.count(1, 0)
        sigma = method.sigma(values, solution.outputs[None])
        mesh = uncalibrated(solution) if method.mesh_error and number == 0 else None
        found = of_field(kept, solution, whitened, prior, prior.matern.mass, sigma, goals, method.rank, method.seed)
        return found if mesh is None else found.assign(mesh_error=("value", mesh))

    def forget() -> None:
        while solving:
            solving.pop().forget()

    def results(outcomes: Sequence[Outcome]) -> xr.Dataset:
        found = [one.dataset for one in outcomes if one.dataset is not None]
        if not found:
            raise SolveError(f"the model has no answer at any of the {len(outcomes)} draws: {outcomes[0].reason}")
        return method.of_fields(found, values)

    return TasksJob(
        names,
        linearise,
        lambda number, outcome: None,
        forget,
        results,
        texts=lambda found: files(spec, found),
    )


def uncalibrated(solution: Solution) -> FloatArray | None:
    """Estimate what the mesh takes away from the outputs (m,) of a solution; None where nothing tells."""
    try:
        error = solution.mesh_error()
    except SolveError:
        return None
    return None if error is None else error.outputs


def values_of(spec: Any, model: Any) -> Measurements:
    """Say of each output of a model what it is and where it is measured."""
    if not spec.placed:
        return of_outputs(spec)
    cases = [spec.cases[number] for number in model.cases]
    parts = [
        AXES[axis] if axis < len(AXES) else case.outputs[axis - len(AXES)].name
        for axis, case in zip(model.axes, cases, strict=True)
    ]
    return Measurements.possible(model.outputs, model.places, [case.name for case in cases], parts)
