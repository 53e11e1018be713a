"""A linear solver for large bodies: conjugate gradients with two levels (`forward.solvers.multigrid`)."""

from __future__ import annotations

from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from forward.fem import ranks
from forward.fem.dolfinx.linear import StiffnessMatrix
from forward.fem.dolfinx.spaces import Transfer
from forward.model import FloatArray, SolveError
from forward.solvers import multigrid
from forward.solvers.lanczos import negative_eigenvalues
from forward.solvers.multigrid import MARGIN, Levels, minimised
from forward.solvers.steps import finish
from forward.solvers.system import TIGHT, LinearSolver, NoConvergence

ITERATIONS = 400  # of conjugate gradients
RESIDUALS = 100  # of generalised conjugate residuals, which remember all directions


class MultigridSolver:
    """A `LinearSolver` that makes no factor of the stiffness, but one of its restriction to linear elements.

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

        bound = self._total(np.array([0.0 if np.isfinite(blocks).all() else 1.0]))[0]
        if bound:
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
