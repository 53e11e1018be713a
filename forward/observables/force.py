"""Forces of tools."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Gt

from forward.bodies.geometry import AXES
from forward.observables.observable import Equations, Functional, Observable
from forward.terms import tools


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
    def negative(self) -> bool:
        """Whether it can be below 0: a tool presses and never pulls."""
        return self.component != "along"

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        import ufl

        from forward.observables.functionals import Integral

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
