"""Differences between DOLFINx 0.5 and 0.11; no other file asks which version it is."""

from __future__ import annotations

from typing import Any

import basix
import dolfinx
import dolfinx.fem.petsc
import numpy as np
import ufl
from dolfinx import cpp, fem, mesh, plot
from numpy.typing import NDArray

from forward.model import FloatArray

FIVE = dolfinx.__version__.startswith("0.5.")  # else 0.11
if not FIVE:
    import basix.ufl

VERSION = dolfinx.__version__
ELEMENTS_ARE_COMPILED = FIVE
JIT = "jit_params" if FIVE else "jit_options"
atan2 = ufl.atan_2 if FIVE else ufl.atan2


# --- elements --------------------------------------------------------------------------------------------------------


def lagrange(cell: Any, degree: int, *, vector: bool) -> Any:
    """Lagrange elements on UFL's cells."""
    if FIVE:
        return (ufl.VectorElement if vector else ufl.FiniteElement)("Lagrange", cell, degree)
    return basix.ufl.element("Lagrange", cell.cellname, degree, shape=(3,) if vector else ())


def mixed(elements: list[Any]) -> Any:
    """One element of several."""
    return ufl.MixedElement(*elements) if FIVE else basix.ufl.mixed_element(elements)


def by_cell(cell: Any) -> Any:
    """A number for each cell."""
    return ufl.FiniteElement("DG", cell, 0) if FIVE else basix.ufl.element("DG", cell.cellname, 0)


def at_quadrature_points(cell: Any, degree: int) -> Any:
    """Numbers at the quadrature points."""
    if FIVE:
        return ufl.FiniteElement("Quadrature", cell, degree, quad_scheme="default")
    return basix.ufl.quadrature_element(cell.cellname, scheme="default", degree=degree)


# --- meshes ----------------------------------------------------------------------------------------------------------


def mesh_of(comm: Any, cell: str, cells: NDArray[np.int64], points: FloatArray) -> Any:
    """Distribute cells with corners at points."""
    if FIVE:
        element = ufl.FiniteElement("Lagrange", cell, 1, variant="equispaced")
        return mesh.create_mesh(comm, cells, points, ufl.Mesh(ufl.VectorElement(element)))
    return mesh.create_mesh(comm, cells, basix.ufl.element("Lagrange", cell, 1, shape=(3,)), points)


def name_variant(msh: Any) -> None:
    """Say which Lagrange elements a box has its coordinates in.

    FFCx names this variant when it first compiles a form, which changes the signatures of all later ones. With the name
    set from the start, a form that was compiled in one run is found by the next.
    """
    if FIVE:
        domain = msh.ufl_domain()
        plain = domain.ufl_coordinate_element()
        named = ufl.FiniteElement(plain.family(), plain.cell(), plain.degree(), variant="equispaced")
        domain._ufl_coordinate_element = ufl.VectorElement(named)


def corners_of_facets(msh: Any, facets: NDArray[np.int32]) -> NDArray[np.int32]:
    """Corners (n, k) of facets, as numbers of points of the mesh."""
    if FIVE:
        return np.asarray(cpp.mesh.entities_to_geometry(msh._mesh, 2, facets, False)).reshape(len(facets), -1)
    return np.asarray(mesh.entities_to_geometry(msh, 2, facets)).reshape(len(facets), -1)


def corners_of_cells(msh: Any) -> NDArray[np.int32]:
    """Corners (n_cells, k) of this rank's cells, ghosts included."""
    if FIVE:
        cells = msh.topology.index_map(3)
        return np.asarray(msh.geometry.dofmap.array).reshape(cells.size_local + cells.num_ghosts, -1)
    return np.asarray(msh.geometry.dofmaps[0])


# --- spaces and functions --------------------------------------------------------------------------------------------


def new_space(msh: Any, element: Any, options: dict[str, Any]) -> Any:
    """Return the space of an element; `options` where the element is compiled."""
    return fem.FunctionSpace(msh, element, **options) if FIVE else fem.functionspace(msh, element)


def degree(space: Any) -> int:
    """Polynomial degree of a space."""
    element = space.ufl_element()
    return int(element.degree() if FIVE else element.degree)


def cell_type(space: Any) -> Any:
    """Basix's name of the cells of a space."""
    name = space.mesh.ufl_cell().cellname
    return basix.cell.string_to_type(name()) if FIVE else basix.CellType[name]


def nodes_of_cells(space: Any, count: int) -> NDArray[np.int32]:
    """Nodes (n_cells, count) of this rank's cells, ghosts included."""
    return np.asarray(space.dofmap.list.array.reshape(-1, count) if FIVE else space.dofmap.list)


def vtk_mesh(space: Any) -> tuple[Any, Any, Any]:
    """Cells in VTK's order, their types, and nodes."""
    found: tuple[Any, Any, Any] = (plot.create_vtk_mesh if FIVE else plot.vtk_mesh)(space)
    return found


def evaluate(expression: Any, msh: Any, cells: NDArray[np.int32]) -> Any:
    """Values of a compiled expression on cells."""
    return expression.eval(cells) if FIVE else expression.eval(msh, cells)


def vector_of(function: Any) -> Any:
    """PETSc's view of a function's values."""
    return function.vector if FIVE else function.x.petsc_vec


def new_vector(form: Any) -> Any:
    """A vector for a compiled linear form."""
    return fem.petsc.create_vector(form if FIVE else form.function_spaces[0])


def block_diagonal_matrix(space: Any, comm: Any) -> Any:
    """A matrix for unknowns of a space of vectors that has room for the coupling of those of each node only."""
    maps, sizes = [space.dofmap.index_map] * 2, [space.dofmap.index_map_bs] * 2
    owned = np.arange(maps[0].size_local, dtype=np.int32)
    pattern = cpp.la.SparsityPattern(comm, maps, sizes)
    pattern.insert_diagonal(owned)
    (pattern.assemble if FIVE else pattern.finalize)()
    return cpp.la.petsc.create_matrix(comm, pattern)


# --- what compiled forms and expressions depend on --------------------------------------------------------------------


def constants_of(made: Any) -> FloatArray:
    """Values of the constants in a compiled form or expression, now."""
    return np.asarray(cpp.fem.pack_constants(getattr(made, "_cpp_object", made)))


def coefficients_of(made: Any) -> list[tuple[NDArray[np.int32], int, FloatArray]]:
    """Nodes of the cells, numbers at each node and their values, of the functions in a compiled form or expression."""
    if isinstance(made, fem.Expression):
        order = made.ufcx_expression
        functions = ufl.algorithms.extract_coefficients(made.ufl_expression)
        places = [order.original_coefficient_positions[i] for i in range(order.num_coefficients)]
        found = [functions[i]._cpp_object for i in places]
    else:
        found = getattr(made, "_cpp_object", made).coefficients
    return [(*numbers_of(function.function_space), function.x.array) for function in found]


def numbers_of(space: Any) -> tuple[NDArray[np.int32], int]:
    """Nodes (n_cells, k) of this rank's cells, ghosts included, in a compiled space, and how many numbers at each."""
    dofmap = space.dofmap
    if FIVE:
        nodes = dofmap.list() if callable(dofmap.list) else dofmap.list
        cells = space.mesh.topology.index_map(3)
        return np.asarray(nodes.array).reshape(cells.size_local + cells.num_ghosts, -1), dofmap.bs
    return np.asarray(getattr(dofmap, "_cpp_object", dofmap).map()), dofmap.bs
