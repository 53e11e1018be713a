"""Assembly of compiled forms, and their values at points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from forward.bodies.geometry import Body
from forward.bodies.mesh_file import MeshFile
from forward.fem.dolfinx import version
from forward.fem.dolfinx.compile import compile_form, compiled, options_for
from forward.fem.dolfinx.meshes import mesh_body, owned_cells
from forward.fem.dolfinx.spaces import cell_element, constant, scalar_space, sum_ghosts
from forward.fem.dolfinx.unknowns import Unknowns
from forward.model import FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class VectorAssembler:
    """A compiled linear form with its vector, used again for every assembly.

    Its test functions are those of the unknowns, or of any other space where no unknowns are given.
    """

    def __init__(self, form: Any, unknowns: Unknowns | None, comm: Any) -> None:
        self._form = compile_form(form, comm)
        self._unknowns = unknowns
        self._vector = version.new_vector(self._form)

    def __call__(self) -> FloatArray:
        """Assemble; return a copy of this rank's part (U_local,)."""
        with self._vector.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(self._vector, self._form)
        self._vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        values = self._vector.array_r
        return np.array(values) if self._unknowns is None else self._unknowns.take(values)


class ScalarAssembler:
    """A compiled functional, summed over the ranks."""

    def __init__(self, form: Any, comm: Any) -> None:
        self._form = compile_form(form, comm)
        self._comm = comm

    def __call__(self) -> float:
        """Assemble; return the same value on every rank."""
        return float(self._comm.allreduce(fem.assemble_scalar(self._form)))


class PointValues:
    """A compiled UFL expression with its values at reference `points` (q, 3) of this rank's cells."""

    def __init__(self, expression: Any, points: FloatArray, space: Any, comm: Any) -> None:
        self._expression = compiled(
            (expression, points), lambda folder: fem.Expression(expression, points, **options_for(folder)), comm
        )
        self._mesh = space.mesh
        self.cells = np.arange(owned_cells(space.mesh), dtype=np.int32)

    def __call__(self) -> FloatArray:
        """Return the values (n_cells, q · size of the expression) at the current state."""
        values = version.evaluate(self._expression, self._mesh, self.cells)
        return np.asarray(values).reshape(len(self.cells), -1)


class FacetValues:
    """A compiled UFL expression with its values at the quadrature points of boundary facets of this rank's cells.

    Attributes
    ----------
    cells
        The cell (n,) of each of the n points.
    local
        Their places (n, 3) in the reference cell.
    outward
        Vectors (n, 3) along the outer normals in the reference cell, as long as the areas that the points represent.
    """

    def __init__(self, expression: Any, facets: NDArray[np.int32], degree: int, space: Any, comm: Any) -> None:
        msh, kind = space.mesh, version.cell_type(space)
        msh.topology.create_connectivity(2, 3)
        msh.topology.create_connectivity(3, 2)
        to_cells, to_facets = msh.topology.connectivity(2, 3), msh.topology.connectivity(3, 2)
        pairs = [(to_cells.links(facet)[0], facet) for facet in facets]
        own = [(cell, facet) for cell, facet in pairs if cell < owned_cells(msh)]
        which = np.array([np.flatnonzero(to_facets.links(cell) == facet)[0] for cell, facet in own], dtype=int)
        corners, sides = basix.geometry(kind), basix.topology(kind)[2]
        flat = basix.CellType.triangle if len(sides[0]) == 3 else basix.CellType.quadrilateral
        inside, weights = basix.make_quadrature(flat, degree)
        points = np.concatenate(
            [corners[side[0]] + inside @ (corners[[side[1], side[2]]] - corners[side[0]]) for side in sides]
        )
        self._every = PointValues(expression, points, space, comm)
        self._every.cells = np.array(sorted({cell for cell, _ in own}), dtype=np.int32)
        rows = np.searchsorted(self._every.cells, [cell for cell, _ in own])
        self._rows = np.repeat(rows.astype(int), len(inside))
        self._columns = (which[:, None] * len(inside) + np.arange(len(inside))).ravel()
        self._count = len(points)
        self.cells = self._every.cells[self._rows]
        self.local = points[self._columns]
        spans = np.array([np.cross(*(corners[side[1:3]] - corners[side[0]])) for side in sides])
        out = np.array([corners[side].mean(axis=0) for side in sides]) - corners.mean(axis=0)
        spans *= np.sign(np.einsum("ij,ij->i", spans, out))[:, None]
        self.outward = (spans[which][:, None] * weights[:, None]).reshape(-1, 3) if len(which) else np.zeros((0, 3))

    def __call__(self) -> FloatArray:
        """Return the values (n, size of the expression) at the current state."""
        if not len(self.cells):
            return np.zeros((0, 1))
        values = self._every().reshape(len(self._every.cells), self._count, -1)
        return np.asarray(values[self._rows, self._columns])


