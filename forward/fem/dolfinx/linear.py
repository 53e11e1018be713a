"""Stiffness matrices and their linear solvers (`forward.solvers.system`): by factors, and by two levels."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import basix
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from forward.fem import ranks
from forward.fem.cost import BYTES_PER_NONZERO, SPARE, Factor
from forward.fem.dolfinx import spaces, version
from forward.fem.dolfinx.meshes import owned_cells
from forward.fem.dolfinx.spaces import Transfer, Unknowns, owned_nodes
from forward.machine import StopError, headroom, require
from forward.model import FloatArray, SolveError
from forward.phases import phase
from forward.solvers import multigrid
from forward.solvers.lanczos import negative_eigenvalues
from forward.solvers.multigrid import MARGIN, Levels, minimised
from forward.solvers.steps import finish
from forward.solvers.system import TIGHT, LinearSolver, NoConvergence
from forward.terms.acting import Entries

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

ROOM = 60  # for what pivoting adds to the factor, in per cent of MUMPS's own estimate
MOST_ROOM = 4000
HOPELESS = 0.6  # fraction of the expected memory without which a factorisation is not begun
SINGULAR = -10  # MUMPS error codes, from its guide
TOO_LITTLE_ROOM = {-8, -9, -14, -15, -17, -20}  # more memory is needed than estimated: retry with more
TOO_LITTLE_MEMORY = {-5, -7, -11, -13, -18, -19, -22}
ITERATIONS = 400  # of conjugate gradients
RESIDUALS = 100  # of generalised conjugate residuals, which remember all directions


class StiffnessMatrix:
    """A bilinear form as a matrix, in which rows and columns of prescribed unknowns are those of the identity.

    Parameters
    ----------
    form
        Compiled bilinear form.
    constraints
        Prescribed unknowns.
    unknowns
        Defines the order of vectors.
    comm
        Communicator of the ranks that share the matrix.
    symmetric
        Whether the form is.
    expected
        Expected size of its factor.
    blocked
        Whether the matrix is stored by blocks of the components, which takes half the memory and suits no factor.
    items
        What else acts: its entries by the rows (U_local,) of the matrix that the unknowns are.

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
        blocked: bool = False,
        items: Callable[[NDArray[Any]], Entries] | None = None,
    ) -> None:
        # PETSc keeps what Python has dropped, such as factors of models that are gone, until all ranks destroy it here.
        PETSc.garbage_cleanup(comm)
        require(2 * BYTES_PER_NONZERO * expected.nonzeros / comm.size + SPARE, "the stiffness matrix")
        self.unknowns, self.comm, self.symmetric, self.expected = unknowns, comm, symmetric, expected
        self._form, self._constraints, self._items = form, constraints, items
        self.matrix = fem.petsc.create_matrix(form, *(["baij"] if blocked else []))
        if symmetric:
            self.matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        if items is not None:  # whose entries have no room yet: the first assembly makes it
            self.matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
            self._numbers = unknowns.take(np.arange(*self.matrix.getOwnershipRange(), dtype=float))

    def assemble(self) -> None:
        """Assemble at the state that is set."""
        self.matrix.zeroEntries()
        fem.petsc.assemble_matrix(self.matrix, self._form, bcs=self._constraints)
        if self._items is not None:
            self.matrix.assemble(PETSc.Mat.AssemblyType.FLUSH)  # between values that are set and those that are added
            rows, columns, values = self._items(self._numbers)
            each = np.arange(len(rows) + 1, dtype=np.int32)
            self.matrix.setValuesIJV(each, columns.astype(np.int32), values, addv=True, rowmap=rows.astype(np.int32))
        self.matrix.assemble()

    def sparse(self) -> csr_matrix:
        """Assemble; return SciPy's sparse matrix (n, n), of one process."""
        from scipy.sparse import csr_matrix

        self.assemble()
        matrix = self.matrix.copy().convert("aij")
        starts, columns, values = matrix.getValuesCSR()
        matrix.destroy()
        n = len(starts) - 1
        ours = np.round(self.unknowns.reorder(np.arange(n, dtype=float))).astype(np.int64)
        rows = ours[np.repeat(np.arange(n), np.diff(starts))]
        return csr_matrix((values, (rows, ours[columns])), shape=(n, n))


