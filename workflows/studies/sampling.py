"""A study that samples a model: a written-down constructor call of a model, its random parameters and a method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import ValidationError, model_validator

from forward.findings import Finding
from forward.machine import MIB
from forward.model import ModelError
from forward.scalars import Mistake
from uq.accuracy.budget import FEWEST
from workflows.config.priors import findings_of_materials, inputs_of, ranges
from workflows.config.tables import at
from workflows.run.from_python import FromPython
from workflows.studies.sampling_blocks import SamplingBlocks
from workflows.studies.study import Sampled, StudyKind

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job


class Study(SamplingBlocks, FromPython, StudyKind):
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
    sensitivity
        What else is asked of derivatives.
    """

    stopped: ClassVar[str] = "one linearisation"
    explains: ClassVar[bool] = False

    @property
    def sampled(self) -> Sampled:
        return Sampled(self.inputs, self.spec)

    @property
    def memory(self) -> float:
        return super().memory + (self.bytes_of_estimates if self.estimates else 0.0)

    @property
    def growth(self) -> tuple[float, str]:
        """Memory (bytes) of the largest mesh that it may make, and what sets it; 0 where it makes none."""
        if self.accuracy.tolerance is None or not self.estimates:
            return super().growth
        from workflows.accuracy.levers import MeshLever

        if not MeshLever.of(self).moves:
            return super().growth
        return MIB * self.accuracy.memory, "what accuracy.memory"

    @property
    def findings(self) -> tuple[Finding, ...]:
        materials = self.spec.materials(self.inputs.names)
        of_draws = () if materials is None else findings_of_materials(self.inputs.within(materials), fail=True)
        found = (*self.model.findings_over(ranges(self.given)), *of_draws, *self._of_estimates())
        if self.source is not None:
            found = (*found, *self.source.findings(self.spec, self.inputs))
        if self.accuracy.tolerance is None:
            return found
        from workflows.accuracy import tolerance_words

        return *found, *tolerance_words.findings(self)

    def _of_estimates(self) -> Iterator[Finding]:
        if self.accuracy.mesh_error and self.spec.hidden:
            yield Finding("mesh-of-body", "note", {"why": self.spec.hidden})
        elif "mesh_error" in self.accuracy.model_fields_set and self.accuracy.mesh_error and not self.spec.meshed:
            yield Finding("no-mesh", "note", {"kind": self.model.kind})
        if self.estimating and self.too_large is not None:
            yield Finding(
                "mesh-estimates-too-large", "warning", {"memory": self.too_large, "limit": self.accuracy.memory}
            )
        if self.accuracy.tolerance is None and 0 < self.estimates < FEWEST:  # a tolerance takes as many as it needs
            yield Finding("mesh-estimates-few", "note", {"points": self.estimates})
        if self.accuracy.mesh_error and self.spec.meshed and self.spec.unestimated_with:
            yield Finding("mesh-with-memory", "warning", {"what": self.spec.unestimated_with})

    def plan(self, rank_groups: int) -> list[str]:
        from workflows.studies.plans import of_sampling

        return of_sampling(self, self.memory, rank_groups)

    def prepared(self, ensemble: Ensemble, directory: Path, say: Callable[[str], None]) -> Self:
        """Refine the mesh, where that is asked for; collective."""
        found = self
        if self.model.unrefined:
            from workflows.accuracy.adapted_mesh import on_adapted_mesh

            found = on_adapted_mesh(self, ensemble, directory, say)
        if self.accuracy.tolerance is not None and self.estimates:
            from workflows.accuracy.tolerance import on_fine_mesh
            from workflows.run.own_code import identity

            found = on_fine_mesh(found, ensemble, directory, say, identity)
        return found

    @property
    def kept(self) -> Self:
        """The study, with a mesh that was refined where its results are."""
        if not self.model.adaptive:
            return self
        from workflows.accuracy.adapted_mesh import MESH

        return self.of(self.model.on_mesh(MESH, self.solid.body.contents))

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        from workflows.studies.sampling_job import job

        return job(self, ensemble, directory)

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        others = {name: other.identity() for name, other in self.models.items()}
        return super().identity() | self.by_contents | ({"models": others} if others else {})

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, value: Any) -> Any:
        """Take `mesh_error` from beside the blocks into its own, unless that says it too.

        And say what a tolerance for all errors leaves out of a file: the method, or how many samples it takes.
        """
        match {"accuracy": {}} | value:
            case {"mesh_error": asked, "accuracy": {**block}, **rest} if "mesh_error" not in block:
                value = rest | {"accuracy": block | {"mesh_error": asked}}
        if at(value, "accuracy", "tolerance") is None:
            return value
        from workflows.accuracy.levers import completed

        return completed(value)

    def mistakes(self) -> Iterator[Mistake]:
        if self.source is not None:
            wrong = list(self.source.mistakes(self.model, tuple(self.parameters)))
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
        yield from self.mistakes_of_parameters()
        if self.accuracy.tolerance is not None or self.method.kind == "automatic":
            from workflows.accuracy import tolerance_words

            yield from tolerance_words.mistakes(self)
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
