"""The only file that knows a DOLFINx version: meshes, spaces, compiled forms, assembly, linear solvers.

Written for DOLFINx 0.5 (Debian 12) and 0.11 (the wheel `dolfinx-solver-real`).
"""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from forward.bodies.geometry import AXES, Body
from forward.bodies.location import locate
from forward.bodies.mesh_file import OwnMesh
from forward.fem.cost import BYTES_PER_NONZERO, BYTES_PER_UNKNOWN, Factor
from forward.machine import MIB, StopError, compiled_forms, headroom, require, reserve_for_linear_algebra
from forward.model import FloatArray, ModelError, SolveError

with suppress(ModuleNotFoundError):
    import dolfinx_solver as _  # the wheel wants to be first  # noqa: F401
import petsc4py

petsc4py.init(["tissuq", "-no_signal_handler"])  # PETSc would end the study where a child process dies (SIGPIPE)

import basix  # noqa: E402
import dolfinx  # noqa: E402
import dolfinx.fem.petsc  # noqa: E402
import ffcx.naming  # noqa: E402
import ufl  # noqa: E402
from dolfinx import cpp, fem, mesh, plot  # noqa: E402
from petsc4py import PETSc  # noqa: E402

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

T = TypeVar("T")

reserve_for_linear_algebra()
basix.create_element(basix.ElementFamily.P, basix.CellType.interval, 1)  # with the linear algebra of DOLFINx, too

_FIVE = dolfinx.__version__.startswith("0.5.")  # else 0.11
atan2 = ufl.atan_2 if _FIVE else ufl.atan2
if not _FIVE:
    import basix.ufl
atan2 = ufl.atan_2 if _FIVE else ufl.atan2
_CELLS = {"hexahedron": mesh.CellType.hexahedron, "tetrahedron": mesh.CellType.tetrahedron}


# --- compilation -----------------------------------------------------------------------------------------------------


# Sums over nodes are vectorised only where the compiler may reorder them; NaN and infinity keep their meaning, which
# -ffast-math would take from them. Measured: residuals 2 to 4 times, stiffness 1.3 times faster.
_REORDER = ["-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math", "-freciprocal-math", "-fno-math-errno"]
_FLAGS = ["-O3", "-march=native", *_REORDER]


def _cache_directory() -> Path:
    """Folder of what was compiled for this kind of processor, this Python and these flags."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(line for line in lines if line.startswith("flags"))
    except (OSError, StopIteration):
        processor = ""
    made_for = [processor, str(sysconfig.get_config_var("SOABI")), dolfinx.__version__, *_FLAGS]
    return compiled_forms() / f"forms-{hashlib.sha256(' '.join(made_for).encode()).hexdigest()[:12]}"


_CACHE = _cache_directory()


def _options(folder: Path) -> dict[str, Any]:
    options = {"cffi_extra_compile_args": _FLAGS, "cffi_libraries": ["m"], "cache_dir": str(folder), "timeout": 600}
    return {"jit_params" if _FIVE else "jit_options": options}


@contextmanager
def _lock(name: str) -> Iterator[None]:
    """Let one process at a time in. The system opens the lock of a process that dies."""
    _CACHE.mkdir(parents=True, exist_ok=True)
    with (_CACHE / f"{name}.lock").open("w") as lock:
        with suppress(OSError):  # some file systems of clusters have no locks: then more than one process compiles
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _compiled(what: Any, make: Callable[[Path], T], comm: Any) -> T:
    """Return what `make` compiles, or loads, in a folder; collective over `comm`.

    Whatever the number of processes that ask for it together, one compiles: in a folder that is renamed when it is
    complete, so that no one ever finds half of it, nor has to wait for a process that was killed. What is there is
    loaded without any lock.
    """
    name = ffcx.naming.compute_signature([what], "")
    folder = _CACHE / name
    if comm.bcast(folder.is_dir() if comm.rank == 0 else None):
        return make(folder)
    with _lock(name) if comm.rank == 0 else nullcontext():
        place = comm.bcast(_vacant(folder) if comm.rank == 0 else None)
        try:
            made = make(place)
            comm.barrier()  # everyone has loaded it
            if comm.rank == 0 and place != folder:
                with suppress(OSError):  # without locks another process may have been faster
                    place.rename(folder)
        finally:
            if comm.rank == 0 and place != folder:
                shutil.rmtree(place, ignore_errors=True)
    return made


def _vacant(folder: Path) -> Path:
    """Where to compile: in a new folder, unless the folder itself has appeared."""
    return folder if folder.is_dir() else Path(tempfile.mkdtemp(dir=_CACHE))


def compile_form(form: Any, comm: Any) -> Any:
    """Compile a UFL form, once per machine; collective over `comm`."""
    return _compiled(form, lambda folder: fem.form(form, **_options(folder)), comm)


class PointValues:
    """A compiled UFL expression with its values at reference `points` (q, 3) of this rank's cells."""

    def __init__(self, expression: Any, points: FloatArray, space: Any, comm: Any) -> None:
        self._expression = _compiled(
            (expression, points), lambda folder: fem.Expression(expression, points, **_options(folder)), comm
        )
        self._mesh = space.mesh
        self._cells = np.arange(_cell_map(space.mesh).size_local, dtype=np.int32)

    def __call__(self) -> FloatArray:
        """Return the values (n_cells, q · size of the expression) at the state that is set."""
        cells = (self._cells,) if _FIVE else (self._mesh, self._cells)
        return np.asarray(self._expression.eval(*cells)).reshape(len(self._cells), -1)


