"""Discrete equations of a hyperelastic body: F(u, ω) = 0, its stiffness K = ∂F/∂u and ∂F/∂ω.

F = ∂Π/∂u (plus follower pressures) on the free unknowns and u = target on the prescribed ones.

Displacement form: Π = ∫ W dX − loads. Mixed form: u holds displacements and then pressures p (tension is positive), and
Π = ∫ W_iso + p g(J) − p²/(2κ) dX − loads, the perturbed Lagrangian of W = W_iso + κ/2 g(J)². There g is J−1, or what a
stated volumetric part makes it, and then p g'(J) is the pressure. K is symmetric and indefinite. Forces (N) and volumes
(m³), metres and pascals share vectors, so norms are of one kind only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, Literal, assert_never

import numpy as np
import ufl

from forward.bodies.geometry import AXES
from forward.bodies.inclusions import stiffness_factor
from forward.bodies.mesh_file import OwnMesh
from forward.fem import ranks
from forward.fem.cost import factor
from forward.fem.dolfinx import assembly, compile, linear, meshes, spaces, unknowns
from forward.fem.invariants import OPS, Invariants
from forward.fem.latest import Latest
from forward.fem.layout import Layout
from forward.fem.vertex_fields import VertexField
from forward.hyperelastic import CONTRAST, Hyperelastic
from forward.materials.admissible import moduli
from forward.materials.material import constants, energy_of, isochoric
from forward.model import FloatArray, SolveError, Work
from forward.solvers.linear import LinearSolver
from forward.solvers.system import Residual
from forward.terms.term import Place, Term

NUDGE = 1e-6  # of the extent of the body, for products with the stiffness by differences
STRETCH = 1e-6  # of the body, to see how stiff it is
VOLUME_ROUNDING = 1e-12  # ‖∫q (J−1 − p/κ) dX‖/‖∫q dX‖ that is rounding, over displacements as a part of the body


class Discretisation:
    """The discrete equations of a body, set to one state and one parameter vector at a time.

    It is the `System` that Newton's method works on. Meshes, compiled forms and solver objects are made once; forms
    that only derivatives need are compiled when they are first used.
    """

    _deadline: tuple[float, float] | None = None  # end of the time of a solve, and its length

    def __init__(self, spec: Hyperelastic, comm: Any, parameters: tuple[str, ...]) -> None:
        self.spec = spec
        self.comm = comm
        self.parameters = parameters
        self.work = Work()
        self.latest = Latest()
        self.mesh, self.facets = meshes.mesh_body(comm, spec.body)
        self.unknowns = unknowns.Unknowns(self.mesh, spec.body.degree, mixed=spec.mixed)
        self.size = self.unknowns.size
        self.space = self.unknowns.displacement
        self.layout = Layout(self.space, comm, self.unknowns.pressure)
        self.nodes_owned = spaces.owned_nodes(self.space)
        self.dx = ufl.dx(domain=self.mesh, metadata={"quadrature_degree": spec.body.quadrature})
        self._ds, self._tags = meshes.facet_measure(self.mesh, self.facets, spec.body.quadrature)

        self._values = {path: scalar.value for path, scalar in spec.scalars.items()}
        self._constants = {
            path: spaces.constant(self.mesh, value)
            for path, value in self._values.items()
            if not path.startswith("displacements.")
        }
        self._variables = {path: ufl.variable(constant) for path, constant in self._constants.items()}
        self.scalars = np.array([i for i, path in enumerate(parameters) if path in self._values], dtype=np.int64)
        self.fields = tuple(VertexField(field, spec.body, self.mesh, comm, parameters) for field in spec.fields)
        self._directions = {path: spaces.constant(self.mesh, 0.0) for path in parameters if path in self._constants}
        self._load = spaces.constant(self.mesh, 1.0)

        self._state = spaces.function(self.unknowns.whole)
        self._along = spaces.function(self.unknowns.whole)
        self._variation = ufl.TestFunction(self.unknowns.whole)
        self.u, self.p = self.unknowns.split(self._state)
        self.test, self._test_pressure = self.unknowns.split(self._variation)
        fibres = [spaces.constant(self.mesh, unit) for unit in spec.fibres]
        self._invariants = Invariants(
            spec.energy, self.mesh, self.u, lambda whole: self.unknowns.split(whole)[0], fibres
        )
        self.F = self._invariants.F
        self.J = ufl.det(self.F)
        self._pressure = None if self.p is None else ufl.variable(self.p)
        self.stored_energy, self._potential, self.dilation = self._energies()
        self._proportional = True  # whether forces at rest are proportional to the numbers of the loads
        self._loads = self._virtual_works()
        self.symmetric = spec.symmetric
        imbalance = self._imbalance_form()
        self._residual = self.vector(imbalance)
        self._prescribe()
        trial = ufl.TrialFunction(self.unknowns.whole)
        self._stiffness = self._bilinear(self.derivative(imbalance, trial))
        self._matrix = self._new_matrix(self._stiffness, symmetric=self.symmetric)
        self._solver: LinearSolver = linear.DirectSolver(self._matrix)
        self._jacobians = self.at_points(self.J)
        self._external = 0.0
        self._stretch = self._small_stretch()
        self._nudge = NUDGE * float(np.ptp(np.array(spec.body.vertices), axis=0).max())

    # --- forms -------------------------------------------------------------------------------------------------------

    @cached_property
    def energy(self) -> Any:
        """Energy density; in the mixed form, without that of the change of volume."""
        energy = energy_of(self.spec.energy) if self.p is None else isochoric(self.spec.energy)
        return self.stiffness_factor * energy(OPS, *self._invariants.measures.values(), **self._material)

    @cached_property
    def _regions(self) -> dict[str, Any]:
        """Indicators of the regions that have numbers of their own."""
        if not self.spec.regions or not isinstance(self.spec.body, OwnMesh):
            return {}
        found = spaces.region_indicators(self.comm, self.spec.body, self.mesh)
        return {name: found[name] for name in self.spec.regions}

    @property
    def _material(self) -> dict[str, Any]:
        """Constants of the material, by their names, each as an expression of the place."""
        values = self._numbers("material")
        for region, inside in self._regions.items():
            for name, number in self._numbers(f"regions.{region}").items():
                if name != CONTRAST:
                    values[name] = (1 - inside) * values[name] + inside * number
        return values

    @cached_property
    def stiffness_factor(self) -> Any:
        """What regions, inclusions and fields multiply every modulus by, by the place, in UFL; 1 without any."""
        factor = 1  # UFL drops it from products: a body without inclusions keeps its forms
        for region, inside in self._regions.items():
            if CONTRAST in self.spec.regions[region]:
                factor *= 1 - inside + inside * self._variables[f"regions.{region}.{CONTRAST}"]
        X = ufl.SpatialCoordinate(self.mesh)
        for inclusion in self.spec.inclusions:
            numbers = self._numbers(f"inclusions.{inclusion.label}")
            factor *= stiffness_factor(OPS, X, inclusion.kind, **numbers)
        return factor * self._factor_of("stiffness")

    def _factor_of(self, quantity: Literal["stiffness", "density"]) -> Any:
        """Product of the random fields on a quantity; 1 without any."""
        factor = 1
        for field in self.fields:
            match field.field.of:
                case "stiffness" | "density" as of:
                    factor = factor * field.factor if of == quantity else factor
                case _:
                    assert_never(field.field.of)
        return factor

    def _numbers(self, block: str) -> dict[str, Any]:
        """Return the numbers of a block of the model, by their names, as variables of forms."""
        paths = (path.rpartition(".") for path in self._variables)
        return {name: self._variables[f"{block}.{name}"] for place, _, name in paths if place == block}

    def _energies(self) -> tuple[Any, Any, Any]:
        """Densities of the stored energy, of the potential whose derivative is the imbalance, and of the volume change.

        In the mixed form ∫ g(J) dX = ∫ p/κ dX at equilibrium (the sum of the rows of the pressures), of which the
        latter keeps its digits however small it is.
        """
        dilation, p = self._invariants.deformation.dilation, self._pressure
        energy, j = self.energy, self._invariants.measures.get("j", dilation)
        if p is None:
            return energy, energy, dilation
        bulk, g = self._invariants.volume(self.stiffness_factor, self._material)
        of_pressure = p**2 / (2 * bulk)
        return energy + of_pressure, energy + p * g - of_pressure, p / bulk if g is j else p / bulk + (j - g)

    def stress_of(self, density: Any) -> Any:
        """P = ∂W/∂F (Pa) of a density of the measures of the energy, as UFL."""
        return self._invariants.stress(density)

    def _variation_of(self, density: Any) -> Any:
        """First variation of a density of its measures and the pressure: P : ∇v, and that of the pressure."""
        work = ufl.inner(self.stress_of(density), ufl.grad(self.test))
        return work if self._pressure is None else work + ufl.diff(density, self._pressure) * self._test_pressure

    def derivative(self, form: Any, direction: Any | None = None) -> Any:
        """Gâteaux derivative of a functional with respect to all unknowns, along a direction or any variation."""
        return self._invariants.derivative(form, self._state, self._variation if direction is None else direction)

    def surface(self, boundary: str) -> Any:
        """Measure of a named boundary."""
        return self._ds(self._tags[boundary])

    def vector(self, form: Any) -> assembly.VectorAssembler:
        """Compile a linear form."""
        return assembly.VectorAssembler(self._invariants.inserted(form), self.unknowns, self.comm)

    def by_vertices(self, form: Any) -> assembly.VectorAssembler:
        """Compile a form that is linear in values at the vertices."""
        return assembly.VectorAssembler(self._invariants.inserted(form), None, self.comm)

    def scalar(self, form: Any) -> assembly.ScalarAssembler:
        """Compile a functional."""
        return assembly.ScalarAssembler(self._invariants.inserted(form), self.comm)

    def at_points(self, expression: Any) -> assembly.PointValues:
        """Compile an expression that is wanted at the quadrature points."""
        points = spaces.quadrature_points(self.space, self.spec.body.quadrature)
        return assembly.PointValues(self._invariants.inserted(expression), points, self.space, self.comm)

    def _bilinear(self, form: Any) -> Any:
        return compile.compile_form(self._invariants.inserted(form), self.comm)

    def _virtual_works(self) -> list[Any]:
        """Forms of the virtual works of the loads, with the sign of forces that are out of balance.

        In load steps the numbers of a load are scaled where it is linear in them, else the whole load.
        """
        works = []
        for load in self.spec.loads:
            numbers = self._numbers(f"loads.{load.label}")
            work = self._out_of_balance(load, {name: self._load * number for name, number in numbers.items()})
            if not _linear(work, numbers.values()):
                self._proportional = False
                work = self._load * self._out_of_balance(load, numbers)
            works.append(work)
        return works

    def _out_of_balance(self, load: Term, numbers: dict[str, Any]) -> Any:
        at = Place(
            u=self.u,
            v=self.test,
            F=self.F,
            J=self.J,
            X=ufl.SpatialCoordinate(self.mesh),
            normal=ufl.FacetNormal(self.mesh),
            dx=self.dx,
            on=self.surface,
            numbers=numbers,
            density=self._factor_of("density"),
            constant=lambda value: spaces.constant(self.mesh, value),
        )
        potential = load.potential(at)
        if potential is None:
            return load.virtual_work(at)
        return ufl.algorithms.expand_derivatives(ufl.derivative(potential, self._state, self._variation))

    def _imbalance_form(self, change: Callable[[Any], Any | None] = lambda integrand: integrand) -> Any | None:
        """Virtual work of all forces, with each integrand replaced by its `change`; None if all vanish."""
        density = change(self._potential)
        terms = [] if density is None else [self._variation_of(density) * self.dx]
        for integral in (integral for work in self._loads for integral in work.integrals()):
            changed = change(integral.integrand())
            if changed is not None:
                terms.append(ufl.Form([integral.reconstruct(changed)]))
        return sum(terms[1:], terms[0]) if terms else None

    def along_parameters(self, integrand: Any) -> Any | None:
        """Σ_i (∂ integrand/∂ω_i) dω_i along the direction dω that is set; nothing if it depends on no parameter."""
        present = set(ufl.algorithms.analysis.extract_constants(integrand * self.dx))
        terms = [
            direction * ufl.diff(integrand, self._variables[path])
            for path, direction in self._directions.items()
            if self._constants[path] in present
        ]
        terms += [field.direction * ufl.diff(integrand, field.log) for field in self.fields if field.inside(integrand)]
        return sum(terms[1:], terms[0]) if terms else None

    @cached_property
    def _parameter_force(self) -> assembly.VectorAssembler | None:
        form = self._imbalance_form(self.along_parameters)
        return None if form is None else self.vector(form)

    @cached_property
    def _field_forces(self) -> tuple[tuple[VertexField, assembly.VectorAssembler], ...]:
        """The fields that forces depend on, each with ∂(wᵀF)/∂m by its values m at the vertices, w being `_along`."""
        found = []
        for field in self.fields:

            def by_vertices(integrand: Any, field: VertexField = field) -> Any | None:
                return field.test * ufl.diff(integrand, field.log) if field.inside(integrand) else None

            form = self._imbalance_form(by_vertices)
            if form is not None:
                form = ufl.replace(form, {self._variation: self._along})
                found.append((field, self.by_vertices(form)))
        return tuple(found)

    @cached_property
    def _stiffness_action(self) -> assembly.VectorAssembler:
        return self.vector(self.derivative(self._imbalance_form(), self._along))

    @cached_property
    def _transposed_action(self) -> assembly.VectorAssembler:
        if self.symmetric:
            return self._stiffness_action
        return self.vector(self.derivative(ufl.action(self._imbalance_form(), self._along)))

    @cached_property
    def gradients(self) -> assembly.NodalGradients:
        """Deformation gradients at the nodes, at the state that is set."""
        return assembly.NodalGradients(self.F, self.space, self.comm)

    @cached_property
    def _unit_loads(self) -> dict[str, FloatArray]:
        """Forces (U_local,) on the undeformed body: those of each load of size one, and ("") those without a size.

        All energies are free of stress there.
        """
        paths = [path for path in self._constants if path.startswith("loads.")]
        forces: dict[str, FloatArray] = {}
        work, self.work = self.work, Work()  # the first solution is charged no more than the others
        for path in ("", *paths):
            for other in paths:
                self._constants[other].value = float(other == path)
            forces[path] = self._forces_at_rest() - forces.get("", 0.0)
            if path == "" and self.norm(forces[path]) <= self.rounding(np.zeros(self.size), 0.0):
                forces[path][:] = 0
        for path in paths:
            self._constants[path].value = self._values[path]
        self.work = work
        return forces

    def _forces_at_rest(self) -> FloatArray:
        """Forces (U_local,) on the undeformed body, of whole loads."""
        kept = self._load.value.copy()
        self._load.value = 1.0
        forces = self._imbalance(np.zeros(self.size))
        forces[self.fixed] = 0
        self._load.value = kept
        return forces

    def new_solver(self) -> LinearSolver:
        """Return a solver for the stiffness, with a matrix of its own."""
        return linear.DirectSolver(self._new_matrix(self._stiffness, symmetric=self.symmetric))

    def _new_matrix(self, form: Any, *, symmetric: bool) -> linear.StiffnessMatrix:
        expected = factor(self.spec.body, mixed=self.spec.mixed)
        return linear.StiffnessMatrix(
            form, self._constraints, self.unknowns, self.comm, symmetric=symmetric, expected=expected
        )

    # --- state and parameters ----------------------------------------------------------------------------------------

    def _prescribe(self) -> None:
        """Collect the prescribed unknowns, the path that moves each (if any), and the marks for assembly."""
        moved: dict[tuple[int, int], str] = {}
        self._constraints = []
        for displacement in self.spec.displacements:
            nodes = spaces.boundary_nodes(self.space, self.facets[displacement.on])
            for axis in displacement.components:
                a = AXES.index(axis)
                self._constraints.append(self.unknowns.constraint(a, nodes))
                moved |= {(int(n), a): f"displacements.{displacement.label}.{axis}" for n in nodes}
        for boundary in self.spec.clamp:
            nodes = spaces.boundary_nodes(self.space, self.facets[boundary])
            for a in range(3):
                self._constraints.append(self.unknowns.constraint(a, nodes))
                moved |= {(int(n), a): "" for n in nodes}
        owned = sorted((3 * n + a, path) for (n, a), path in moved.items() if n < self.nodes_owned)
        self.fixed = np.array([unknown for unknown, _ in owned], dtype=np.int64)
        paths = [path for _, path in owned]
        self._movers = {
            path: np.array([p == path for p in paths], dtype=float)
            for path in self._values
            if path.startswith("displacements.")
        }
        self._targets = np.zeros(len(self.fixed))
        self._moves = False

    def set_parameters(self, parameters: FloatArray) -> None:
        """Give the parameters (d,) their values."""
        self.latest.rounding = None
        if self.latest.parameters is not None and np.array_equal(parameters, self.latest.parameters):
            return
        self.latest.parameters = np.array(parameters, dtype=float)
        self.latest.moved()
        self._values |= {self.parameters[i]: float(parameters[i]) for i in self.scalars}
        for path, constant in self._constants.items():
            constant.value = self._values[path]
        self._full_targets = np.zeros(len(self.fixed))
        for path, mover in self._movers.items():
            self._full_targets += self._values[path] * mover
        self._moves = any(self._values[path] != 0 for path in self._movers)
        external = np.zeros(self.size) if self._proportional else self._forces_at_rest()
        with np.errstate(invalid="ignore"):  # a load that is not finite has no finite residual, which the solver says
            for path, force in self._unit_loads.items() if self._proportional else ():
                external += self._values.get(path, 1.0) * force
        self._external = self.norm(external)
        for field in self.fields:  # the size of the loads is that without fluctuations
            field.set(parameters)

    def _small_stretch(self) -> FloatArray:
        """Stretch the body a little; in the mixed form along x only, since without pressure nothing else resists."""
        places = STRETCH * spaces.node_coordinates(self.space)
        if self.p is not None:
            places[:, 1:] = 0
        return self.with_pressures(places.ravel())

    @cached_property
    def _volumes(self) -> FloatArray:
        """Volumes ∫q dX (m³) of the test functions q of this rank's pressures."""
        kept = self.state()
        self.set_state(self._stretch)
        volumes = self._residual()[3 * self.nodes_owned :] / STRETCH
        self.set_state(kept)
        return volumes

    @cached_property
    def _volumes_size(self) -> float:
        return float(np.sqrt(self.dot(self._volumes, self._volumes)))

    @cached_property
    def _distance(self) -> float:
        """Edge (m) of a cube that is the part of the body for each pressure."""
        return float((self.total(np.array([self._volumes.sum()]))[0] / self.unknowns.pressures) ** (1 / 3))

    def _force_per_volume(self) -> float:
        """What turns volumes v (m³) that are out of balance into forces (N): κ v/h³ is the pressure that they cost.

        It acts on an area h². A body whose boundary is held altogether is so far from its pressure; others are nearer.
        """
        values = {name: self._values[f"material.{name}"] for name in constants(self.spec.energy)}
        return float(moduli(self.spec.energy, values)[1] / self._distance)

    def weights(self) -> FloatArray:
        """What turns an imbalance (U_local,) into forces (N): one on displacements."""
        weights = np.ones(self.size)
        if self.p is not None:
            weights[3 * self.nodes_owned :] = self._force_per_volume()
        return weights

    def set_state(self, u: FloatArray) -> None:
        """Give the unknowns (U_local,) their values, ghosts included."""
        self.latest.moved()
        self.unknowns.give(self._state, u)

    def state(self) -> FloatArray:
        """This rank's part (U_local,) of the state that is set."""
        return self.unknowns.take(self._state.x.array)

    def displacements(self) -> FloatArray:
        """Displacements (nodes_owned, 3) of the state that is set."""
        return self.state()[: 3 * self.nodes_owned].reshape(-1, 3)

    def with_pressures(self, displacements: FloatArray) -> FloatArray:
        """Extend this rank's part (3 nodes_owned,) of a vector by zeros for the pressures, where they are unknowns."""
        return np.append(displacements, np.zeros(self.size - len(displacements)))

    def dot(self, x: FloatArray, y: FloatArray) -> float:
        """Inner product over all ranks."""
        return float(ranks.total(self.comm, np.array([x @ y]))[0])

    # --- the nonlinear system ----------------------------------------------------------------------------------------

    def at_load(self, fraction: float) -> None:
        """Scale all loads and prescribed displacements."""
        self.latest.moved()
        self._load.value = fraction
        self._targets = fraction * self._full_targets

    def _imbalance(self, u: FloatArray) -> FloatArray:
        self.set_state(u)
        self.work.residuals += 1
        return self._residual()

    def imbalance(self) -> FloatArray:
        """Imbalance (U_local,) at the state that is set; on prescribed unknowns, the reactions."""
        return self._residual()

    def residual(self, u: FloatArray) -> Residual:
        """Return the imbalance at u (U_local,).

        Raises
        ------
        SolveError
            If `time_limit` has passed.
        """
        self._check_time()
        r = self._imbalance(u)
        reactions = r[self.fixed]
        gap = u[self.fixed] - self._targets
        r[self.fixed] = 0
        forces, volumes = r[: 3 * self.nodes_owned], r[3 * self.nodes_owned :]
        squares = [forces @ forces, reactions @ reactions, gap @ gap, volumes @ volumes]
        free, fixed, apart, lacking = np.sqrt(self.total(np.array(squares))).tolist()
        r[self.fixed] = gap
        scale = float(self._load.value) * self._external
        if self._moves:
            scale = max(scale, fixed)
        return Residual(r, free, scale, apart, self._force_of(lacking, u))

    @contextmanager
    def time_limit(self, seconds: float | None) -> Iterator[None]:
        """Within this context, residuals are refused after so many seconds."""
        self._deadline = None if seconds is None else (time.monotonic() + seconds, seconds)
        try:
            yield
        finally:
            self._deadline = None

    def _check_time(self) -> None:
        if self._deadline is None:
            return
        end, seconds = self._deadline
        if ranks.smallest(self.comm, end - time.monotonic()) < 0:  # all ranks agree
            message = f"the solve took longer than solve_seconds = {seconds:g}"
            raise SolveError(message, work=self.work)

    def _force_of(self, lacking: float, u: FloatArray) -> float:
        """Force (N) of volumes (m³) that are out of balance; volumes that are rounding have none."""
        if self.p is None:
            return 0.0
        strained = min(1.0, self.norm(u) / self._extent)
        return 0.0 if lacking <= VOLUME_ROUNDING * strained * self._volumes_size else lacking * self._force_per_volume()

    @cached_property
    def _extent(self) -> float:
        """Norm of the distances (m) of the nodes from their mean: what displacements are compared with."""
        places = spaces.node_coordinates(self.space)
        count, *sums = self.total(np.array([len(places), *places.sum(axis=0)])).tolist()
        return self.norm(self.with_pressures((places - np.array(sums) / count).ravel()))

    def rounding(self, u: FloatArray, scale: float) -> float:
        """What the size of a residual with this scale (N) cannot be expected to fall below at u (U_local,).

        Measures keep their digits however small u is, so that what its last digits weigh is what rounding leaves:
        ‖F(u (1 ± ε)) − F(u)‖, of which so much counts as still leaves four digits of the loads. A body without loads
        has no such scale; there, stresses of the size of the stiffness round: a few ε ‖F(δX)‖/δ, where δX is a small
        stretch (more of them where it is along one axis only).
        """
        if scale == 0:
            return self._rounding_without_loads()
        last_digits = np.where(np.arange(self.size) % 2 == 0, 1.0, -1.0) * np.finfo(float).eps
        change = self._imbalance(u * (1 + last_digits)) - self._imbalance(u)
        change[self.fixed] = 0
        left = 2 * self.norm(change)
        # A body that is moved as if it were rigid has no forces but those of rounding.
        return min(left, 1e-4 * scale) if self._external > 0 else left

    def _rounding_without_loads(self) -> float:
        if self.latest.rounding is None:
            load = self._load.value.copy()
            self._load.value = 0.0
            few = 4 if self.p is None else 16
            self.latest.rounding = (
                few * float(np.finfo(float).eps) * self.norm(self._imbalance(self._stretch)) / STRETCH
            )
            self._load.value = load
        return self.latest.rounding

    def on_target(self, u: FloatArray) -> FloatArray:
        """Return u (U_local,) with the prescribed unknowns at their targets."""
        v = np.array(u)
        v[self.fixed] = self._targets
        return v

    def factorise(self, u: FloatArray) -> None:
        """Assemble and factorise the stiffness at u (U_local,)."""
        self.set_state(u)
        self.work.assemblies += 1
        self.work.factorisations += 1
        self.latest.factorised = None  # a factorisation that fails leaves no factor
        self._solver.factorise()
        self.latest.factorised_at = u

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = right; rows of prescribed unknowns give their values."""
        if self._moves or self._movers:
            known = right[self.fixed]
            if ranks.smallest(self.comm, -float(np.abs(known).max(initial=0.0))) < 0:
                w = np.zeros_like(right)
                w[self.fixed] = known
                assert self.latest.factorised_at is not None
                self.set_state(self.latest.factorised_at)
                right = right - self.stiffness_times(w)
                right[self.fixed] = known
        return self.back_substitute(right)

    def back_substitute(self, right: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Solve with K, or with Kᵀ, whose prescribed rows and columns are those of the identity; (n,) or (k, n)."""
        self.work.back_substitutions += 1 if right.ndim == 1 else len(right)
        return self._solver.solve(right, transpose=transpose)

    def stiffness_times(self, w: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product of the stiffness of all unknowns (or its transpose) with w (U_local,), at the state that is set."""
        self.unknowns.give(self._along, w)
        self.work.residuals += 1
        return (self._transposed_action if transpose else self._stiffness_action)()

    def free_stiffness_times(self, x: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product (k, n) of the matrix that `back_substitute` inverts, at the state that is set, with rows x (k, n)."""
        w = np.array(x)
        w[:, self.fixed] = 0
        y = np.array([self.stiffness_times(row, transpose=transpose) for row in w])
        y[:, self.fixed] = x[:, self.fixed]
        return y

    def curvature(self, move: FloatArray, change: FloatArray) -> float:
        """Second difference of the energy along a move (U_local,), from the change of the imbalance.

        The energy of displacements and pressures is a saddle, so that the pressures count with the other sign.
        """
        n = 3 * self.nodes_owned
        return float(self.total(np.array([move[:n] @ change[:n] - move[n:] @ change[n:]]))[0])

    def total(self, values: FloatArray) -> FloatArray:
        """Sum over all ranks."""
        return ranks.total(self.comm, values)

    def norms(self, rows: FloatArray) -> FloatArray:
        """Euclidean norms over the displacements of rows (k, U_local), of all ranks."""
        displacements = rows[:, : 3 * self.nodes_owned]
        return np.asarray(np.sqrt(self.total(np.einsum("kn,kn->k", displacements, displacements))))

    def norm(self, x: FloatArray) -> float:
        """Euclidean norm over the displacements (or their forces) of all ranks."""
        return float(self.norms(x[None])[0])

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest J over the quadrature points of all ranks."""
        self.set_state(u)
        return ranks.smallest(self.comm, float(self._jacobians().min(initial=np.inf)))

    def assembled_stiffness(self) -> Any:
        """The stiffness at the state that is set, for `products`; the factor of `factorise` is lost."""
        self.latest.factorised = None
        return self._matrix.assembled()

    def products(self, matrix: Any, rows: FloatArray) -> FloatArray:
        """Products (k, U_local) of such a matrix with rows (k, U_local)."""
        return self._matrix.products(matrix, rows)

    @cached_property
    def _symmetric_stiffness(self) -> Any:
        """The symmetric part of the stiffness, compiled; the stiffness itself where it is symmetric."""
        if self.symmetric:
            return self._stiffness
        trial = ufl.TrialFunction(self.unknowns.whole)
        works = list(zip(self.spec.loads, self._loads, strict=True))
        rest = sum((work for load, work in works if load.symmetric), self._variation_of(self._potential) * self.dx)
        of_rest, of_followers = (
            self.derivative(work, trial) for work in (rest, sum(work for load, work in works if not load.symmetric))
        )
        return self._bilinear(of_rest + 0.5 * of_followers + 0.5 * ufl.adjoint(of_followers))

    def new_symmetric_solver(self) -> LinearSolver:
        """Return a solver for the symmetric part of the stiffness, with a matrix of its own."""
        return linear.DirectSolver(self._new_matrix(self._symmetric_stiffness, symmetric=True))

    @cached_property
    def _symmetric_part(self) -> LinearSolver:
        return self.new_symmetric_solver()

    def negative_eigenvalues(self, u: FloatArray) -> int | None:
        """Factorise at u (U_local,); return the number of negative eigenvalues, of the symmetric part under pressures.

        Those of the condensed stiffness: in the mixed form each pressure adds one, which does not count.
        """
        if self.symmetric:
            self.factorise(u)
            return self.inertia()
        self.set_state(u)
        self.work.assemblies += 1
        self.work.factorisations += 1
        self._symmetric_part.factorise()
        return self._condensed(self._symmetric_part.negative_eigenvalues())

    @cached_property
    def free_displacements(self) -> FloatArray:
        """1 on free displacements, 0 on other unknowns (U_local,)."""
        free = np.zeros(self.size)
        free[: 3 * self.nodes_owned] = 1
        free[self.fixed] = 0
        return free

    def stiffness_near(self, u: FloatArray, imbalance: FloatArray, rows: FloatArray) -> FloatArray:
        """Products (k, U_local) of the stiffness of the free unknowns at u (U_local,) with rows, to a few digits.

        They are differences from the `imbalance` at u (that of a `Residual`).
        """
        largest = np.abs(rows[:, : 3 * self.nodes_owned]).max(axis=1, initial=0.0)
        products = np.empty_like(rows)
        for row, product, size in zip(rows, products, largest, strict=True):
            step = self._nudge / max(-ranks.smallest(self.comm, -float(size)), float(np.finfo(float).tiny))
            product[:] = (self._imbalance(u + step * row) - imbalance) / step
        products[:, self.fixed] = 0
        return products

    def inertia(self) -> int | None:
        """Number of negative eigenvalues of the factorised stiffness beyond one for each pressure; None if unknown."""
        return self._condensed(self._solver.negative_eigenvalues())

    def _condensed(self, negative: int | None) -> int | None:
        return None if negative is None else negative - self.unknowns.pressures

    # --- derivatives with respect to the parameters ------------------------------------------------------------------

    def unit_directions(self) -> Iterator[str]:
        """Set the direction to each unit vector of the s parameters that are numbers of the model in turn."""
        self._set_field_directions(np.zeros(len(self.parameters)))
        for i in self.scalars:
            path = self.parameters[i]
            for other, direction in self._directions.items():
                direction.value = 1.0 if other == path else 0.0
            yield path

    def _set_field_directions(self, direction: FloatArray) -> None:
        for field in self.fields:
            field.set_direction(direction)

    def parameter_forces(self) -> FloatArray:
        """∂F/∂ω (s, U_local) over all unknowns, at the state that is set, by the numbers of the model."""
        forces = np.zeros((len(self.scalars), self.size))
        for i, path in enumerate(self.unit_directions()):
            if path in self._directions and self._parameter_force is not None:
                self.work.residuals += 1
                forces[i] = self._parameter_force()
        return forces

    def right_sides_of_all(self) -> FloatArray:
        """Right-hand sides (d, U_local) of the tangents along every parameter, at the state set."""
        return self.right_sides_along(np.eye(len(self.parameters)))

    def right_sides_along(self, directions: FloatArray) -> FloatArray:
        """Right-hand sides (k, U_local) of the tangents along directions (k, d) of the parameters, at the state set."""
        right = directions[:, self.scalars] @ self.right_sides()
        return right + self.field_right_sides(directions) if self.fields else right

    def field_right_sides(self, directions: FloatArray) -> FloatArray:
        """Right-hand sides (k, U_local) of tangents along what directions (k, d) change of fields, at the state set."""
        right = np.zeros((len(directions), self.size))
        for direction in self._directions.values():
            direction.value = 0.0
        positions = np.concatenate([field.positions for field in self.fields])
        for row, direction in zip(right, directions, strict=True):
            if self._parameter_force is not None and direction[positions].any():
                self._set_field_directions(direction)
                self.work.residuals += 1
                row[:] = -self._parameter_force()
        right[:, self.fixed] = 0
        return right

    def field_products(self, w: FloatArray) -> FloatArray:
        """Products wᵀ∂F/∂ω (d,) with w (U_local,) at the state that is set; zero for the numbers of the model.

        One assembly for each field, however many parameters it has.
        """
        products = np.zeros(len(self.parameters))
        if self._field_forces:
            self.unknowns.give(self._along, w)
        for field, assemble in self._field_forces:
            self.work.residuals += 1
            products[field.positions] = field.pull(assemble())
        return products

    def right_sides(self) -> FloatArray:
        """Right-hand sides (s, U_local) of the tangents at the state that is set: K du/dω_i = b_i."""
        right = -self.parameter_forces()
        for i, path in enumerate(self.parameters[j] for j in self.scalars):
            right[i, self.fixed] = 0
            if path in self._movers:
                w = np.zeros(right.shape[1])
                w[self.fixed] = self._movers[path]
                right[i] -= self.stiffness_times(w)
                right[i, self.fixed] = self._movers[path]
        return right


def _linear(work: Any, numbers: Collection[Any]) -> bool:
    """Whether a form is proportional to all of these numbers, which are variables, together."""
    integrands = [integral.integrand() for integral in work.integrals()]
    zero = {number.expression(): ufl.as_ufl(0.0) for number in numbers}
    slopes = [ufl.algorithms.expand_derivatives(ufl.diff(one, number)) for one in integrands for number in numbers]
    if any(c in zero for slope in slopes for c in ufl.algorithms.analysis.extract_constants(slope)):
        return False
    return all(ufl.replace(ufl.algorithms.strip_variables(one), zero) == 0 for one in integrands)
