"""A study that samples a model: a written-down constructor call of a model, its random parameters and a method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, ValidationError, model_validator

from forward.findings import Finding
from forward.machine import MIB
from forward.model import ModelError
from forward.registry import OfKind, named
from forward.scalars import Mistake
from forward.spec import MODELS, ModelSpec
from uq.accuracy.budget import FEWEST, OF_SOLVER, estimates_for, spare_for
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from uq.methods.method import MESH, METHODS, Method
from workflows.config.blocks import Accuracy, Correlation
from workflows.config.priors import (
    findings_of_draws,
    inputs_of,
    mistakes_of_priors,
    ranges,
)
from workflows.config.source import AVERAGED, READER, STACKED, Sourced
from workflows.studies.study import Sampled, StudyKind

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluations
    from workflows.studies.job import Job


OF_TOLERANCE = "workflows.studies.tolerance_asked"  # what a tolerance of all errors decides and forbids


class Study(Sourced, StudyKind):
    """What to compute.

    Parameters
    ----------
    model
        A body, or a model of another program.
    parameters
        Distributions by the paths of the numbers of the model that they replace; may be left out if the model has
        random fields, whose coefficients are parameters automatically. ``from`` among them names draws (`source`).
    source
        Draws of further numbers; in a file it is ``parameters.from``.
    correlations
        Correlations between them.
    method
        What is computed and how.
    accuracy
        What is asked of errors beside those of sampling. ``mesh_error`` may stand beside the blocks too.
    """

    stopped: ClassVar[str] = "one linearisation"
    explains: ClassVar[bool] = False

    model: Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")]
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    method: Annotated[Method, OfKind(METHODS)]
    accuracy: Accuracy = Accuracy()

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Study:
        """Check the blocks of a study, or of one that is averaged over the candidates of a comparison."""
        parameters = blocks.get("parameters")
        source = parameters.get("from") if isinstance(parameters, Mapping) else None
        if isinstance(source, Mapping) and source.get("model") in (AVERAGED, STACKED):
            of_all: type[Study] = named("workflows.studies.averaged:AveragedStudy")
            return of_all.model_validate(blocks)
        return cls.model_validate(blocks)

    @property
    def inputs(self) -> Inputs:
        """The random parameters: those that are given, and then the standard normal coefficients of random fields."""
        return inputs_of(self.parameters, self.correlations, self.model.coefficients, draws=self.draws)

    @cached_property
    def spec(self) -> ModelSpec:
        """The model, in the form that suits all values of its parameters, solved as exactly as a tolerance needs."""
        spec, asked = self.model.over(ranges(self.given)), self.accuracy.tolerance
        solver = spec.solver_tolerance
        return spec if asked is None or solver is None else spec.solved_to(min(solver, OF_SOLVER * asked))

    @property
    def sampled(self) -> Sampled:
        """The model with its random parameters."""
        return Sampled(self.inputs, self.spec)

    @property
    def models(self) -> dict[str, ModelSpec]:
        """The models that the method may ask for beside that one, by name."""
        return self.method.models(self.spec)

    @property
    def meshes(self) -> tuple[ModelSpec, ...]:
        """The model, and the same on the finer meshes that a multilevel method may use."""
        return self.spec, *(model for name, model in self.models.items() if name.startswith(MESH))

    @property
    def planned(self) -> int:
        """Number of solves: the most if a tolerance may end the study earlier, the least for multilevel methods."""
        return self.method.planned(len(self.inputs.names))

    @cached_property
    def estimates(self) -> int:
        """Number of estimates of the error of the mesh with the planned solves: none of models without one.

        Methods on several meshes, and comparisons that are asked to solve on a finer one, estimate it themselves.
        """
        return 0 if not self._estimating or self._too_large is not None else self.estimates_of(self.planned)

    def estimates_of(self, solves: int) -> int:
        """Number of estimates of the error of the mesh that so many solves afford, two at least, by predicted times."""
        paid: float = named("workflows.studies.predictions:estimates_paid")(self.spec, len(self.inputs.names), solves)
        return estimates_for(solves, paid)

    @property
    def spare(self) -> float:
        """How many solves the calibration of these estimates may cost with the planned solves."""
        return math.inf if self.accuracy.tolerance is not None else spare_for(self.planned)

    @property
    def _estimating(self) -> bool:
        theirs = len(self.meshes) > 1 or getattr(self.method, "mesh_error", False)
        return self.accuracy.mesh_error and self.spec.meshed and not theirs and not self.spec.remembers

    @cached_property
    def _too_large(self) -> float | None:
        """Memory (MiB) that an estimate of the error of the mesh and its calibration take, if that is too much."""
        needed = self._bytes_of_estimates / MIB
        return needed if needed > self.accuracy.memory else None

    @cached_property
    def _bytes_of_estimates(self) -> float:
        cost = self.spec.mesh_error_cost(self.spare)
        return 0.0 if cost is None else cost.bytes + cost.calibration_bytes

    @property
    def memory(self) -> float:
        """Memory (bytes) of a group of ranks beside that of the program; 0 where there are no finite elements."""
        return super().memory + (self._bytes_of_estimates if self.estimates else 0.0)

    @property
    def growth(self) -> tuple[float, str]:
        """Memory (bytes) of the largest mesh that it may make, and what sets it; 0 where it makes none."""
        if self.accuracy.tolerance is None or not self.estimates or not named(f"{OF_TOLERANCE}:refinement")(self)[0]:
            return super().growth
        return MIB * self.accuracy.memory, "what accuracy.memory"

    @property
    def solves(self) -> int:
        """Number of solves, those for the error of the mesh too."""
        return self.planned + self.estimates

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the study before anything is solved."""
        materials = self.spec.materials(self.inputs.names)
        of_draws = () if materials is None else findings_of_draws(self.inputs.within(materials))
        found = (*self.model.findings_over(ranges(self.given)), *of_draws, *self._of_estimates())
        if self.source is not None:
            found = (*found, *named(f"{READER}:findings")(self.source, self.spec, self.inputs))
        return found if self.accuracy.tolerance is None else (*found, *named(f"{OF_TOLERANCE}:findings")(self))

    def _of_estimates(self) -> Iterator[Finding]:
        if self.accuracy.mesh_error and self.spec.hidden:
            yield Finding("mesh-of-body", "note", {"why": self.spec.hidden})
        elif "mesh_error" in self.accuracy.model_fields_set and self.accuracy.mesh_error and not self.spec.meshed:
            yield Finding("no-mesh", "note", {"kind": self.model.kind})
        if self._estimating and self._too_large is not None:
            yield Finding(
                "mesh-estimates-too-large", "warning", {"memory": self._too_large, "limit": self.accuracy.memory}
            )
        if self.accuracy.tolerance is None and 0 < self.estimates < FEWEST:  # a tolerance takes as many as it needs
            yield Finding("mesh-estimates-few", "note", {"points": self.estimates})
        if self.accuracy.mesh_error and self.spec.meshed and self.spec.remembers:
            yield Finding("mesh-with-memory", "note", {"what": self.spec.remembers})

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The model, and those beside it."""
        return self.spec, *self.models.values()

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is sampled, how often, and how long that will take."""
        from workflows.studies.plans import of_sampling

        return of_sampling(self, rank_groups)

    def prepared(self, ensemble: Ensemble, directory: Path, say: Callable[[str], None]) -> Study:
        """Refine the mesh, where that is asked for; collective."""
        found: Study = self
        if self.model.unrefined:
            found = named("workflows.studies.adapted_mesh:on_adapted_mesh")(self, ensemble, directory, say)
        if self.accuracy.tolerance is not None and self.estimates:
            found = named("workflows.studies.tolerance:on_fine_mesh")(found, ensemble, directory, say)
        return found

    @property
    def kept(self) -> Study:
        """The study, with a mesh that was refined where its results are."""
        if not self.model.adaptive:
            return self
        found: Study = named("workflows.studies.adapted_mesh:kept")(self)
        return found

    def of(self, model: ModelSpec) -> Study:
        """Return the same study of another model."""
        return type(self)(**{name: getattr(self, name) for name in type(self).model_fields} | {"model": model})

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the model, and others that the method may want, at the points of the method; collective."""
        made: Job = named("workflows.studies.sampling_job:job")(self, ensemble, directory)
        return made

    def finished(self, dataset: xr.Dataset, evaluations: Mapping[str, Evaluations]) -> xr.Dataset:
        """Add how the stability of each sample was tested."""
        with_stability = named("workflows.studies.sampling_job:with_stability")
        found: xr.Dataset = with_stability(self, dataset, evaluations["/"])
        found = named("workflows.studies.sampling_job:with_unknown_meshes")(self, found)
        return named("workflows.studies.adapted_mesh:with_history")(self, found) if self.model.adaptive else found

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        others = {name: other.identity() for name, other in self.models.items()}
        return super().identity() | self.by_contents | ({"models": others} if others else {})

    @model_validator(mode="before")
    @classmethod
    def _choose_method(cls, value: Any) -> Any:
        """Say what a tolerance for all errors leaves out of a file: the method, or how many samples it takes."""
        accuracy = value.get("accuracy") if isinstance(value, dict) else None
        asked = isinstance(accuracy, dict | Accuracy) and "tolerance" in dict(accuracy)
        return named(f"{OF_TOLERANCE}:completed")(value) if asked else value

    @model_validator(mode="before")
    @classmethod
    def _gather_accuracy(cls, value: Any) -> Any:
        """Take `mesh_error` from beside the blocks into its own, unless that says it too."""
        if not isinstance(value, dict) or "mesh_error" not in value:
            return value
        accuracy = value.get("accuracy", {})
        if not isinstance(accuracy, dict) or "mesh_error" in accuracy:
            return value
        rest = {name: block for name, block in value.items() if name != "mesh_error"}
        return rest | {"accuracy": accuracy | {"mesh_error": value["mesh_error"]}}

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if self.source is not None:
            wrong = list(named(f"{READER}:mistakes")(self.source, self.model, tuple(self.parameters)))
            yield from wrong
            if wrong:
                return
        unfit = list(self.method.unfit(self.spec))
        yield from unfit
        if not unfit:
            yield from self._mistakes_of_models()
        if not self.given and not self.model.coefficients:
            or_field = ", or one of model.fields" if self.spec.meshed else ""
            yield ("parameters",), f"no parameter is random, expected at least one{or_field}", {}
        yield from mistakes_of_priors(self.spec, self.parameters, self.correlations, lambda: self.inputs, self.draws)
        if self.accuracy.tolerance is not None or self.method.kind == "automatic":
            yield from named(f"{OF_TOLERANCE}:mistakes")(self)
        not_sampled = list(self.spec.mistakes_of_samples())
        yield from not_sampled
        yield from self.mistakes_of_ranks(self.spec)
        inputs = inputs_of(self.parameters, (), self.model.coefficients)
        with suppress(ValueError):  # correlations, which are reported above
            inputs = self.inputs
        if not not_sampled:
            yield from self.method.mistakes(inputs, self.spec)

    def _mistakes_of_models(self) -> Iterator[Mistake]:
        try:
            _ = self.models
        except ValidationError as error:
            message = f"the finest mesh cannot be: {error.errors()[0]['msg']}"
            yield ("method", "levels"), message, getattr(self.method, "levels", None)
        except ModelError as error:
            yield ("method", "kind"), str(error), self.method.kind