# --- meshes and spaces -----------------------------------------------------------------------------------------------


def mesh_body(comm: Any, body: Body) -> tuple[Any, dict[str, NDArray[np.int32]]]:
    """Mesh a body; return this rank's part and its facets on each named boundary; collective over `comm`."""
    require(BYTES_PER_UNKNOWN * body.nodes / comm.size + SPARE, "the mesh")
    if isinstance(body, OwnMesh):
        return _own_mesh(comm, body)
    msh = mesh.create_box(comm, [[0.0, 0.0, 0.0], list(body.meshed)], list(body.cells), cell_type=_CELLS[body.cell])
    if _FIVE:
        # FFCx names this variant when it first compiles a form, which changes the look of all later ones. With the name
        # from the start, a form that was compiled in one run is found by the next.
        domain = msh.ufl_domain()
        plain = domain.ufl_coordinate_element()
        named = ufl.FiniteElement(plain.family(), plain.cell(), plain.degree(), variant="equispaced")
        domain._ufl_coordinate_element = ufl.VectorElement(named)
    # Facets are found while boundaries are planes across an axis.
    facets = _box_facets(msh, body.meshed)
    msh.geometry.x[:] = body.place(msh.geometry.x)
    return msh, facets


def _own_mesh(comm: Any, body: OwnMesh) -> tuple[Any, dict[str, NDArray[np.int32]]]:
    """Distribute a mesh that the first rank reads."""
    loaded = _on_first(comm, body.load)
    corners = 4 if body.cell == "tetrahedron" else 8
    points, cells, boundaries = np.zeros((0, 3)), np.zeros((0, corners), dtype=np.int64), None
    if loaded is not None:
        points, boundaries = loaded.points, loaded.boundaries
        # From VTK's order of the corners.
        cells = loaded.cells if corners == 4 else np.ascontiguousarray(loaded.cells[:, [0, 1, 3, 2, 4, 5, 7, 6]])
    if _FIVE:
        element = ufl.FiniteElement("Lagrange", body.cell, 1, variant="equispaced")
        msh = mesh.create_mesh(comm, cells, points, ufl.Mesh(ufl.VectorElement(element)))
    else:
        msh = mesh.create_mesh(comm, cells, basix.ufl.element("Lagrange", body.cell, 1, shape=(3,)), points)
    boundaries = comm.bcast(boundaries)
    msh.topology.create_entities(2)
    msh.topology.create_connectivity(2, 3)
    facet_map = msh.topology.index_map(2)
    every = np.arange(facet_map.size_local + facet_map.num_ghosts, dtype=np.int32)
    if _FIVE:
        nodes = np.asarray(cpp.mesh.entities_to_geometry(msh._mesh, 2, every, False))
    else:
        nodes = np.asarray(mesh.entities_to_geometry(msh, 2, every))
    originals = np.sort(np.asarray(msh.geometry.input_global_indices)[nodes.reshape(len(every), -1)], axis=1)
    numbers = {tuple(row): k for k, row in enumerate(originals.tolist())}
    facets = {}
    for name, wanted in boundaries.items():
        here = [numbers[row] for row in map(tuple, np.sort(wanted, axis=1).tolist()) if row in numbers]
        facets[name] = np.array(sorted(here), dtype=np.int32)
    return msh, facets


