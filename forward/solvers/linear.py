"""What solvers of equilibria need from a linear solver."""

from __future__ import annotations

from typing import Protocol

from forward.model import FloatArray, SolveError

TIGHT = 1e-10  # tolerance of solutions on which derivatives rest
ROUGH = 1e-2  # of steps of Newton's method, which correct each other


class NoConvergence(SolveError):  # noqa: N818 - what has happened
    """A linear solver that iterates has not converged."""


class LinearSolver(Protocol):
    """A solver of K x = b, with the stiffness K of the state that was set when `factorise` was last called.

    K may be symmetric and definite, symmetric and indefinite (with pressures as unknowns), or not symmetric (under
    loads that follow the body). Rows and columns of prescribed unknowns are those of the identity. Vectors hold this
    rank's part; every method is collective over the ranks that share the matrix.
    """

    def factorise(self) -> None:
        """Prepare for the stiffness at the current state: assemble it, and compute whatever solutions need.

        Raises
        ------
        SolveError
            If it is singular.
        StopError
            If there is no memory for it.
        """

    def solve(self, right: FloatArray, *, transpose: bool = False, tolerance: float = TIGHT) -> FloatArray:
        """Solve with K, or with Kᵀ, for one (n,) or several (k, n) right-hand sides.

        Parameters
        ----------
        right
            The right-hand sides.
        transpose
            Whether to solve with Kᵀ.
        tolerance
            Error, relative to the solution in the norm of the energy, that a solver that iterates may leave.

        Raises
        ------
        NoConvergence
            If such a solver does not converge.
        """

    def release(self) -> None:
        """Free what `factorise` has prepared."""

    def negative_eigenvalues(self) -> int | None:
        """Return the number of negative eigenvalues of K (its inertia); None if the solver does not know it.

        A solver that iterates may stop at the first that it finds.

        Raises
        ------
        NoConvergence
            If such a solver cannot tell the lowest eigenvalue from zero.
        """

    def memory(self) -> int:
        """Return the bytes that the prepared data take on all ranks; 0 before `factorise`."""
