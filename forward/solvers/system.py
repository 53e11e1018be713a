"""What the search for equilibria needs from a discrete system and from a linear solver, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from forward.model import FloatArray, SolveError, Stability, Work

TIGHT = 1e-10  # tolerance of solutions on which derivatives rest
ROUGH = 1e-2  # of steps of Newton's method, which correct each other
Move = tuple[FloatArray, FloatArray]  # where a step of Newton's method begins, and the whole of it


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

        One that iterates may leave an error of the tolerance, relative to the solution in the norm of the energy.

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


@dataclass(frozen=True)
class Residual:
    """Imbalance of a state.

    Attributes
    ----------
    vector
        This rank's part: forces on the free displacements, distance from the target on the prescribed ones, volumes
        on the pressures.
    size
        Euclidean norm over the free displacements, of all ranks (N).
    scale
        What `size` is compared with (N).
    gap
        Largest distance of a prescribed unknown from its target (m).
    volume
        Norm of the residual of the volumes, over all ranks, as a force (N); 0 if it is rounding, or if pressures are
        not unknowns.
    """

    vector: FloatArray
    size: float
    scale: float
    gap: float
    volume: float = 0.0

    @property
    def relative(self) -> float:
        """The residual relative to the loads."""
        largest = max(self.size, self.volume)
        return largest / self.scale if self.scale > 0 else largest


class System(Protocol):
    """A nonlinear system at a load fraction, and the linear system of its factorised stiffness.

    Vectors hold this rank's part; every method is collective over the ranks of the system.
    """

    work: Work

    @property
    def contact(self) -> bool:
        """Whether forces set in suddenly somewhere, so that whole Newton steps may go to and fro."""

    def in_words(self, fraction: float) -> str:
        """Say in parentheses what a fraction of the load is; empty if that says no more than the number."""

    def at_load(self, fraction: float) -> None:
        """Scale all loads and prescribed displacements."""

    def on_target(self, u: FloatArray) -> FloatArray:
        """Return u with the prescribed unknowns at their targets."""

    def residual(self, u: FloatArray) -> Residual:
        """Return the imbalance at u."""

    def rounding(self, u: FloatArray, scale: float) -> float:
        """Size (N) below which a residual with this scale cannot be expected to fall at u, whatever the loads."""

    def factorise(self, u: FloatArray, *, curved: bool = True, last: Move | None = None) -> FloatArray | float:
        """Assemble and factorise the stiffness at u; if not `curved`, without the curvature of surfaces in contact.

        Those on which the `last` step was to press the body, and which nothing touches at u, are linearised where it
        was to lead; what their imbalance is then beyond that at u is returned.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """

    def has_factor(self, u: FloatArray) -> bool:
        """Whether the factor at hand is that of the stiffness at this very array u."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = right with the factor at hand; prescribed rows are identities."""

    def total(self, values: FloatArray) -> FloatArray:
        """Sum over all ranks."""

    def curvature(self, move: FloatArray, change: FloatArray) -> float:
        """Second difference of the energy along a move, from the change of the residual's vector."""

    def weights(self) -> FloatArray:
        """Weights that turn a residual's vector into forces (N)."""

    def norm(self, x: FloatArray) -> float:
        """Euclidean norm over the displacements of all ranks (pressures, in another unit, follow them)."""

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest J = det F over the quadrature points of all ranks."""

    def crossed(self, u: FloatArray) -> bool:
        """Whether the body has passed through a plane that holds it along the normal n: n·Fn ≤ 0 somewhere on it."""

    def rotations(self, u: FloatArray) -> FloatArray:
        """Return the rotations (3, 3, n_owned) of this rank's nodes from rest to u."""

    def angle(self, R: FloatArray, Q: FloatArray) -> float:
        """Largest angle (rad) between rotations of the nodes of all ranks."""

    def inertia(self) -> int | None:
        """Number of negative eigenvalues of the factorised stiffness of displacements; None if unknown.

        A stable state has none. Those due to pressures (one each, at every state) do not count.
        """

    def negative_eigenvalues(self, u: FloatArray) -> int | None:
        """Factorise the stiffness at u; count negative eigenvalues, of its symmetric part if it is not symmetric.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """


class Found(NamedTuple):
    """A state (U_local,) and what is known about it.

    Attributes
    ----------
    state
        The state.
    residual
        Its relative residual.
    converged
        Whether it is an equilibrium to the solver's tolerance.
    corrected
        Whether it was found with the factor of the reference.
    stability
        How its stability was tested.
    predicted
        What a tangent predicted for it (U_local,), from another equilibrium; None if nothing did.
    snapped
        Whether the path of loads from rest has jumped to it.
    """

    state: FloatArray
    residual: float
    converged: bool = True
    corrected: bool = False
    stability: Stability = Stability.NOT_TESTED
    predicted: FloatArray | None = None
    snapped: bool = False