def _on_first(comm: Any, load: Callable[[], Any]) -> Any:
    """Call on the first rank; what is raised there is raised on all."""
    found, problem = None, None
    if comm.rank == 0:
        try:
            found = load()
        except ModelError as error:
            problem = str(error)
    problem = comm.bcast(problem)
    if problem is not None:
        raise ModelError(problem)
    return found


def region_numbers(comm: Any, body: OwnMesh, msh: Any) -> NDArray[np.int32]:
    """Return the number of the region of each of this rank's cells, ghosts included; collective."""
    loaded = _on_first(comm, body.load)
    region = comm.bcast(None if loaded is None else loaded.region.astype(np.int32))
    return np.asarray(region[np.asarray(msh.topology.original_cell_index)])


def region_indicators(comm: Any, body: OwnMesh, msh: Any) -> dict[str, Any]:
    """Return functions of the cells by the names of the regions of a body: 1 there, 0 elsewhere; collective."""
    of_cells = region_numbers(comm, body, msh)
    cell = msh.ufl_cell()
    constants = ufl.FiniteElement("DG", cell, 0) if _FIVE else basix.ufl.element("DG", cell.cellname, 0)
    space = _space(msh, constants)
    dofs = np.array([space.dofmap.cell_dofs(cell)[0] for cell in range(len(of_cells))])
    found = {}
    for number, name in enumerate(body.regions):
        found[name] = fem.Function(space)
        found[name].x.array[dofs] = of_cells == number
    return found


def _box_facets(msh: Any, size: tuple[float, float, float]) -> dict[str, NDArray[np.int32]]:
    facets = {}
    for axis, (_, length) in enumerate(zip(AXES, size, strict=True)):
        for end, position in (("min", 0.0), ("max", length)):

            def on_boundary(x: FloatArray, axis: int = axis, position: float = position, length: float = length) -> Any:
                return np.abs(x[axis] - position) < 1e-9 * length

            facets[f"{AXES[axis]}-{end}"] = mesh.locate_entities_boundary(msh, 2, on_boundary)
    return facets


def facet_measure(msh: Any, facets: dict[str, NDArray[np.int32]], degree: int) -> tuple[Any, dict[str, int]]:
    """Return the surface measure of the named boundaries and the tag of each."""
    tags = {name: tag for tag, name in enumerate(facets, start=1)}
    indices = np.concatenate(list(facets.values()))
    values = np.concatenate([np.full(len(facets[name]), tag, dtype=np.int32) for name, tag in tags.items()])
    order = np.argsort(indices)
    marked = mesh.meshtags(msh, 2, indices[order].astype(np.int32), values[order])
    return ufl.Measure("ds", domain=msh, subdomain_data=marked, metadata={"quadrature_degree": degree}), tags


def _cell_map(msh: Any) -> Any:
    return msh.topology.index_map(3)


