"""The area that a tool touches, from pressures and gaps that are averaged over cells.

At single points a mesh says little of contact: between nodes that touch, the body lies off the tool by less than a
micrometre, and the edge of the area goes from one line of nodes to the next. Averages with the hat functions φ_i of the
vertices are right all the same, since pressures balance what the elements can be deformed by. Where a smooth body and a
tool part, at a distance d from the edge of the area, the pressure is p = C √d on one side and the gap is
g = 4C/(3E*) d^(3/2) on the other (K. L. Johnson, Contact Mechanics (1985), chapter 4; Hertz's are such). With a hat of
half-width l on an edge through its vertex, ∫pφ/∫gφ = (7/4) E*/l, and wherever the edge is, the part of the hat in
contact is

    θ = 1/(1 + (7 E* ∫gφ / (4 ∫l pφ))^(3/5))

to 0.016. It is 1 where there are no gaps and 0 where there is no pressure, for any tool.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from forward.model import FloatArray
from forward.observables.functionals import AsIntegral, Integral
from forward.observables.observable import Equations, Functional, Observable
from forward.terms import tools

BALANCE, POWER = 7 / 4, 3 / 5


class ContactArea(Observable):
    """Area (m²) of the deformed body that a tool touches.

    Around its edge a part of each cell counts that follows from pressures and gaps there. Under tools that are smooth
    where contact ends it is right to 5 % from two cells along the radius of the area on, and to 10 % with one; under a
    punch whose edge lies inside a cell most of the ring of cells there is missing (docs/measurements.md).
    """

    kind: Literal["contact-area"] = "contact-area"
    unit: ClassVar[str] = "m²"
    estimable: ClassVar[bool] = False
    negative: ClassVar[bool] = False
    tool: str = "indenter"

    def functional(self, equations: Equations) -> Functional:
        return _Touched(equations, self.tool)


class _Touched(AsIntegral):
    """ψ = Σ θ_i ∫ φ_i da, with derivatives as of an integral with the weights of these at the state that is set."""

    def __init__(self, equations: Equations, label: str) -> None:
        import ufl

        from forward.fem.dolfinx import spaces

        self._equations = equations
        tool, at = equations.tool(label)
        touch, measure = tool.touch(at, at.X + at.u), tool.measure(at)
        normal = ufl.dot(at.J * ufl.inv(at.F).T, at.normal)
        length = ufl.sqrt(ufl.geometry.FacetJacobianDeterminant(equations.mesh))
        parts = (
            ufl.sqrt(ufl.dot(normal, normal)),
            length * tools.pressure(at.ops, *touch) / at.constant(BALANCE * at.modulus()),
            at.ops.positive(touch.gap - touch.width / 2),
        )
        space = spaces.scalar_space(equations.mesh, 1)
        hat = ufl.TestFunction(space)
        self._sums = [equations.by_vertices(part * hat * measure) for part in parts]
        self._weights = [spaces.function(space) for _ in parts]
        weighted = sum(w * part for w, part in zip(self._weights, parts, strict=True))
        self._integral = Integral(equations, weighted, measure=measure)

    def _shares(self) -> tuple[FloatArray, ...]:
        """The parts θ (n,) of the hats of this rank's vertices that are in contact, and the sums (n,) over these."""
        area, pressed, apart = (np.asarray(sums()) for sums in self._sums)
        ratio = np.divide(apart, pressed, out=np.full_like(apart, np.inf), where=pressed > 0)
        return 1 / (1 + ratio**POWER), area, pressed, apart

    def value(self) -> float:
        share, area, *_ = self._shares()
        return float(self._equations.comm.allreduce(share @ area))

    def _here(self) -> Integral:
        from forward.fem.dolfinx import spaces

        share, area, *others = self._shares()
        slope = POWER * area * share * (1 - share)
        pressed, apart = (np.divide(slope, one, out=np.zeros_like(one), where=slope > 0) for one in others)
        for weight, values in zip(self._weights, (share, pressed, -apart), strict=True):
            spaces.give(weight, values)
        return self._integral
