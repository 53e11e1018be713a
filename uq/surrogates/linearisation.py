"""The model and its derivatives at the mean parameters: local sensitivities, control variates and predictions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray, ForwardModel, ReferenceSolution, Solution, SolveError
from uq.estimators.estimate import Variables
from uq.evaluation.request import Evaluate, Evaluations, FieldSum, Prediction, Request
from uq.inputs.coordinates import Coordinates
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

MANY = 256  # parameters above which the state has no slopes: each would be a field to store and send


@dataclass(frozen=True)
class Linearisation:
    """A model at one point, with its derivatives there.

    Attributes
    ----------
    point
        Parameters (d,).
    outputs
        ψ̄ (m,).
    tangents
        dψ/dω (m, d); NaN for a model without derivatives.
    state
        ū (U,) in canonical order.
    slopes
        dū/dω (d, U); empty (0, U) for a model without derivatives or of more than `MANY` parameters.
    coordinates
        In which predictions are linear.
    spread
        Standard deviations (d,) of the parameters.
    joined
        Whether the state is joined to rest.
    """

    point: FloatArray
    outputs: FloatArray
    tangents: FloatArray
    state: FloatArray
    slopes: FloatArray
    coordinates: Coordinates
    spread: FloatArray
    joined: bool = True

    @property
    def prediction(self) -> Prediction | None:
        """The prediction of the state, linear if there are slopes; None for a model without derivatives."""
        if self.state.size == 0 or np.isnan(self.tangents).all():
            return None
        return Prediction(self.reference, self.state_slopes, self.coordinates)

    @property
    def reference(self) -> ReferenceSolution:
        """The state and where it is, as the solver's reference."""
        return ReferenceSolution(self.point, self.state, self.spread, self.joined)

    @property
    def output_slopes(self) -> FloatArray:
        """Derivatives dψ/dt (m, d) of the outputs along the coordinates."""
        return self.coordinates.along(self.tangents, self.point)

    @property
    def state_slopes(self) -> FloatArray:
        """Derivatives dū/dt (d, U) of the state along the coordinates; empty (0, U) if there are none."""
        if len(self.slopes) == 0:
            return self.slopes
        return np.ascontiguousarray(self.coordinates.along(self.slopes.T, self.point).T)

    @property
    def middle(self) -> FloatArray:
        """The outputs (m,) predicted by tangents at the mean coordinates: the mean of their prediction.

        These are the mean parameters, unless coordinates are logarithms. Without derivatives, the outputs themselves.
        """
        if np.isnan(self.tangents).all():
            return self.outputs
        return np.asarray(self.outputs - self.output_slopes @ self.coordinates.of(self.point))

    def predicted(self, points: FloatArray) -> FloatArray:
        """Return what the tangent predicts (…, m) of deviations from `middle` at points (…, d)."""
        return np.asarray(self.coordinates.of(points) @ self.output_slopes.T)

    def predicted_variance(self, correlation: FloatArray) -> FloatArray:
        """Return the variance (m,) of that prediction, from the correlation (d, d) of the coordinates."""
        slopes = self.output_slopes
        return np.asarray(np.einsum("mi,ij,mj->m", slopes, correlation, slopes))

    @property
    def state_middle(self) -> FloatArray:
        """The same for the state (U,); the state itself if it has no slopes."""
        if len(self.slopes) == 0:
            return self.state
        return np.asarray(self.state - self.coordinates.of(self.point) @ self.state_slopes)


@dataclass(frozen=True)
class _StateAndSlopes(FieldSum):
    slopes: bool

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        if not self.slopes:
            return lambda solution, _: solution.state[None, :]
        directions = np.eye(len(model.parameters))
        return lambda solution, _: np.vstack([solution.state, solution.state_tangent(directions)])


def linearise(inputs: Inputs, evaluate: Evaluate, point: FloatArray | None = None) -> Linearisation:
    """Solve at a point (d,), by default the mean parameters, with all derivatives (of the state, up to `MANY`).

    Raises `SolveError` if the model has no answer at the point.
    """
    centre, derivatives = inputs.mean if point is None else point, evaluate.differentiable
    slopes = derivatives and len(evaluate.parameters) <= MANY
    found = evaluate(Request(centre[None, :], tangents=derivatives, fields=_StateAndSlopes(slopes)))
    return linearised(inputs, evaluate, found, point)


def linearised(
    inputs: Inputs, evaluate: Evaluate, found: Evaluations, point: FloatArray | None = None
) -> Linearisation:
    """Return the result of `linearise` from its evaluations."""
    for failure in found.failures:
        where = "mean" if point is None else "given"
        raise SolveError(f"the model has no answer at the {where} parameters: {failure.reason}", failure.history)
    m, d = len(evaluate.outputs), len(evaluate.parameters)
    tangents = np.full((m, d), np.nan) if found.tangents is None else found.tangents[0]
    fields = found.fields if found.fields.size else np.zeros((1 + d, 0))
    at, outputs, joined = found.points[0], found.outputs[0], bool(found.joined[0])
    return Linearisation(at, outputs, tangents, fields[0], fields[1:], inputs.coordinates, inputs.std, joined)


def local_dataset(inputs: Inputs, evaluate: Evaluate, centre: Linearisation, *, fields: bool) -> xr.Dataset:
    """Return nominal values and local derivatives as labelled arrays."""
    import xarray as xr

    ranges = np.array([np.nan if m.support is None else m.support[1] - m.support[0] for m in inputs.marginals.values()])
    data: Variables = {
        "nominal": (("output",), centre.outputs),
        "parameter_mean": (("parameter",), inputs.mean),
        "parameter_std": (("parameter",), inputs.std),
        "parameter_range": (("parameter",), ranges),
    }
    if evaluate.differentiable:
        data |= {
            "derivative": (("output", "parameter"), centre.tangents),
            "derivative_per_std": (("output", "parameter"), centre.tangents * inputs.std),
            "derivative_per_range": (("output", "parameter"), centre.tangents * ranges),
        }
    coordinates = {"output": list(evaluate.outputs), "parameter": list(evaluate.parameters)}
    if fields and centre.state.size:
        count = evaluate.displacements
        coordinates["component"] = ["x", "y", "z"]
        data["field_nominal"] = (("node", "component"), centre.state[:count].reshape(-1, 3))
        if len(centre.slopes):
            slopes = centre.slopes[:, :count]
            shape = (len(slopes), -1, 3)
            data["field_derivative"] = (("parameter", "node", "component"), slopes.reshape(shape))
    return xr.Dataset(data, coords=coordinates)
