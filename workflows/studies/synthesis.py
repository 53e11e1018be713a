"""Studies that make synthetic data: a known model is solved, and measured with errors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from forward.scalars import Mistake
from forward.spec import MEASURED, ModelSpec
from inverse.methods.synthesize import Synthesize
from uq.evaluation.evaluate import Recorder
from workflows.config.one_model import OneModel
from workflows.config.priors import ranges
from workflows.data.synthetic import displacements, files_of, outputs
from workflows.run.from_python import FromPython
from workflows.studies.job import MethodJob
from workflows.studies.predictions import duration
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    import xarray as xr

    from forward.findings import Finding
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate


class Synthesis(OneModel, FromPython, StudyKind):
    """What synthetic data to make: displacements of a specimen, or outputs of any other model.

    Parameters
    ----------
    model
        The specimen to be measured, with its observations; or another model, whose outputs are measured. Errors that
        are relative are so to the root mean square of an output over its steps; data sets have a share of the steps.
    parameters
        Distributions of numbers that are drawn for each data set; coefficients of random fields always are.
    correlations
        Correlations between them.
    method
        Errors, and the points that data sets have.
    """

    stopped: ClassVar[str] = "all data made"
    explains: ClassVar[bool] = False

    model: Annotated[ModelSpec, MEASURED]
    method: Synthesize

    @property
    def findings(self) -> tuple[Finding, ...]:
        return self.model.findings_over(ranges(self.parameters))

    @property
    def planned(self) -> int:
        return len(self.method.fraction) + 1

    def plan(self, rank_groups: int) -> list[str]:
        sets, cost = len(self.method.fraction), self.spec.cost()
        names = [] if self.model.placed else [output.name for output in self.model.returned]
        return [
            f"method      {self.method.kind}",
            *(f"{what:10}  {found}" for what, found in self.model.described(ranges(self.parameters))),
            *([f"outputs     {', '.join(names)}"] if names else []),
            f"data sets   {sets}",
            *([] if cost is None else [f"time        about {duration(sets * cost.textbook)} on 1 core (rough)"]),
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> MethodJob:
        model: Any = self.spec.build(ensemble.group, self.inputs.names)
        spec: Any = self.model
        made = displacements(spec, self.method, self.inputs, model, ensemble) if spec.placed else outputs(spec, model)
        recorders: dict[str, Recorder] = {}

        def task(evaluate: Evaluate) -> xr.Dataset:
            recorders["/"] = Recorder(evaluate)
            return self.method.run(self.inputs, recorders["/"], made.groups, made.points)

        def texts(found: xr.Dataset) -> dict[str, str]:
            texts = files_of(made, self.model, self.method, self.inputs, name, found)
            return {f"data/{file}": text for file, text in texts.items()}

        return MethodJob(made.model, {}, task, recorders, labelled=made.labelled, texts=texts)

    def mistakes(self) -> Iterator[Mistake]:
        if self.model.placed:
            yield from self._mistakes_of_specimen(self.model)
        yield from self.model.mistakes_of_mesh()
        for i in self.nodal:
            message = "values at the vertices are not independent, expected 'modes' or 'noise'"
            yield ("model", "fields", i, "basis"), message, "nodes"
        yield from self.mistakes_of_parameters()

    def _mistakes_of_specimen(self, model: Any) -> Iterator[Mistake]:
        method = self.method
        if not model.observed and not any(case.outputs for case in model.cases):
            message = "nothing is observed, expected boundaries or points, or outputs of load cases"
            yield ("model", "observed"), message, ()
        if method.format != "csv" and any(case.outputs for case in model.cases):
            yield ("method", "format"), "outputs of load cases are written to tables, expected 'csv'", method.format
        if method.format != "stl":
            return
        if not any(item.on is not None for item in model.observed):
            yield ("model", "observed"), "surfaces are of boundaries, expected { on = ... }", ()
        if method.missing > 0 or min(method.fraction) < 1:
            yield ("method", "format"), "surfaces have all their points, expected fraction = 1 and missing = 0", "stl"
        if method.noise.absolute is None:
            message = "one standard deviation is stated of all surfaces, expected absolute errors"
            yield ("method", "noise"), message, method.noise.model_dump(exclude_none=True)
