"""Studies that say which observations tell candidate models apart."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, TypeAdapter

from forward.registry import OfKind, named
from forward.scalars import Mistake
from forward.spec import MODELS, ModelSpec
from inverse.methods.design import Design
from workflows.config.priors import ranges
from workflows.studies.design_values import mistakes
from workflows.studies.model_selection import ModelCandidate, changed, described
from workflows.studies.predictions import duration
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    from forward.findings import Finding
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.inputs.random_parameters import Inputs
    from workflows.studies.job import Job

_SPEC: TypeAdapter[ModelSpec] = TypeAdapter(Annotated[ModelSpec, OfKind(MODELS, "specimen")])


class DesignOfModels(StudyKind):
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

    @cached_property
    def of_candidates(self) -> dict[str, ModelSpec]:
        """The model of each candidate, in the form that suits all values of its parameters."""
        return {
            name: _SPEC.validate_python(changed(self.model, one.model)).over(ranges(one.parameters))
            for name, one in self.candidates.items()
        }

    @property
    def priors(self) -> dict[str, Inputs]:
        """The unknowns of each candidate."""
        return {name: one.restricted(self.of_candidates[name]) for name, one in self.candidates.items()}

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
        found = (spec.findings_over(ranges(self.candidates[name].parameters)) for name, spec in self._named)
        return tuple(dict.fromkeys(one for several in found for one in several))

    @property
    def _named(self) -> Iterator[tuple[str, ModelSpec]]:
        yield from self.of_candidates.items()

    def plan(self, rank_groups: int) -> list[str]:
        """Say what can be chosen to tell what apart, and how long that will take."""
        costs = [spec.cost() for spec in self.specs]
        seconds = self.method.draws * sum(cost.textbook for cost in costs if cost is not None)
        return [
            f"method      {self.method.kind}, criterion {self.method.criterion}",
            *(f"candidate   {name}: {spec.description}" for name, spec in self._named),
            f"chosen      {self.method.wanted}",
            f"solves      {self.planned}",
            *([] if None in costs else [f"time        about {duration(seconds)} on 1 core (rough)"]),
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the models; collective."""
        weights = {name: one.weight for name, one in self.candidates.items()}
        make = named("workflows.studies.design_job:job_of_models")
        found: Job = make(self.method, self.of_candidates, self.priors, weights, ensemble)
        return found

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the unknowns of a candidate."""
        return self.priors[label].names

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the numbers of a candidate's model."""
        return {path: number.unit for path, number in self.of_candidates[label].scalars.items()}

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if self.method.criterion != "models":
            yield ("method", "criterion"), "there are candidates, expected 'models'", self.method.criterion
        first = True
        for place, spec, wrong in described(self.candidates, self.model, _SPEC.validate_python):
            yield from wrong
            if spec is None:
                continue
            if first:  # which the others are observed like
                yield from mistakes(self.method, spec)
                first = False
            yield from self.mistakes_of_ranks(spec)
            if spec.coefficients:
                message = "random fields, expected numbers only"
                yield (*place, "model", "fields"), message, len(spec.coefficients)
