"""Local sensitivities: derivatives at the mean parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from forward.model import ModelError
from uq.evaluation.request import Evaluate
from uq.inputs.random_parameters import Inputs
from uq.methods.method import Method
from uq.surrogates.linearisation import linearise, local_dataset

if TYPE_CHECKING:
    import xarray as xr


class LocalSensitivity(Method):
    """Derivatives of all outputs and of the displacement field at the mean parameters: one solve and its tangents.

    Results: `derivative` dψ/dω, `derivative_per_std` (times the standard deviation of the parameter),
    `derivative_per_range` (times upper − lower, for bounded distributions), and `field_derivative` du/dω at every node.
    """

    kind: Literal["local-sensitivity"] = "local-sensitivity"

    def planned(self, dimension: int) -> int:
        return 1

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        if not evaluate.differentiable:
            message = "the model has no derivatives, expected one that has for method.kind = 'local-sensitivity'"
            raise ModelError(message)
        return local_dataset(inputs, evaluate, linearise(inputs, evaluate), fields=True)
