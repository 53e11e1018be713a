"""Finite-element model of a hyperelastic body: equilibria, tangents and adjoints.

With the equations F(u, ω) = 0 of `forward.fem.equations`, K = ∂F/∂u: tangent K du = −∂F/∂ω dω; adjoint Kᵀλ = ∂ψ/∂u,
dψ/dω = −λᵀ∂F/∂ω + ∂ψ/∂ω.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from itertools import chain, islice, repeat
from typing import Any

import numpy as np

from forward.fem.affordable import allowance, richer
from forward.fem.cost import MOST_BYTES, Linear, Way, estimate, together
from forward.fem.enriched import Enriched, EnrichedState
from forward.fem.equations import Discretisation
from forward.fem.reference import ReferenceFactor
from forward.fem.saturation import factors, typical
from forward.fem.space import BodySpace
from forward.fem.together import by_reference, refused, task
from forward.hyperelastic import Hyperelastic
from forward.materials.admissible import Admission
from forward.model import (
    FloatArray,
    Guess,
    InadmissibleError,
    MeshError,
    OneByOne,
    ReferenceSolution,
    Saturation,
    Solution,
    SolveError,
    Stability,
    Work,
)
from forward.observables.observable import Functional
from forward.registry import named
from forward.solvers.anderson import block_galerkin
from forward.solvers.equilibrium import solve
from forward.solvers.rotations import turn
from forward.solvers.stability import NOT_SCREENED, Screened, draw
from forward.solvers.steps import Corrector, Steps, Task, finish_all
from forward.solvers.system import Found, Residual

FEW = 4  # number of derivatives up to which products with the stiffness are cheaper than a factorisation
AT_REST = 1e-12  # norm of displacements over the extent of a body that nothing has moved
UNSEEN = 0.02  # of the depth, by which a tool may enter a body that nothing has moved
STIFFER, RAISES = 4.0, 3  # factor on the stiffness of tools that the body enters too far, and how often it is raised
ITERATIONS = 20  # for these derivatives, before the stiffness is factorised after all


class HyperelasticModel(OneByOne):
    """A hyperelastic body as a `ForwardModel`: one mesh, one set of forms and one solver for every realisation.

    Parameters
    ----------
    spec
        The body.
    comm
        Communicator of the ranks that share it.
    parameters
        Paths of the random parameters, in the order of the parameter vectors.

    Raises
    ------
    ValueError
        For a path that is not a number of the model, or an output at a point outside the body.
    """

    def __init__(self, spec: Hyperelastic, comm: Any, parameters: tuple[str, ...]) -> None:
        scalars = spec.scalars
        coefficients = set(spec.coefficients)
        for path in parameters:
            if path not in scalars and path not in coefficients:
                known = [*scalars, *(f"fields.{field.label}.0" for field in spec.fields)]
                message = f"'{path}' is not a number of the model, expected one of: {', '.join(known)}"
                raise ValueError(message)
        self.spec = spec
        self.parameters = parameters
        self._admission = Admission(spec, parameters)
        self.outputs = tuple(output.name for output in spec.outputs)
        self._extent = max(high - low for low, high in spec.body.bounds)
        self.equations = Discretisation(spec, comm, parameters)
        self.space = BodySpace(self.equations)
        self.differentiable = True
        self.functionals = [output.functional(self.equations) for output in spec.outputs]
        self._enrichments = _Enrichments(spec, self.equations, self.functionals)

    @cached_property
    def reference(self) -> ReferenceFactor:
        """The factor at the last reference given."""
        return ReferenceFactor(self.equations)

    def with_own_reference(self) -> HyperelasticModel:
        """Return the same model with a reference factor of its own, which shares everything else with this one."""
        other = copy.copy(self)
        vars(other).pop("reference", None)
        return other

    @property
    def enriched(self) -> Enriched:
        """The body in elements of one degree higher, to estimate the error of its mesh; collective when first used."""
        return self._enrichments.once

    @property
    def enriched_twice(self) -> Enriched | None:
        """The same in elements of two degrees more, which calibrate that.

        None where they take too much memory, or are solved too roughly.
        """
        return self._enrichments.twice

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> FiniteElementSolution:
        """Find the equilibrium at `parameters` (d,); collective.

        The state of the guess is corrected with the factor at its reference, which is computed when the reference is
        first given and kept until another is. Iterations are corrections with that factor (Newton steps without a
        reference, or with ``solver = "newton"``); if their number is limited, derivatives are those of the equations
        linearised at the state reached.

        Raises
        ------
        SolveError
            With the load fraction where the solver stopped, the reason, and the history of its iterations.
        """
        equations = self.equations
        equations.latest.begin()
        self.require_admissible(parameters)
        guess = guess or Guess()
        way = self.way(parameters, guess)
        equations.work = Work()
        equations.set_parameters(parameters)
        with equations.time_limit(self.spec.solver.solve_seconds):
            found = solve(equations, self.spec.solver, np.zeros(equations.size), guess.state, way, guess.iterations)
            stiffer = 1.0
            if found.converged and equations.contact:
                found, stiffer = self._kept_out(found, parameters)
        solution = self.solution(parameters, found, equations.work, way, stiffer)
        if equations.symmetric and equations.latest.factorised_at is found.state:  # to count its eigenvalues
            equations.latest.factorised = solution
        return solution

    def way(self, parameters: FloatArray, guess: Guess) -> _Way | None:
        """Return the path from the reference of a guess, whose factor is computed if it is another's; None without."""
        if self.spec.solver.kind == "newton" or self.equations.linear == Linear.MULTIGRID:
            return None
        if guess.state is None or guess.reference is None:
            return None
        self.reference.prepare(guess.reference)
        screen = not self.spec.solver.accept_unstable and self.reference.prepare_screen()
        return _Way(self, guess.reference, parameters, screen=screen)

    def solution(
        self, parameters: FloatArray, found: Found, work: Work, way: _Way | None, stiffer: float = 1.0
    ) -> FiniteElementSolution:
        """Return what was found at `parameters` (d,) as a solution."""
        # If Newton's method had to take over, the reference is too far away for the derivatives too.
        return FiniteElementSolution(self, parameters, found, work, way if found.corrected else None, stiffer)

    @cached_property
    def together(self) -> int:
        """How many points `solve_many` corrects together; 1 where each needs the equations for itself."""
        solver = self.spec.solver
        alone = self.equations.contact or solver.kind == "newton" or solver.solve_seconds is not None
        alone = alone or self.equations.linear == Linear.MULTIGRID
        return 1 if alone else together(self.equations.layout.size)

    def solve_many(
        self, points: FloatArray, guesses: Iterable[Guess | None] | None = None
    ) -> Iterator[Solution | SolveError]:
        """Find the equilibria at points (n, d); some of those from one reference are found `together`; collective.

        Which are corrected together depends only on the points and their guesses.
        """
        pairs = zip(points, guesses or repeat(None), strict=False)
        for predicted, group in by_reference(pairs):
            some = list(islice(group, 2 if predicted and self.together > 1 else 0))
            if len(some) == 2:
                yield from self._solve_together(chain(some, group))
            else:
                for point, guess in chain(some, group):
                    yield from super().solve_many(point[None], [guess])

    def _solve_together(self, starts: Iterable[tuple[FloatArray, Guess]]) -> Iterator[Solution | SolveError]:
        equations, zero = self.equations, np.zeros(self.equations.size)
        begun: deque[tuple[FloatArray, _Way | None, Work]] = deque()

        def tasks() -> Iterator[Task[Found]]:
            for point, guess in starts:
                way, work = None, Work()
                try:
                    self.require_admissible(point)
                except InadmissibleError as error:
                    one = refused(error)
                else:
                    way = self.way(point, guess)
                    assert way is not None
                    one = task(equations, self.spec.solver, zero, way, guess, work)
                begun.append((point, way, work))
                yield one

        def solve(right: FloatArray) -> FloatArray:
            way = begun[0][1]
            if way is not None and self.reference.prepare(way.reference):  # others may have had theirs meanwhile
                self.reference.prepare_screen()
            return self.reference.solve_uncounted(right)

        for found in finish_all(tasks(), solve, self.together):
            equations.latest.begin()  # the last factor may be that of any of them
            point, way, work = begun.popleft()
            yield found if isinstance(found, SolveError) else self.solution(point, found, work, way)

    def require_admissible(self, parameters: FloatArray) -> None:
        """Refuse parameters (d,) for which there is no model."""
        self._admission.require(parameters)

    def _kept_out(self, found: Found, parameters: FloatArray) -> tuple[Found, float]:
        """Raise the stiffness of the tools until the body enters none too far; return its factor too.

        Steps of a factor, so that most samples of a study have the same stiffness and all their derivatives are exact.
        """
        equations, stiffer = self.equations, 1.0
        self.refuse_sharp(found)
        while said := self.entered(found):
            if stiffer >= STIFFER**RAISES:
                raise SolveError(self.too_far(said, stiffer), work=equations.work)
            stiffer *= STIFFER
            equations.set_parameters(parameters, stiffer)
            found = solve(equations, self.spec.solver, np.zeros(equations.size), found.state)
        return found, stiffer

    def too_far(self, said: str, stiffer: float) -> str:
        """Say why there is no answer where even stiffer tools are entered too far."""
        return (
            f"{said}, even with tools {stiffer:g} times as stiff as the depth and the constants as stated ask for: "
            "pressures are far above these; state constants, or a depth, near those of the samples"
        )

    def entered(self, found: Found) -> str:
        """Say how far the body enters a tool where that is more than is aimed at; empty where it is not."""
        equations = self.equations
        equations.set_state(found.state)
        for label, penetration in equations.penetrations().items():
            depth, aim = equations.number(f"loads.{label}.depth"), self._aims[label]
            if depth > 0 and penetration > aim * depth:
                share = penetration / depth
                return f"the body enters the tool '{label}' by {share:.2g} of its depth, where {aim:g} is aimed at"
        return ""

    @cached_property
    def _aims(self) -> dict[str, float]:
        """Penetrations that are aimed at, relative to the depth, by the labels of the tools."""
        return {load.label: load.penetration for load in self.spec.loads if load.contact}  # type: ignore[attr-defined]

    def refuse_sharp(self, found: Found) -> None:
        """Refuse a body that nothing has moved though a tool is inside it, between the points that are looked at."""
        equations = self.equations
        if equations.norm(found.state) > AT_REST * self._extent:
            return
        for load in (load for load in self.spec.loads if load.contact):
            numbers = {name: equations.number(f"loads.{load.label}.{name}") for name in load.scalars}
            if load.entered(self.spec.body, numbers) > UNSEEN * numbers["depth"]:  # type: ignore[attr-defined]
                message = (
                    f"the tool '{load.label}' enters the body between the points at which contact is looked for: it is "
                    "too sharp, or its depth too small, for the mesh; refine the mesh there"
                )
                raise SolveError(message, work=equations.work)

    def visit(self, solution: FiniteElementSolution) -> Discretisation:
        """Set parameters and state to those of a solution, unless they are already."""
        equations = self.equations
        if equations.latest.solution is not solution:
            equations.set_parameters(solution.parameters, solution.stiffer)
            equations.at_load(1.0)
            equations.set_state(solution.state)
            equations.latest.solution = solution
        equations.work = solution.work
        return equations

    def linearise(self, solution: FiniteElementSolution) -> Discretisation:
        """Factorise the stiffness at a solution, unless the current factor is its own."""
        equations = self.visit(solution)
        if equations.latest.factorised is not solution:
            equations.factorise(solution.state)
            equations.latest.factorised = solution
            if solution.stability == Stability.SCREENED and equations.symmetric:
                negative = equations.inertia()
                if negative is not None and negative > 0:
                    message = (
                        f"the equilibrium is unstable (its stiffness has {negative} negative eigenvalues), which a "
                        "derivative has shown: the body buckles, or its mesh is too coarse"
                    )
                    raise SolveError(message, work=solution.work, stability=Stability.MISSED)
                solution.stability = Stability.COUNTED
        return equations

    def has_factor(self, solution: FiniteElementSolution) -> bool:
        """Whether the current factor is that of a solution."""
        return self.equations.latest.factorised is solution

    def take_reference(self, reference: ReferenceSolution) -> ReferenceFactor:
        """Return the factor at a reference; this may change parameters and state."""
        self.reference.prepare(reference)
        return self.reference


