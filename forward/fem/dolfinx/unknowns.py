"""The unknowns of a body as spaces and as vectors, in an order independent of DOLFINx."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from forward.fem.dolfinx import version
from forward.fem.dolfinx.spaces import cell_element, new_space, owned_nodes, scalar_space, vector_space
from forward.fem.dolfinx.version import nodes_of_cells
from forward.model import FloatArray


class Unknowns:
    """The unknowns of a body: displacements and, in the mixed form, pressures; as spaces and as vectors.

    A vector (U_local,) holds the displacements of the nodes that this rank owns, interleaved, and then the pressures of
    the vertices that it owns. DOLFINx numbers the unknowns of its mixed space differently; only this class knows how.

    Attributes
    ----------
    whole
        The space of all unknowns.
    displacement
        The space of displacements.
    pressure
        The space of pressures, continuous and one degree lower (P. Hood, C. Taylor, Navier–Stokes equations using mixed
        interpolation, 1974); None in the displacement form.
    size
        Number of unknowns that this rank owns.
    pressures
        Number of pressures on all ranks.
    """

    def __init__(self, msh: Any, degree: int, *, mixed: bool) -> None:
        self._numbers: NDArray[np.int32] | None = None  # of displacements, ghosts included, in the mixed space
        self._order: NDArray[np.int32] | None = None
        self.pressure = None
        self.pressures = 0
        if not mixed:
            self.whole = self.displacement = vector_space(msh, degree)
            self.size = 3 * owned_nodes(self.displacement)
            return
        cell = msh.ufl_cell()
        elements = [version.lagrange(cell, degree, vector=True), version.lagrange(cell, degree - 1, vector=False)]
        self.whole = new_space(msh, version.mixed(elements))
        self.displacement, self.pressure = vector_space(msh, degree), scalar_space(msh, degree - 1)
        self.pressures = int(self.pressure.dofmap.index_map.size_global)
        parts = [self.whole.sub(0).sub(axis) for axis in range(3)]
        self._numbers = np.column_stack([_numbers(self.displacement, part) for part in parts]).ravel()
        owned = self._numbers[: 3 * owned_nodes(self.displacement)]
        self._order = np.concatenate([owned, _numbers(self.pressure, self.whole.sub(1))[: owned_nodes(self.pressure)]])
        self.size = len(self._order)

    @property
    def test(self) -> Any:
        """A test function, in UFL."""
        return ufl.TestFunction(self.whole)

    @property
    def trial(self) -> Any:
        """A trial function, in UFL."""
        return ufl.TrialFunction(self.whole)

    def split(self, all_of_them: Any) -> tuple[Any, Any]:
        """Displacement and pressure of a UFL argument or function of the whole space; no pressure if there is none."""
        return tuple(ufl.split(all_of_them)) if self.pressure is not None else (all_of_them, None)

    def constraint(self, axis: int, nodes: NDArray[np.int32]) -> Any:
        """Mark a component of nodes as prescribed, for the assembly of matrices."""
        numbers, space = 3 * nodes + axis, self.whole
        if self._numbers is not None:
            numbers, space = self._numbers[numbers], space.sub(0)
        return fem.dirichletbc(fem.Constant(space.mesh, PETSc.ScalarType(0)), numbers, space.sub(axis))

    def give(self, function: Any, values: FloatArray) -> None:
        """Set a function of the whole space to a vector (U_local,), ghosts included; collective."""
        if self._order is None:
            function.x.array[: self.size] = values
        else:
            function.x.array[self._order] = values
        function.x.scatter_forward()

    def take(self, values: FloatArray) -> FloatArray:
        """Copy values of DOLFINx or PETSc on the whole space into a vector (U_local,), or rows (k, U_local)."""
        return np.array(values[..., : self.size]) if self._order is None else np.asarray(values[..., self._order])

    def reorder(self, values: FloatArray) -> FloatArray:
        """Return a vector (U_local,), or rows (k, U_local), in PETSc's order."""
        if self._order is None:
            return values
        reordered = np.empty_like(values)
        reordered[..., self._order] = values
        return reordered


def _numbers(space: Any, part: Any) -> NDArray[np.int32]:
    """Return the numbers (n,) that the nodes of a space, ghosts included, have in a part of a mixed space.

    (The map of DOLFINx's `collapse` is wrong from degree 3 on: it does not permute the nodes of edges and faces.)
    """
    count = len(cell_element(space).points)
    index_map = space.dofmap.index_map
    found = np.empty(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    found[nodes_of_cells(space, count)] = nodes_of_cells(part, count)
    return found
