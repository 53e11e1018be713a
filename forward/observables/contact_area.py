"""Areas in contact."""

from __future__ import annotations

from typing import ClassVar, Literal

from forward.observables.observable import Equations, Functional, Observable
from forward.terms import tools


class ContactArea(Observable):
    """Area (m²) of the deformed body that a tool touches.

    It grows by whole quadrature points, so that its derivatives and its error of the mesh are worth little.
    """

    kind: Literal["contact-area"] = "contact-area"
    unit: ClassVar[str] = "m²"
    estimable: ClassVar[bool] = False
    tool: str = "indenter"

    @property
    def negative(self) -> bool:
        """Whether it can be below 0."""
        return False

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        import ufl

        from forward.observables.functionals import Integral

        tool, at = equations.tool(self.tool)
        touch = tool.touch(at, at.X + at.u)
        normal = ufl.dot(at.J * ufl.inv(at.F).T, at.normal)
        density = tools.contact(at.ops, touch.gap, touch.width) * ufl.sqrt(ufl.dot(normal, normal))
        return Integral(equations, density, measure=tool.measure(at))
