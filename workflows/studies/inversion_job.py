"""The job of an inversion: one data set, whose solves all groups of ranks share, or data sets side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from forward.combine import Recorded, along_columns
from forward.fem.finer import FinerMeshes, extrapolated
from forward.machine import write_text
from forward.model import FloatArray, ForwardModel, SolveError
from forward.settings import one_line
from inverse.criticism.assumptions import by_evaluation, by_model
from inverse.criticism.finer import Finer
from inverse.criticism.questions import Questions
from inverse.data.measurements import Measurements
from inverse.data.shared_motion import SharedMotion, together
from inverse.methods.infer import Problem, Sampled, Starts
from inverse.methods.invert import Invert, derivable
from inverse.methods.invert_few import Nearby, invert_few
from inverse.methods.model_error import Truth
from inverse.methods.record import as_dataset, noise_of
from inverse.methods.stand_ins import SharedExpansion, invert_by_reduced, shared_expansion
from uq.evaluation.evaluate import ALL_AGAIN, Recorder, SerialEvaluate, Steps
from uq.evaluation.kept import Kept, KeptSolves
from uq.evaluation.request import Evaluate, Evaluations
from uq.evaluation.tasks import Outcome
from uq.findings import add
from workflows.data.measured import motion_of, observing
from workflows.studies import predicted
from workflows.studies.assumptions import ASSUMED, SAMPLED
from workflows.studies.candidates import TRUTH
from workflows.studies.inversion_blocks import PREDICTED, InversionBlocks
from workflows.studies.inversion_results import BATCH, Vertices, batch_table, dataset, judged, table_of_finished
from workflows.studies.job import MOVED, MethodJob, TasksJob, kept_starts
from workflows.studies.solves import of_answers
from workflows.studies.study import FINER

if TYPE_CHECKING:
    import xarray as xr

    from forward.joined_models import JoinedMeshes
    from inverse.methods.predict import Band
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble

BY_REDUCED = "an inversion of the body itself with method.reduced corrects that, and the error of the reduced model"
On = Callable[[str, ForwardModel], Evaluate]  # evaluates models beside that of a data set, by name


def job(study: InversionBlocks, ensemble: Ensemble, directory: Path, checkpoint: Checkpoint) -> MethodJob | TasksJob:
    """Make the model; collective over the group."""
    inverting = _Inverting(study, ensemble, checkpoint)
    return inverting.one_job() if study.together else inverting.job_of_many(directory)


@dataclass(frozen=True)
class _Observed:
    """What a data set is compared with."""

    model: ForwardModel  # of what was measured
    # What is asked besides, by name: the same on finer meshes (`forward.fem.finer`), what tells which errors
    # the data share, the model with the numbers that are taken for granted, and with those that can be sampled, and
    # the one against which its errors are learnt.
    beside: dict[str, ForwardModel]
    motion: SharedMotion | None  # what is uncertain of rigid motions
    questions: Questions | None  # to its shape


class _Inverting:
    """The models of an inversion on a group of ranks, and what is done by them with a data set; made collectively.

    Those are of a specimen, or of outputs of which the data tell which were measured.
    """

    def __init__(self, study: InversionBlocks, ensemble: Ensemble, checkpoint: Checkpoint) -> None:
        spec, comm, taken = study.spec, ensemble.group, study.taken
        self.study, self.ensemble, self.checkpoint, self.taken = study, ensemble, checkpoint, taken
        model: Any = spec.build(comm, study.unknown)
        derivable(model, spec.kind)
        self.model = model
        self.meshes: FinerMeshes | JoinedMeshes | None = None
        self.unseen = f"{spec.hidden}; {BY_REDUCED}" if spec.hidden else None  # why; None without a mesh
        if spec.bodies:
            self.meshes, self.unseen = self._meshes()
        self.held = None if taken is None else taken.build(comm)
        self.truth = None if study.model_error is None else study.truth.build(comm, study.unknown)
        self.asking = asking(spec, study.unknown, comm) if study.method.question else lambda data: None
        self.predicted = None if study.predict is None else study.predicts.by_deviations(comm)
        # Places (N, 3) of the vertices of a specimen, cells, and VTK's number of their kind; None of other models.
        at = model.vertices if spec.placed else None
        self.vertices: Vertices | None = None if at is None else (at.coordinates, *at.cells())
        self.solving: list[Kept] = []  # of the data set at hand

    def _meshes(self) -> tuple[FinerMeshes | JoinedMeshes | None, str]:
        """Return a body on finer meshes, which are first solved on at the mean, or why there are none."""
        study = self.study
        if not study.looked:
            return None, study.unlooked
        start = np.zeros(len(study.unknown)) if study.field else study.inputs.mean
        try:
            return extrapolated(self.model, start, kept_starts(self.checkpoint, self.ensemble.group)), ""
        except ValueError as error:  # a mesh that is not divided, or would be too large
            return None, one_line(str(error))

    def look(self, points: FloatArray) -> FloatArray:
        """Return ln of the stiffness factor (n, N) at the vertices of a specimen, of parameters (n, d)."""
        assert self.vertices is not None
        return np.asarray(self.study.stiffness(self.vertices[0], points) + self.model.log_fields(points))

    def observed(self, number: int) -> _Observed:
        """Return what a data set, by its number, is compared with; a SolveError if there is nothing; collective."""
        study, model, taken = self.study, self.model, self.taken
        data, own, motion = study.measurements[number], model, None
        beside: dict[str, ForwardModel | None] = {TRUTH: self.truth}
        if study.spec.placed:
            try:
                own = observing(model, data)
            except ValueError as error:  # a place that is far from the mesh: the other data sets go on
                raise SolveError(str(error)) from None
            motion = motion_of(data, study.model.body)
            beside[MOVED] = None if motion is None else model.observing(*motion.observed)
            beside[TRUTH] = None if self.truth is None else observing(self.truth, data)
        beside[FINER] = None if self.meshes is None else self.meshes.of(own)
        if taken is not None:
            beside[ASSUMED] = taken.observed(self.held, data)
            can = taken.sampled and not study.field
            beside[SAMPLED] = taken.sampling(observing(self.held, data), study.inputs) if can else None
        there = {name: one for name, one in beside.items() if one is not None}
        return _Observed(own, there, motion, self.asking(data))

    def problem(self, number: int, seen: _Observed, on: On, kept: Kept, start: Starts | None) -> Problem[Invert]:
        """Return what is inverted of a data set, by its number; with a reduced model, steps are done repeatedly."""
        study, taken, beside, ensemble = self.study, self.taken, seen.beside, self.ensemble
        data, learnt = study.measurements[number], study.model_error
        finer = None if self.unseen is None else Finer(None, self.unseen)
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
            elsewhere = predicted.elsewhere_of(study)
        steps = Steps(kept, count=ensemble.count) if study.method.reduced is None else ALL_AGAIN
        besides: dict[str, Any] = {"assumed": assumed, "sampled": sampled, "truth": truth, "elsewhere": elsewhere}
        besides |= {"model": seen.model, "questions": seen.questions, "say": ensemble.say, "steps": steps}
        return Problem(data, study.method, study.data.errors, finer, shared, start, **besides)

    def inverted(self, problem: Problem[Invert], evaluate: Recorder, cheap: ForwardModel | None) -> xr.Dataset:
        """Invert a data set for few parameters, with a reduced model if there is one, which is `cheap`."""
        inputs = self.study.inputs
        if cheap is None:
            return invert_few(inputs, evaluate, problem, None if self.vertices is None else self.look).dataset
        if problem.shared is not None:  # a reduced model would have to know what moved points do
            message = (
                "method.reduced: uncertain motions of scans are not counted with it, expected a known motion or none"
            )
            raise SolveError(message)
        return invert_by_reduced(inputs, evaluate, cheap, problem)

    def with_predictions(self, found: xr.Dataset, on: On, before: Callable[[], Band]) -> xr.Dataset:
        """Add what the posterior of few parameters says on what is predicted, beside what the prior says of it."""
        assert self.predicted is not None
        each = on(PREDICTED, self.predicted), on(f"{PREDICTED}, mesh", self.predicted)
        record = predicted.of_few(self.study, found, *each, before)
        return found.merge(as_dataset(record))

    def written(self) -> dict[str, Any]:
        """Return what every job of an inversion leaves beside its results."""

        def labelled(found: xr.Dataset) -> xr.Dataset:
            found = judged(found, self.study)
            if not self.study.model.bodies:
                add(found, *of_answers(self.model, self.study.inputs))
            return found

        return {"labelled": labelled, "texts": lambda found: {BATCH: batch_table(found)}}

    # --- one data set, whose solves all groups share -----------------------------------------------------------------

    def one_job(self) -> MethodJob:
        """Return the job of one data set; collective over the group."""
        study, seen, there = self.study, self.observed(0), self.predicted
        recorders: dict[str, Recorder] = {}
        cheap = self.reduced()(seen.model)
        models = seen.beside | ({} if there is None else {PREDICTED: there})
        others = {name: partial(lambda one: one, model) for name, model in models.items()}

        def task(evaluate: Evaluate) -> xr.Dataset:
            full = recorders["/"] = Recorder(evaluate)

            def on(name: str, _: ForwardModel) -> Evaluate:
                if name == PREDICTED:
                    return recorders.setdefault(name, Recorder(evaluate.on(name)))
                # Values at moved points and errors of meshes are not kept.
                return full.on(name) if name == FINER else evaluate.on(name.partition(",")[0])

            problem = self.problem(0, seen, on, Kept(self.checkpoint, MPI.COMM_SELF, "steps"), None)
            found = self.inverted(problem, full, cheap)
            if there is not None:
                before = partial(predicted.prior_band, study, on(PREDICTED, there))
                found = self.with_predictions(found, on, before)
            return dataset(study, [Outcome(found, "", None, 0.0)], self.vertices)

        return MethodJob(seen.model, others, task, recorders, **self.written())

    # --- data sets side by side, each on one group -------------------------------------------------------------------

    def kept(self, name: str) -> Kept:
        """Return what keeps solves of the data set at hand, by their name."""
        self.solving.append(Kept(self.checkpoint, self.ensemble.group, name))
        return self.solving[-1]

    def job_of_many(self, directory: Path) -> TasksJob:
        """Return the job of several data sets, each a task."""
        study, names = self.study, [one.name for one in self.study.data.sets]
        finished = table_of_finished(study, self.vertices, partial(write_text, directory / BATCH))
        reduced, there = self.reduced(), None if study.field else self.predicted
        expanded = cache(self.expanded)
        invert_field = self.inverting_field() if study.field else None

        def beside(name: str, model: ForwardModel) -> SerialEvaluate:
            """Solve other models, on finer meshes or at moved points, which are no solves of the model."""
            return SerialEvaluate(model, kept=self.kept(name))

        @cache
        def before() -> Band:
            assert there is not None
            return predicted.prior_band(study, beside(f"prior, {PREDICTED}", there))

        def invert(number: int, solved: list[Evaluations]) -> xr.Dataset:
            def on(name: str, model: ForwardModel) -> SerialEvaluate:
                return beside(f"{names[number]}/{name}", model)

            found = inverted(number, solved, on)
            return found if there is None else self.with_predictions(found, on, before)

        def inverted(number: int, solved: list[Evaluations], on: On) -> xr.Dataset:
            if study.measurements[number] is None:
                raise SolveError(study.data.sets[number].refused)
            if study.method.expansion is not None:
                found, log = expanded()
                if all(one is None for one in study.measurements[:number]):  # those of the first that can be used
                    solved += log
                return self.by_expansion(found, number)
            seen, name = self.observed(number), names[number]
            near = None if study.field else partial(Nearby.at, seen.model, spread=study.inputs.std)
            problem = self.problem(number, seen, on, self.kept(name), near)
            if invert_field is not None:
                return invert_field(name, Recorded(seen.model, KeptSolves(self.kept(name), solved)), problem)
            full = Recorder(SerialEvaluate(seen.model, self.ensemble.count, kept=self.kept(name)), log=solved)
            return self.inverted(problem, full, reduced(seen.model))

        def results(outcomes: Sequence[Outcome]) -> xr.Dataset:
            if all(one.dataset is None for one in outcomes):
                raise SolveError("; ".join(f"{name}: {one.reason}" for name, one in zip(names, outcomes, strict=True)))
            return dataset(study, outcomes, self.vertices)

        return TasksJob(names, invert, results, self.solving, finished, **self.written())

    def expanded(self) -> tuple[SharedExpansion, list[Evaluations]]:
        """Solve for the expansion that all data sets share; every group does so, or reads what others have solved."""

        def kept(model: ForwardModel, label: str) -> Recorder:
            stored = Kept(self.checkpoint, self.ensemble.group, label)
            return Recorder(SerialEvaluate(model, self.ensemble.count, kept=stored))

        first, samples = self.observed(0), self.study.method.expansion
        fine = kept(first.beside[FINER], f"expansion, {FINER}") if FINER in first.beside else None
        assert samples is not None
        own = kept(self.model, "expansion")
        return shared_expansion(self.study.inputs, own, fine, samples, self.unseen or ""), own.log

    def by_expansion(self, found: SharedExpansion, number: int) -> xr.Dataset:
        """Invert a data set with the expansion, whose errors are among those of the data."""
        study, data = self.study, self.study.measurements[number]
        missed = found.error[data.axes]
        wider = replace(data, sigma=np.hypot(data.sigma, missed))
        near = partial(Nearby.at, found.model, spread=study.inputs.std)
        known = study.data.errors, found.finer
        problem = Problem(wider, study.method, *known, start=near, model=found.model, say=self.ensemble.say)
        one = invert_few(study.inputs, SerialEvaluate(found.model), problem).dataset
        size, count = float((missed / data.sigma).max()), found.solves + found.finer_solves
        return one.assign(solves=0.0, expansion_error=size, expansion_solves=float(count))

    def inverting_field(self) -> Callable[[str, ForwardModel, Problem[Invert]], xr.Dataset]:
        """Return what inverts a data set, by its name, for a field of a specimen."""
        from inverse.fields.field_posterior import FieldPosterior
        from inverse.methods.invert_field import Vertices, invert_field

        study, model, there, count = self.study, self.model, self.predicted, self.ensemble.count
        prior = study.model.fields[0].prior(study.model.body)
        offset = model.log_fields(np.zeros((1, len(model.parameters))))[0]
        predicting: predicted.FieldPredictions | None = None
        if there is not None:
            predicting = predicted.of_field(study, lambda name: Recorded(there, KeptSolves(self.kept(name))))

        def invert(name: str, states: ForwardModel, problem: Problem[Invert]) -> xr.Dataset:
            posterior = FieldPosterior(states, problem.data.values, noise_of(problem), prior, progress=count)
            predict = None if predicting is None else partial(predicting, name)
            return invert_field(posterior, problem, Vertices(offset, prior.matern.mass), predict)

        return invert

    def reduced(self) -> Callable[[Any], ForwardModel | None]:
        """Load what stands for a model with which data are compared; no model is returned where that is asked itself.

        What is returned is collective over the ranks of that model.
        """
        study = self.study
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


# --- questions to the shape of a body --------------------------------------------------------------------------------


def asking(spec: Any, names: tuple[str, ...], comm: Any) -> Callable[[Measurements], Questions]:
    """Return what makes the questions for a data set on a body with unknown numbers, by their paths; collective."""
    from forward.enlargements import enlarged, enlargements, fitted
    from forward.fem.layout import vertex_matrices

    larger, paths = enlarged(spec)
    model = larger.build(comm, (*names, *paths))
    places = vertex_matrices(spec.body)[3]
    forms = partial(enlargements, spec, names, places=places)

    def of(data: Measurements) -> Questions:
        own = observing(model, data)

        def having(wanted: Sequence[str], patterns: FloatArray) -> SerialEvaluate:
            columns = dict(zip((name for name in wanted if name not in names), patterns, strict=True))
            return SerialEvaluate(along_columns(own, wanted, columns, np.zeros(len(paths))))

        return Questions(own, forms, having, partial(fitted, spec, places=places))

    return of