class _Enrichments:
    """A body in elements of higher degrees, made when they are first asked for."""

    def __init__(self, spec: Hyperelastic, equations: Discretisation, functionals: list[Functional]) -> None:
        self._spec, self._equations, self._functionals = spec, equations, functionals

    @cached_property
    def once(self) -> Enriched:
        return Enriched(self._equations, self._spec.enriched(), self._functionals)

    @cached_property
    def twice(self) -> Enriched | None:
        spec = self._spec.enriched().enriched()
        cost = estimate(self._spec.body, spec.body, mixed=spec.mixed, symmetric=spec.symmetric)
        # What steps with pressures leave is too much of what two degrees say more than one: typical factors are closer.
        rough = spec.mixed and cost.way == Way.SMOOTHING
        return Enriched(self._equations, spec, self._functionals) if cost.bytes <= MOST_BYTES and not rough else None


class _Way:
    """The straight line in parameters from a reference.

    Attributes
    ----------
    reference
        Its start.
    state
        Of the reference.
    rotation
        Rotations of the nodes from the reference to the last prediction, (3, 3, n_owned).
    draw
        A number in [0, 1) that depends on the requested parameters.
    """

    def __init__(
        self, model: HyperelasticModel, reference: ReferenceSolution, parameters: FloatArray, *, screen: bool
    ) -> None:
        self._screen, self._fraction = screen, 1.0
        self.draw = draw(parameters)
        self._equations, self._factor = model.equations, model.reference
        self._from, self._to = reference.parameters, parameters
        self.reference = reference
        self.state = reference.state
        self.rotation: FloatArray | None = None

    def corrector(self, u: FloatArray) -> Corrector:
        self.rotation = self._factor.rotation(u)
        return self._factor.corrector(self.rotation)

    def solve(self, right: FloatArray) -> FloatArray:
        return self._factor.solve(right)

    def screen(self, u: FloatArray, residual: Residual) -> Steps[Screened]:
        if not self._screen or self.rotation is None:
            return NOT_SCREENED
        return (yield from self._factor.screen(u, residual.vector, self.rotation))

    def definite(self, u: FloatArray, residual: Residual) -> Steps[bool]:
        if not self._screen or self.rotation is None:
            return False
        return (yield from self._factor.definite(u, residual.vector, self.rotation))

    def at(self, fraction: float) -> None:
        self._fraction = fraction
        self._equations.set_parameters(self._to if fraction == 1 else self._from + fraction * (self._to - self._from))
        self._equations.at_load(1.0)

    def resume(self, work: Work, solved: int) -> None:
        """Set the equations to where they were on this path, and count their work and back-substitutions there."""
        work.back_substitutions += solved
        self._equations.work = work
        self.at(self._fraction)


class FiniteElementSolution:
    """An equilibrium with its linearisation.

    k derivatives cost one factorisation and k back-substitutions. If the solution was found with a reference, a few
    derivatives are computed with the factor at the reference instead, to the solver's `derivative_tolerance`.
    """

    def __init__(
        self,
        model: HyperelasticModel,
        parameters: FloatArray,
        found: Found,
        work: Work,
        way: _Way | None,
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