def _lagrange(msh: Any, degree: int, *, vector: bool) -> Any:
    """Lagrange elements, as UFL knows them."""
    cell = msh.ufl_cell()
    if _FIVE:
        return (ufl.VectorElement if vector else ufl.FiniteElement)("Lagrange", cell, degree)
    return basix.ufl.element("Lagrange", cell.cellname, degree, shape=(3,) if vector else ())


def _space(msh: Any, element: Any) -> Any:
    """Return the space of an element; DOLFINx 0.5 compiles the element."""
    if not _FIVE:
        return fem.functionspace(msh, element)
    return _compiled(element, lambda folder: fem.FunctionSpace(msh, element, **_options(folder)), msh.comm)


def vector_space(msh: Any, degree: int) -> Any:
    """Continuous vector-valued Lagrange elements."""
    return _space(msh, _lagrange(msh, degree, vector=True))


def scalar_space(msh: Any, degree: int) -> Any:
    """Continuous scalar Lagrange elements."""
    return _space(msh, _lagrange(msh, degree, vector=False))


def interpolate(values: Any, space: Any) -> FloatArray:
    """Return this rank's values of a function at the nodes of another space on its mesh."""
    other = fem.Function(space)
    other.interpolate(values)
    return np.array(other.x.array[: owned_nodes(space)])


def trilinear_elements(body: Body) -> tuple[Any, list[csr_matrix]]:
    """Mesh a body in this process; return linear elements and ∫vw dX, ∫∇v·∇w dX, ∫vw dS of them.

    They are on hexahedra, but for bodies that come with a mesh of tetrahedra.
    """
    from scipy.sparse import csr_matrix

    boxed = body if isinstance(body, OwnMesh) else body.model_copy(update={"cell": "hexahedron"})
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


class Unknowns:
    """The unknowns of a body: displacements and, in the mixed form, pressures; as spaces and as vectors.

    A vector (U_local,) holds the displacements of the nodes that this rank owns, interleaved, and then the pressures of
    the vertices that it owns. DOLFINx numbers the unknowns of its mixed space in another order, which ends here.

    Attributes
    ----------
    whole
        The space of all unknowns.
    displacement
        The space of displacements.
    pressure
        The space of pressures, continuous and one degree lower (P. Hood, C. Taylor, Navier–Stokes equations using mixed
        interpolation, 1974); nothing in the displacement form.
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
        elements = [_lagrange(msh, degree, vector=True), _lagrange(msh, degree - 1, vector=False)]
        self.whole = _space(msh, ufl.MixedElement(*elements) if _FIVE else basix.ufl.mixed_element(elements))
        self.displacement, displacements = self.whole.sub(0).collapse()
        self.pressure, pressures = self.whole.sub(1).collapse()
        self.pressures = int(self.pressure.dofmap.index_map.size_global)
        self._numbers = np.array(displacements, dtype=np.int32).ravel()
        owned = self._numbers[: 3 * owned_nodes(self.displacement)]
        self._order = np.concatenate([owned, np.array(pressures, dtype=np.int32).ravel()[: owned_nodes(self.pressure)]])
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
        """Copy what DOLFINx or PETSc holds of the whole space into a vector (U_local,), or into rows (k, U_local)."""
        return np.array(values[..., : self.size]) if self._order is None else np.asarray(values[..., self._order])

    def reorder(self, values: FloatArray) -> FloatArray:
        """Return a vector (U_local,), or rows (k, U_local), in PETSc's order."""
        if self._order is None:
            return values
        reordered = np.empty_like(values)
        reordered[..., self._order] = values
        return reordered


def quadrature_space(msh: Any, degree: int) -> Any:
    """Scalars at the quadrature points."""
    cell = msh.ufl_cell()
    if _FIVE:
        return _space(msh, ufl.FiniteElement("Quadrature", cell, degree, quad_scheme="default"))
    return _space(msh, basix.ufl.quadrature_element(cell.cellname, scheme="default", degree=degree))


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
    topology, kinds, _ = (plot.create_vtk_mesh if _FIVE else plot.vtk_mesh)(space)
    owned = _cell_map(space.mesh).size_local
    return np.asarray(topology).reshape(len(kinds), -1)[:owned, 1:].astype(np.int64), int(kinds[0])


