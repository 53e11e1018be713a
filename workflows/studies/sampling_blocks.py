"""What stands in a study that samples a model, and what follows from it before anything is solved."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar

from forward.machine import MIB
from forward.registry import OfKind
from forward.settings import Settings
from forward.spec import MODELS, ModelSpec
from uq.accuracy.budget import OF_SOLVER, estimates_for, spare_for
from uq.methods.method import MESH, METHODS, Method
from workflows.config.blocks import Accuracy
from workflows.config.one_model import Sourced
from workflows.config.priors import ranges
from workflows.studies.study import estimates_paid, never_estimable

if TYPE_CHECKING:
    from forward.fem.mesh_error_cost import Estimate
    from uq.accuracy.doubts import Told
    from workflows.studies.assumptions import TakenForGranted


class Sensitivity(Settings):
    """What else is asked of derivatives.

    Parameters
    ----------
    all
        Derivatives of the outputs at the mean by all numbers of the model, not by the random ones alone: which constant
        that nobody made uncertain matters most. One solve, and an adjoint for each output.
    """

    all: bool = False


class SamplingBlocks(Sourced):
    """The blocks of a study that samples a model, as `workflows.studies.sampling.Study` explains them."""

    model: Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")]
    method: Annotated[Method, OfKind(METHODS)]
    accuracy: Accuracy = Accuracy()
    sensitivity: Sensitivity = Sensitivity()

    @cached_property
    def spec(self) -> ModelSpec:
        spec, asked = self.model.over(ranges(self.given)), self.accuracy.tolerance
        solver = spec.solver_tolerance
        return spec if asked is None or solver is None else spec.solved_to(min(solver, OF_SOLVER * asked))

    @property
    def solid(self) -> Any:
        """The body on whose mesh the model is solved (`forward.loaded.LoadedBody`)."""
        return self.model.bodies[0]

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
        return 0 if not self.estimating or self.too_large is not None else self.estimates_of(self.planned)

    def estimates_of(self, solves: int) -> int:
        """Number of estimates of the error of the mesh that so many solves afford, two at least, by predicted times."""
        return estimates_for(solves, estimates_paid(self.spec, len(self.inputs.names), solves))

    @property
    def spare(self) -> float:
        """How many solves the calibration of these estimates may cost with the planned solves."""
        return math.inf if self.accuracy.tolerance is not None else spare_for(self.planned)

    @property
    def estimating_cost(self) -> Estimate | None:
        """Times and memory of these estimates; None where there are none."""
        return self.spec.mesh_error_cost(self.spare) if self.estimates else None

    @property
    def estimating(self) -> bool:
        """Whether the error of the mesh is estimated, if there is memory for that."""
        theirs = len(self.meshes) > 1 or getattr(self.method, "mesh_error", False)
        return self.accuracy.mesh_error and self.spec.meshed and not theirs and not self.spec.unestimated_with

    @cached_property
    def too_large(self) -> float | None:
        """Memory (MiB) that an estimate of the error of the mesh and its calibration take, if that is too much."""
        needed = self.bytes_of_estimates / MIB
        return needed if needed > self.accuracy.memory else None

    @cached_property
    def bytes_of_estimates(self) -> float:
        """Memory (bytes) of an estimate and of its calibration."""
        cost = self.spec.mesh_error_cost(self.spare)
        return 0.0 if cost is None else cost.bytes + cost.calibration_bytes

    @property
    def solves(self) -> int:
        """Number of solves, those for the error of the mesh too."""
        return self.planned + self.estimates

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        return self.spec, *self.models.values()

    def of(self, model: ModelSpec) -> Self:
        """Return the same study of another model."""
        return type(self)(**{name: getattr(self, name) for name in type(self).model_fields} | {"model": model})

    @property
    def taken(self) -> TakenForGranted | None:
        """What is taken for granted; None where it is not asked for."""
        if not self.sensitivity.all:
            return None
        from workflows.studies.assumptions import TakenForGranted

        return TakenForGranted(self.spec, self.inputs.names, ())

    @property
    def told(self) -> Told:
        """What is known of the outputs beside their values."""
        from uq.accuracy.doubts import Told

        units = {one.name: one.unit for one in self.spec.returned}
        return Told(units, frozenset(never_estimable(self.spec)), self.spec.solver_tolerance or 0.0)


S = TypeVar("S", bound=SamplingBlocks)
