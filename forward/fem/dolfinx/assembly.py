"""Assembly of compiled forms, and their values at points."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from forward.bodies.geometry import Body
from forward.fem.dolfinx import version
from forward.fem.dolfinx.compile import compile_form, compiled, options_for, signature
from forward.fem.dolfinx.lanes import Kernel, Numbers
from forward.fem.dolfinx.meshes import mesh_body, owned_cells
from forward.fem.dolfinx.spaces import Unknowns, cell_element, constant, scalar_space, sum_rows
from forward.model import FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class VectorAssembler:
    """A compiled linear form with its vector, used again for every assembly.

    Its test functions are those of the unknowns, or of any other space where no unknowns are given. What is assembled
    `often` takes several cells at once, if that can be compiled (`forward.fem.dolfinx.lanes`).
    """

    def __init__(self, form: Any, unknowns: Unknowns | None, comm: Any, *, often: bool = False) -> None:
        cells, rest = _parts(form) if often else (None, form)
        parts = [part for part in (cells, rest) if part is not None]
        names = [signature(part) for part in parts]
        self._forms = [compile_form(part, comm, name) for part, name in zip(parts, names, strict=True)]
        self._lanes: Kernel | None = None
        if cells is not None and all(one.subdomain_id() == "everywhere" for one in cells.integrals()):
            space = self._forms[0].function_spaces[0]
            to = Numbers(*version.numbers_of(space), np.empty(0))
            self._lanes = _kernel(names[0], self._forms[0], space.mesh, comm, to)
        self._of_cells = self._forms[0]
        if self._lanes is not None:
            self._forms.pop(0)
        self._unknowns = unknowns
        self._vector = version.new_vector(self._of_cells)
        self._alone = comm.size == 1 and not self._forms

    def __call__(self) -> FloatArray:
        """Assemble; return a copy of this rank's part (U_local,)."""
        if self._alone and self._lanes is not None:
            values = np.zeros(self._vector.local_size)
            self._lanes(version.constants_of(self._of_cells), values)
            return values if self._unknowns is None else self._unknowns.take(values)
        with self._vector.localForm() as local:
            local.set(0.0)
            if self._lanes is not None:
                self._lanes(version.constants_of(self._of_cells), local.array)
        for form in self._forms:
            fem.petsc.assemble_vector(self._vector, form)
        self._vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        values = self._vector.array_r
        return np.array(values) if self._unknowns is None else self._unknowns.take(values)


def _parts(form: Any) -> tuple[Any | None, Any | None]:
    """The integrals over cells and the others; None where there are none."""
    integrals = form.integrals()
    cells = [one for one in integrals if one.integral_type() == "cell"]
    rest = [one for one in integrals if one.integral_type() != "cell"]
    return (ufl.Form(cells) if cells else None), (ufl.Form(rest) if rest else None)


def _kernel(name: str, made: Any, msh: Any, comm: Any, *to: Numbers, stored: int = 0) -> Kernel | None:
    """A kernel for several cells of the form or expression of this name that DOLFINx has `made`; None without one."""
    own = owned_cells(msh)
    places = np.asarray(msh.geometry.x[version.corners_of_cells(msh)[:own]])
    coefficients = [Numbers(*numbers) for numbers in version.coefficients_of(made)]
    own_cells, own_to = ([one._replace(nodes=one.nodes[:own]) for one in some] for some in (coefficients, to))
    kernel = Kernel(name, places, own_cells, len(version.constants_of(made)), own_to, stored, comm)
    return kernel if kernel.available else None


class ScalarAssembler:
    """A compiled functional, summed over the ranks."""

    def __init__(self, form: Any, comm: Any) -> None:
        self._form = compile_form(form, comm)
        self._comm = comm

    def __call__(self) -> float:
        """Assemble; return the same value on every rank."""
        return float(self._comm.allreduce(fem.assemble_scalar(self._form)))