def point_weights(
    space: Any, points: FloatArray
) -> tuple[list[tuple[NDArray[np.int32], FloatArray] | None], FloatArray]:
    """Return nodes and weights that interpolate at each point (n, 3), on one rank each; collective.

    A point in no cell has the weights of the place of the mesh that is nearest; the other array (n,) says, on every
    rank, how far it is from there (m). The rank that is nearest, and of several the first, has the point.
    """
    msh, comm = space.mesh, space.mesh.comm
    lists = msh.geometry.dofmap if _FIVE else msh.geometry.dofmaps[0]
    corners = lists.array.reshape(_cell_map(msh).size_local + _cell_map(msh).num_ghosts, -1) if _FIVE else lists
    found = locate(msh.geometry.x[np.asarray(corners)[: _cell_map(msh).size_local]], points)
    every = np.array(comm.allgather(found.distances))
    degree = space.ufl_element().degree() if _FIVE else space.ufl_element().degree
    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.gll_warped
    # Nodes of degree 1 and 2 stand in the same order in every cell: none has two on an edge or a face.
    values = basix.create_element(family, _basix_cell(space), degree, variant).tabulate(0, found.reference)[0, :, :, 0]
    mine = every.argmin(axis=0) == comm.rank
    here = [
        (np.asarray(space.dofmap.cell_dofs(cell)), np.array(row)) if own else None
        for cell, row, own in zip(found.cells, values, mine, strict=True)
    ]
    return here, every.min(axis=0)


def quadrature_points(space: Any, degree: int) -> FloatArray:
    """Reference points (q, 3) of the quadrature that the integrals use."""
    points, _ = basix.make_quadrature(_basix_cell(space), degree)
    return np.asarray(points)


def _basix_cell(space: Any) -> Any:
    name = space.mesh.ufl_cell().cellname
    return basix.cell.string_to_type(name()) if _FIVE else basix.CellType[name]


def constant(msh: Any, value: Any) -> Any:
    """A constant of forms whose value can change without compiling again."""
    return fem.Constant(msh, np.asarray(value, dtype=PETSc.ScalarType))


def function(space: Any) -> Any:
    """A finite-element function, zero."""
    return fem.Function(space)


class NodalGradients:
    """Deformation gradients at the nodes: averages over the cells that meet there."""

    def __init__(self, F: Any, space: Any, comm: Any) -> None:
        element = space.ufl_element()
        # The nodes in the order of the cells' lists, as `vector_space` places them.
        family, variant = basix.ElementFamily.P, basix.LagrangeVariant.gll_warped
        degree = element.degree() if _FIVE else element.degree
        nodes = basix.create_element(family, _basix_cell(space), degree, variant).points
        self._comm = comm
        self._values = PointValues(F, nodes, space, comm)
        self._count = space.dofmap.index_map.size_local + space.dofmap.index_map.num_ghosts
        lists = space.dofmap.list.array.reshape(-1, len(nodes)) if _FIVE else space.dofmap.list
        self._nodes = lists[: _cell_map(space.mesh).size_local].ravel()
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
        """Return F (3, 3, n_owned) at this rank's nodes, for the state that is set."""
        values = self._values().reshape(-1, 9).T
        sums = np.array([np.bincount(self._nodes, weights=row, minlength=self._count) for row in values])
        F = np.array([self._owned(rows) for rows in sums.reshape(3, 3, -1)])
        return np.asarray(F / self._meeting)


# --- assembly and linear algebra -------------------------------------------------------------------------------------


