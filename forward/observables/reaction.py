"""Forces that hold a boundary."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from forward.bodies.geometry import AXES, Axis
from forward.model import FloatArray
from forward.observables.observable import DiscreteBody, Functional, Observable


class Reaction(Observable):
    """Force component (N) that holds a boundary: the sum of the nodal reactions where it is clamped or moved."""

    kind: Literal["reaction"] = "reaction"
    unit: ClassVar[str] = "N"
    of_held: ClassVar[bool] = True
    on: str
    component: Axis

    def functional(self, body: DiscreteBody) -> Functional:
        """Prepare the evaluation."""
        return _Reaction(body, self)


class _Reaction:
    """ψ = wᵀ r(u, ω), with r the imbalance of all unknowns and w = 1 on a component of a boundary's nodes."""

    def __init__(self, body: DiscreteBody, output: Reaction) -> None:
        from forward.fem.dolfinx import spaces

        self._body = body
        nodes = spaces.boundary_nodes(body.space, body.facets[output.on])
        owned = nodes[nodes < body.nodes_owned]
        self._w = np.zeros(body.size)
        self._w[3 * owned + AXES.index(output.component)] = 1

    def value(self) -> float:
        return self._body.dot(self._w, self._body.imbalance())

    def gradient(self) -> FloatArray:
        return self._body.stiffness_times(self._w, transpose=True)

    def partial(self) -> FloatArray:
        body = self._body
        slopes = body.field_products(self._w)
        slopes[body.scalars] = [body.dot(self._w, force) for force in body.parameter_forces()]
        return slopes
