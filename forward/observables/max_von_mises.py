"""Largest stress."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from forward.materials import kinematics
from forward.model import FloatArray
from forward.observables.observable import Equations, Functional, Observable

if TYPE_CHECKING:
    from forward.observables.functionals import Integral


class MaxVonMises(Observable):
    """Largest von Mises stress (Pa, Cauchy) over the quadrature points; derivatives are those at that point."""

    kind: Literal["max-von-mises"] = "max-von-mises"
    unit: ClassVar[str] = "Pa"
    estimable: ClassVar[bool] = False  # at an edge that is held it grows without end as the mesh is refined

    @property
    def negative(self) -> bool:
        """Whether it can be below 0."""
        return False

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        return _MaxVonMises(equations)


class _MaxVonMises:
    """ψ = max of the von Mises stress over the quadrature points; of tied points, the first of the lowest rank.

    The stress at one point is written as the integral ∫ w σ dX / ∫ w dX with w = 1 at that point and 0 at the others,
    so that its derivatives are those of an integral.
    """

    def __init__(self, equations: Equations) -> None:
        import ufl

        from forward.fem.dolfinx import spaces

        self._equations = equations
        # A pressure has no deviator: in the mixed form the isochoric energy is all that is needed.
        cauchy = equations.stress_of(equations.energy) * equations.F.T / equations.J
        stress = kinematics.von_mises(ufl, cauchy, ufl.Identity(3))
        degree = equations.spec.body.quadrature
        self._values = equations.at_points(stress)
        self._selector = spaces.function(spaces.quadrature_space(equations.mesh, degree))
        self.stress = stress

    def value(self) -> float:
        from forward.fem import ranks

        return -ranks.smallest(self._equations.comm, -self._values().max(initial=0.0))

    def place(self) -> int:
        """Number of the quadrature point of this rank at which it is largest."""
        return int(np.argmax(self._values()))

    def _at_place(self) -> Integral:
        """Return the stress at the point where it is currently largest."""
        equations = self._equations
        here = np.argwhere(self._values() >= self.value())
        holders = equations.comm.allgather(len(here) > 0)
        self._selector.x.array[:] = 0
        if holders.index(True) == equations.comm.rank:
            cell, point = here[0]
            self._selector.x.array[self._selector.function_space.dofmap.cell_dofs(cell)[point]] = 1
        self._selector.x.scatter_forward()
        self._selected.size = self._weight()
        return self._selected

    @cached_property
    def _selected(self) -> Integral:
        from forward.observables.functionals import Integral

        return Integral(self._equations, self._selector * self.stress)

    @cached_property
    def _weight(self) -> Any:
        return self._equations.scalar(self._selector * self._equations.dx)

    def gradient(self) -> FloatArray:
        return self._at_place().gradient()

    def partial(self) -> FloatArray:
        return self._at_place().partial()
