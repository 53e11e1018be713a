"""Displacement at a point."""

from __future__ import annotations

from typing import Literal

import numpy as np

from forward.bodies.geometry import AXES, Axis, Vector, tolerance
from forward.bodies.mesh_file import MeshFile
from forward.model import ModelError
from forward.observables.observable import Equations, Functional, Observable


class PointDisplacement(Observable):
    """Displacement component (m) at a point of the undeformed body (m)."""

    kind: Literal["displacement"] = "displacement"
    at: Vector
    component: Axis

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        from forward.fem.dolfinx import spaces
        from forward.observables.functionals import Linear

        (found,), (distance,) = spaces.point_weights(equations.space, np.array([self.at]))
        spec = equations.spec.body
        # Points outside boxes and blocks were refused before; the mesh may cut their curved faces.
        most = tolerance(spec) if isinstance(spec, MeshFile) else max(tolerance(spec), spec.longest_edge)
        if distance > most:
            where = ", ".join(f"{x:g}" for x in self.at)
            message = (
                f"output '{self.name}': the point ({where}) lies {distance:.3g} m outside the body, "
                f"expected at most {most:.3g} m"
            )
            raise ModelError(message)
        probe = spaces.function(equations.space)
        if found is not None:
            nodes, weights = found
            probe.x.array[3 * nodes + AXES.index(self.component)] = weights
        # Weights of ghost nodes are sent to the ranks that own them.
        return Linear(equations, equations.with_pressures(spaces.sum_ghosts(probe)))
