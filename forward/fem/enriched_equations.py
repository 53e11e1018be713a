"""The equations of a body in elements of one degree higher on the same mesh, and three ways to solve them.

Where a factor of their own is too dear, the factor at a reference serves many solutions, or a few steps of a Krylov
method without a factor leave to the stiffness of the body what a coarser space can solve for.
"""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np

from forward.fem.dolfinx.linear import Preconditioner
from forward.fem.dolfinx.spaces import Transfer
from forward.fem.equations import Discretisation
from forward.fem.mesh_error_cost import Way, estimate
from forward.fem.reference import ReferenceFactor
from forward.loaded import LoadedBody
from forward.model import FloatArray, ReferenceSolution, Work
from forward.solvers.multigrid import minimised, smoothed

ROUGH = 0.03  # tolerance of solves with the stiffness of the body, relative to the solution
STEPS = 100  # of conjugate gradients or residuals, at most
ORTHOGONAL = 1e-6  # relative size of forces that are neglected on the body
LITTLE = 0.01  # the same before the steps, after which these forces are met again
ITERATIONS = 30  # with the factor at a reference in the enriched space, at most


class Linearised(Protocol):
    """What is asked of a solution of the body (`forward.fem.solution`)."""

    parameters: FloatArray
    state: FloatArray
    stiffer: float
    reference: ReferenceSolution | None

    def solve(self, right: FloatArray, *, transpose: bool = False, tolerance: float | None = None) -> FloatArray:
        """Solve with the stiffness there, or its transpose, for rows (k, U_local)."""


