"""Largest contact pressure."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from forward.model import FloatArray
from forward.observables.observable import Equations, Functional, Observable
from forward.terms import tools


class MaxPressure(Observable):
    """Largest pressure (Pa, per undeformed area) of a tool at quadrature points; derivatives are those at that point.

    Under a sharp edge it grows as the mesh is refined.
    """

    kind: Literal["max-pressure"] = "max-pressure"
    unit: ClassVar[str] = "Pa"
    estimable: ClassVar[bool] = False
    tool: str = "indenter"

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        return _MaxPressure(equations, self.tool)


class _MaxPressure:
    """ψ = max p(g(X + u)) over quadrature points; of tied ones, the first of the lowest rank."""

    def __init__(self, equations: Equations, label: str) -> None:
        import ufl

        self._equations = equations
        tool, at = equations.tool(label)
        x = ufl.variable(at.X + at.u)
        touch = tool.touch(at, x)
        self._pressure = tools.pressure(at.ops, *touch)
        slope = -touch.stiffness * tools.contact(at.ops, touch.gap, touch.width)
        change = slope * ufl.diff(touch.gap, x)
        self._on, self._degree = tool.on, tool.degree
        self._points = self._compiled(ufl.as_vector([self._pressure, *(change[i] for i in range(3))]))

    def _compiled(self, expression: Any) -> Any:
        return self._equations.on_facets(expression, self._on, self._degree)

    def value(self) -> float:
        from forward.fem import ranks

        return -ranks.smallest(self._equations.comm, -self._points()[:, 0].max(initial=0.0))

    def _place(self) -> int | None:
        """The point of this rank at which the pressure is largest; None if another rank has it, or nothing touches."""
        top = self.value()
        here = np.flatnonzero(self._points()[:, 0] >= top)
        holders = self._equations.comm.allgather(bool(len(here)) and top > 0)
        return int(here[0]) if True in holders and holders.index(True) == self._equations.comm.rank else None

    def gradient(self) -> FloatArray:
        from forward.fem.dolfinx import spaces

        equations = self._equations
        carrier = spaces.function(equations.space)
        point = self._place()
        if point is not None:
            nodes = np.asarray(equations.space.dofmap.cell_dofs(self._points.cells[point]))
            weights = spaces.cell_element(equations.space).tabulate(0, self._points.local[[point]])[0, 0, :, 0]
            for a in range(3):
                carrier.x.array[3 * nodes + a] = weights * self._points()[point, 1 + a]
        return equations.with_pressures(spaces.sum_ghosts(carrier))

    @cached_property
    def _along_parameters(self) -> Any | None:
        found = self._equations.along_parameters(self._pressure)
        return None if found is None else self._compiled(found)

    def partial(self) -> FloatArray:
        equations, point = self._equations, self._place()
        slopes = np.zeros(len(equations.parameters))
        if self._along_parameters is None:
            return slopes
        for i, _ in zip(equations.scalars, equations.unit_directions(), strict=True):
            values = self._along_parameters()
            slopes[i] = equations.comm.allreduce(0.0 if point is None else float(values[point, 0]))
        return slopes