class NodalAverages:
    """An expression of a space of displacements at its nodes: averages over the cells that meet there.

    Parameters
    ----------
    expression
        UFL expression.
    shape
        Its shape.
    """

    def __init__(self, expression: Any, shape: tuple[int, ...], space: Any, comm: Any) -> None:
        nodes = cell_element(space).points
        self._comm, self._shape = comm, shape
        self._values = PointValues(expression, nodes, space, comm)
        self._count = space.dofmap.index_map.size_local + space.dofmap.index_map.num_ghosts
        self._nodes = version.nodes_of_cells(space, len(nodes))[: owned_cells(space.mesh)].ravel()
        self._carrier = fem.Function(space)
        meeting = np.bincount(self._nodes, minlength=self._count).astype(float)
        self._meeting = self._owned(np.broadcast_to(meeting, (3, self._count)))[0]

    def _owned(self, rows: FloatArray) -> FloatArray:
        """Add what other ranks hold of three rows (3, n) at this rank's nodes."""
        if self._comm.size == 1:
            return rows
        self._carrier.x.array[:] = rows.T.ravel()
        return np.asarray(sum_ghosts(self._carrier).reshape(-1, 3).T)

    def __call__(self) -> FloatArray:
        """Return the values (*shape, n_owned) at this rank's nodes, for the current state."""
        count = int(np.prod(self._shape))
        values = self._values().reshape(-1, count).T
        sums = np.array([np.bincount(self._nodes, weights=row, minlength=self._count) for row in values])
        found = np.concatenate([self._owned(rows) for rows in sums.reshape(-1, 3, self._count)])
        return np.asarray((found / self._meeting).reshape(*self._shape, -1))


def trilinear_elements(body: Body) -> tuple[Any, list[csr_matrix]]:
    """Mesh a body in this process; return linear elements and ∫vw dX, ∫∇v·∇w dX, ∫vw dS of them.

    The elements are hexahedra, except for bodies that come with a mesh of tetrahedra.
    """
    from scipy.sparse import csr_matrix

    boxed = body if isinstance(body, MeshFile) else body.model_copy(update={"cell": "hexahedron"})
    msh, _ = mesh_body(MPI.COMM_SELF, boxed)
    space = scalar_space(msh, 1)
    v, w = ufl.TestFunction(space), ufl.TrialFunction(space)
    parts = [constant(msh, 0.0) for _ in range(3)]
    exact = {"quadrature_degree": 3}
    dx, ds = ufl.dx(domain=msh, metadata=exact), ufl.ds(domain=msh, metadata=exact)
    form = compile_form(
        parts[0] * v * w * dx + parts[1] * ufl.inner(ufl.grad(v), ufl.grad(w)) * dx + parts[2] * v * w * ds,
        MPI.COMM_SELF,
    )
    matrices = []
    for part in parts:
        for other in parts:
            other.value = float(other is part)
        matrix = fem.petsc.assemble_matrix(form)
        matrix.assemble()
        indptr, indices, values = matrix.getValuesCSR()
        matrices.append(csr_matrix((values, indices, indptr), shape=matrix.getSize()))
        matrix.destroy()
    return space, matrices
