"""The factor of a reference in single precision: half the memory, and faster to read.

What corrects predictions needs a few digits only, since residuals are in double precision. Where all digits are wanted,
solutions are refined with the stiffness itself (N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed.,
chapter 12). PETSc has MUMPS in double precision only; its library in single precision stands beside it on Debian.
"""

from __future__ import annotations

import ctypes
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from forward import native
from forward.fem.cost import SPARE
from forward.fem.dolfinx.linear import MOST_ROOM, ROOM, TOO_LITTLE_ROOM, DirectSolver, StiffnessMatrix
from forward.machine import require
from forward.model import FloatArray
from forward.solvers.system import ROUGH, TIGHT

SINGLE = np.float32
CONTRACTION = 0.1  # largest share of an error that a refinement may leave: then the factor has the stiffness' inertia
TRIED, TRIALS = 4, 4  # random right-hand sides, and refinements, with which that is found out
REFINEMENTS = 12  # most of a solution
_SOURCE = Path(__file__).with_name("single.c")


@cache
def library() -> Any | None:
    """Return MUMPS in single precision, of the same build as that which PETSc has loaded; None where there is none."""
    doubles = re.findall(r"\S*/libdmumps\S*\.so\S*", Path("/proc/self/maps").read_text(encoding="utf-8"))
    beside = [Path(one.replace("libdmumps", "libsmumps")) for one in doubles]
    found = next((one for one in beside if one.exists()), None)
    if found is None:
        return None
    include = f"-I{found.parents[1] / 'include'}"
    loaded = native.library(_SOURCE.read_text(encoding="utf-8"), flags=("-O2", include), against=(str(found),))
    if loaded is None:  # no header
        return None
    array, number = ctypes.c_void_p, ctypes.c_int
    loaded.begin.restype = array
    loaded.factorise.argtypes = [array, number, ctypes.c_int64, *[array] * 3, *[number] * 2]
    loaded.solve.argtypes = [array, array, number, number]
    loaded.told.argtypes, loaded.end.argtypes = [array, number], [array]
    return loaded


