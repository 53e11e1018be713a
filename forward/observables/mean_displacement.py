"""Mean displacement of a boundary."""

from __future__ import annotations

from typing import Literal

import numpy as np

from forward.bodies.geometry import AXES, Axis
from forward.observables.observable import Equations, Functional, Observable


class MeanDisplacement(Observable):
    """Mean of a displacement component (m) over a boundary."""

    kind: Literal["mean-displacement"] = "mean-displacement"
    on: str
    component: Axis

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        import ufl

        from forward.fem.dolfinx import spaces
        from forward.observables.functionals import Linear

        axis = spaces.constant(equations.mesh, np.eye(3)[AXES.index(self.component)])
        weights = equations.vector(ufl.inner(axis, equations.test) * equations.surface(self.on))()
        return Linear(equations, weights / equations.dot(weights, np.ones_like(weights)))
