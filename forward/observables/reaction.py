"""Forces that hold a boundary."""

from __future__ import annotations

from collections.abc import Callable
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
        from forward.fem.dolfinx import spaces

        nodes = spaces.boundary_nodes(equations.space, equations.facets[self.on])
        owned = nodes[nodes < equations.nodes_owned]
        w = np.zeros(equations.size)
        w[3 * owned + AXES.index(self.component)] = 1
        return _Reaction(equations, w)

    def enriched(self, coarse: Functional, equations: Equations, up: Callable[[FloatArray], FloatArray]) -> Functional:
        """Prepare the evaluation along the same virtual displacement, so that u_h has the same reaction there."""
        assert isinstance(coarse, _Reaction)
        return _Reaction(equations, up(coarse.w))


class _Reaction:
    """ψ = wᵀ r(u, ω), with r the imbalance of all unknowns and w = 1 on a component of a boundary's nodes."""

    def __init__(self, equations: Equations, w: FloatArray) -> None:
        self._equations = equations
        self.w = w

    def value(self) -> float:
        return self._equations.dot(self.w, self._equations.imbalance())

    def gradient(self) -> FloatArray:
        return self._equations.stiffness_times(self.w, transpose=True)

    def gradient_before(self) -> FloatArray:
        """By the state at the end of the increment before, where friction depends on it."""
        return self._equations.rubbed(self.w)

    def partial(self) -> FloatArray:
        equations = self._equations
        slopes = equations.field_products(self.w)
        slopes[equations.scalars] = [equations.dot(self.w, force) for force in equations.parameter_forces()]
        return slopes
