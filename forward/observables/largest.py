"""Largest values over a body: of displacements, stresses, and pressures under a tool."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from forward.bodies.geometry import AXES
from forward.materials import kinematics
from forward.model import FloatArray
from forward.observables.functionals import AsIntegral, Integral
from forward.observables.observable import Equations, Functional, Observable


class MaxDisplacement(Observable):
    """Largest |u_c| over the nodes (m), or largest |u| where `component` is "magnitude".

    Differentiable where only one node attains it; derivatives are those at that node.
    """

    kind: Literal["max-displacement"] = "max-displacement"
    negative: ClassVar[bool] = False
    component: Literal["x", "y", "z", "magnitude"] = "magnitude"

    def functional(self, equations: Equations) -> Functional:
        return _MaxDisplacement(equations, None if self.component == "magnitude" else AXES.index(self.component))


class MaxVonMises(Observable):
    """Largest von Mises stress (Pa, Cauchy) over the quadrature points; derivatives are those at that point."""

    kind: Literal["max-von-mises"] = "max-von-mises"
    unit: ClassVar[str] = "Pa"
    estimable: ClassVar[bool] = False  # at an edge that is held it grows without end as the mesh is refined
    negative: ClassVar[bool] = False

    def functional(self, equations: Equations) -> Functional:
        return _MaxVonMises(equations)


class MaxPressure(Observable):
    """Largest pressure (Pa, per undeformed area) of a tool at vertices of the mesh; derivatives are those at that one.

    Pressures at vertices are averages over the facets that meet there, weighted by hat functions, so that they make up
    the force; those at single quadrature points scatter where a tool curves within a facet. Under a sharp edge the
    largest one grows as the mesh is refined.
    """

    kind: Literal["max-pressure"] = "max-pressure"
    unit: ClassVar[str] = "Pa"
    estimable: ClassVar[bool] = False
    negative: ClassVar[bool] = False
    tool: str = "indenter"

    def functional(self, equations: Equations) -> Functional:
        return _MaxPressure(equations, self.tool)


class _Largest(AsIntegral):
    """ψ = max of values ≥ 0 at the places of all ranks; its derivatives are those of what it is at its place."""

    _equations: Equations
    _values: Callable[[], FloatArray]

    def value(self) -> float:
        from forward.fem import ranks

        return -ranks.smallest(self._equations.comm, -float(self._values().max(initial=0.0)))


def _first(equations: Equations, here: NDArray[np.intp]) -> bool:
    """Whether this is the first rank that has any of what is listed."""
    holders = equations.comm.allgather(len(here) > 0)
    return True in holders and holders.index(True) == equations.comm.rank


class _MaxDisplacement(_Largest):
    """ψ = max over the nodes of |u_c|, or of |u|; of tied nodes, the first in canonical order counts."""

    reduced_as = "largest"

    def __init__(self, equations: Equations, axis: int | None) -> None:
        self._equations = equations
        self._axis = axis

    def _values(self) -> FloatArray:
        u = self._equations.displacements()
        return np.asarray(np.linalg.norm(u, axis=1) if self._axis is None else np.abs(u[:, self._axis]))

    def place(self) -> int:
        """Number of the node of this rank at which it is largest."""
        candidates = self._values()
        return int(_tied(candidates, candidates.max(initial=0.0))[0])

    def gradient(self) -> FloatArray:
        from forward.fem import ranks

        candidates, top = self._values(), self.value()
        ties = _tied(candidates, top)
        position = self._equations.layout.positions[ties]
        first = ranks.smallest(self._equations.comm, float(position.min(initial=np.iinfo(np.int64).max)))
        g = np.zeros((len(candidates), 3))
        if top > 0:
            for node in ties[position == first]:
                u = self._equations.displacements()[node]
                if self._axis is None:
                    g[node] = u / np.linalg.norm(u)
                else:
                    g[node, self._axis] = np.sign(u[self._axis])
        return np.asarray(self._equations.with_pressures(g.ravel()))

    def partial(self) -> FloatArray:
        return np.zeros(len(self._equations.parameters))


def _tied(candidates: FloatArray, top: float) -> NDArray[np.intp]:
    """Number the nodes at which candidates (n,) are the largest but for rounding."""
    return np.flatnonzero(candidates >= top * (1 - 1e-10))


class _MaxVonMises(_Largest):
    """ψ = max of the von Mises stress over the quadrature points; of tied points, the first of the lowest rank.

    The stress at one point is written as the integral ∫ w σ dX / ∫ w dX with w = 1 at that point and 0 at the others,
    so that its derivatives are those of an integral.
    """

    reduced_as = "peak"

    def __init__(self, equations: Equations) -> None:
        import ufl

        from forward.fem.dolfinx import spaces

        self._equations = equations
        # A pressure has no deviator: in the mixed form the isochoric energy is all that is needed.
        self.stress = kinematics.von_mises(ufl, equations.cauchy_of(equations.energy), ufl.Identity(3))
        self._values = equations.at_points(self.stress)
        self._selector = spaces.function(spaces.quadrature_space(equations.mesh, equations.spec.body.quadrature))

    def place(self) -> int:
        """Number of the quadrature point of this rank at which it is largest."""
        return int(np.argmax(self._values()))

    def _here(self) -> Integral:
        here = np.argwhere(self._values() >= self.value())
        self._selector.x.array[:] = 0
        if _first(self._equations, here):
            cell, point = here[0]
            self._selector.x.array[self._selector.function_space.dofmap.cell_dofs(cell)[point]] = 1
        self._selector.x.scatter_forward()
        self._selected.size = self._weight()
        return self._selected

    @cached_property
    def _selected(self) -> Integral:
        return Integral(self._equations, self._selector * self.stress)

    @cached_property
    def _weight(self) -> Any:
        return self._equations.scalar(self._selector * self._equations.dx)


class _MaxPressure(_Largest):
    """ψ = max ∫p φ_i dS/∫φ_i dS over hat functions φ_i; of tied ones, that of the first vertex of the lowest rank."""

    def __init__(self, equations: Equations, label: str) -> None:
        from forward.fem.dolfinx import spaces
        from forward.fem.vertex_fields import PressuresAtVertices

        self._equations = equations
        self._values = pressures = PressuresAtVertices(equations, label)
        self._areas = pressures.areas
        self._hat = spaces.function(spaces.scalar_space(equations.mesh, 1))
        self._at_hat = Integral(equations, pressures.density * self._hat, measure=pressures.measure)

    def _here(self) -> Integral:
        values, top = self._values(), self.value()
        here = np.flatnonzero(values >= top) if top > 0 else np.zeros(0, dtype=int)
        self._hat.x.array[:] = 0.0
        mine = _first(self._equations, here)
        if mine:
            self._hat.x.array[here[0]] = 1.0
        self._hat.x.scatter_forward()
        area = self._equations.comm.allreduce(float(self._areas[here[0]]) if mine else 0.0)
        self._at_hat.size = float(area) or 1.0
        return self._at_hat
