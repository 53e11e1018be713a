"""Studies that say which observations to make: those that tell most on a model, or tell candidate models apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field

from forward.findings import Finding
from forward.registry import OfKind
from forward.scalars import Mistake
from forward.spec import MODELS, ModelSpec
from inverse.methods.design import Design
from workflows.config.blocks import AVERAGED
from workflows.config.priors import findings_of_materials, ranges
from workflows.config.source import Sourced
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


PRODUCTS = 600  # with the derivative, for the directions of a field that many candidates tell


class DesignStudy(Sourced, FromPython, StudyKind):
    """What could be observed, and how much of it.

    Parameters
    ----------
    model
        What is measured: a specimen, whose `observed` displacements and outputs of load cases are the candidates, or
        any other model, whose outputs are.
    parameters
        Priors by the paths of the unknown numbers of the model; none for a field of nodal values.
    source
        Draws of unknown numbers; in a file it is ``parameters.from``: a posterior as prior.
    correlations
        Correlations between them.
    method
        What is chosen and how.
    """

    stopped: ClassVar[str] = "a design"
    explains: ClassVar[bool] = False

    restricted: ClassVar[bool] = True

    model: Annotated[ModelSpec, OfKind(MODELS, "specimen")]
    method: Design

    @property
    def planned(self) -> int:
        """Number of solves: one for each draw."""
        return self.method.draws

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about model and prior before anything is solved."""
        inputs, source = self.inputs, self.source
        of_draws = () if source is None else source.findings(self.spec, inputs)
        return (*self.model.findings_over(ranges(self.given)), *findings_of_materials(inputs), *of_draws)

    @classmethod
    def forms(cls) -> Iterator[type[StudyKind]]:
        """One model, and several to be told apart."""
        yield DesignStudy
        yield DesignOfModels

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> StudyKind:  # type: ignore[override]
        """Check the blocks of a design for one model, or for telling several apart."""
        if "candidates" in blocks:
            return DesignOfModels.model_validate(blocks)
        return cls.model_validate(blocks)

    def plan(self, rank_groups: int) -> list[str]:
        """Say what can be chosen, and how long that will take."""
        method, cost, d = self.method, self.spec.cost(), len(self.inputs.names)
        unknown = f"{d}: {', '.join(self.inputs.names[:12])}{', …' if d > 12 else ''}"
        if self.field:
            unknown = f"{len(self.model.coefficients):,} values of ln stiffness"
        derivatives = 0.0 if cost is None else PRODUCTS * PRODUCT * cost.textbook if self.field else cost.tangents(d)
        seconds = 0.0 if cost is None else method.draws * (cost.textbook + derivatives)
        return [
            f"method      {method.kind}, criterion {method.criterion}",
            *(f"{what:10}  {found}" for what, found in self.model.described(ranges(self.given))),
            f"unknown     {unknown}",
            f"chosen      {method.wanted}",
            f"solves      {self.planned}, each with its derivatives",
            *([] if cost is None else [f"time        about {duration(seconds)} on 1 core (rough)"]),
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the model; collective."""
        return job(self.method, self.spec, self.inputs, ensemble, checkpoint, field=self.field)

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        return super().identity() | self.by_contents

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if self.method.criterion == "models":
            yield ("method", "criterion"), "one model, expected several as candidates", "models"
        if self.source is not None:
            if self.source.model == AVERAGED:
                yield ("parameters", "from", "model"), "one model is linearised, expected one of them", AVERAGED
                return
            wrong = list(self.source.mistakes(self.model, tuple(self.parameters)))
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
        yield from self.model.mistakes_of_mesh()
        yield from self.mistakes_of_ranks(self.spec)
        yield from self.mistakes_of_parameters()
        yield from mistakes_of_values(self.method, self.model)


class DesignOfModels(OfCandidates, FromPython, StudyKind):
    """What could be observed, and the models that it should tell apart.

    Parameters
    ----------
    model
        What is measured, as far as the candidates have it in common; see `DesignStudy`.
    candidates
        Models by name, as of a comparison.
    method
        What is chosen and how.
    """

    stopped: ClassVar[str] = "a design"
    explains: ClassVar[bool] = False

    model: dict[str, Any]
    candidates: dict[str, ModelCandidate] = Field(min_length=2)
    method: Design

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The models of all candidates."""
        return tuple(self.of_candidates.values())

    @property
    def planned(self) -> int:
        """Number of solves: one for each draw of each candidate."""
        return self.method.draws * len(self.candidates)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the models before anything is solved, each once."""
        return tuple(dict.fromkeys(self.findings_of_models))

    def plan(self, rank_groups: int) -> list[str]:
        """Say what can be chosen to tell what apart, and how long that will take."""
        costs = [spec.cost() for spec in self.specs]
        seconds = self.method.draws * sum(cost.textbook for cost in costs if cost is not None)
        return [
            f"method      {self.method.kind}, criterion {self.method.criterion}",
            *(f"candidate   {name}: {spec.description}" for name, spec in self.of_candidates.items()),
            f"chosen      {self.method.wanted}",
            f"solves      {self.planned}",
            *([] if None in costs else [f"time        about {duration(seconds)} on 1 core (rough)"]),
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the models; collective."""
        weights = {name: one.weight for name, one in self.candidates.items()}
        return job_of_models(self.method, self.of_candidates, self.priors, weights, ensemble)

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if self.method.criterion != "models":
            yield ("method", "criterion"), "there are candidates, expected 'models'", self.method.criterion
        first = True
        for _, spec, wrong in self.models_and_mistakes():
            yield from wrong
            if spec is None:
                continue
            if first:  # which the others are observed like
                yield from mistakes_of_values(self.method, spec)
                first = False
            yield from self.mistakes_of_ranks(spec)
