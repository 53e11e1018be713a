"""An equilibrium of a finite-element model with its linearisation, and the error of its mesh.

With the equations F(u, ω) = 0 of `forward.fem.equations`, K = ∂F/∂u: tangent K du = −∂F/∂ω dω; adjoint Kᵀλ = ∂ψ/∂u,
dψ/dω = −λᵀ∂F/∂ω + ∂ψ/∂ω.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from forward.fem.body import Calibrating, DiscreteBody, not_estimated
from forward.fem.enriched import Enriched, EnrichedState, relative
from forward.fem.equations import Discretisation
from forward.fem.mesh_error_cost import allowance, richer
from forward.model import FloatArray, MeshError, Saturation, SolveError, Stability, Work
from forward.phases import phase
from forward.solvers.rotations import turn
from forward.solvers.system import Found
from forward.solvers.way import Way

FEW = 4  # number of derivatives up to which products with the stiffness are cheaper than a factorisation
ITERATIONS = 20  # for these derivatives, before the stiffness is factorised after all
LEAST, MOST = 0.5, 3.0  # ratios of errors to what is seen of them that hold at other parameters too
# Where finding them takes too much memory: of linear elements, which see most, and of others at edges that are held.
TYPICAL = {1: 1.1, 2: 1.35}
RATES = np.geomspace(1e-3, 60.0, 2000)  # β
OF_DEGREES, OF_TYPICAL = 0.25, 0.5  # doubt of an error that three degrees tell, and with a typical factor


class FiniteElementSolution:
    """An equilibrium with its linearisation.

    k derivatives cost one factorisation and k back-substitutions. If the solution was found with a reference, a few
    derivatives are computed with the factor at the reference instead, to the solver's `derivative_tolerance`.
    """

    def __init__(
        self,
        model: DiscreteBody[Any],
        parameters: FloatArray,
        found: Found,
        work: Work,
        way: Way | None,
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
        # If Newton's method had to take over, the reference is too far away for the derivatives too.
        near = way if way is not None and found.corrected else None
        self.reference = None if near is None else near.reference
        self._rotation = None if near is None else near.rotation
        self.visit()
        outputs = np.array([f.value() for f in model.functionals])
        self.outputs = self._seen(model.equations, self.state, lambda: outputs)
        self.outputs.flags.writeable = False

    def _seen(self, equations: Discretisation, states: FloatArray, outputs: Callable[[], FloatArray]) -> FloatArray:
        """What is observed (…, n) of states (…, U_local) and outputs (…, m)."""
        rows = self._model.rows
        return outputs() if rows is None else rows.of(equations, states, outputs)

    def _apart(self, weights: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Loads (…, U_local) and weights (…, m) of outputs that weights (…, n) of what is observed are."""
        rows = self._model.rows
        if rows is None:
            return np.asarray(weights @ self._gradients), weights
        loads, of_outputs = rows.apart(self._model.equations, weights, len(self._model.functionals))
        return (loads + of_outputs @ self._gradients, of_outputs) if rows.of_outputs else (loads, None)

    def visit(self) -> Discretisation:
        """Return the equations, set to parameters and state of this solution."""
        equations = self._model.equations
        if equations.linearisation_point.solution is not self:
            equations.set_to(self.parameters, self.state, self.stiffer)
            equations.linearisation_point.solution = self
        equations.work = self.work
        return equations

    def linearise(self) -> Discretisation:
        """Return the same with the factor of the stiffness there, unless the current factor is its own.

        Raises
        ------
        SolveError
            If the factor shows that the equilibrium is unstable.
        """
        equations = self.visit()
        if equations.linearisation_point.factorised is not self:
            equations.factorise(self.state)
            equations.linearisation_point.factorised = self
            if self.stability == Stability.SCREENED and equations.symmetric:
                negative = equations.inertia()
                if negative is not None and negative > 0:
                    message = (
                        f"the equilibrium is unstable (its stiffness has {negative} negative eigenvalues), which a "
                        "derivative has shown: the body buckles, or its mesh is too coarse"
                    )
                    raise SolveError(message, work=self.work, stability=Stability.MISSED)
                self.stability = Stability.COUNTED
        return equations

    @cached_property
    def _right_sides(self) -> FloatArray:
        return self.visit().right_sides()

    @cached_property
    def _gradients(self) -> FloatArray:
        """∂ψ/∂u (m, U_local)."""
        self.visit()
        return np.array([f.gradient() for f in self._model.functionals])

    @cached_property
    def _partials(self) -> FloatArray:
        """∂ψ/∂ω (m, d)."""
        self.visit()
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
        model, R = self._model, self._rotation
        factored = model.equations.linearisation_point.factorised is self
        if self.reference is not None and R is not None and not factored and len(right) <= FEW:
            # With the factor at the reference, rotated as for the prediction, unless that is too far away.
            factor, fixed, first = model.reference.at(self.reference), model.equations.fixed, None
            if directions is not None and directions.shape[1] <= FEW:
                # Rotated with the body, the tangents at the reference are what a first back-substitution would give.
                first = turn(directions @ factor.slopes(), R)
                first[:, fixed] = 0
            self.visit()
            free = np.array(right)
            free[:, fixed] = 0
            if tolerance is None:
                tolerance = model.spec.solver.derivative_tolerance
            found = factor.solve_near(R, free, tolerance, ITERATIONS, transpose=transpose, first=first)
            if found is not None:
                found[:, fixed] = right[:, fixed]
                return found
        return self.linearise().back_substitute(right, transpose=transpose)

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return du (U_local,) along a `direction` (d,), or (k, U_local) for k of them; collective."""
        directions = np.atleast_2d(direction)
        equations = self._model.equations
        right = directions[:, equations.scalars] @ self._right_sides
        if equations.fields:
            right += self.visit().field_right_sides(directions)
        du = self.solve(right, directions=directions)
        return du.reshape(*np.shape(direction)[:-1], -1)

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        return self.along(self.state_tangent(direction), direction)

    def along(self, state: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along changes of state (U_local,) and parameters (d,); collective.

        For k of both, (k, m).
        """
        equations = self._model.equations

        def outputs() -> FloatArray:
            return equations.total(state @ self._gradients.T) + direction @ self._partials.T

        return self._seen(equations, state, outputs)

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,), or (k, d) for k of them; collective."""
        weighted, of_outputs = self._apart(weights)
        loads = np.atleast_2d(weighted)
        multipliers = self.solve(loads, transpose=True)
        equations = self._model.equations
        gradients = np.zeros((len(loads), len(self.parameters)))
        gradients[:, equations.scalars] = equations.total(multipliers @ self._right_sides.T)
        if equations.fields:
            equations = self.visit()
            multipliers[:, equations.fixed] = 0
            gradients -= np.array([equations.field_products(multiplier) for multiplier in multipliers])
        found = gradients.reshape(*np.shape(weights)[:-1], -1)
        return found if of_outputs is None else found + of_outputs @ self._partials

    def loads(self, weights: FloatArray) -> FloatArray:
        """Return the derivative (U_local,) of outputs weighted by `weights` (m,) by the state; (k, U_local) of k."""
        return self._apart(weights)[0]

    @cached_property
    def enriched_state(self) -> EnrichedState:
        """The state in elements of one degree higher, by one linear solve from this state; collective."""
        self.visit()
        return self.estimated(self._model.enriched)

    def estimated(self, enriched: Enriched, nearer: tuple[EnrichedState, float] | None = None) -> EnrichedState:
        """Find the state in an enriched space; solves with the stiffness of the body are charged to it too.

        With `nearer`, go on from one until its nonlinearity is below a bound.
        """
        self.visit()
        kept, self.work = self.work, Work()
        try:
            found = enriched.state(self) if nearer is None else enriched.nearer(self, *nearer)
            return found._replace(work=Work.sum_of([found.work, self.work]))
        finally:
            self.work = kept

    @phase("estimating the error of the mesh")
    def mesh_error(self) -> MeshError:
        """Estimate the error of the mesh in outputs and state (`forward.fem.enriched`); collective.

        Raises
        ------
        SolveError
            If the stiffness in the enriched space is singular.
        """
        found, enriched = self.enriched_state, self._model.enriched
        errors = self._seen(enriched.equations, found.state, lambda: enriched.values(self, found)) - self.outputs
        change, size = enriched.down(found.change), relative(found.energy, found.stored)
        far, stored = found.nonlinearity, found.stored
        return MeshError(errors, change, found.energy, size, found.work, nonlinearity=far, stored=stored)

    @phase("calibrating the error of the mesh")
    def saturation(self, spare: float = math.inf, finer: Calibrating[Self] | None = None) -> Saturation:
        """Calibrate estimates of the error of the mesh by a finer mesh (`forward.fem.calibration`); collective.

        Where that is too large, by elements of two degrees more (`factors`); typical values where this
        takes too much memory too. In a short study, either is too large also where it would take too long
        (`forward.fem.mesh_error_cost.allowance`).

        Parameters
        ----------
        spare
            How many solves it may cost (`forward.fem.mesh_error_cost.allowance`).
        finer
            The body on a finer mesh (`forward.fem.calibration.FinerMesh`), where there is one already.

        Raises
        ------
        SolveError
            If a stiffness in an enriched space is singular.
        """
        if self._model.rows is not None:
            return self._by_degrees()
        if self._model.spec.unenriched_with:
            raise not_estimated(self._model.spec.unenriched_with)
        finer, spec = finer or self._model.finer_mesh(spare), self._model.spec
        found, unstable = None, False
        try:
            found = finer.calibrated(self)
        except SolveError as error:
            unstable = error.stability == Stability.REFUSED
        if found is None:
            found = self._by_degrees() if richer(spec) <= allowance(spec, spare) else self._typical(self.mesh_error())
            found = replace(found, unstable=unstable)
        return replace(found, hidden=finer.hidden(self))

    def _typical(self, error: MeshError) -> Saturation:
        """Return what is typical of estimates with elements of this degree."""
        factor = TYPICAL[self._model.spec.body.degree]
        factors = np.where(np.isnan(error.outputs), np.nan, factor)
        doubts = self._doubts(error, factors, OF_TYPICAL)
        return Saturation(factors, factor, factor, measured=False, doubts=doubts)

    def _doubts(self, error: MeshError, factors: FloatArray, share: float) -> FloatArray:
        """How far errors of outputs times `factors` (m,) may be wrong: by a share of them.

        Errors of outputs are of second order by Galerkin's orthogonality, as that of the energy is. What is smaller
        than that, relative to the change from rest, is so since errors of several places cancel: then the share is of
        what the error would be without.
        """
        equations = self.visit()
        equations.set_state(np.zeros_like(self.state))
        equations.linearisation_point.solution = None
        at_rest = np.array([f.value() for f in self._model.functionals])
        moved = self.outputs - self._seen(equations, np.zeros_like(self.state), lambda: at_rest)
        usual = np.nan_to_num(error.relative) ** 2 * np.abs(moved)
        return np.asarray(share * np.maximum(np.abs(factors * error.outputs), usual))

    def _by_degrees(self) -> Saturation:
        """Calibrate estimates by elements of two degrees more; typical values where that is too much or too rough."""
        model, error = self._model, self.mesh_error()
        seen, degree = error.outputs, model.spec.body.degree
        self.visit()
        twice = model.enriched_twice
        if twice is None:
            return self._typical(error)
        once, found = self.enriched_state, self.estimated(twice)
        n = 3 * model.equations.nodes_owned
        own, change = model.enriched.down(once.change)[:n], twice.down(found.change)[:n]
        products = model.equations.total(np.array([own @ own, own @ change]))
        (of_state,) = factors(products[0], products[1], degree)
        (of_energy,) = factors(once.energy, found.energy, degree)
        more = self._seen(twice.equations, found.state, lambda: twice.values(self, found)) - self.outputs
        of_outputs = factors(seen, more, degree)
        doubts = self._doubts(error, of_outputs, OF_DEGREES)
        return Saturation(of_outputs, float(of_state), float(of_energy), doubts=doubts)

    def mesh_indicators(self, weights: FloatArray) -> FloatArray:
        """Return contributions of this rank's cells to the mesh error of outputs, by `weights` (m,); collective.

        They are (n_cells,), or (k, n_cells) for k rows of weights, in DOLFINx's order, and not negative
        (`Enriched.indicators`).
        """
        self.visit()
        found = self._model.enriched.indicators(self, np.atleast_2d(weights))
        return found.reshape(*np.shape(weights)[:-1], -1)


def factors(seen: ArrayLike, more: ArrayLike, degree: int) -> FloatArray:
    """Return what errors seen in elements of one degree more are to be multiplied by, from what two degrees more see.

    Beside edges and corners, where stresses are singular, errors fall with a power of the degree p, C p^−β, and twice
    as fast in p as in the size of cells (I. Babuška, M. Suri, The p and h-p versions of the finite element method, SIAM
    Rev. 36 (1994) 578–632). Values in three degrees tell β and with it the rest. An extrapolation, so bounded: no
    factor is trusted beyond that of β ≈ 1.

    Parameters
    ----------
    seen, more
        Errors (m,) as elements of one and of two degrees more see them.
    degree
        Of the body.
    """
    one, two = np.atleast_1d(np.asarray(seen, dtype=float)), np.atleast_1d(np.asarray(more, dtype=float))
    p = float(degree)
    first = p**-RATES - (p + 1) ** -RATES
    ratios = ((p + 1) ** -RATES - (p + 2) ** -RATES) / first  # falls with β
    found = np.ones(one.shape)
    good = np.isfinite(one) & np.isfinite(two) & (one != 0)
    step = (two[good] - one[good]) / one[good]
    powers = np.interp(step, ratios[::-1], (p**-RATES / first)[::-1])
    found[good] = np.clip(np.where(step > 0, powers, 1 + step), LEAST, MOST)
    found[np.isnan(one)] = math.nan
    return found
