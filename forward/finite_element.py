"""Finite-element model of a hyperelastic body: forms, equilibrium, tangents and adjoints.

F(u, ω) = 0 with F = ∂Π/∂u (plus follower pressures) on the free unknowns and u = target on the prescribed ones.
K = ∂F/∂u. Tangent: K du = −∂F/∂ω dω. Adjoint: Kᵀλ = ∂ψ/∂u, dψ/dω = −λᵀ∂F/∂ω + ∂ψ/∂ω.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl

from forward import fenicsx, kinematics
from forward.functionals import functional
from forward.geometry import AXES
from forward.hyperelastic import Hyperelastic
from forward.inclusions import stiffness_factor
from forward.layout import Layout
from forward.loads import LOAD_SIZES, Gravity, Pressure, Traction
from forward.materials import MATERIALS
from forward.model import FloatArray, SolveError, Work
from forward.newton import Residual, solve

STRETCH = 1e-6  # of the body, to see how stiff it is
_OPS = SimpleNamespace(ln=ufl.ln, exp=ufl.exp, sqrt=ufl.sqrt, tanh=ufl.tanh)


class Discretisation:
    """The discrete equations of a body, set to one state and one parameter vector at a time.

    It is the `System` that Newton's method works on. Meshes, compiled forms and solver objects are made once; forms
    that only derivatives need are compiled when they are first used.
    """

    def __init__(self, spec: Hyperelastic, comm: Any, parameters: tuple[str, ...]) -> None:
        self.spec = spec
        self.comm = comm
        self.parameters = parameters
        self.work = Work()
        self.mesh = fenicsx.box_mesh(comm, spec.body)
        self.space = fenicsx.vector_space(self.mesh, spec.body.degree)
        self.layout = Layout(self.space, comm)
        self.nodes_owned = fenicsx.owned_nodes(self.space)
        self.facets = fenicsx.box_facets(self.mesh, spec.body)
        self.dx = ufl.dx(domain=self.mesh, metadata={"quadrature_degree": spec.body.quadrature})
        self._ds, self._tags = fenicsx.facet_measure(self.mesh, self.facets, spec.body.quadrature)

        self._values = {path: scalar.value for path, scalar in spec.scalars.items()}
        self._constants = {
            path: fenicsx.constant(self.mesh, value)
            for path, value in self._values.items()
            if not path.startswith("displacements.")
        }
        self._variables = {path: ufl.variable(constant) for path, constant in self._constants.items()}
        self._directions = {path: fenicsx.constant(self.mesh, 0.0) for path in parameters if path in self._constants}
        self._load = fenicsx.constant(self.mesh, 1.0)

        self.u = fenicsx.function(self.space)
        self._along = fenicsx.function(self.space)
        self.test = ufl.TestFunction(self.space)
        self.F = kinematics.deformation_gradient(ufl.grad(self.u), ufl.Identity(3))
        self.J = ufl.det(self.F)
        self.energy_density = self.energy_of(self.F)
        self._potentials, self._followers = self._loads()
        self._symmetric = not self._followers
        imbalance = self._imbalance_form()
        self._residual = self.vector(imbalance)
        self._prescribe()
        self._solver = fenicsx.DirectSolver(
            ufl.derivative(imbalance, self.u, ufl.TrialFunction(self.space)),
            self._constraints,
            comm,
            symmetric=self._symmetric,
        )
        self._factorised_at = np.zeros(3 * self.nodes_owned)
        self._jacobians = fenicsx.compile_expression(
            self.J, fenicsx.quadrature_points(self.space, spec.body.quadrature), comm
        )
        self._compiled: dict[tuple[int, str], Any] = {}
        self._external = 0.0
        self._rounding = 0.0
        self._stretch = STRETCH * fenicsx.node_coordinates(self.space).ravel()

    # --- forms -------------------------------------------------------------------------------------------------------

    def energy_of(self, F: Any) -> Any:
        """Strain energy density as a UFL expression of a deformation gradient."""
        energy = MATERIALS[getattr(self.spec.material, "kind")]  # noqa: B009 - every material has a kind
        return self.stiffness_factor * energy(_OPS, *kinematics.invariants(ufl, F), **self._numbers("material"))

    @cached_property
    def stiffness_factor(self) -> Any:
        """What the inclusions multiply every modulus by, as a UFL expression of the place; 1 without inclusions."""
        factor = 1  # UFL drops it from products: a body without inclusions keeps its forms
        X = ufl.SpatialCoordinate(self.mesh)
        for inclusion in self.spec.inclusions:
            numbers = self._numbers(f"inclusions.{inclusion.label}")
            factor *= stiffness_factor(_OPS, X, inclusion.kind, **numbers)
        return factor

    def _numbers(self, block: str) -> dict[str, Any]:
        """Return the numbers of a block of the model, by their names, as variables of forms."""
        paths = (path.rpartition(".") for path in self._variables)
        return {name: self._variables[f"{block}.{name}"] for place, _, name in paths if place == block}

    def surface(self, boundary: str) -> Any:
        """Measure of a named boundary."""
        return self._ds(self._tags[boundary])

    def vector(self, form: Any) -> fenicsx.VectorAssembler:
        """Compile a linear form."""
        return fenicsx.VectorAssembler(form, self.comm)

    def _loads(self) -> tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]]:
        """Potentials (integrand, measure) of energy and dead loads; virtual work of loads that follow the surface."""
        potentials = [(self.energy_density, self.dx)]
        followers = []
        for load in self.spec.loads:
            size = self._load * self._variables[f"loads.{load.label}.{LOAD_SIZES[load.kind]}"]
            match load:
                case Gravity():
                    pull = fenicsx.constant(self.mesh, load.acceleration * np.array(load.unit))
                    potentials.append((-size * ufl.dot(pull, self.u), self.dx))
                case Traction():
                    direction = fenicsx.constant(self.mesh, load.unit)
                    potentials.append((-size * ufl.dot(direction, self.u), self.surface(load.on)))
                case Pressure():
                    # Nanson's formula: the deformed area element is J F⁻ᵀ N dS.
                    normal = ufl.dot(self.J * ufl.inv(self.F).T, ufl.FacetNormal(self.mesh))
                    followers.append((size * ufl.dot(normal, self.test), self.surface(load.on)))
        return potentials, followers

    def _imbalance_form(self, change: Callable[[Any], Any | None] = lambda integrand: integrand) -> Any | None:
        """Virtual work of all forces, with each integrand replaced by its `change`; nothing if all vanish."""
        form = None
        for integrand, measure in self._potentials:
            changed = change(integrand)
            if changed is not None:
                term = ufl.derivative(changed * measure, self.u, self.test)
                form = term if form is None else form + term
        for integrand, measure in self._followers:
            changed = change(integrand)
            if changed is not None:
                term = changed * measure
                form = term if form is None else form + term
        return form

    def along_parameters(self, integrand: Any) -> Any | None:
        """Σ_i (∂ integrand/∂ω_i) dω_i with the direction dω as constants; nothing if it depends on no parameter."""
        present = set(ufl.algorithms.analysis.extract_constants(integrand * self.dx))
        terms = [
            direction * ufl.diff(integrand, self._variables[path])
            for path, direction in self._directions.items()
            if self._constants[path] in present
        ]
        return sum(terms[1:], terms[0]) if terms else None

    def compiled(self, owner: object, what: str, make: Callable[[], Any]) -> Any:
        """Compile a form of an output when it is first needed."""
        key = (id(owner), what)
        if key not in self._compiled:
            self._compiled[key] = make()
        return self._compiled[key]

    @cached_property
    def _parameter_force(self) -> fenicsx.VectorAssembler | None:
        form = self._imbalance_form(self.along_parameters)
        return None if form is None else self.vector(form)

    @cached_property
    def _stiffness_action(self) -> fenicsx.VectorAssembler:
        return self.vector(ufl.derivative(self._imbalance_form(), self.u, self._along))

    @cached_property
    def _transposed_action(self) -> fenicsx.VectorAssembler:
        if self._symmetric:
            return self._stiffness_action
        return self.vector(ufl.derivative(ufl.action(self._imbalance_form(), self._along), self.u, self.test))

    # --- state and parameters ----------------------------------------------------------------------------------------

    def _prescribe(self) -> None:
        """Collect the prescribed unknowns, the path that moves each (if any), and the marks for assembly."""
        moved: dict[tuple[int, int], str] = {}
        self._constraints = []
        for displacement in self.spec.displacements:
            nodes = fenicsx.boundary_nodes(self.space, self.facets[displacement.on])
            for axis in displacement.components:
                a = AXES.index(axis)
                self._constraints.append(fenicsx.constraint(self.space, a, nodes))
                moved |= {(int(n), a): f"displacements.{displacement.label}.{axis}" for n in nodes}
        for boundary in self.spec.clamp:
            nodes = fenicsx.boundary_nodes(self.space, self.facets[boundary])
            for a in range(3):
                self._constraints.append(fenicsx.constraint(self.space, a, nodes))
                moved |= {(int(n), a): "" for n in nodes}
        owned = sorted((3 * n + a, path) for (n, a), path in moved.items() if n < self.nodes_owned)
        self._fixed = np.array([unknown for unknown, _ in owned], dtype=np.int64)
        paths = [path for _, path in owned]
        self._movers = {
            path: np.array([p == path for p in paths], dtype=float)
            for path in self._values
            if path.startswith("displacements.")
        }
        self._targets = np.zeros(len(self._fixed))
        self._moves = False

    def set_parameters(self, parameters: FloatArray) -> None:
        """Give the parameters (d,) their values."""
        self._values |= dict(zip(self.parameters, map(float, parameters), strict=True))
        for path, constant in self._constants.items():
            constant.value = self._values[path]
        self._full_targets = np.zeros(len(self._fixed))
        for path, mover in self._movers.items():
            self._full_targets += self._values[path] * mover
        self._moves = any(self._values[path] != 0 for path in self._movers)

    def measure_loads(self) -> None:
        """Find the scale of residuals, and what of them is rounding.

        The scale is ‖F(0)‖ at full load (all energies are free of stress at 0). The rounding is that of stresses of
        the size of the stiffness: a few ε ‖F(δX)‖/δ without loads, where δX is a small stretch of the body.
        """
        self.at_load(0.0)
        self._rounding = 4 * float(np.finfo(float).eps) * self.norm(self._imbalance(self._stretch)) / STRETCH
        self.at_load(1.0)
        r = self._imbalance(np.zeros(3 * self.nodes_owned))
        r[self._fixed] = 0
        self._external = self.norm(r)

    def set_state(self, u: FloatArray) -> None:
        """Give the displacement (U_local,) its values, ghosts included."""
        self.u.x.array[: len(u)] = u
        self.u.x.scatter_forward()

    def state(self) -> FloatArray:
        """This rank's part (U_local,) of the displacement that is set."""
        return np.asarray(self.u.x.array[: 3 * self.nodes_owned])

    def dot(self, x: FloatArray, y: FloatArray) -> float:
        """Inner product over all ranks."""
        return float(fenicsx.total(self.comm, np.array([x @ y]))[0])

    # --- the nonlinear system ----------------------------------------------------------------------------------------

    def at_load(self, fraction: float) -> None:
        """Scale all loads and prescribed displacements."""
        self._load.value = fraction
        self._targets = fraction * self._full_targets

    def _imbalance(self, u: FloatArray) -> FloatArray:
        self.set_state(u)
        self.work.residuals += 1
        return self._residual()

    def imbalance(self) -> FloatArray:
        """Forces out of balance (U_local,) at the state that is set; on prescribed unknowns, the reactions."""
        return self._residual()

    def residual(self, u: FloatArray) -> Residual:
        """Return the imbalance at u (U_local,)."""
        r = self._imbalance(u)
        reactions = r[self._fixed]
        gap = u[self._fixed] - self._targets
        r[self._fixed] = 0
        free, fixed, apart = fenicsx.total(self.comm, np.array([r @ r, reactions @ reactions, gap @ gap]))
        r[self._fixed] = gap
        scale = float(self._load.value) * self._external
        if self._moves:
            scale = max(scale, float(np.sqrt(fixed)))
        return Residual(r, float(np.sqrt(free)), scale, self._rounding, float(np.sqrt(apart)))

    def factorise(self, u: FloatArray) -> None:
        """Assemble and factorise the stiffness at u (U_local,)."""
        self.set_state(u)
        self.work.assemblies += 1
        self.work.factorisations += 1
        self._solver.factorise()
        self._factorised_at = u

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = right; rows of prescribed unknowns give their values."""
        if self._moves or self._movers:
            known = right[self._fixed]
            if fenicsx.smallest(self.comm, -float(np.abs(known).max(initial=0.0))) < 0:
                w = np.zeros_like(right)
                w[self._fixed] = known
                self.set_state(self._factorised_at)
                right = right - self.stiffness_times(w)
                right[self._fixed] = known
        return self.back_substitute(right)

    def back_substitute(self, right: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Solve with K, or with Kᵀ, whose prescribed rows and columns are those of the identity."""
        self.work.back_substitutions += 1
        return self._solver.solve(right, transpose=transpose)

    def stiffness_times(self, w: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product of the stiffness of all unknowns (or its transpose) with w (U_local,), at the state that is set."""
        self._along.x.array[: len(w)] = w
        self._along.x.scatter_forward()
        self.work.residuals += 1
        return (self._transposed_action if transpose else self._stiffness_action)()

    def norm(self, x: FloatArray) -> float:
        """Euclidean norm over all ranks."""
        return float(np.sqrt(self.dot(x, x)))

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest J over the quadrature points of all ranks."""
        self.set_state(u)
        values = np.asarray(self._jacobians.eval(fenicsx.owned_cells(self.space)))
        return fenicsx.smallest(self.comm, float(values.min(initial=np.inf)))

    def negative_pivots(self) -> int:
        """Number of negative eigenvalues of the factorised stiffness."""
        return self._solver.negative_pivots()

    # --- derivatives with respect to the parameters ------------------------------------------------------------------

    def unit_directions(self) -> Iterator[str]:
        """Set the direction constants to each unit vector in turn."""
        for path in self.parameters:
            for other, direction in self._directions.items():
                direction.value = 1.0 if other == path else 0.0
            yield path

    def parameter_forces(self) -> FloatArray:
        """∂F/∂ω (d, U_local) over all unknowns, at the state that is set."""
        forces = np.zeros((len(self.parameters), 3 * self.nodes_owned))
        for i, path in enumerate(self.unit_directions()):
            if path in self._directions and self._parameter_force is not None:
                self.work.residuals += 1
                forces[i] = self._parameter_force()
        return forces

    def right_sides(self) -> FloatArray:
        """Right-hand sides (d, U_local) of the tangents at the state that is set: K du/dω_i = b_i."""
        right = -self.parameter_forces()
        for i, path in enumerate(self.parameters):
            right[i, self._fixed] = 0
            if path in self._movers:
                w = np.zeros(right.shape[1])
                w[self._fixed] = self._movers[path]
                right[i] -= self.stiffness_times(w)
                right[i, self._fixed] = self._movers[path]
        return right


class HyperelasticModel:
    """A hyperelastic body as a `ForwardModel`: one mesh, one set of forms and one solver for every realisation.

    Parameters
    ----------
    spec
        The body.
    comm
        Communicator of the ranks that share it.
    parameters
        Paths of the numbers that vary, in the order of the parameter vectors.

    Raises
    ------
    ValueError
        For a path that is not a number of the model, or an output at a point outside the body.
    """

    def __init__(self, spec: Hyperelastic, comm: Any, parameters: tuple[str, ...]) -> None:
        for path in parameters:
            if path not in spec.scalars:
                message = f"'{path}' is not a number of the model, expected one of: {', '.join(spec.scalars)}"
                raise ValueError(message)
        self.spec = spec
        self.parameters = parameters
        self.outputs = tuple(output.name for output in spec.outputs)
        self.body = Discretisation(spec, comm, parameters)
        self.layout = self.body.layout
        self.differentiable = True
        self._functionals = [functional(output, self.body) for output in spec.outputs]
        self._visited: object = None  # the solution whose state is set
        self._factorised: object = None  # the solution at whose state the stiffness is factorised

    def solve(self, parameters: FloatArray, start: FloatArray | None = None) -> FiniteElementSolution:
        """Find the equilibrium at `parameters` (d,), from the state `start` (U_local,) if given; collective.

        Raises
        ------
        SolveError
            With the load fraction where the solver stopped, the reason, and the history of its iterations.
        """
        body = self.body
        self._visited = self._factorised = None
        body.work = Work()
        for path, value in zip(self.parameters, parameters, strict=True):
            objection = self.spec.scalars[path].objection(float(value))
            if objection is not None:
                message = f"{path} = {value:.6g} is not admissible: {objection}"
                raise SolveError(message)
        body.set_parameters(parameters)
        body.measure_loads()
        u = solve(body, self.spec.solver, np.zeros(3 * body.nodes_owned), start)
        return FiniteElementSolution(self, parameters, u, body.work)

    def gather(self, rows: FloatArray) -> FloatArray | None:
        """Collect (k, U_local) as (k, U) in canonical order on the first rank."""
        return self.layout.gather(rows)

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Take this rank's part (k, U_local) of (k, U) in canonical order."""
        return self.layout.scatter(rows)

    def visit(self, solution: FiniteElementSolution) -> Discretisation:
        """Set parameters and state to those of a solution, if they are not."""
        if self._visited is not solution:
            self.body.set_parameters(solution.parameters)
            self.body.at_load(1.0)
            self.body.set_state(solution.state)
            self._visited = solution
        self.body.work = solution.work
        return self.body

    def linearise(self, solution: FiniteElementSolution) -> Discretisation:
        """Factorise the stiffness at a solution, if the factor at hand is another's."""
        body = self.visit(solution)
        if self._factorised is not solution:
            self._factorised = None  # a factorisation that fails leaves no factor
            body.factorise(solution.state)
            self._factorised = solution
        return body


class FiniteElementSolution:
    """An equilibrium with its linearisation: k derivatives cost one factorisation and k back-substitutions."""

    def __init__(self, model: HyperelasticModel, parameters: FloatArray, state: FloatArray, work: Work) -> None:
        self._model = model
        self.parameters = np.array(parameters, dtype=float)
        self.state = np.array(state)
        self.work = work
        for array in (self.parameters, self.state):
            array.flags.writeable = False
        model.visit(self)
        self.outputs = np.array([f.value() for f in model._functionals])
        self.outputs.flags.writeable = False

    @cached_property
    def _right_sides(self) -> FloatArray:
        return self._model.visit(self).right_sides()

    @cached_property
    def _gradients(self) -> FloatArray:
        """∂ψ/∂u (m, U_local)."""
        self._model.visit(self)
        return np.array([f.gradient() for f in self._model._functionals])

    @cached_property
    def _partials(self) -> FloatArray:
        """∂ψ/∂ω (m, d)."""
        self._model.visit(self)
        return np.array([f.partial() for f in self._model._functionals])

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return du (U_local,) along a `direction` (d,) of the parameters; collective."""
        right = np.asarray(direction) @ self._right_sides
        return self._model.linearise(self).back_substitute(right)

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,) of the parameters; collective."""
        du = self.state_tangent(direction)
        body = self._model.body
        return fenicsx.total(body.comm, self._gradients @ du) + self._partials @ direction

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,); collective."""
        load = np.asarray(weights) @ self._gradients
        body = self._model.linearise(self)
        multiplier = body.back_substitute(load, transpose=True)
        return fenicsx.total(body.comm, self._right_sides @ multiplier) + weights @ self._partials
