"""Error of the mesh in a solution, from the same body on the same mesh in elements of one degree higher.

With u_h the solution on V_h, V⁺ ⊃ V_h the enriched space and F⁺, K⁺ the equations there, one linear solve
K⁺(u_h) e = −F⁺(u_h) estimates the error of the whole state, and ψ⁺(u_h + e) − ψ(u_h) that of an output ψ. To first
order this is the dual-weighted residual −F⁺(u_h; z⁺) with the adjoint z⁺ ∈ V⁺ of every output (R. Becker, R. Rannacher,
An optimal control approach to a posteriori error estimation, Acta Numerica 10 (2001) 1–102), without one adjoint each.
Where F⁺(u_h + e) is not small, more steps of Newton's method follow: outputs of second order need them. Prescribed
unknowns keep their values on V_h. V⁺ has an error too: the part that e misses is called saturation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from forward.fem.dolfinx import spaces, version
from forward.fem.dolfinx.linear import Preconditioner
from forward.fem.dolfinx.meshes import owned_cells
from forward.fem.dolfinx.spaces import Transfer
from forward.fem.equations import Discretisation
from forward.fem.mesh_error_cost import Way, own_estimate
from forward.fem.reference import ReferenceFactor
from forward.loaded import LoadedBody
from forward.model import FloatArray, ReferenceSolution, Work
from forward.observables.observable import Functional
from forward.solvers.multigrid import minimised, smoothed

NEGLIGIBLE = 1e-3  # error relative to the state below which nothing bends
NEAR = 0.1  # nonlinearity below which the stiffness at the solution will do for further steps
BARELY = 0.3  # the same with pressures and without a factor; up to it, a large body without one needs no further steps
MORE = 6  # steps at most: bodies that lock so that they bend half as far as richer ones take four
AFFORDED = 40_000  # unknowns up to which steps have a factor of their own, where the first one does without
ROUGH = 0.03  # tolerance of solves with the stiffness of the body, relative to the solution
STEPS = 100  # of conjugate gradients or residuals, at most
ORTHOGONAL = 1e-6  # relative size of forces that are neglected on the body
LITTLE = 0.01  # the same before the steps, after which these forces are met again
ITERATIONS = 30  # with the factor at a reference in the enriched space, at most


@dataclass(frozen=True)
class Rule:
    """How closely the enriched equations are solved, and when they are solved on.

    Tolerances are relative to the solution, and mean nothing to a factor of their own. Of steps without a factor they
    are the part of the energy of e that may be missing or, with pressures, which leave no energy to go by, of the
    forces.

    Attributes
    ----------
    first, further, other
        Tolerance of the first solve, of those of further steps with the same stiffness, which change a tenth, and of
        all others: adjoints, and steps with the stiffness at another state.
    bent
        Nonlinearity above which further steps are made.
    near
        That below which these need no other stiffness.
    """

    first: float
    further: float
    other: float
    bent: float
    near: float


# With pressures, whose part of the work has the other sign, a second step follows always. With the factor of a
# reference one correction is enough for that, and steps without a factor have left part of the forces to it.
RULES = {  # by whether it is done by steps without a factor, and whether there are pressures
    (False, False): Rule(first=5e-3, further=0.1, other=5e-3, bent=0.05, near=NEAR),
    (False, True): Rule(first=0.05, further=1.0, other=5e-3, bent=0.0, near=NEAR),
    (True, False): Rule(first=0.01, further=0.1, other=0.01, bent=0.05, near=NEAR),
    (True, True): Rule(first=0.05, further=0.1, other=0.05, bent=0.0, near=BARELY),
}


class EnrichedState(NamedTuple):
    """A state of the enriched space, by one linear solve from a solution of the body, or a few.

    Attributes
    ----------
    state, change
        u_h + e and e (U⁺_local,).
    energy
        Half the square of the energy norm of e (J).
    stored
        Energy (J) stored at u_h.
    nonlinearity
        |F⁺(u_h + e)·e / F⁺(u_h)·e| after the last step: 0 for a linear problem; NaN where u_h + e turns cells inside
        out, ∞ where steps do not help.
    work
        Its cost.
    before, step
        The last state (U⁺_local,) before it, and the step from there to `state`.
    linearised
        The state (U⁺_local,) with whose stiffness that step was found.
    """

    state: FloatArray
    change: FloatArray
    energy: float
    stored: float
    nonlinearity: float
    work: Work
    before: FloatArray
    step: FloatArray
    linearised: FloatArray

    @property
    def straight(self) -> bool:
        """Whether one linear step led there."""
        return self.step is self.change


def relative(energy: float, stored: float) -> float:
    """Return the size of an error with an energy (J) relative to a state with a stored energy (J); NaN if that is 0."""
    return float(np.sqrt(max(energy, 0.0) / stored)) if stored > 0 else np.nan


def nonlinearity(energy: float, stored: float, after: float) -> float:
    """Return how far a linear step is from solving the equations: 0 if they are linear, 1 if it is worth nothing.

    The work of the imbalance after the step along it, over that before; ∞ where the stiffness is not positive along it.

    `energy` and `stored` are those of `EnrichedState`, `after` is the work (J) of the imbalance after the step.
    """
    if abs(energy) <= NEGLIGIBLE**2 * stored:
        return 0.0
    return abs(after) / (2 * energy) if energy > 0 else np.inf


class Linearised(Protocol):
    """What is asked of a solution of the body (`forward.fem.solution`)."""

    parameters: FloatArray
    state: FloatArray
    stiffer: float
    reference: ReferenceSolution | None

    def solve(self, right: FloatArray, *, transpose: bool = False, tolerance: float | None = None) -> FloatArray:
        """Solve with the stiffness there, or its transpose, for rows (k, U_local)."""


class Enriched:
    """The equations of a body in an enriched space, and what they say of the error of its solutions and of its outputs.

    Made from those of the body, its specification in elements of a higher degree, and its outputs. Where a factor of
    their own is too dear, the factor at a reference serves many solutions, or a few steps of a Krylov method without a
    factor leave to the stiffness of the body what a coarser space can solve for.

    Attributes
    ----------
    equations
        The equations in the enriched space.
    way
        How they are solved; depends only on sizes, form and degree.
    """

    def __init__(self, equations: Discretisation, spec: LoadedBody, functionals: Sequence[Functional]) -> None:
        self._coarse = equations
        self.equations = Discretisation(spec, equations.comm, equations.parameters, equations)
        pairs = [(equations.unknowns.displacement, self.equations.unknowns.displacement)]
        if equations.unknowns.pressure is not None:
            pairs.append((equations.unknowns.pressure, self.equations.unknowns.pressure))
        self._up = [Transfer(coarse, fine) for coarse, fine in pairs]
        self._down = [Transfer(fine, coarse) for coarse, fine in pairs]
        cost = own_estimate(equations.spec, spec)
        self.way, self._alone = cost.way, cost.alone
        self._blocks: tuple[ReferenceSolution, Preconditioner | None] | None = None
        self._of_forces = [output.of_held for output in spec.outputs]
        self._functionals = [
            output.enriched(functional, self.equations, self.up) if output.estimable else None
            for output, functional in zip(spec.outputs, functionals, strict=True)
        ]
        self._stored = self.equations.scalar(self.equations.stored_energy * self.equations.dx)

    @property
    def _rule(self) -> Rule:
        return RULES[self.way == Way.SMOOTHING, self.equations.spec.mixed]

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
        # What steps are preconditioned by is made at the reference of a solution, for all that have it.
        at = solution.reference or ReferenceSolution(solution.parameters, solution.state)
        if self._blocks is None or not self._blocks[0].same(at):
            kept, self.equations.work = self.equations.work, Work()  # counted for no solution, as a reference's factor
            self.equations.set_to(at.parameters, self.up(at.state))
            self._blocks = (at, self.equations.preconditioner())
            self.equations.work = kept
        _, inverse = self._blocks
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

    @cached_property
    def _reference(self) -> ReferenceFactor:
        return ReferenceFactor(self.equations)

    def state(self, solution: Linearised) -> EnrichedState:
        """Find u_h + e from a solution of the body; collective.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """
        equations = self.equations
        equations.work = Work()
        forces = -self.imbalance(solution)
        (change,) = self.solve(solution, forces[None], self._rule.first)
        start = self.up(solution.state)
        # In the mixed form the energy has a saddle point, and the pressures count with the opposite sign.
        energy = 0.5 * equations.curvature(change, forces)
        equations.set_state(start)
        stored = float(self._stored())
        left = self.imbalance(solution, start + change)
        far = nonlinearity(energy, stored, equations.curvature(change, left))
        found = EnrichedState(start + change, change, energy, stored, far, Work(), start, change, start)
        return self.nearer(solution, found, self._rule.bent, left)

    def nearer(
        self, solution: Linearised, found: EnrichedState, bent: float, left: FloatArray | None = None
    ) -> EnrichedState:
        """Go on from a state that was found until its nonlinearity is below `bent`; collective.

        By steps of Newton's method: outputs of second order need u_h + e to be in equilibrium. Where the imbalance that
        is `left` (U⁺_local,) has just been found, a step with an old stiffness is the only one.

        Raises
        ------
        SolveError
            If the stiffness is singular.
        """
        equations, rule, once = self.equations, self._rule, left is not None
        if left is None:
            equations.work = Work()
            left = self.imbalance(solution, found.state)
        start, far = self.up(solution.state), found.nonlinearity
        for _ in range(MORE):
            if not bent < far < np.inf:
                break
            near = far < rule.near
            if not near and self.way == Way.SMOOTHING and equations.spec.unknowns > AFFORDED:
                far = far if far < BARELY else np.inf
                break
            at, close = (None, rule.further) if near else (found.state, rule.other)
            (step,) = self.solve(solution, -left[None], close, at=at)
            change = found.change + step
            before, linearised = found.state, start if near else found.state
            found = found._replace(state=start + change, change=change, before=before, step=step, linearised=linearised)
            left = self.imbalance(solution, found.state)
            closer = nonlinearity(found.energy, found.stored, equations.curvature(change, left))
            settled = closer < NEAR and near  # where pressures and displacements cancel, work says little
            far = closer if closer < far or settled else np.inf
            if near and once:
                break
        return found._replace(nonlinearity=far, work=equations.work)

    def values(self, solution: Linearised, found: EnrichedState) -> FloatArray:
        """Return the outputs (m,) at a state found from a solution; NaN where not estimated.

        Outputs of the balance of forces are linearised along the last step, as the equations that it solves: at the
        state itself, what is left of second order would count as a force.
        """
        forces = {i: f for i, f in enumerate(self._functionals) if f is not None and self._of_forces[i]}
        equations = self.visit(solution, found.linearised)
        slopes = {i: equations.dot(f.gradient(), found.step) for i, f in forces.items()}
        self.visit(solution, found.before)
        linear = {i: f.value() + slopes[i] for i, f in forces.items()}
        self.visit(solution, found.state)
        known = [np.nan if f is None or i in linear else f.value() for i, f in enumerate(self._functionals)]
        return np.array([linear.get(i, value) for i, value in enumerate(known)])

    def adjoints(self, solution: Linearised, weights: FloatArray) -> FloatArray:
        """Return z⁺ (k, U⁺_local) with K⁺ᵀz⁺ = ∂ψ/∂u of outputs weighted by `weights` (k, m); collective.

        Raises
        ------
        ValueError
            If the error of a weighted output is not estimated.
        """
        known = [i for i, f in enumerate(self._functionals) if f is not None]
        if np.delete(weights, known, axis=1).any():
            raise ValueError("the mesh error of a weighted output is not estimated")
        self.visit(solution)
        gradients = np.array([f.gradient() for f in self._functionals if f is not None])
        loads = weights[:, known] @ gradients
        loads[:, self.equations.fixed] = 0
        return self.solve(solution, loads, self._rule.other, transpose=True)

    def indicators(self, solution: Linearised, weights: FloatArray) -> FloatArray:
        """Return contributions (k, n_cells) of this rank's cells to the error of outputs weighted by (k, m); ≥ 0.

        The size of the dual-weighted residual F⁺(u_h; φ_i (z⁺ − I_h z⁺)) of each vertex i with its hat function φ_i is
        shared equally by the cells that meet there: T. Richter, T. Wick, Variational localizations of the dual weighted
        residual estimator, J. Comput. Appl. Math. 279 (2015) 192–208. (Split by cell without jumps of stresses, terms
        that cancel between neighbours would count.) Cells are in DOLFINx's order.
        """
        equations, space = self.equations, spaces.scalar_space(self.equations.mesh, 1)
        corners = version.nodes_of_cells(space, len(spaces.cell_element(space).points))[: owned_cells(equations.mesh)]
        carrier = spaces.function(space)
        carrier.x.array[:] = np.bincount(corners.ravel(), minlength=len(carrier.x.array))
        meeting = spaces.sum_ghosts(carrier)  # cells at this rank's vertices
        found = []
        for z in self.adjoints(solution, weights):
            self.visit(solution)
            sizes = np.abs(equations.imbalance_by_vertices(z - self.up(self.down(z))))
            spaces.give(carrier, sizes / meeting)
            found.append(carrier.x.array[corners].sum(axis=1))
        return np.array(found)
