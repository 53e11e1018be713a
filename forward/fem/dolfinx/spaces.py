"""Spaces of functions on a mesh, their nodes, values at points; the unknowns of a body, in an order of their own."""

from __future__ import annotations

from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from forward.bodies.location import locate
from forward.bodies.mesh_file import MeshFile
from forward.fem.dolfinx import version
from forward.fem.dolfinx.compile import compiled, options_for, signature
from forward.fem.dolfinx.meshes import owned_cells, region_numbers
from forward.model import FloatArray


def new_space(msh: Any, element: Any) -> Any:
    """Return the space of an element."""
    if not version.ELEMENTS_ARE_COMPILED:
        return version.new_space(msh, element, {})
    name = signature(element)
    return compiled(name, lambda folder: version.new_space(msh, element, options_for(folder)), msh.comm)


def vector_space(msh: Any, degree: int) -> Any:
    """Continuous vector-valued Lagrange elements."""
    return new_space(msh, version.lagrange(msh.ufl_cell(), degree, vector=True))


def scalar_space(msh: Any, degree: int) -> Any:
    """Continuous scalar Lagrange elements."""
    return new_space(msh, version.lagrange(msh.ufl_cell(), degree, vector=False))


def region_indicators(comm: Any, body: MeshFile, msh: Any) -> dict[str, Any]:
    """Return functions of the cells by the names of the regions of a body: 1 there, 0 elsewhere; collective."""
    of_cells = region_numbers(comm, body, msh)
    space = new_space(msh, version.by_cell(msh.ufl_cell()))
    dofs = np.array([space.dofmap.cell_dofs(cell)[0] for cell in range(len(of_cells))])
    found = {}
    for number, name in enumerate(body.regions):
        found[name] = fem.Function(space)
        found[name].x.array[dofs] = of_cells == number
    return found


def quadrature_space(msh: Any, degree: int) -> Any:
    """Scalars at the quadrature points."""
    return new_space(msh, version.at_quadrature_points(msh.ufl_cell(), degree))


def cell_element(space: Any) -> Any:
    """Lagrange elements of a space on one cell, the nodes in the order of the cells' lists."""
    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.gll_warped
    return basix.create_element(family, version.cell_type(space), version.degree(space), variant)


def interpolate(values: Any, space: Any) -> FloatArray:
    """Return this rank's values of a function at the nodes of another space on its mesh."""
    other = fem.Function(space)
    other.interpolate(values)
    return np.array(other.x.array[: owned_nodes(space)])


def owned_nodes(space: Any) -> int:
    """Number of nodes that this rank owns."""
    return int(space.dofmap.index_map.size_local)


def node_coordinates(space: Any) -> FloatArray:
    """Coordinates (n_owned, 3) of the nodes that this rank owns."""
    return np.asarray(space.tabulate_dof_coordinates()[: owned_nodes(space)])


def global_node_numbers(space: Any) -> NDArray[np.int64]:
    """Global numbers of this rank's nodes, ghosts included."""
    index_map = space.dofmap.index_map
    count = index_map.size_local + index_map.num_ghosts
    return np.asarray(index_map.local_to_global(np.arange(count, dtype=np.int32)))


def boundary_nodes(space: Any, facets: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return this rank's nodes (ghosts included) on facets; collective."""
    return np.asarray(fem.locate_dofs_topological(space, 2, facets))


def vtk_cells(space: Any) -> tuple[NDArray[np.int64], int]:
    """Return the nodes (n_cells, k) of this rank's cells in VTK's order, and VTK's number of the cell type."""
    topology, kinds, _ = version.vtk_mesh(space)
    owned = owned_cells(space.mesh)
    return np.asarray(topology).reshape(len(kinds), -1)[:owned, 1:].astype(np.int64), int(kinds[0])


def point_rows(space: Any, points: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.int32], FloatArray, FloatArray]:
    """Return which points (n, 3) are this rank's, nodes and weights (n, k) that interpolate there; collective.

    A point in no cell gets the weights of the nearest place of the mesh; the last array (n,) holds, on every rank, its
    distance from there (m). The nearest rank, or the first of several, has the point.
    """
    msh, comm = space.mesh, space.mesh.comm
    found = locate(msh.geometry.x[version.corners_of_cells(msh)[: owned_cells(msh)]], points)
    every = np.array(comm.allgather(found.distances))
    # If an edge or a face has several nodes, DOLFINx permutes them: here they are as on the reference cell.
    element = cell_element(space)
    values = element.tabulate(0, found.local)[0, :, :, 0]
    nodes = version.nodes_of_cells(space, len(element.points))
    some = nodes[found.cells] if len(nodes) else np.zeros((len(points), nodes.shape[1]), dtype=np.int32)
    return every.argmin(axis=0) == comm.rank, some, np.asarray(values), every.min(axis=0)