class BoundaryBlocks:
    """The 3×3 blocks on the diagonal of a stiffness of displacements on boundaries, without the rest of it."""

    def __init__(self, form: Any, space: Any, comm: Any) -> None:
        self._form = form
        self._matrix = version.block_diagonal_matrix(space, comm)
        nodes = np.arange(owned_nodes(space) + 1, dtype=np.int32)
        self._matrix.setValuesBlockedLocalCSR(nodes, nodes[:-1], np.zeros(9 * len(nodes[1:])))
        self._matrix.assemble()  # what is on the diagonal has its place now
        self._matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATIONS, False)

    def __call__(self) -> FloatArray:
        """Assemble at the state that is set; return them (n_owned, 3, 3)."""
        self._matrix.zeroEntries()
        fem.petsc.assemble_matrix(self._matrix, self._form)
        self._matrix.assemble()
        return _nodal_blocks(self._matrix)


class Preconditioner(NamedTuple):
    """An approximate inverse of a stiffness.

    Attributes
    ----------
    apply
        Its product with forces (U_local,); collective.
    weights
        What makes forces comparable (U_local,) where the stiffness is not definite; None where it is.
    """

    apply: Callable[[FloatArray], FloatArray]
    weights: FloatArray | None


def saddle_blocks(stiffness: StiffnessMatrix, nodes: int, fixed: NDArray[np.int64]) -> Preconditioner | None:
    """Return what preconditions a stiffness of displacements and pressures: no factor, and little of the matrix.

    With A = K_uu, B = K_pu and C = K_pp, pressures are found first, p = −S⁻¹ r_p with the diagonal of
    S = −C + B A_d⁻¹ Bᵀ, then displacements, u = A_d⁻¹ (r_u − Bᵀ p): A_d are the 3×3 blocks on the diagonal of A, and
    in S their diagonal (M. Benzi, G. H. Golub, J. Liesen, Acta Numerica 14 (2005) 1–137, section 10).

    The matrix is assembled and then freed; `nodes` are how many this rank has, `fixed` its prescribed unknowns. None
    if blocks of this rank are not those of a stable body.
    """
    stiffness.assemble()
    K, n = stiffness.matrix, 3 * nodes
    first, last = K.getOwnershipRange()
    numbers = stiffness.unknowns.take(np.arange(first, last, dtype=np.int32))  # in our order
    of_u, of_p = (PETSc.IS().createGeneral(part, comm=stiffness.comm) for part in (numbers[:n], numbers[n:]))
    of_displacements = K.createSubMatrix(of_u, of_u)
    blocks = _nodal_blocks(of_displacements)
    of_displacements.destroy()
    coupling = K.createSubMatrix(of_p, of_u)
    diagonal = stiffness.unknowns.take(K.getDiagonal().array_r)
    K.destroy()
    u, p = coupling.createVecRight(), coupling.createVecLeft()
    rows, columns, values = coupling.getValuesCSR()
    squares = coupling.duplicate()
    squares.setValuesCSR(rows, columns, values**2)
    squares.assemble()
    u.array[:] = 1 / diagonal[:n]
    squares.mult(u, p)
    squares.destroy()
    schur = p.array_r - diagonal[n:]
    if not (positive(blocks) and (schur > 0).all()):
        return None
    inverse = np.linalg.inv(blocks)

    def apply(r: FloatArray) -> FloatArray:
        z = np.empty_like(r)
        z[n:] = p.array[:] = -r[n:] / schur
        coupling.multTranspose(p, u)
        rest = r[:n] - u.array_r
        z[:n] = np.einsum("nij,nj->ni", inverse, rest.reshape(-1, 3)).ravel()
        z[fixed] = 0
        return z

    diagonals = np.repeat(np.einsum("nii->n", blocks) / 3, 3)
    return Preconditioner(apply, np.asarray(1 / np.sqrt(np.concatenate([diagonals, schur]))))


