"""What solvers of equilibria want of a linear solver."""

from __future__ import annotations

from typing import Protocol

from forward.model import FloatArray


class LinearSolver(Protocol):
    """A solver of K x = b for a stiffness K, which is that of the state that was set when `factorise` was last called.

    K may be symmetric and definite, symmetric and indefinite (with pressures as unknowns), or not symmetric (under
    loads that follow the body). Rows and columns of prescribed unknowns are those of the identity. Vectors hold this
    rank's part; every method is collective over the ranks that share the matrix.
    """

    def factorise(self) -> None:
        """Take over the stiffness at the state that is set: assemble, and prepare whatever solutions need.

        Raises
        ------
        SolveError
            If it is singular.
        StopError
            If there is no memory for it.
        """

    def solve(self, right: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Solve with K, or with Kᵀ, for one (n,) or several (k, n) right-hand sides."""

    def negative_eigenvalues(self) -> int | None:
        """Return the number of negative eigenvalues of K (its inertia); None where the solver does not know it."""

    def memory(self) -> int:
        """Return the bytes that what is prepared takes on all ranks; 0 before."""