def quadrature(space: Any, degree: int) -> tuple[FloatArray, FloatArray]:
    """Reference points (q, 3) of the quadrature rule of the integrals, and their weights (q,)."""
    points, weights = basix.make_quadrature(version.cell_type(space), degree)
    return np.asarray(points), np.asarray(weights)


def constant(msh: Any, value: Any) -> Any:
    """A constant in forms whose value can change without compiling again."""
    return fem.Constant(msh, np.asarray(value, dtype=PETSc.ScalarType))


def function(space: Any) -> Any:
    """A finite-element function, zero."""
    return fem.Function(space)


def give(carrier: Any, values: FloatArray) -> None:
    """Set what a function holds at this rank's own nodes, and send it to the ghosts; collective."""
    carrier.x.array[: len(values)] = values
    carrier.x.scatter_forward()


def sum_ghosts(values: Any) -> FloatArray:
    """Send what a function holds at ghost nodes to their owners, add it there, and return the owned part."""
    vector = version.vector_of(values)
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    return np.array(vector.array_r)


def sum_rows(carrier: Any, rows: FloatArray) -> FloatArray:
    """Add what ranks hold of three rows (3, n) at nodes, ghosts included, by a function; return (n_owned, 3)."""
    carrier.x.array[:] = rows.T.ravel()
    return sum_ghosts(carrier).reshape(-1, 3)


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
    found[version.nodes_of_cells(space, count)] = version.nodes_of_cells(part, count)
    return found


class Transfer:
    """Interpolation from one continuous Lagrange space into another on the same mesh, as a sparse matrix.

    It is exact where the first space lies in the second. Values (n,) are those of this rank's nodes, interleaved by
    component; both calls are collective.
    """

    def __init__(self, source: Any, target: Any) -> None:
        self._source = fem.Function(source)
        self._components = int(source.dofmap.index_map_bs)
        here, there = cell_element(source), cell_element(target)
        # DOLFINx permutes the nodes of cells, so that those of all cells stand as on the reference cell.
        values = here.tabulate(0, there.points)[0, :, :, 0]
        values[np.abs(values) < 1e-14] = 0
        from_nodes = version.nodes_of_cells(source, len(here.points))
        to_nodes = version.nodes_of_cells(target, len(there.points))
        owned = owned_nodes(target)
        _, first = np.unique(to_nodes, return_index=True)  # of the places of each node
        cells, places = np.divmod(first[:owned], to_nodes.shape[1])
        index_map = source.dofmap.index_map
        columns = from_nodes[cells]
        ends = columns.shape[1] * np.arange(owned + 1)
        from scipy.sparse import csr_matrix

        shape = (owned, index_map.size_local + index_map.num_ghosts)
        self._matrix = csr_matrix((values[places].ravel(), columns.ravel(), ends), shape=shape)
        self._matrix.eliminate_zeros()
        self._transposed = self._matrix.T.tocsr()

    def __call__(self, values: FloatArray) -> FloatArray:
        """Interpolate."""
        give(self._source, values)
        return np.asarray((self._matrix @ self._source.x.array.reshape(-1, self._components)).ravel())

    def transposed(self, values: FloatArray) -> FloatArray:
        """Apply the transpose."""
        carrier = self._source
        carrier.x.array[:] = (self._transposed @ values.reshape(-1, self._components)).ravel()
        return sum_ghosts(carrier)
