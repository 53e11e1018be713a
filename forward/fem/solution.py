"""An equilibrium of a finite-element model with its linearisation, and the error of its mesh.

With the equations F(u, ω) = 0 of `forward.fem.equations`, K = ∂F/∂u: tangent K du = −∂F/∂ω dω; adjoint Kᵀλ = ∂ψ/∂u,
dψ/dω = −λᵀ∂F/∂ω + ∂ψ/∂ω.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from forward.fem.affordable import allowance, richer
from forward.fem.enriched import Enriched, EnrichedState
from forward.fem.equations import Discretisation
from forward.fem.reference import ReferenceFactor, WayFromReference
from forward.fem.saturation import factors, typical
from forward.fem.space import BodySpace
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray, MeshError, ReferenceSolution, Saturation, SolveError, Work
from forward.observables.observable import Functional
from forward.registry import named
from forward.solvers.anderson import block_galerkin
from forward.solvers.rotations import turn
from forward.solvers.system import Found

FEW = 4  # number of derivatives up to which products with the stiffness are cheaper than a factorisation
ITERATIONS = 20  # for these derivatives, before the stiffness is factorised after all


class SolvedModel(Protocol):
    """What a solution asks of the model that found it."""

    spec: Hyperelastic
    parameters: tuple[str, ...]
    equations: Discretisation
    space: BodySpace
    functionals: list[Functional]

    @property
    def enriched(self) -> Enriched:
        """The body in elements of one degree higher, to estimate the error of its mesh."""

    @property
    def enriched_twice(self) -> Enriched | None:
        """The same in elements of two degrees more; None where they take too much."""

    def visit(self, solution: FiniteElementSolution) -> Discretisation:
        """Set parameters and state to those of a solution."""

    def linearise(self, solution: FiniteElementSolution) -> Discretisation:
        """Factorise the stiffness at a solution."""

    def has_factor(self, solution: FiniteElementSolution) -> bool:
        """Whether the current factor is that of a solution."""

    def take_reference(self, reference: ReferenceSolution) -> ReferenceFactor:
        """Return the factor at a reference."""


class FiniteElementSolution:
    """An equilibrium with its linearisation.

    k derivatives cost one factorisation and k back-substitutions. If the solution was found with a reference, a few
    derivatives are computed with the factor at the reference instead, to the solver's `derivative_tolerance`.
    """

    def __init__(
        self,
        model: SolvedModel,
        parameters: FloatArray,
        found: Found,
        work: Work,
        way: WayFromReference | None,
        stiffer: float = 1.0,
    ) -> None:
        self._model, self.stiffer = model, stiffer
        self.parameters = np.array(parameters, dtype=float)
        self.state = np.array(found.state)
        self.residual, self.converged = found.residual, found.converged
        self.stability = found.stability
        self.work = work
        for array in (self.parameters, self.state):
            array.flags.writeable = False
        self.reference = None if way is None else way.reference
        self._rotation = None if way is None else way.rotation
        model.visit(self)
        self.outputs = np.array([f.value() for f in model.functionals])
        self.outputs.flags.writeable = False

    def touched(self) -> dict[str, FloatArray]:
        """Undeformed places (m) and pressures (Pa), (n, 4), at the vertices under each tool; collective."""
        return self._model.visit(self).touched()

    def stressed(self) -> FloatArray | None:
        """Cauchy stresses (Pa) and Green–Lagrange strains (2, N, 6) at all nodes in canonical order; collective.

        On the first rank only. Components xx, yy, zz, xy, yz, xz; averages over the cells that meet at a node.
        """
        return self._model.visit(self).stressed()

    @cached_property
    def _right_sides(self) -> FloatArray:
        return self._model.visit(self).right_sides()

    @cached_property
    def _gradients(self) -> FloatArray:
        """∂ψ/∂u (m, U_local)."""
        self._model.visit(self)
        return np.array([f.gradient() for f in self._model.functionals])

    @cached_property
    def _partials(self) -> FloatArray:
        """∂ψ/∂ω (m, d)."""
        self._model.visit(self)
        return np.array([f.partial() for f in self._model.functionals])

    def solve(
        self,
        right: FloatArray,
        *,
        transpose: bool = False,
        directions: FloatArray | None = None,
        tolerance: float | None = None,
    ) -> FloatArray:
        """Solve K x = b, or Kᵀ x = b, for rows b (k, U_local); collective.

        For tangents, `directions` (k, d) are given. By default the tolerance is that of derivatives.
        """
        model = self._model
        near = self.reference is not None and not model.has_factor(self)
        if near and self.reference is not None and self._rotation is not None and len(right) <= FEW:
            if tolerance is None:
                tolerance = model.spec.solver.derivative_tolerance
            found = self._solve_near(
                right, self.reference, self._rotation, tolerance, transpose=transpose, directions=directions
            )
            if found is not None:
                return found
        return model.linearise(self).back_substitute(right, transpose=transpose)

    def _solve_near(
        self,
        right: FloatArray,
        reference: ReferenceSolution,
        R: FloatArray,
        tolerance: float,
        *,
        transpose: bool,
        directions: FloatArray | None,
    ) -> FloatArray | None:
        """Solve with the factor at the reference, rotated as for its prediction; None if that is too far away."""
        model = self._model
        factor = model.take_reference(reference)
        fixed = model.equations.fixed
        first = None
        if directions is not None and directions.shape[1] <= FEW:
            # Rotated with the body, the tangents at the reference are what a first back-substitution would give.
            first = turn(directions @ factor.slopes(), R)
            first[:, fixed] = 0
        equations = model.visit(self)
        free = np.array(right)
        free[:, fixed] = 0
        found = block_galerkin(
            lambda x: equations.free_stiffness_times(x, transpose=transpose),
            factor.inverse(R, transpose=transpose),
            free,
            equations.total,
            equations.norms,
            tolerance,
            ITERATIONS,
            first,
        )
        if found is not None:
            found[:, fixed] = right[:, fixed]
        return found

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return du (U_local,) along a `direction` (d,), or (k, U_local) for k of them; collective."""
        directions = np.atleast_2d(direction)
        equations = self._model.equations
        right = directions[:, equations.scalars] @ self._right_sides
        if equations.fields:
            right += self._model.visit(self).field_right_sides(directions)
        du = self.solve(right, directions=directions)
        return du.reshape(*np.shape(direction)[:-1], -1)

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        return self.along(self.state_tangent(direction), direction)

    def along(self, state: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along changes of state (U_local,) and parameters (d,); collective.

        For k of both, (k, m).
        """
        return self._model.equations.total(state @ self._gradients.T) + direction @ self._partials.T

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,), or (k, d) for k of them; collective."""
        return self.state_adjoint(self.loads(weights)) + self.directly(weights)

    def loads(self, weights: FloatArray) -> FloatArray:
        """Return the derivative (U_local,) of outputs weighted by `weights` (m,) by the state; (k, U_local) of k."""
        return np.asarray(weights @ self._gradients)

    def directly(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) at this state of the outputs weighted by `weights` (m,), or (k, d) for k of them."""
        return np.asarray(weights @ self._partials)

    def state_adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the state weighted by `weights` (U_local,), or (k, d) for k of them; collective.

        The transpose of `state_tangent`, summed over the ranks.
        """
        loads = np.atleast_2d(weights)
        multipliers = self.solve(loads, transpose=True)
        equations = self._model.equations
        gradients = np.zeros((len(loads), len(self.parameters)))
        gradients[:, equations.scalars] = equations.total(multipliers @ self._right_sides.T)
        if equations.fields:
            equations = self._model.visit(self)
            multipliers[:, equations.fixed] = 0
            gradients -= np.array([equations.field_products(multiplier) for multiplier in multipliers])
        return gradients.reshape(*np.shape(weights)[:-1], -1)

    @cached_property
    def enriched_state(self) -> EnrichedState:
        """The state in elements of one degree higher, by one linear solve from this state; collective."""
        self._model.visit(self)
        return self.estimated(self._model.enriched)

    def estimated(self, enriched: Enriched, nearer: tuple[EnrichedState, float] | None = None) -> EnrichedState:
        """Find the state in an enriched space; solves with the stiffness of the body are charged to it too.

        With `nearer`, go on from one until its nonlinearity is below a bound.
        """
        self._model.visit(self)
        kept, self.work = self.work, Work()
        try:
            found = enriched.state(self) if nearer is None else enriched.nearer(self, *nearer)
            work = found.work.as_array() + self.work.as_array()
        finally:
            self.work = kept
        return found._replace(work=Work(*work.tolist()))

    def mesh_error(self) -> MeshError:
        """Estimate the error of the mesh in outputs and state (`forward.fem.enriched`); collective.

        Raises
        ------
        SolveError
            If the stiffness in the enriched space is singular.
        """
        found, enriched = self.enriched_state, self._model.enriched
        errors = enriched.values(self, found) - self.outputs
        change = enriched.down(found.change)
        far = found.nonlinearity
        return MeshError(errors, change, found.energy, found.relative, found.work, nonlinearity=far)

    def saturated(self) -> tuple[Enriched, EnrichedState, float, float] | None:
        """Find the state in elements of two degrees more too, and the factors of state and energy; collective.

        None where that takes too much memory, or is too rough.
        """
        model = self._model
        model.visit(self)
        twice = model.enriched_twice
        if twice is None:
            return None
        once, found = self.enriched_state, self.estimated(twice)
        n = 3 * model.equations.nodes_owned
        seen, more = model.enriched.down(once.change)[:n], twice.down(found.change)[:n]
        products = model.equations.total(np.array([seen @ seen, seen @ more]))
        degree = model.spec.body.degree
        (of_state,) = factors(products[0], products[1], degree)
        (of_energy,) = factors(once.energy, found.energy, degree)
        return twice, found, float(of_state), float(of_energy)

    def saturation(self, spare: float = math.inf, finer: Any | None = None) -> Saturation:
        """Calibrate estimates of the error of the mesh by a finer mesh (`forward.fem.calibration`); collective.

        Where that is too large, by elements of two degrees more (`forward.fem.saturation`); typical values where this
        takes too much memory too. In a short study, either is too large also where it would take too long
        (`forward.fem.affordable.allowance`).

        Parameters
        ----------
        spare
            How many solves it may cost (`forward.fem.affordable.allowance`).
        finer
            The body on a finer mesh (`forward.fem.calibration.FinerMesh`), where there is one already.

        Raises
        ------
        SolveError
            If a stiffness in an enriched space is singular.
        """
        if finer is None:
            finer = named("forward.fem.calibration:FinerMesh")(self._model, spare)
        with suppress(SolveError):
            found: Saturation | None = finer.calibrated(self)
            if found is not None:
                return found
        seen = self.mesh_error().outputs
        spec = self._model.spec
        cheap = richer(spec) <= allowance(spec, spare)
        saturated = self.saturated() if cheap else None
        if saturated is None:
            return typical(seen, self._model.spec.body.degree)
        twice, state, of_state, of_energy = saturated
        more = twice.values(self, state) - self.outputs
        return Saturation(factors(seen, more, self._model.spec.body.degree), of_state, of_energy)

    def mesh_indicators(self, weights: FloatArray) -> FloatArray:
        """Return contributions of this rank's cells to the mesh error of outputs, by `weights` (m,); collective.

        They are (n_cells,), or (k, n_cells) for k rows of weights, in DOLFINx's order, and not negative
        (`Enriched.indicators`).
        """
        self._model.visit(self)
        found = self._model.enriched.indicators(self, np.atleast_2d(weights))
        return found.reshape(*np.shape(weights)[:-1], -1)
