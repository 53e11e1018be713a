"""Stiffness matrices and their linear solvers (`forward.solvers.linear`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from forward.fem.cost import BYTES_PER_NONZERO, SPARE, Factor
from forward.fem.dolfinx import version
from forward.fem.dolfinx.spaces import owned_nodes
from forward.fem.dolfinx.unknowns import Unknowns
from forward.machine import StopError, headroom, require
from forward.model import FloatArray, SolveError

ROOM = 60  # for what pivoting adds to the factor, in per cent of MUMPS's own estimate
MOST_ROOM = 4000
HOPELESS = 0.6  # fraction of the expected memory without which a factorisation is not begun
SINGULAR = -10  # MUMPS error codes, from its guide
TOO_LITTLE_ROOM = {-8, -9, -14, -15, -17, -20}  # more memory is needed than estimated: retry with more
TOO_LITTLE_MEMORY = {-5, -7, -11, -13, -18, -19, -22}


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

    Attributes
    ----------
    matrix
        PETSc's matrix.

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
        require(2 * BYTES_PER_NONZERO * expected.nonzeros / comm.size + SPARE, "the stiffness matrix")
        self.unknowns, self.comm, self.symmetric, self.expected = unknowns, comm, symmetric, expected
        self._form = form
        self._constraints = constraints
        self.matrix = fem.petsc.create_matrix(form)
        if symmetric:
            self.matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)

    def assemble(self) -> None:
        """Assemble at the state that is set."""
        self.matrix.zeroEntries()
        fem.petsc.assemble_matrix(self.matrix, self._form, bcs=self._constraints)
        self.matrix.assemble()

    def assembled(self) -> Any:
        """Assemble; return a copy of PETSc's matrix, for `products`."""
        self.assemble()
        return self.matrix.copy()

    def products(self, matrix: Any, rows: FloatArray) -> FloatArray:
        """Return the products (k, n) of such a copy with rows (k, n)."""
        x, y = matrix.createVecs()
        found = np.empty_like(rows)
        for row, product in zip(rows, found, strict=True):
            x.array[:] = self.unknowns.reorder(row)
            matrix.mult(x, y)
            product[:] = self.unknowns.take(y.array_r)
        x.destroy()
        y.destroy()
        return found


class NodalBlocks:
    """The 3×3 blocks on the diagonal of a stiffness of displacements, without the rest of it.

    Parameters
    ----------
    form, constraints, comm
        As of `StiffnessMatrix`.
    space
        The space of displacements.
    """

    def __init__(self, form: Any, constraints: list[Any], space: Any, comm: Any) -> None:
        self._form, self._constraints = form, constraints
        self._matrix = version.block_diagonal_matrix(space, comm)
        nodes = np.arange(owned_nodes(space) + 1, dtype=np.int32)
        self._matrix.setValuesBlockedLocalCSR(nodes, nodes[:-1], np.zeros(9 * len(nodes[1:])))
        self._matrix.assemble()  # what is on the diagonal has its place now
        self._matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATIONS, False)

    def inverted(self) -> FloatArray | None:
        """Assemble at the state that is set; return the inverses (n_owned, 3, 3), None where one is not positive."""
        self._matrix.zeroEntries()
        fem.petsc.assemble_matrix(self._matrix, self._form, bcs=self._constraints)
        self._matrix.assemble()
        rows, _, values = self._matrix.getValuesCSR()
        first, last = self._matrix.getOwnershipRange()
        assert len(values) == 3 * (last - first) == rows[-1]
        blocks = np.asarray(values).reshape(-1, 3, 3)
        if not np.isfinite(blocks).all() or np.linalg.eigvalsh(blocks + blocks.swapaxes(1, 2)).min(initial=1.0) <= 0:
            return None
        return np.asarray(np.linalg.inv(blocks))


class DirectSolver:
    """A `LinearSolver` that factorises a stiffness matrix by MUMPS: LDLᵀ where it is symmetric, else LU.

    One matrix and one solver object serve every realisation, so that the symbolic analysis is done once and no
    communicator is created in a loop. If another solver assembles the matrix, the factor is lost.
    """

    def __init__(self, stiffness: StiffnessMatrix) -> None:
        self._stiffness = stiffness
        self._unknowns, self._symmetric = stiffness.unknowns, stiffness.symmetric
        self._room = ROOM
        self._analysed = self._factorised = False
        self._ksp = self._new_ksp(stiffness.comm)
        self._right = stiffness.matrix.createVecLeft()
        self._solution = stiffness.matrix.createVecRight()

    def factorise(self) -> None:
        """Assemble and factorise.

        Raises
        ------
        SolveError
            If the matrix is singular or has entries that are not finite.
        StopError
            If there is no memory for the factor.
        """
        unknowns, ranks = self._stiffness.matrix.getSize()[0], self._ksp.comm.size
        if not self._analysed:  # the analysis crashes without memory
            hopeless = HOPELESS * self._stiffness.expected.bytes / ranks + SPARE
            require(hopeless, f"the factor of the stiffness of {unknowns:,} unknowns")
        self._stiffness.assemble()
        while (status := self._try()) in TOO_LITTLE_ROOM and self._room < MOST_ROOM:
            self._room *= 4
            self._renew()
        self._analysed = True
        self._factorised = status >= 0
        if self._factorised:
            return
        needed = self._ksp.pc.getFactorMatrix().getMumpsInfog(16)  # by its analysis, on the rank that needs most
        self._renew()  # or else PETSc would report this failure for ever
        if status == SINGULAR:
            message = "the stiffness is singular"
            raise SolveError(message)
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

    def _renew(self) -> None:
        """Start with a new factor, which is analysed again."""
        self._ksp.destroy()
        self._ksp = self._new_ksp(self._stiffness.comm)
        self._analysed = False

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

    def release(self) -> None:
        """Free the factor."""
        self._renew()
        self._factorised = False

    def negative_eigenvalues(self) -> int | None:
        """Return the number of negative pivots of LDLᵀ, which is that of negative eigenvalues; None for LU."""
        if not self._symmetric:
            return None
        return int(self._ksp.pc.getFactorMatrix().getMumpsInfog(12))

    def memory(self) -> int:
        """Return the bytes of the last factor with its working memory on all ranks, in whole megabytes; 0 before."""
        if not self._factorised:
            return 0
        return 10**6 * int(self._ksp.pc.getFactorMatrix().getMumpsInfog(22))