class PointValues:
    """A compiled UFL expression with its values at reference `points` (q, 3) of this rank's cells.

    As in `VectorAssembler` for what is evaluated `often`, at all cells.
    """

    def __init__(self, expression: Any, points: FloatArray, space: Any, comm: Any, *, often: bool = False) -> None:
        self._name = signature((expression, points))
        self._comm = comm
        self._expression = compiled(
            self._name, lambda folder: fem.Expression(expression, points, **options_for(folder)), comm
        )
        self._mesh = space.mesh
        self.cells = np.arange(owned_cells(space.mesh), dtype=np.int32)
        self._size = len(points) * int(np.prod(expression.ufl_shape))
        self._lanes = _kernel(self._name, self._expression, space.mesh, comm, stored=self._size) if often else None

    def __call__(self) -> FloatArray:
        """Return the values (n_cells, q · size of the expression) at the current state."""
        if self._lanes is not None:
            found = np.empty((len(self.cells), self._size))
            self._lanes(version.constants_of(self._expression), found)
            return found
        values = version.evaluate(self._expression, self._mesh, self.cells)
        return np.asarray(values).reshape(len(self.cells), -1)

    def summed(self, space: Any) -> Callable[[FloatArray], None] | None:
        """Return what adds the values at the nodes of a space, if the points are these, to an array (n_nodes, size).

        None if it cannot be compiled.
        """
        nodes, _ = version.numbers_of(space)
        to = Numbers(nodes, self._size // nodes.shape[1], np.empty(0))
        kernel = _kernel(self._name, self._expression, self._mesh, self._comm, to)
        return None if kernel is None else lambda sums: kernel(version.constants_of(self._expression), sums)


class FacetValues:
    """A compiled UFL expression with its values at the quadrature points of boundary facets of this rank's cells.

    Attributes
    ----------
    outward
        Vectors (n, 3) along the outer normals in the reference cell, as long as the areas that the n points represent.
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
        spans = np.array([np.cross(*(corners[side[1:3]] - corners[side[0]])) for side in sides])
        out = np.array([corners[side].mean(axis=0) for side in sides]) - corners.mean(axis=0)
        spans *= np.sign(np.einsum("ij,ij->i", spans, out))[:, None]
        self.outward = (spans[which][:, None] * weights[:, None]).reshape(-1, 3) if len(which) else np.zeros((0, 3))

    def __call__(self) -> FloatArray:
        """Return the values (n, size of the expression) at the current state."""
        if not len(self._rows):
            return np.zeros((0, 1))
        values = self._every().reshape(len(self._every.cells), self._count, -1)
        return np.asarray(values[self._rows, self._columns])


class NodalAverages:
    """An expression of a space of displacements at its nodes: averages over the cells that meet there."""

    def __init__(self, expression: Any, shape: tuple[int, ...], space: Any, comm: Any, *, often: bool = False) -> None:
        nodes = cell_element(space).points
        self._comm, self._shape = comm, shape
        self._values = PointValues(expression, nodes, space, comm)
        self._sums = self._values.summed(space) if often else None
        self._count = space.dofmap.index_map.size_local + space.dofmap.index_map.num_ghosts
        self._nodes = version.nodes_of_cells(space, len(nodes))[: owned_cells(space.mesh)].ravel()
        self._carrier = fem.Function(space)
        meeting = np.bincount(self._nodes, minlength=self._count).astype(float)
        self._meeting = self._owned(np.broadcast_to(meeting, (3, self._count)))[0]

    def _owned(self, rows: FloatArray) -> FloatArray:
        """Add what other ranks hold of three rows (3, n) at this rank's nodes."""
        if self._comm.size == 1:
            return rows
        return np.asarray(sum_rows(self._carrier, rows).T)

    def __call__(self) -> FloatArray:
        """Return the values (*shape, n_owned) at this rank's nodes, for the current state."""
        count = int(np.prod(self._shape))
        if self._sums is not None:
            added = np.zeros((self._count, count))
            self._sums(added)
            if self._comm.size == 1:
                return np.divide(added.T, self._meeting, order="C").reshape(*self._shape, -1)
            sums = np.ascontiguousarray(added.T)
        else:
            values = self._values().reshape(-1, count).T
            sums = np.array([np.bincount(self._nodes, weights=row, minlength=self._count) for row in values])
        found = np.concatenate([self._owned(rows) for rows in sums.reshape(-1, 3, self._count)])
        return np.asarray((found / self._meeting).reshape(*self._shape, -1))


def trilinear_elements(body: Body) -> tuple[Any, list[csr_matrix]]:
    """Mesh a body in this process; return linear elements and ∫vw dX, ∫∇v·∇w dX, ∫vw dS of them.

    The elements are hexahedra, except for bodies that come with a mesh of tetrahedra.
    """
    from scipy.sparse import csr_matrix

    boxed = body if body.kind == "mesh" else body.model_copy(update={"cell": "hexahedron"})
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