def _nodal_blocks(matrix: Any) -> FloatArray:
    """Return this rank's blocks (n, 3, 3) on the diagonal of a matrix."""
    rows, columns, values = matrix.getValuesCSR()
    first, _ = matrix.getOwnershipRange()
    nodes = np.repeat(np.arange(first, first + len(rows) - 1, dtype=np.int32) // 3, np.diff(rows))
    return np.asarray(values[columns // 3 == nodes].reshape(-1, 3, 3))


def positive(blocks: FloatArray) -> bool:
    """Whether blocks (n, 3, 3) are all finite and positive definite."""
    finite = np.isfinite(blocks).all()
    return bool(finite and np.linalg.eigvalsh(blocks + blocks.swapaxes(1, 2)).min(initial=1.0) > 0)


class DirectSolver:
    """A `LinearSolver` that factorises a stiffness matrix by MUMPS: LDLᵀ where it is symmetric, else LU.

    One matrix and one solver object serve every realisation, so that the symbolic analysis is done once and no
    communicator is created in a loop. If another solver assembles the matrix, the factor is lost.
    """

    def __init__(self, stiffness: StiffnessMatrix) -> None:
        self._stiffness = stiffness
        self._unknowns, self._symmetric = stiffness.unknowns, stiffness.symmetric
        self._room = ROOM
        self._analysed = False
        self._ksp = self._new_ksp(stiffness.comm)
        self._right = stiffness.matrix.createVecLeft()
        self._solution = stiffness.matrix.createVecRight()

    def factorise(self) -> None:
        """Assemble and factorise; errors as of `LinearSolver`, also for entries that are not finite."""
        unknowns, sharing = self._stiffness.matrix.getSize()[0], self._ksp.comm.size
        if not self._analysed:  # the analysis crashes without memory
            hopeless = HOPELESS * self._stiffness.expected.bytes / sharing + SPARE
            require(hopeless, f"the factor of the stiffness of {unknowns:,} unknowns")
        self._stiffness.assemble()
        while (status := self._try()) in TOO_LITTLE_ROOM and self._room < MOST_ROOM:
            self._room *= 4
            self.release()
        self._analysed = True
        if status >= 0:
            return
        needed = self._ksp.pc.getFactorMatrix().getMumpsInfog(16)  # by its analysis, on the rank that needs most
        self.release()  # or else PETSc would report this failure for ever
        if status == SINGULAR:
            raise SolveError("the stiffness is singular")
        if status in TOO_LITTLE_ROOM or status in TOO_LITTLE_MEMORY:
            have = headroom()
            raise StopError(
                f"memory ran out: the factor of the stiffness of {unknowns:,} unknowns needs {needed:,} MiB"
                f"{' on one rank' if sharing > 1 else ''}, {have}"
            )
        raise SolveError(f"the factorisation failed (MUMPS error {status})")

    @phase("factorising")
    def _try(self) -> int:
        """Factorise; return MUMPS's status, negative if it failed."""
        self._ksp.pc.setUp()  # the KSP's own set-up would leave it to the first solve
        return int(self._ksp.pc.getFactorMatrix().getMumpsInfog(1))

    def _new_ksp(self, comm: Any) -> Any:
        ksp = PETSc.KSP().create(comm)
        ksp.setOperators(self._stiffness.matrix)
        ksp.setType("preonly")
        ksp.pc.setType("cholesky" if self._symmetric else "lu")
        ksp.pc.setFactorSolverType("mumps")
        ksp.pc.setFactorSetUpSolverType()
        ksp.pc.getFactorMatrix().setMumpsIcntl(14, self._room)
        if self._symmetric:
            # ScaLAPACK, to which MUMPS leaves the last front on several ranks, counts no negative pivots.
            ksp.pc.getFactorMatrix().setMumpsIcntl(13, 1)
        return ksp

    def release(self) -> None:
        """Free the factor; the next one is analysed again."""
        self._ksp.destroy()
        self._ksp = self._new_ksp(self._stiffness.comm)
        self._analysed = False

    def solve(self, right: FloatArray, *, transpose: bool = False, tolerance: float = TIGHT) -> FloatArray:
        """Solve to rounding with the factor at hand, or with its transpose, for (n,) or (k, n) right-hand sides."""
        del tolerance
        transpose = transpose and not self._symmetric
        if right.ndim == 1:
            self._right.array[:] = self._unknowns.reorder(right)
            (self._ksp.solveTranspose if transpose else self._ksp.solve)(self._right, self._solution)
            return self._unknowns.take(self._solution.array_r)
        if transpose or len(right) <= 1:
            return np.array([self.solve(row, transpose=transpose) for row in right]).reshape(right.shape)
        # The factor is read once for all of them.
        ordered = np.asfortranarray(self._unknowns.reorder(right).T)
        sizes = (self._stiffness.matrix.getSizes()[0], (None, len(right)))  # rows of this rank, and of all
        rights = PETSc.Mat().createDense(sizes, array=ordered, comm=self._ksp.comm)
        solutions = PETSc.Mat().createDense(sizes, comm=self._ksp.comm)
        for matrix in (rights, solutions):
            matrix.setUp()
            matrix.assemble()
        self._ksp.pc.getFactorMatrix().matSolve(rights, solutions)
        result = self._unknowns.take(np.array(solutions.getDenseArray().T, order="C"))
        rights.destroy()
        solutions.destroy()
        return result

    def negative_eigenvalues(self) -> int | None:
        """Return the number of negative pivots of LDLᵀ, which is that of negative eigenvalues; None for LU."""
        if not self._symmetric:
            return None
        return int(self._ksp.pc.getFactorMatrix().getMumpsInfog(12))


class MultigridSolver:
    """A `LinearSolver` for large bodies, whose only factor is that of the stiffness in linear elements.

    Where conjugate gradients meet a direction of negative energy, or the stiffness is not symmetric, generalised
    conjugate residuals take their place.

    The stiffness is stored by blocks; the coarse solver is for the same form in linear elements, from which `transfer`
    leads into those of the body. Prescribed unknowns are those of this rank.
    """

    def __init__(
        self,
        stiffness: StiffnessMatrix,
        coarse: LinearSolver,
        transfer: Transfer,
        fixed: NDArray[np.int64],
        coarse_fixed: NDArray[np.int64],
    ) -> None:
        self._stiffness, self._coarse, self._transfer = stiffness, coarse, transfer
        self._fixed, self._coarse_fixed = fixed, coarse_fixed
        self._in, self._out = stiffness.matrix.createVecs()
        self._levels: Levels | None = None
        self._total = partial(ranks.total, stiffness.comm)

    def factorise(self) -> None:
        """Assemble both stiffnesses, and factorise the coarse one; errors as of `LinearSolver`.

        Also if a block on the diagonal is singular, or entries are not finite.
        """
        self._levels = None
        self._stiffness.assemble()
        self._coarse.factorise()
        # PETSc has a block's entries by columns.
        found = self._stiffness.matrix.invertBlockDiagonal()
        blocks = np.ascontiguousarray(np.asarray(found).reshape(-1, 3, 3).swapaxes(1, 2))

        def smooth(r: FloatArray) -> FloatArray:
            return np.asarray(np.einsum("nij,nj->ni", blocks, r.reshape(-1, 3)).ravel())

        if self._total(np.array([0.0 if np.isfinite(blocks).all() else 1.0]))[0]:
            raise SolveError("a block on the diagonal of the stiffness is singular or not finite")
        largest = MARGIN * multigrid.largest_eigenvalue(self._multiply, smooth, self._random, self._total)
        self._levels = Levels(self._multiply, smooth, self._on_coarse, self._total, largest)

    @cached_property
    def _random(self) -> FloatArray:
        random = np.random.default_rng(self._stiffness.comm.rank)
        forces = random.standard_normal(self._stiffness.unknowns.size)
        forces[self._fixed] = 0
        return forces

    def _multiply(self, x: FloatArray, *, transpose: bool = False) -> FloatArray:
        K = self._stiffness.matrix
        self._in.array[:] = x
        (K.multTranspose if transpose else K.mult)(self._in, self._out)
        return np.array(self._out.array_r)

    def _on_coarse(self, r: FloatArray) -> FloatArray:
        below = self._transfer.transposed(r)
        below[self._coarse_fixed] = 0
        z = self._transfer(self._coarse.solve(below))
        z[self._fixed] = 0
        return z

    def solve(self, right: FloatArray, *, transpose: bool = False, tolerance: float = TIGHT) -> FloatArray:
        """Solve with K, or with Kᵀ, for one (n,) or several (k, n) right-hand sides; errors as of `LinearSolver`."""
        if right.ndim == 2:
            rows = [self.solve(row, transpose=transpose, tolerance=tolerance) for row in right]
            return np.array(rows).reshape(right.shape)
        assert self._levels is not None, "factorise comes first"
        levels, free, definite = self._levels, np.array(right), self._stiffness.symmetric
        free[self._fixed] = 0  # rows and columns of the identity: nothing else depends on them
        if definite:
            x, converged, definite = multigrid.conjugate_gradients(
                levels.multiply, levels.cycle, free, self._total, tolerance, ITERATIONS
            )
        if not definite:
            multiply = partial(self._multiply, transpose=transpose and not self._stiffness.symmetric)
            scale = 1 / np.sqrt(np.abs(self._stiffness.matrix.getDiagonal().array_r))  # makes forces comparable
            x, _, converged = minimised(multiply, levels.cycle, free, scale, self._total, tolerance, RESIDUALS)
        if not converged:
            raise NoConvergence(f"the linear solver did not converge to {tolerance:g}")
        x[self._fixed] = right[self._fixed]
        return x

    def release(self) -> None:
        """Free the coarse factor."""
        self._coarse.release()
        self._levels = None

    def negative_eigenvalues(self) -> int | None:
        """Return how many are found, 0 only if there are none; None if unknown; errors as of `LinearSolver`."""
        if not self._stiffness.symmetric or self._levels is None:
            return None
        below = self._coarse.negative_eigenvalues()
        if below:
            return below
        levels, size = self._levels, self._stiffness.matrix.getSize()[0]
        found = finish(negative_eigenvalues(levels.multiply, self._random, self._total, size), levels.cycle)
        if found is None:
            raise NoConvergence("the stiffness is nearly singular: its lowest eigenvalue cannot be told from zero")
        return found


class NodalBlocks:
    """The 3×3 blocks of the nodes on the diagonal of a stiffness, from moduli of the cells, without an element matrix.

    Of a cell with moduli 𝔸 = ∂P/∂F and shape functions φ_i, the block of node i is ∫ 𝔸_{akbl} ∂_kφ_i ∂_lφ_i dX. Here 𝔸
    and the Jacobian are means over the cell: for what only preconditions. An element matrix of cubic hexahedra has
    36 864 entries, of which these are 576.
    """

    def __init__(self, space: Any) -> None:
        element, cells = spaces.cell_element(space), owned_cells(space.mesh)
        self._carrier = fem.Function(space)
        self._nodes = version.nodes_of_cells(space, len(element.points))[:cells].ravel()
        kind = version.cell_type(space)
        points, weights = basix.make_quadrature(kind, 2 * version.degree(space))
        slopes = element.tabulate(1, points)[1:, :, :, 0]
        self._products = np.einsum("q,mqi,nqi->mni", weights, slopes, slopes).reshape(9, -1)
        middle = points.T @ weights / weights.sum()
        linear = basix.create_element(basix.ElementFamily.P, kind, 1).tabulate(1, middle[None])[1:, 0, :, 0]
        places = np.asarray(space.mesh.geometry.x[version.corners_of_cells(space.mesh)[:cells]])
        jacobians = np.einsum("mi,cik->ckm", linear, places)
        self._sizes = np.abs(np.linalg.det(jacobians))
        self._slopes = np.linalg.inv(jacobians)  # (c, m, k): of the reference coordinates

    def __call__(self, moduli: FloatArray) -> FloatArray:
        """Return the blocks (n_owned, 3, 3) of moduli (n_cells, a, k, b, l), ∂P_ak/∂F_bl, of this rank's cells."""
        K = self._slopes
        local = np.einsum("c,cakbl,cmk,cnl->cabmn", self._sizes, moduli, K, K, optimize=True)
        parts = (local.reshape(-1, 9) @ self._products).reshape(len(K), 9, -1).swapaxes(0, 1)
        count = len(self._carrier.x.array) // 3
        sums = [np.bincount(self._nodes, weights=part.ravel(), minlength=count) for part in parts]
        rows = [spaces.sum_rows(self._carrier, np.array(sums[i : i + 3])) for i in (0, 3, 6)]
        return np.asarray(np.stack(rows, axis=1))
