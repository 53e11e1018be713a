"""Studies that say which observations to make: those that tell most on a model, or tell candidate models apart."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, SerializeAsAny, model_validator

from forward.findings import Finding
from forward.registry import OfKind
from forward.scalars import Mistake
from forward.spec import MODELS, ModelSpec
from inverse.methods.design import Design
from workflows.config.blocks import AS_DECIDED, AVERAGED, PartOrKind, decided
from workflows.config.priors import findings_of_materials, ranges
from workflows.config.source import Sourced
from workflows.config.tables import at
from workflows.run.from_python import FromPython
from workflows.studies.candidates import ModelCandidate, OfCandidates
from workflows.studies.design_job import job, job_of_models
from workflows.studies.design_job import mistakes as mistakes_of_values
from workflows.studies.predictions import PRODUCT, duration
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job


ANY_MODEL = OfKind(MODELS, "specimen")
PRODUCTS = 600  # with the derivative, for the directions of a field that many candidates tell


class DesignStudy(Sourced, OfCandidates, FromPython, StudyKind):
    """What could be observed, and how much of it.

    Parameters
    ----------
    model
        What is measured: a specimen, whose `observed` displacements and outputs of load cases can be chosen, or any
        other model, whose outputs can; with candidates, as far as these have it in common.
    parameters
        Priors by the paths of the unknown numbers of the model; none for a field of nodal values.
    source
        Draws of unknown numbers; in a file it is ``parameters.from``: a posterior as prior.
    correlations
        Correlations between them.
    candidates
        Models by name, as of a comparison, that the observations should tell apart.
    method
        What is chosen and how.
    """

    stopped: ClassVar[str] = "a design"
    explains: ClassVar[bool] = False
    restricted: ClassVar[bool] = True

    model: Annotated[SerializeAsAny[ModelSpec] | dict[str, Any], AS_DECIDED, PartOrKind(ANY_MODEL)]
    candidates: Annotated[dict[str, ModelCandidate], Field(min_length=2)] | None = None
    method: Design

    @model_validator(mode="before")
    @classmethod
    def _by_candidates(cls, blocks: Any) -> Any:
        """Take the model as it is where each candidate completes it."""
        whole = at(blocks, "candidates") is None
        return decided(blocks, model=Annotated[ModelSpec, ANY_MODEL]) if whole else blocks

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The model, or those of all candidates."""
        return tuple(self.of_candidates.values()) or (self.spec,)

    @property
    def planned(self) -> int:
        """Number of solves: one for each draw, of each candidate."""
        return self.method.draws * len(self.candidates or "1")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about models and priors before anything is solved, each once."""
        if self.candidates is not None:
            return tuple(dict.fromkeys(self.findings_of_models))
        model: Any = self.model
        inputs, source = self.inputs, self.source
        of_draws = () if source is None else source.findings(self.spec, inputs)
        return (*model.findings_over(ranges(self.given)), *findings_of_materials(inputs), *of_draws)

    def plan(self, rank_groups: int) -> list[str]:
        """Say what can be chosen, to know what or tell what apart, and how long that will take."""
        method, costs = self.method, [spec.cost() for spec in self.specs]
        draw = sum(cost.textbook for cost in costs if cost is not None)
        if self.candidates is None:
            told, draw = self._unknown(draw)
        else:
            told = [f"candidate   {name}: {spec.description}" for name, spec in self.of_candidates.items()]
        return [
            f"method      {method.kind}, criterion {method.criterion}",
            *told,
            f"chosen      {method.wanted}",
            f"solves      {self.planned}{'' if self.candidates else ', each with its derivatives'}",
            *([] if None in costs else [f"time        about {duration(method.draws * draw)} on 1 core (rough)"]),
        ]

    def _unknown(self, solve: float) -> tuple[list[str], float]:
        """Say what is unknown of the model, and predict the time (s) of a draw: a solve with its derivatives."""
        model: Any = self.model
        cost, d = self.spec.cost(), len(self.inputs.names)
        unknown = f"{d}: {', '.join(self.inputs.names[:12])}{', …' if d > 12 else ''}"
        if self.field:
            unknown = f"{len(model.coefficients):,} values of ln stiffness"
        derivatives = 0.0 if cost is None else PRODUCTS * PRODUCT * cost.textbook if self.field else cost.tangents(d)
        lines = (f"{what:10}  {found}" for what, found in model.described(ranges(self.given)))
        return [*lines, f"unknown     {unknown}"], solve + derivatives

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the model, or those of all candidates; collective."""
        if self.candidates is None:
            return job(self.method, self.spec, self.inputs, ensemble, checkpoint, field=self.field)
        weights = {name: one.weight for name, one in self.candidates.items()}
        return job_of_models(self.method, self.of_candidates, self.priors, weights, ensemble)

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the unknowns, of a candidate if there are some."""
        return self.inputs.names if self.candidates is None else super().parameters_of(label)

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the numbers of the model, or of that of a candidate."""
        return StudyKind.units_of(self, label) if self.candidates is None else super().units_of(label)

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        return super().identity() | (self.by_contents if self.candidates is None else {})

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        yield from self._of_model() if self.candidates is None else self._of_candidates()

    def _of_model(self) -> Iterator[Mistake]:
        model: Any = self.model
        if self.method.criterion == "models":
            yield ("method", "criterion"), "one model, expected several as candidates", "models"
        if self.source is not None:
            if self.source.model == AVERAGED:
                yield ("parameters", "from", "model"), "one model is linearised, expected one of them", AVERAGED
                return
            wrong = list(self.source.mistakes(model, tuple(self.parameters)))
            yield from wrong
            if wrong:
                return
        fields, nodal = self.random_fields, self.nodal
        if nodal and (len(fields) > 1 or self.given):
            message = "a field of nodal values is unknown alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
            return
        if nodal and fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", "density"
        if not nodal and not self.inputs.names:
            yield ("parameters",), "nothing is unknown, expected at least one parameter", {}
        yield from model.mistakes_of_mesh()
        yield from self.mistakes_of_ranks(self.spec)
        yield from self.mistakes_of_parameters()
        yield from mistakes_of_values(self.method, model)

    def _of_candidates(self) -> Iterator[Mistake]:
        if self.method.criterion != "models":
            yield ("method", "criterion"), "there are candidates, expected 'models'", self.method.criterion
        for block, given in (("parameters", self.parameters), ("correlations", self.correlations)):
            if given or self.source is not None:
                yield (block,), "those of each candidate are its own, expected none of the model", list(given)
                return
        first = True
        for _, spec, wrong in self.models_and_mistakes():
            yield from wrong
            if spec is None:
                continue
            if first:  # which the others are observed like
                yield from mistakes_of_values(self.method, spec)
                first = False
            yield from self.mistakes_of_ranks(spec)
