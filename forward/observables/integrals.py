"""Outputs that are linear in the state, forces, and integrals over the body or its boundaries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Gt

from forward.bodies.geometry import AXES, Axis, Vector, tolerance
from forward.model import FloatArray, ModelError
from forward.observables.functionals import Integral, Linear
from forward.observables.observable import Equations, Functional, Observable
from forward.terms import tools


class PointDisplacement(Observable):
    """Displacement component (m) at a point of the undeformed body (m)."""

    kind: Literal["displacement"] = "displacement"
    at: Vector
    component: Axis

    def functional(self, equations: Equations) -> Functional:
        from forward.fem.dolfinx import spaces

        (mine,), (nodes,), (weights,), (distance,) = spaces.point_rows(equations.space, np.array([self.at]))
        spec = equations.spec.body
        # Elsewhere points outside were refused before; the mesh may cut curved faces.
        most = tolerance(spec) if spec.kind == "mesh" and spec.file else max(tolerance(spec), spec.longest_edge)
        if distance > most:
            where = ", ".join(f"{x:g}" for x in self.at)
            raise ModelError(
                f"output '{self.name}': the point ({where}) lies {distance:.3g} m outside the body, "
                f"expected at most {most:.3g} m"
            )
        probe = spaces.function(equations.space)
        if mine:
            probe.x.array[3 * nodes + AXES.index(self.component)] = weights
        # Weights of ghost nodes are sent to the ranks that own them.
        return Linear(equations, equations.with_pressures(spaces.sum_ghosts(probe)))


class MeanDisplacement(Observable):
    """Mean of a displacement component (m) over a boundary."""

    kind: Literal["mean-displacement"] = "mean-displacement"
    on: str
    component: Axis

    def functional(self, equations: Equations) -> Functional:
        import ufl

        from forward.fem.dolfinx import spaces

        axis = spaces.constant(equations.mesh, np.eye(3)[AXES.index(self.component)])
        weights = equations.vector(ufl.inner(axis, equations.test) * equations.surface(self.on))()
        return Linear(equations, weights / equations.dot(weights, np.ones_like(weights)))


class Reaction(Observable):
    """Force component (N) that holds a boundary: the sum of the nodal reactions where it is clamped or moved."""

    kind: Literal["reaction"] = "reaction"
    unit: ClassVar[str] = "N"
    of_held: ClassVar[bool] = True
    on: str
    component: Axis

    def functional(self, equations: Equations) -> Functional:
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

    reduced_as = "work"

    def __init__(self, equations: Equations, w: FloatArray) -> None:
        self._equations = equations
        self.w = w

    def value(self) -> float:
        return float(self._equations.dot(self.w, self._equations.imbalance()))

    def gradient(self) -> FloatArray:
        return np.asarray(self._equations.stiffness_times(self.w, transpose=True))

    def gradient_before(self) -> FloatArray:
        """By what the increment before has left, where friction or an item depends on it."""
        return np.asarray(self._equations.rubbed(self.w))

    def partial(self) -> FloatArray:
        equations = self._equations
        slopes: FloatArray = equations.field_products(self.w)
        slopes[equations.scalars] = [equations.dot(self.w, force) for force in equations.parameter_forces()]
        return slopes


class StrainEnergy(Observable):
    """Stored energy ∫W dX (J)."""

    kind: Literal["strain-energy"] = "strain-energy"
    unit: ClassVar[str] = "J"

    def functional(self, equations: Equations) -> Functional:
        return Integral(equations, equations.stored_energy)


class VolumeChange(Observable):
    """Relative change of volume ∫(J−1) dX / ∫dX (dimensionless)."""

    kind: Literal["volume-change"] = "volume-change"
    unit: ClassVar[str] = "1"

    def functional(self, equations: Equations) -> Functional:
        return Integral(equations, equations.dilation, equations.volume)


class Force(Observable):
    """Force (N) with which a tool presses on the body: along its direction, or one component.

    It is the derivative of the potential by the place of the tool, with the tractions of friction, so that it balances
    the reactions exactly.

    Parameters
    ----------
    tool
        Name of the load.
    component
        Along the direction of the tool, or along an axis.
    times
        What it is multiplied by: 4 where a quarter of a symmetric body is solved.
    """

    kind: Literal["force"] = "force"
    unit: ClassVar[str] = "N"
    tool: str = "indenter"
    component: Literal["x", "y", "z", "along"] = "along"
    times: Annotated[float, Gt(0)] = 1.0

    @property
    def negative(self) -> bool:  # type: ignore[override]
        """Whether it can be below 0: a tool presses and never pulls."""
        return self.component != "along"

    def functional(self, equations: Equations) -> Functional:
        import ufl

        tool, at = equations.tool(self.tool)
        if self.component == "along":
            along = ufl.as_vector(tool.pointing(at.ops, at.numbers))
        else:
            along = at.constant(np.eye(3)[AXES.index(self.component)])
        x = ufl.variable(at.X + at.u)
        touch = tool.touch(at, x)
        density = tools.pressure(at.ops, *touch) * ufl.dot(ufl.diff(touch.gap, x), along)
        if tool.friction:
            density -= ufl.dot(tool.rub(at).traction, along)
        return Integral(equations, density, 1 / self.times, tool.measure(at))