class SingleSolver:
    """A `LinearSolver` of one process whose factor is in single precision; where that will not do, it is in double.

    A factor S is taken if refinements x ← x + S⁻¹(b − Kx) leave at most a tenth of every error, on random right-hand
    sides. Then ρ(I − S⁻¹K) < 1, so that no S + t(K − S) with 0 ≤ t ≤ 1 is singular: S has as many negative eigenvalues
    as K.

    Parameters
    ----------
    stiffness
        The matrix.
    counted
        Whether its negative eigenvalues are. Where the factor only preconditions what says itself whether it converges,
        that test is left out: it takes as long as several solutions.

    Attributes
    ----------
    in_single
        Whether the factor at hand is in single precision.
    contraction
        That share, of the last factor in single precision that was tested.
    """

    def __init__(self, stiffness: StiffnessMatrix, *, counted: bool = True) -> None:
        self._stiffness, self._counted = stiffness, counted
        self._symmetric = stiffness.symmetric
        self._factor: Any = None
        self.in_single, self._room = False, ROOM
        self.contraction = np.inf
        self._double: DirectSolver | None = None
        self._x, self._b = stiffness.matrix.createVecs()
        self._library: Any = library()

    def factorise(self) -> None:
        """Assemble and factorise; errors as of `DirectSolver`."""
        if self._made_single():
            return
        self._end()
        self._double = self._double or DirectSolver(self._stiffness)
        self._double.factorise()

    def _made_single(self) -> bool:
        """Assemble, and make a factor that is good enough; False if there is none."""
        found = self._library
        if found is None:
            return False
        n = self._stiffness.matrix.getSize()[0]
        require(self._stiffness.expected.bytes / 4 + SPARE, f"the factor of the stiffness of {n:,} unknowns")
        if self._double is not None:
            self._double.release()
        self._factor = self._factor or found.begin(int(self._symmetric), MPI.COMM_SELF.py2f())
        if not self._factor:
            return False
        self._stiffness.assemble()
        rows, columns, values = _entries(self._stiffness.matrix, half=self._symmetric)
        if not np.isfinite(values).all():
            return False
        while True:
            at = [array.ctypes.data for array in (rows, columns, values)]
            status = found.factorise(self._factor, n, len(values), *at, self._room, not self.in_single)
            self.in_single = status >= 0
            if status not in TOO_LITTLE_ROOM or self._room >= MOST_ROOM:
                break
            self._room *= 4
        if not self._counted:
            return bool(self.in_single)
        self.contraction = self._contracted() if self.in_single else np.inf
        return self.contraction <= CONTRACTION

    def _contracted(self) -> float:
        """Return the share of random errors that a refinement leaves, once only the largest are left."""
        random = np.random.default_rng(0)
        before = self._scaled(random.standard_normal((TRIED, self._stiffness.matrix.getSize()[0])))
        for _ in range(TRIALS):
            after = before - self._scaled(self._products(before))
            share = float((np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)).max())
            before = after
        return share if np.isfinite(share) else np.inf

    def _once(self, rows: NDArray[np.float32], *, transpose: bool = False) -> None:
        """Solve with the factor for rows (k, n) in PETSc's order, in place."""
        status = self._library.solve(self._factor, rows.ctypes.data, len(rows), int(transpose and not self._symmetric))
        assert status >= 0, status

    def _scaled(self, rights: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Solve with the factor for rows (k, n) of any size: single precision reaches from 1e-38 to 1e38 only.

        Row by row, so that each stays in the cache.
        """
        rows, found, sizes = np.empty(rights.shape, SINGLE), np.empty(rights.shape), np.empty(len(rights))
        for i, right in enumerate(rights):
            size = max(float(right.max(initial=0.0)), -float(right.min(initial=0.0)))
            sizes[i] = size if size != 0 else 1.0  # NaN stays
            np.divide(right, sizes[i], out=rows[i], casting="same_kind")
        self._once(rows, transpose=transpose)
        for row, size, solution in zip(rows, sizes, found, strict=True):
            np.multiply(row, size, out=solution)
        return found

    def _products(self, rows: FloatArray, *, transpose: bool = False) -> FloatArray:
        """K, or Kᵀ, times rows (k, n): several at a time, since reading the matrix is what takes long."""
        matrix = self._stiffness.matrix
        if len(rows) == 1:
            self._x.array[:] = rows[0]
            (matrix.multTranspose if transpose else matrix.mult)(self._x, self._b)
            return np.array(self._b.array_r)[None]
        columns = PETSc.Mat().createDense(size=rows.T.shape, array=rows.reshape(-1), comm=matrix.comm)
        columns.assemble()
        products = (matrix.transposeMatMult if transpose else matrix.matMult)(columns)
        found = np.array(products.getDenseArray().T)
        columns.destroy()
        products.destroy()
        return found

    def solve(self, right: FloatArray, *, transpose: bool = False, tolerance: float = TIGHT) -> FloatArray:
        """Solve with K, or with Kᵀ, for one (n,) or several (k, n) right-hand sides; refine unless it may be rough."""
        if not self.in_single:
            assert self._double is not None
            return self._double.solve(right, transpose=transpose, tolerance=tolerance)
        rights = self._stiffness.unknowns.reorder(np.atleast_2d(right))
        found = self._scaled(rights, transpose=transpose)
        if tolerance < ROUGH:
            found = self._refined(found, rights, tolerance, transpose=transpose)
        return self._stiffness.unknowns.take(found).reshape(right.shape)

    def _refined(self, x: FloatArray, rights: FloatArray, tolerance: float, *, transpose: bool) -> FloatArray:
        """Refine rows until what is left is below the tolerance, or steps no longer fall: that is rounding in double.

        A step is as much shorter than the one before as what is left is shorter than it.
        """
        before = 1.0
        for _ in range(REFINEMENTS):
            residuals = rights - self._products(x, transpose=transpose)
            step = self._scaled(residuals, transpose=transpose)
            lengths = np.linalg.norm(x, axis=1)
            share = float((np.linalg.norm(step, axis=1) / np.where(lengths > 0, lengths, 1.0)).max())
            if not share < before / 2:
                break
            left, before = share * (share / before), share
            x = x + step
            if left <= tolerance * 1e-2:
                break
        return x

    def release(self) -> None:
        """Free the factor."""
        self._end()
        if self._double is not None:
            self._double.release()

    def _end(self) -> None:
        if self._factor:
            self._library.end(self._factor)
        self._factor, self.in_single = None, False

    def __del__(self) -> None:
        if not MPI.Is_finalized():
            self._end()

    def negative_eigenvalues(self) -> int | None:
        """Return the number of negative pivots of LDLᵀ, which is that of negative eigenvalues of K; None for LU."""
        if not self.in_single:
            assert self._double is not None
            return self._double.negative_eigenvalues()
        return int(self._library.told(self._factor, 12)) if self._symmetric else None


def _entries(matrix: Any, *, half: bool) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Return rows and columns from one, and entries; of the lower half only."""
    starts, columns, values = matrix.getValuesCSR()
    rows = np.repeat(np.arange(1, len(starts), dtype=np.int32), np.diff(starts))
    columns = columns.astype(np.int32) + np.int32(1)
    if half:
        lower = columns <= rows
        rows, columns, values = rows[lower], columns[lower], values[lower]
    with np.errstate(over="ignore"):
        return rows, columns, values.astype(SINGLE)
