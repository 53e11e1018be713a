"""The job of an inversion: one data set, whose solves all groups of ranks share, or data sets side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from forward.combine import Recorded
from forward.fem.finer import FinerMeshes, Keep, extrapolated
from forward.machine import write_text
from forward.model import FloatArray, ForwardModel, SolveError
from forward.settings import one_line
from inverse.criticism.assumptions import by_evaluation, by_model
from inverse.criticism.finer import Finer
from inverse.data.shared_motion import SharedMotion, together
from inverse.methods.infer import Problem, Sampled, Starts
from inverse.methods.invert import Invert, derivable
from inverse.methods.invert_few import Look, Nearby, invert_few
from inverse.methods.model_error import Truth
from inverse.methods.record import as_dataset, noise_of
from inverse.methods.shared_expansion import SharedExpansion, shared_expansion
from uq.evaluation.evaluate import ALL_AGAIN, Recorder, SerialEvaluate, Steps
from uq.evaluation.kept import Kept, KeptSolves
from uq.evaluation.request import Evaluate, Evaluations
from uq.evaluation.tasks import Outcome
from uq.findings import add
from workflows.data.measured import motion_of, observing
from workflows.studies.assumptions import ASSUMED, SAMPLED
from workflows.studies.candidates import TRUTH
from workflows.studies.inversion_blocks import PREDICTED, InversionBlocks
from workflows.studies.inversion_results import BATCH, Vertices, batch_table, dataset, judged, table_of_finished
from workflows.studies.job import MOVED, MethodJob, TasksJob, kept_starts
from workflows.studies.predictions import FINER
from workflows.studies.solves import of_answers

if TYPE_CHECKING:
    import xarray as xr

    from forward.joined_models import JoinedMeshes
    from inverse.criticism.questions import Questions
    from inverse.methods.predict import Band
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.predicted import FieldPredictions

BY_REDUCED = "an inversion of the body itself with method.reduced corrects that, and the error of the reduced model"
On = Callable[[str, ForwardModel], Evaluate]  # evaluates models beside that of a data set, by name


def job(study: InversionBlocks, ensemble: Ensemble, directory: Path, checkpoint: Checkpoint) -> MethodJob | TasksJob:
    """Make the model; collective over the group."""
    made = _made(study, ensemble, kept_starts(checkpoint, ensemble.group))
    if study.together:
        return _one(study, made, ensemble, checkpoint)
    return _many(study, made, ensemble, directory, checkpoint)


@dataclass(frozen=True)
class _Observed:
    """What a data set is compared with.

    Attributes
    ----------
    model
        The model of what was measured.
    beside
        What is asked besides, by name: the same on finer meshes (`forward.fem.finer`), what tells which errors the data
        share, the model with the numbers that are taken for granted, and with those that can be sampled, and the one
        against which its errors are learnt; those that there are.
    unseen
        Why there is none on finer meshes, empty if there is one; None without a mesh.
    motion
        What is uncertain of rigid motions; None if nothing is.
    questions
        Questions to its shape; None where there are none.
    """

    model: ForwardModel
    beside: dict[str, ForwardModel]
    unseen: str | None
    motion: SharedMotion | None
    questions: Questions | None


@dataclass(frozen=True)
class _Made:
    """A measured model, as inversions need it.

    Attributes
    ----------
    model
        The model.
    observed
        What a data set, by its number, is compared with; a SolveError if there is nothing.
    predicted
        The model of what is predicted, if anything is.
    vertices
        Places (N, 3) of the vertices of a specimen, cells, and VTK's number of their kind; None of other models.
    look
        Parameters (n, d) → ln of the stiffness factor (n, N) at the vertices, of a specimen.
    """

    model: ForwardModel
    observed: Callable[[int], _Observed]
    predicted: ForwardModel | None
    vertices: Vertices | None = None
    look: Look | None = None


def _made(study: InversionBlocks, ensemble: Ensemble, keep: Keep) -> _Made:
    """Make a specimen, or a model with outputs of which the data tell which were measured; collective."""
    spec, comm, taken = study.spec, ensemble.group, study.taken
    model: Any = spec.build(comm, study.unknown)
    derivable(model, spec.kind)
    meshes, unseen = None, f"{spec.hidden}; {BY_REDUCED}" if spec.hidden else None
    if spec.bodies:
        meshes, unseen = _meshes(study, model, keep)
    held = None if taken is None else taken.build(comm)
    truth = None if study.model_error is None else study.truth.build(comm, study.unknown)
    asked = None
    if study.method.question:
        from workflows.studies.questions import asking

        asked = asking(spec, study.unknown, comm)

    def observed(number: int) -> _Observed:
        data, own, motion = study.measurements[number], model, None
        beside: dict[str, ForwardModel | None] = {TRUTH: truth}
        if spec.placed:
            try:
                own = observing(model, data)
            except ValueError as error:  # a place that is far from the mesh: the other data sets go on
                raise SolveError(str(error)) from None
            motion = motion_of(data, study.model.body)
            beside[MOVED] = None if motion is None else model.observing(*motion.observed)
            beside[TRUTH] = None if truth is None else observing(truth, data)
        beside[FINER] = None if meshes is None else meshes.of(own)
        if taken is not None:
            beside[ASSUMED] = taken.observed(held, data)
            can = taken.sampled and not study.field
            beside[SAMPLED] = taken.sampling(observing(held, data), study.inputs) if can else None
        there = {name: one for name, one in beside.items() if one is not None}
        return _Observed(own, there, unseen, motion, None if asked is None else asked(data))

    predicted = None if study.predict is None else study.predicts.by_deviations(comm)
    if not spec.placed:
        return _Made(model, observed, predicted)
    vertices = (model.vertices.coordinates, *model.vertices.cells())

    def look(points: FloatArray) -> FloatArray:
        return np.asarray(study.stiffness(vertices[0], points) + model.log_fields(points))

    return _Made(model, observed, predicted, vertices, look)


def _meshes(study: InversionBlocks, model: ForwardModel, keep: Keep) -> tuple[FinerMeshes | JoinedMeshes | None, str]:
    """Return a body on finer meshes, which are first solved on at the mean, or why there are none."""
    if not study.looked:
        return None, study.unlooked
    start = np.zeros(len(study.unknown)) if study.field else study.inputs.mean
    try:
        return extrapolated(model, start, keep), ""
    except ValueError as error:  # a mesh that is not divided, or would be too large
        return None, one_line(str(error))


def _written(study: InversionBlocks, made: _Made) -> dict[str, Any]:
    """Return what every job of an inversion leaves beside its results."""

    def labelled(found: xr.Dataset) -> xr.Dataset:
        found = judged(found, study)
        if study.specimen is None and not study.model.bodies:
            add(found, *of_answers(made.model, study.inputs))
        return found

    def texts(found: xr.Dataset) -> dict[str, str]:
        return {BATCH: batch_table(found)}

    return {"labelled": labelled, "texts": texts}


def _problem(
    study: InversionBlocks, number: int, seen: _Observed, on: On, ensemble: Ensemble, kept: Kept, start: Starts | None
) -> Problem[Invert]:
    """Return what is inverted of a data set, by its number; with a reduced model, steps are done more than once."""
    data, taken, learnt, beside = study.measurements[number], study.taken, study.model_error, seen.beside
    finer = None if seen.unseen is None else Finer(None, seen.unseen)
    if FINER in beside:
        finer = Finer.by(on(FINER, beside[FINER]))
    shared = None if seen.motion is None else seen.motion.errors_by(on(MOVED, beside[MOVED]))
    assumed = sampled = elsewhere = None
    if taken is not None:
        held = beside.get(ASSUMED)
        ask = None if held is None else by_model(held) if study.field else by_evaluation(on(ASSUMED, held))
        assumed = taken.of(data, ask)
        shared = together(shared, assumed.shared)
        if SAMPLED in beside:
            sampled = Sampled(taken.sampled, lambda: beside[SAMPLED], on(SAMPLED, beside[SAMPLED]))
    truth = None if learnt is None else Truth(on(TRUTH, beside[TRUTH]), learnt.solves, study.method.seed)
    if study.predict is not None and study.data.errors.process:
        from workflows.studies.predicted import elsewhere_of

        elsewhere = elsewhere_of(study)
    steps = Steps(kept, count=ensemble.count) if study.method.reduced is None else ALL_AGAIN
    besides: dict[str, Any] = {"assumed": assumed, "sampled": sampled, "truth": truth, "elsewhere": elsewhere}
    besides |= {"model": seen.model, "questions": seen.questions, "say": ensemble.say, "steps": steps}
    return Problem(data, study.method, study.data.errors, finer, shared, start, **besides)


def _inverted(
    study: InversionBlocks, made: _Made, problem: Problem[Invert], evaluate: Recorder, cheap: ForwardModel | None
) -> xr.Dataset:
    """Invert a data set for few parameters, with a reduced model if there is one, which is `cheap`."""
    if cheap is None:
        return invert_few(study.inputs, evaluate, problem, made.look).dataset
    if problem.shared is not None:  # a reduced model would have to know what moved points do
        message = "method.reduced: uncertain motions of scans are not counted with it, expected a known motion or none"
        raise SolveError(message)
    from inverse.methods.by_reduced import invert_by_reduced

    return invert_by_reduced(study.inputs, evaluate, cheap, problem)


def _with_predictions(
    study: InversionBlocks, found: xr.Dataset, model: ForwardModel, on: On, before: Callable[[], Band]
) -> xr.Dataset:
    """Add what the posterior of few parameters says on the model of what is predicted, beside what the prior says."""
    from workflows.studies.predicted import of_few

    record = of_few(study, found, on(PREDICTED, model), on(f"{PREDICTED}, mesh", model), before)
    return found.merge(as_dataset(record))


def _many(study: InversionBlocks, made: _Made, ensemble: Ensemble, directory: Path, checkpoint: Checkpoint) -> TasksJob:
    """Data sets side by side, each on one group."""
    names = [one.name for one in study.data.sets]
    finished = table_of_finished(study, made.vertices, partial(write_text, directory / BATCH))
    solving: list[Kept] = []  # of the data set at hand
    reduced, predicted = _reduced(study), None if study.field else made.predicted
    expanded = cache(partial(_expanded, study, made, ensemble, checkpoint))

    def kept(name: str) -> Kept:
        solving.append(Kept(checkpoint, ensemble.group, name))
        return solving[-1]

    def beside(name: str, model: ForwardModel) -> SerialEvaluate:
        """Solve other models, on finer meshes or at moved points, which are no solves of the model."""
        return SerialEvaluate(model, kept=kept(name))

    invert_field = _inverting_field(study, made, ensemble, kept) if study.field else None

    @cache
    def before() -> Band:
        assert predicted is not None
        from workflows.studies.predicted import prior_band

        return prior_band(study, beside(f"prior, {PREDICTED}", predicted))

    def invert(number: int, solved: list[Evaluations]) -> xr.Dataset:
        def on(name: str, model: ForwardModel) -> SerialEvaluate:
            return beside(f"{names[number]}/{name}", model)

        found = inverted(number, solved, on)
        return found if predicted is None else _with_predictions(study, found, predicted, on, before)

    def inverted(number: int, solved: list[Evaluations], on: On) -> xr.Dataset:
        if study.measurements[number] is None:
            raise SolveError(study.data.sets[number].refused)
        if study.method.expansion is not None:
            found, log = expanded()
            if all(one is None for one in study.measurements[:number]):  # those of the first data set that can be used
                solved += log
            return _by_expansion(study, found, number, ensemble.say)
        seen = made.observed(number)
        near = None if study.field else partial(Nearby.at, seen.model, spread=study.inputs.std)
        problem = _problem(study, number, seen, on, ensemble, kept(names[number]), near)
        if invert_field is not None:
            return invert_field(names[number], Recorded(seen.model, KeptSolves(kept(names[number]), solved)), problem)
        full = Recorder(SerialEvaluate(seen.model, ensemble.count, kept=kept(names[number])), log=solved)
        return _inverted(study, made, problem, full, reduced(seen.model))

    def results(outcomes: Sequence[Outcome]) -> xr.Dataset:
        if all(one.dataset is None for one in outcomes):
            raise SolveError("; ".join(f"{name}: {one.reason}" for name, one in zip(names, outcomes, strict=True)))
        return dataset(study, outcomes, made.vertices)

    return TasksJob(names, invert, results, solving, finished, **_written(study, made))


def _expanded(
    study: InversionBlocks, made: _Made, ensemble: Ensemble, checkpoint: Checkpoint
) -> tuple[SharedExpansion, list[Evaluations]]:
    """Solve for the expansion that all data sets share; every group does so, or reads what others have solved."""

    def kept(model: ForwardModel, label: str) -> Recorder:
        return Recorder(SerialEvaluate(model, ensemble.count, kept=Kept(checkpoint, ensemble.group, label)))

    first, samples = made.observed(0), study.method.expansion
    fine = kept(first.beside[FINER], f"expansion, {FINER}") if FINER in first.beside else None
    assert samples is not None
    own = kept(made.model, "expansion")
    return shared_expansion(study.inputs, own, fine, samples, first.unseen or ""), own.log


def _by_expansion(
    study: InversionBlocks, found: SharedExpansion, number: int, say: Callable[[str], None]
) -> xr.Dataset:
    """Invert a data set with the expansion, whose errors are among those of the data."""
    data = study.measurements[number]
    missed = found.error[data.axes]
    wider = replace(data, sigma=np.hypot(data.sigma, missed))
    near = partial(Nearby.at, found.model, spread=study.inputs.std)
    known = study.data.errors, found.finer
    problem = Problem(wider, study.method, *known, start=near, model=found.model, say=say)
    one = invert_few(study.inputs, SerialEvaluate(found.model), problem).dataset
    size, count = float((missed / data.sigma).max()), found.solves + found.finer_solves
    return one.assign(solves=0.0, expansion_error=size, expansion_solves=float(count))


def _inverting_field(
    study: InversionBlocks, made: _Made, ensemble: Ensemble, kept: Callable[[str], Kept]
) -> Callable[[str, ForwardModel, Problem[Invert]], xr.Dataset]:
    """Return what inverts a data set, by its name, for a field of a specimen."""
    from inverse.fields.field_posterior import FieldPosterior
    from inverse.methods.invert_field import Vertices, invert_field

    model: Any = made.model
    prior = study.model.fields[0].prior(study.model.body)
    offset = model.log_fields(np.zeros((1, len(model.parameters))))[0]
    predicting: FieldPredictions | None = None
    predicted = made.predicted
    if predicted is not None:
        from workflows.studies.predicted import of_field

        predicting = of_field(study, lambda name: Recorded(predicted, KeptSolves(kept(name))))

    def invert(name: str, states: ForwardModel, problem: Problem[Invert]) -> xr.Dataset:
        posterior = FieldPosterior(states, problem.data.values, noise_of(problem), prior, progress=ensemble.count)
        predict = None if predicting is None else partial(predicting, name)
        return invert_field(posterior, problem, Vertices(offset, prior.matern.mass), predict)

    return invert


def _reduced(study: InversionBlocks) -> Callable[[Any], ForwardModel | None]:
    """Load what stands for a model with which data are compared; no model is returned where that is asked itself.

    What is returned is collective over the ranks of that model.
    """
    if study.method.reduced is None:
        return lambda observed: None
    if study.specimen is None:
        alone: ForwardModel = study.reduced[""].standing_for(study.spec, study.inputs.names)
        return lambda observed: alone
    bodies = [study.specimen.loaded(case) for case in study.specimen.cases]
    acting = [tuple(p for p in study.inputs.names if p in {*one.scalars, *one.coefficients}) for one in bodies]
    found = zip(study.reduced.values(), bodies, acting, strict=True)
    models = tuple(one.standing_for(body, paths) for one, body, paths in found)
    from forward.reduced.model import observed_by

    return lambda observed: observed_by(observed, models)


def _one(study: InversionBlocks, made: _Made, ensemble: Ensemble, checkpoint: Checkpoint) -> MethodJob:
    """One data set, whose solves all groups share; collective over the group."""
    seen, predicted = made.observed(0), made.predicted
    recorders: dict[str, Recorder] = {}
    cheap = _reduced(study)(seen.model)
    models = seen.beside | ({} if predicted is None else {PREDICTED: predicted})
    others = {name: partial(lambda one: one, model) for name, model in models.items()}

    def task(evaluate: Evaluate) -> xr.Dataset:
        full = recorders["/"] = Recorder(evaluate)

        def on(name: str, _: ForwardModel) -> Evaluate:
            if name == PREDICTED:
                return recorders.setdefault(name, Recorder(evaluate.on(name)))
            # Values at moved points and errors of meshes are not kept.
            return full.on(name) if name == FINER else evaluate.on(name.partition(",")[0])

        problem = _problem(study, 0, seen, on, ensemble, Kept(checkpoint, MPI.COMM_SELF, "steps"), None)
        found = _inverted(study, made, problem, full, cheap)
        if predicted is not None:
            from workflows.studies.predicted import prior_band

            before = partial(prior_band, study, on(PREDICTED, predicted))
            found = _with_predictions(study, found, predicted, on, before)
        return dataset(study, [Outcome(found, "", None, 0.0)], made.vertices)

    return MethodJob(seen.model, others, task, recorders, **_written(study, made))
