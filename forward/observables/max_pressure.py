"""Largest contact pressure."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from forward.model import FloatArray
from forward.observables.observable import Equations, Functional, Observable


class MaxPressure(Observable):
    """Largest pressure (Pa, per undeformed area) of a tool at vertices of the mesh; derivatives are those at that one.

    Pressures at vertices are averages over the facets that meet there, weighted by hat functions, so that they make up
    the force; those at single quadrature points scatter where a tool curves within a facet. Under a sharp edge the
    largest one grows as the mesh is refined.
    """

    kind: Literal["max-pressure"] = "max-pressure"
    unit: ClassVar[str] = "Pa"
    estimable: ClassVar[bool] = False
    tool: str = "indenter"

    @property
    def negative(self) -> bool:
        """Whether it can be below 0."""
        return False

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        return _MaxPressure(equations, self.tool)


class _MaxPressure:
    """ψ = max ∫p φ_i dS/∫φ_i dS over hat functions φ_i; of tied ones, that of the first vertex of the lowest rank."""

    def __init__(self, equations: Equations, label: str) -> None:
        from forward.fem.dolfinx import spaces
        from forward.observables.functionals import Integral

        self._equations = equations
        self._pressures = equations.pressures_at_vertices(label)
        self._hat = spaces.function(spaces.scalar_space(equations.mesh, 1))
        self._at_hat = Integral(equations, self._pressures.density * self._hat, measure=self._pressures.measure)

    def value(self) -> float:
        from forward.fem import ranks

        return -ranks.smallest(self._equations.comm, -float(self._pressures().max(initial=0.0)))

    def _choose(self) -> float:
        """Set the hat function to that of the largest pressure; return its integral (m²)."""
        values, top = self._pressures(), self.value()
        here = np.flatnonzero(values >= top) if top > 0 else np.zeros(0, dtype=int)
        holders = self._equations.comm.allgather(len(here) > 0)
        self._hat.x.array[:] = 0.0
        mine = True in holders and holders.index(True) == self._equations.comm.rank
        if mine:
            self._hat.x.array[here[0]] = 1.0
        self._hat.x.scatter_forward()
        return float(self._equations.comm.allreduce(float(self._pressures.areas[here[0]]) if mine else 0.0)) or 1.0

    def gradient(self) -> FloatArray:
        area = self._choose()
        return self._at_hat.gradient() / area

    def partial(self) -> FloatArray:
        area = self._choose()
        return self._at_hat.partial() / area
