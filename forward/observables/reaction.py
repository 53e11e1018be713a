"""Forces that hold a boundary."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from forward.bodies.geometry import AXES, Axis
from forward.model import FloatArray
from forward.observables.observable import Equations, Functional, Observable


class Reaction(Observable):
    """Force component (N) that holds a boundary: the sum of the nodal reactions where it is clamped or moved."""

    kind: Literal["reaction"] = "reaction"
    unit: ClassVar[str] = "N"
    of_held: ClassVar[bool] = True
    on: str
    component: Axis

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        return _Reaction(equations, self)


class _Reaction:
    """ψ = wᵀ r(u, ω), with r the imbalance of all unknowns and w = 1 on a component of a boundary's nodes."""

    def __init__(self, equations: Equations, output: Reaction) -> None:
        from forward.fem.dolfinx import spaces

        self._equations = equations
        nodes = spaces.boundary_nodes(equations.space, equations.facets[output.on])
        owned = nodes[nodes < equations.nodes_owned]
        self._w = np.zeros(equations.size)
        self._w[3 * owned + AXES.index(output.component)] = 1

    def value(self) -> float:
        return self._equations.dot(self._w, self._equations.imbalance())

    def gradient(self) -> FloatArray:
        return self._equations.stiffness_times(self._w, transpose=True)

    def partial(self) -> FloatArray:
        equations = self._equations
        slopes = equations.field_products(self._w)
        slopes[equations.scalars] = [equations.dot(self._w, force) for force in equations.parameter_forces()]
        return slopes