class VectorAssembler:
    """A compiled linear form with its vector, used again for every assembly.

    Its test functions are those of the unknowns, or of any other space where no unknowns are given.
    """

    def __init__(self, form: Any, unknowns: Unknowns | None, comm: Any) -> None:
        self._form = compile_form(form, comm)
        self._unknowns = unknowns
        self._vector = fem.petsc.create_vector(self._form if _FIVE else self._form.function_spaces[0])

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


ROOM = 60  # for what pivoting adds to the factor, in per cent of MUMPS's own estimate
MOST_ROOM = 4000
HOPELESS = 0.6  # part of the memory that a factor is expected to take, without which it is not begun
SPARE = 64 * MIB  # for what libraries allocate without looking
SINGULAR = -10  # errors of MUMPS, as its guide numbers them
TOO_LITTLE_ROOM = {-8, -9, -14, -15, -17, -20}  # more than was estimated is needed: more room helps
TOO_LITTLE_MEMORY = {-5, -7, -11, -13, -18, -19, -22}


class DirectSolver:
    """A stiffness matrix and its factorisation by MUMPS: LDLᵀ where the matrix is symmetric, else LU.

    One matrix and one solver object serve every realisation, so that the symbolic analysis is done once and no
    communicator is created in a loop.

    Parameters
    ----------
    form
        Compiled bilinear form.
    constraints
        Prescribed unknowns; their rows and columns become those of the identity.
    unknowns
        Knows the order of vectors.
    comm
        Communicator of the ranks that share the matrix.
    symmetric
        Whether the form is.
    expected
        What the factor is expected to be.

    Raises
    ------
    StopError
        If there is no memory for the matrix.
    """

    def __init__(
        self,
        form: Any,
        constraints: list[Any],
        unknowns: Unknowns,
        comm: Any,
        *,
        symmetric: bool,
        expected: Factor,
    ) -> None:
        self._expected = expected
        require(2 * BYTES_PER_NONZERO * expected.nonzeros / comm.size + SPARE, "the stiffness matrix")
        self._form = form
        self._unknowns = unknowns
        self._constraints = constraints
        self._matrix = fem.petsc.create_matrix(form)
        self._symmetric = symmetric
        if symmetric:
            self._matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._room = ROOM
        self._analysed = False
        self._ksp = self._new_ksp(comm)
        self._right = self._matrix.createVecLeft()
        self._solution = self._matrix.createVecRight()

    def factorise(self) -> None:
        """Assemble and factorise.

        Raises
        ------
        SolveError
            If the matrix is singular or has entries that are not finite.
        StopError
            If there is no memory for the factor.
        """
        unknowns, ranks = self._matrix.getSize()[0], self._ksp.comm.size
        if not self._analysed:  # the analysis crashes where it finds no memory
            hopeless = HOPELESS * self._expected.bytes / ranks + SPARE
            require(hopeless, f"the factor of the stiffness of {unknowns:,} unknowns")
        self._assemble()
        while (status := self._try()) in TOO_LITTLE_ROOM and self._room < MOST_ROOM:
            self._room *= 4
            self._renew()
        self._analysed = True
        if status >= 0:
            return
        if status == SINGULAR:
            message = "the stiffness is singular"
            raise SolveError(message)
        needed = self._ksp.pc.getFactorMatrix().getMumpsInfog(16)  # by its analysis, on the rank that needs most
        self._renew()  # or else PETSc would report this failure for ever
        if status in TOO_LITTLE_ROOM or status in TOO_LITTLE_MEMORY:
            have = headroom()
            message = (
                f"memory ran out: the factor of the stiffness of {unknowns:,} unknowns needs {needed:,} MiB"
                f"{' on one rank' if ranks > 1 else ''}, {have}"
            )
            raise StopError(message)
        message = f"the factorisation failed (MUMPS error {status})"
        raise SolveError(message)

    def _try(self) -> int:
        """Factorise; return MUMPS's status, negative where it failed."""
        self._ksp.pc.setUp()  # the KSP's own set-up would leave it to the first solve
        return int(self._ksp.pc.getFactorMatrix().getMumpsInfog(1))

    def _new_ksp(self, comm: Any) -> Any:
        ksp = PETSc.KSP().create(comm)
        ksp.setOperators(self._matrix)
        ksp.setType("preonly")
        ksp.pc.setType("cholesky" if self._symmetric else "lu")
        ksp.pc.setFactorSolverType("mumps")
        ksp.pc.setFactorSetUpSolverType()
        ksp.pc.getFactorMatrix().setMumpsIcntl(14, self._room)
        if (
            self._symmetric
        ):  # ScaLAPACK, to which MUMPS leaves the last front on several ranks, counts no negative pivots
            ksp.pc.getFactorMatrix().setMumpsIcntl(13, 1)
        return ksp

    def _renew(self) -> None:
        """Begin with a new factor, which is analysed again."""
        self._ksp.destroy()
        self._ksp = self._new_ksp(self._matrix.comm)
        self._analysed = False

    def _assemble(self) -> None:
        self._matrix.zeroEntries()
        fem.petsc.assemble_matrix(self._matrix, self._form, bcs=self._constraints)
        self._matrix.assemble()

    def assembled(self) -> Any:
        """Assemble; return a copy of the matrix, for `products`. The factor at hand is that of another matrix then."""
        self._assemble()
        return self._matrix.copy()

    def products(self, matrix: Any, rows: FloatArray) -> FloatArray:
        """Return the products (k, n) of such a matrix with rows (k, n)."""
        found = np.empty_like(rows)
        for row, product in zip(rows, found, strict=True):
            self._right.array[:] = self._unknowns.reorder(row)
            matrix.mult(self._right, self._solution)
            product[:] = self._unknowns.take(self._solution.array_r)
        return found

    def solve(self, right: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Solve with the factor at hand, or with its transpose, for one (n,) or several (k, n) right-hand sides."""
        transpose = transpose and not self._symmetric
        if right.ndim == 1:
            self._right.array[:] = self._unknowns.reorder(right)
            (self._ksp.solveTranspose if transpose else self._ksp.solve)(self._right, self._solution)
            return self._unknowns.take(self._solution.array_r)
        if transpose or len(right) == 1 or self._ksp.comm.size > 1:
            return np.array([self.solve(row, transpose=transpose) for row in right]).reshape(right.shape)
        # The factor is read once for all of them.
        ordered = np.asfortranarray(self._unknowns.reorder(right).T)
        rights = PETSc.Mat().createDense(ordered.shape, array=ordered, comm=self._ksp.comm)
        solutions = PETSc.Mat().createDense(ordered.shape, comm=self._ksp.comm)
        for matrix in (rights, solutions):
            matrix.setUp()
            matrix.assemble()
        self._ksp.pc.getFactorMatrix().matSolve(rights, solutions)
        result = self._unknowns.take(np.array(solutions.getDenseArray().T, order="C"))
        rights.destroy()
        solutions.destroy()
        return result

    def negative_pivots(self) -> int:
        """Number of negative pivots of LDLᵀ, that is of negative eigenvalues; −1 where it is not known."""
        if not self._symmetric:
            return -1
        return int(self._ksp.pc.getFactorMatrix().getMumpsInfog(12))


def smallest(comm: Any, value: float) -> float:
    """Smallest value over the ranks; NaN counts as −∞."""
    return float(comm.allreduce(value if value == value else -np.inf, op=MPI.MIN))  # noqa: PLR0124


def total(comm: Any, values: FloatArray) -> FloatArray:
    """Sum of arrays over the ranks."""
    if comm.size == 1:
        return values
    result = np.empty_like(values)
    comm.Allreduce(values, result, op=MPI.SUM)
    return result


def sum_ghosts(values: Any) -> FloatArray:
    """Send what a function holds at ghost nodes to their owners, add it there, and return the owned part."""
    vector = values.vector if _FIVE else values.x.petsc_vec
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    return np.array(vector.array_r)