class EnrichedEquations:
    """The equations of a body in an enriched space, and its transfer to and from the space of the body.

    Made from those of the body, and its specification in elements of a higher degree.

    Attributes
    ----------
    equations
        The equations in the enriched space.
    way
        How they are solved; depends only on sizes, form and degree.
    """

    def __init__(self, equations: Discretisation, spec: LoadedBody) -> None:
        self._coarse = equations
        self.equations = Discretisation(spec, equations.comm, equations.parameters, equations)
        pairs = [(equations.unknowns.displacement, self.equations.unknowns.displacement)]
        if equations.unknowns.pressure is not None:
            pairs.append((equations.unknowns.pressure, self.equations.unknowns.pressure))
        self._up = [Transfer(coarse, fine) for coarse, fine in pairs]
        self._down = [Transfer(fine, coarse) for coarse, fine in pairs]
        cost = estimate(equations.spec.body, spec.body, mixed=spec.mixed, symmetric=spec.symmetric)
        self.way, self._alone = cost.way, cost.alone
        self._blocks: tuple[ReferenceSolution, Preconditioner | None] | None = None

    def up(self, u: FloatArray) -> FloatArray:
        """Return a vector (U_local,) of the body in the enriched space (U⁺_local,): the same function."""
        parts = np.split(u, [3 * self._coarse.nodes_owned])
        return np.concatenate([up(part) for up, part in zip(self._up, parts, strict=False)])

    def down(self, u: FloatArray) -> FloatArray:
        """Interpolate a vector (U⁺_local,) of the enriched space at the nodes of the body (U_local,)."""
        parts = np.split(u, [3 * self.equations.nodes_owned])
        return np.concatenate([down(part) for down, part in zip(self._down, parts, strict=False)])

    def restrict(self, forces: FloatArray) -> FloatArray:
        """Restrict forces (U⁺_local,) of the enriched space to those (U_local,) of the body: the transpose of `up`."""
        parts = np.split(forces, [3 * self.equations.nodes_owned])
        return np.concatenate([up.transposed(part) for up, part in zip(self._up, parts, strict=False)])

    def visit(self, solution: Linearised, at: FloatArray | None = None) -> Discretisation:
        """Set parameters, loads and state to those of a solution of the body, or to a state (U⁺_local,) near it."""
        equations, key = self.equations, solution if at is None else at
        if equations.linearisation_point.solution is not key:
            equations.set_to(solution.parameters, self.up(solution.state) if at is None else at, solution.stiffer)
            equations.linearisation_point.solution = key
        return equations

    def imbalance(self, solution: Linearised, at: FloatArray | None = None) -> FloatArray:
        """F⁺ (U⁺_local,) at a solution, or at a state near it, zero on prescribed unknowns."""
        equations = self.visit(solution, at)
        forces = equations.imbalance()
        equations.work.residuals += 1
        forces[equations.fixed] = 0
        return forces

    def solve(
        self,
        solution: Linearised,
        right: FloatArray,
        close: float,
        *,
        transpose: bool = False,
        at: FloatArray | None = None,
    ) -> FloatArray:
        """Solve with K⁺ at a solution for rows (k, U⁺_local) that are zero on prescribed unknowns; collective.

        To rounding with its own factor, else to the tolerance `close`: relative to the solution with the factor of a
        reference; of steps without a factor, the part that may be missing of the energy or, with pressures, of the
        forces. With `at`, K⁺ is that at a state (U⁺_local,) near the solution.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """
        found = None
        if self.way == Way.SMOOTHING and at is None:  # where K(u_h) is near
            found = self._solve_by_smoothing(solution, right, close, transpose=transpose)
        elif self.way == Way.REFERENCE and solution.reference is not None:
            # With the factor of the enriched stiffness at the reference, unless that is too far away.
            if self._alone:
                self.equations.release()
            known = ReferenceSolution(solution.reference.parameters, self.up(solution.reference.state))
            factor = self._reference.at(known)
            R = factor.rotation(self.up(solution.state) if at is None else at)
            self.visit(solution, at)
            found = factor.solve_near(R, right, close, ITERATIONS, transpose=transpose)
        if found is None:
            equations, key = self.visit(solution, at), solution if at is None else at
            if equations.linearisation_point.factorised is not key:
                if self._alone:
                    self._reference.release()
                equations.factorise(self.up(solution.state) if at is None else at)
                equations.linearisation_point.factorised = equations.linearisation_point.solution = key
            found = equations.back_substitute(right, transpose=transpose)
        return found

    def _solve_by_smoothing(
        self, solution: Linearised, right: FloatArray, close: float, *, transpose: bool
    ) -> FloatArray | None:
        """Solve by steps of conjugate gradients and, after them and perhaps before, with the stiffness of the body.

        The former may miss such a part of the energy. The solve afterwards corrects what affects outputs most: it makes
        the residual orthogonal to V_h.
        """
        inverse = self._preconditioner(solution)
        if inverse is None:
            return None
        equations, fixed = self.visit(solution), self.equations.fixed

        def multiply(x: FloatArray) -> FloatArray:
            y = equations.stiffness_times(x, transpose=transpose)
            y[fixed] = 0
            return y

        found = self._on_the_body(solution, right, LITTLE, transpose=transpose)
        for i, b in enumerate(right):
            residual = b - multiply(found[i]) if found[i].any() else b
            if inverse.weights is None:
                change, _, settled = smoothed(multiply, inverse.apply, residual, equations.total, close, STEPS)
            else:
                change, _, settled = minimised(
                    multiply, inverse.apply, residual, inverse.weights, equations.total, close, STEPS
                )
            if not settled:
                return None
            found[i] += change
        left = right - np.array([multiply(x) for x in found])
        return found + self._on_the_body(solution, left, ORTHOGONAL, transpose=transpose)

    def _on_the_body(
        self, solution: Linearised, right: FloatArray, negligible: float, *, transpose: bool
    ) -> FloatArray:
        """Solve with the stiffness of the body for the restriction of rows (k, U⁺_local), unless that is negligible."""
        forces = np.array([self.restrict(row) for row in right])
        forces[:, self._coarse.fixed] = 0
        sizes, wholes = self._coarse.norms(forces), self.equations.norms(right)
        worth = sizes > negligible * wholes
        found = np.zeros_like(right)
        if worth.any():
            solved = solution.solve(forces[worth], transpose=transpose, tolerance=ROUGH)
            found[worth] = [self.up(row) for row in solved]
            found[:, self.equations.fixed] = 0
        self.visit(solution)
        return found

    def _preconditioner(self, solution: Linearised) -> Preconditioner | None:
        """What steps are preconditioned by, at the reference of a solution, shared by all that have it."""
        at = solution.reference or ReferenceSolution(solution.parameters, solution.state)
        if self._blocks is None or not self._blocks[0].same(at):
            equations = self.equations
            kept, equations.work = equations.work, Work()  # counted for no solution, as the factor at a reference
            equations.set_to(at.parameters, self.up(at.state))
            self._blocks = (at, equations.preconditioner())
            equations.work = kept
        return self._blocks[1]

    @cached_property
    def _reference(self) -> ReferenceFactor:
        return ReferenceFactor(self.equations)
