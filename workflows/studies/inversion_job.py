"""The job of an inversion: one data set, whose solves all groups of ranks share, or data sets side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from forward.model import SolveError
from inverse.criticism.finer import Finer
from inverse.methods.invert_few import invert_by_all, invert_by_group
from uq.evaluation.evaluate import Evaluate, Evaluations, Recorder
from uq.evaluation.tasks import Outcome
from workflows.results.directory import write_text
from workflows.studies.findings_inversion import judged
from workflows.studies.finer import FINER, finer_mesh, on_finer_mesh, solved_by
from workflows.studies.inversion_results import BATCH, Rows, batch_table, dataset, groups
from workflows.studies.job import MethodJob, TasksJob

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from forward.fem.finer import FinerMesh
    from forward.model import FloatArray, ForwardModel
    from forward.specimen import SpecimenModel
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.tasks import Outcome
    from workflows.studies.inversion import Inversion


def job(study: Inversion, ensemble: Ensemble, directory: Path, checkpoint: Checkpoint) -> MethodJob | TasksJob:
    """Make the specimen; collective over the group."""
    return _one(study, ensemble) if study.together else _many(study, ensemble, directory, checkpoint)


@dataclass(frozen=True)
class _Specimen:
    """What inversions of a specimen need of it; making it is collective over the group.

    Attributes
    ----------
    model
        The specimen.
    vertices
        Places (N, 3) of its vertices, cells, and VTK's number of their kind.
    look
        Parameters (n, d) → ln of the stiffness factor (n, N) at the vertices.
    mesh
        The specimen on a finer mesh, or `why` there is none.
    """

    model: SpecimenModel
    vertices: tuple[FloatArray, NDArray[np.int64], int]
    look: Callable[[FloatArray], FloatArray]
    mesh: FinerMesh | None
    why: str

    @classmethod
    def of(cls, study: Inversion, ensemble: Ensemble) -> _Specimen:
        model = study.specimen.build(ensemble.group, study.model.coefficients if study.field else study.inputs.names)
        vertices = (model.vertices.coordinates, *model.vertices.cells())

        def look(points: FloatArray) -> FloatArray:
            return study.stiffness(vertices[0], points) + model.log_fields(points)

        mesh, why = finer_mesh(model) if study.method.mesh_check else (None, "method.mesh_check = false")
        return cls(model, vertices, look, mesh, why)


def _many(study: Inversion, ensemble: Ensemble, directory: Path, checkpoint: Checkpoint) -> TasksJob:
    """Data sets side by side, each on one group."""
    from inverse.fields.field_posterior import FieldPosterior
    from inverse.methods.invert_field import Vertices, invert_field
    from uq.evaluation.kept import KeptEvaluate, KeptModel

    method, errors = study.method, study.data.errors
    specimen = _Specimen.of(study, ensemble)
    model, vertices = specimen.model, specimen.vertices
    prior = study.model.fields[0].prior(study.model.body) if study.field else None
    names = [one.name for one in study.data.sets]
    rows = Rows(study, vertices, lambda text: write_text(directory / BATCH, text))
    solving: list[KeptEvaluate | KeptModel] = []  # of the data set at hand

    def invert(number: int, solved: list[Evaluations]) -> xr.Dataset:
        if study.measurements[number] is None:
            raise SolveError(study.data.sets[number].refused)
        data = study.measurements[number].observations.components()
        try:
            observed = model.observing(data.places, data.axes, data.cases)
        except ValueError as error:  # a place that is far from the mesh: the other data sets go on
            raise SolveError(str(error)) from None
        finer = Finer(None if specimen.mesh is None else partial(specimen.mesh.outputs, observed), specimen.why)
        if prior is None:
            kept = KeptEvaluate(observed, ensemble.group, checkpoint, names[number], ensemble.count, log=solved)
            solving.append(kept)
            return invert_by_group(study.inputs, observed, data, method, specimen.look, errors, finer, kept)
        states = KeptModel(observed, ensemble.group, checkpoint, names[number], log=solved)
        solving.append(states)
        posterior = FieldPosterior(states, data.values, data.sigma, prior, progress=ensemble.count, errors=errors)
        offset = model.log_fields(np.zeros((1, len(model.parameters))))[0]
        return invert_field(posterior, data, method, Vertices(offset, prior.matern.mass), finer)

    def forget() -> None:
        """Remove the solves of a data set: what follows from them is kept."""
        while solving:
            solving.pop().forget()

    def results(outcomes: Sequence[Outcome]) -> xr.Dataset:
        if all(one.dataset is None for one in outcomes):
            raise SolveError("; ".join(f"{name}: {one.reason}" for name, one in zip(names, outcomes, strict=True)))
        return dataset(study, outcomes, vertices)

    return TasksJob(
        names,
        invert,
        rows.add,
        forget,
        results,
        lambda found: judged(found, study),
        groups=partial(groups, study),
        texts=lambda found: {BATCH: batch_table(found)},
    )


def _one(study: Inversion, ensemble: Ensemble) -> MethodJob:
    """One data set, whose solves all groups share; collective over the group."""
    specimen = _Specimen.of(study, ensemble)
    data = study.measurements[0].observations.components()
    observed = specimen.model.observing(data.places, data.axes, data.cases)
    recorders: dict[str, Recorder] = {}
    others: dict[str, Callable[[], ForwardModel]] = {}
    if specimen.mesh is not None:
        others = {FINER: partial(on_finer_mesh, observed, partial(specimen.mesh.outputs, observed))}

    def task(evaluate: Evaluate) -> xr.Dataset:
        recorders["/"] = Recorder(evaluate)
        finer = solved_by(recorders["/"].on(FINER)) if others else Finer(None, specimen.why)
        errors = study.data.errors
        found = invert_by_all(study.inputs, recorders["/"], data, study.method, specimen.look, errors, finer)
        return dataset(study, [Outcome(found, "", None, 0.0)], specimen.vertices)

    return MethodJob(
        observed,
        others,
        task,
        recorders,
        lambda found: judged(found, study),
        groups=partial(groups, study),
        texts=lambda found: {BATCH: batch_table(found)},
    )
