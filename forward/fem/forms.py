"""Forms of a hyperelastic body: its energies, loads and their derivatives, in UFL, and compiled."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from functools import cached_property
from typing import Any, Literal

import numpy as np
import ufl
from numpy.typing import NDArray

from forward.bodies.inclusions import stiffness_factor
from forward.fem.dolfinx import assembly, compile, meshes, spaces
from forward.fem.invariants import OPS, Invariants
from forward.fem.layout import Layout
from forward.fem.vertex_fields import VertexField
from forward.loaded import LoadedBody
from forward.materials.material import energy_of, isochoric
from forward.model import FloatArray
from forward.solid import CONTRAST
from forward.terms.term import Place, Since, Term

SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))  # components of symmetric tensors, as in ParaView


class Forms:
    """What is integrated over a body, as functions of its state, its parameters and directions of both.

    Forms needed only for derivatives are compiled on first use.

    Parameters
    ----------
    spec, comm, parameters
        As in `HyperelasticModel`.
    beside
        Forms of the same body in other elements, whose mesh and random fields these share.

    Attributes
    ----------
    scalars
        Which of the parameters (s,) are numbers of the model rather than coefficients of random fields.
    fields
        Random fields.
    mesh, facets, space, layout
        Mesh, facets of each boundary, space of the displacements, order of the nodes.
    nodes_owned, size
        Numbers of this rank's nodes and unknowns.
    dx
        Measure of the undeformed body.
    u, test, F, J
        Displacement, virtual displacement, deformation gradient and its determinant.
    spatial
        As of `Invariants`.
    stored_energy, dilation
        Densities of the stored energy and of the change of volume.
    unknown
        The state as the function that forms are written in; in the mixed form, displacements and pressure.
    constants
        The numbers of the model in forms, by their paths.
    virtual_works
        Forms of the virtual works of the loads, in their order, with the sign of the imbalance.
    """

    def __init__(self, spec: LoadedBody, comm: Any, parameters: tuple[str, ...], beside: Forms | None = None) -> None:
        self.spec = spec
        self.comm = comm
        self.parameters = parameters
        found = meshes.mesh_body(comm, spec.body) if beside is None else (beside.mesh, beside.facets)
        self.mesh: Any = found[0]
        self.facets: dict[str, NDArray[np.int32]] = found[1]
        self.unknowns = spaces.Unknowns(self.mesh, spec.body.degree, mixed=spec.mixed)
        self.size = self.unknowns.size
        self.space = self.unknowns.displacement
        self.layout = Layout(self.space, comm, self.unknowns.pressure)
        self.nodes_owned = spaces.owned_nodes(self.space)
        self.dx = ufl.dx(domain=self.mesh, metadata={"quadrature_degree": spec.body.quadrature})
        self._ds, self._tags = meshes.facet_measure(self.mesh, self.facets)

        self._values = {path: scalar.value for path, scalar in spec.scalars.items()}
        self.constants = {
            path: spaces.constant(self.mesh, value)
            for path, value in self._values.items()
            if not path.startswith("displacements.")
        }
        self._variables = {path: ufl.variable(constant) for path, constant in self.constants.items()}
        self.scalars = np.array([i for i, path in enumerate(parameters) if path in self._values], dtype=np.int64)
        self.fields: tuple[VertexField, ...] = (
            tuple(VertexField(field, spec.body, self.mesh, comm, parameters) for field in spec.fields)
            if beside is None
            else beside.fields
        )
        self._directions = {path: spaces.constant(self.mesh, 0.0) for path in parameters if path in self.constants}
        self._load = spaces.constant(self.mesh, 1.0)

        self.unknown = spaces.function(self.unknowns.whole)
        self._along = spaces.function(self.unknowns.whole)
        self._variation = ufl.TestFunction(self.unknowns.whole)
        self.u, self.p = self.unknowns.split(self.unknown)
        self.test, self._test_pressure = self.unknowns.split(self._variation)
        fibres = [spaces.constant(self.mesh, unit) for unit in spec.fibres]
        small = (self.unknown, self._along) if spec.strains == "small" else None
        self._invariants = Invariants(
            spec.energy, self.mesh, self.u, lambda whole: self.unknowns.split(whole)[0], fibres, small
        )
        self.F, self.spatial = self._invariants.F, self._invariants.spatial
        self.J = ufl.det(self.F)
        self._pressure = None if self.p is None else ufl.variable(self.p)
        self.stored_energy, self._potential, self.dilation = self._energies()
        # Where there is friction: the state at the end of the increment before, and what has moved since.
        self.increments = spec.increments
        self._before = spaces.function(self.unknowns.whole) if spec.path_dependent else None
        self._share = spaces.constant(self.mesh, 0.0)
        self._shifts = {load.label: spaces.constant(self.mesh, np.zeros(4)) for load in spec.loads if load.contact}
        self._proportional = True  # whether forces at rest are proportional to the numbers of the loads
        # Virtual works of those loads that act in contact, and what they are written with.
        self._tools: list[tuple[Any, Term, Place]] = []
        self._curved = spaces.constant(self.mesh, 1.0)  # 0 takes the curvature of tools out of the stiffness
        self._last = [spaces.function(self.unknowns.whole) for _ in range(2 if self._shifts else 0)]
        self._left = {label: spaces.constant(self.mesh, 0.0) for label in self._shifts}  # 1: linearised where expected
        self._touched = spaces.constant(self.mesh, 1.0)  # 0 takes them away
        self._stiffer = spaces.constant(self.mesh, 1.0)  # factor on their stiffness
        self._rubbing: list[tuple[Any, Term, Place]] = []  # virtual works of friction
        self.virtual_works = self._works_of_loads()
        self.symmetric = spec.symmetric

    @property
    def load(self) -> float:
        """Fraction of the loads and prescribed displacements that is set."""
        return float(self._load.value)

    @cached_property
    def energy(self) -> Any:
        """Energy density; in the mixed form, without its volumetric part."""
        energy = energy_of(self.spec.energy) if self.p is None else isochoric(self.spec.energy)
        return self.stiffness_factor * energy(OPS, *self._invariants.measures.values(), **self._material)

    @cached_property
    def _regions(self) -> dict[str, Any]:
        """Indicators of the regions that have their own numbers."""
        if not self.spec.regions or self.spec.body.kind != "mesh":
            return {}
        found = spaces.region_indicators(self.comm, self.spec.body, self.mesh)
        return {name: found[name] for name in self.spec.regions}

    @property
    def _material(self) -> dict[str, Any]:
        """Constants of the material, by name, each as an expression of position."""
        values = self._numbers("material")
        for region, inside in self._regions.items():
            for name, number in self._numbers(f"regions.{region}").items():
                if name != CONTRAST:
                    values[name] = (1 - inside) * values[name] + inside * number
        return values

    @cached_property
    def stiffness_factor(self) -> Any:
        """Factor of regions, inclusions and fields on every modulus, as a UFL expression of position; 1 without any."""
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
        return math.prod(field.factor for field in self.fields if field.field.of == quantity)

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
        stored, first = self._invariants.stored, self._invariants.to_first_order
        energy, j = self.energy, self._invariants.measures.get("j", dilation)
        if p is None:
            return stored(energy), energy, first(dilation)
        bulk, g = self._invariants.volume(self.stiffness_factor, self._material)
        of_pressure = p**2 / (2 * bulk)
        less = p / bulk if g is j else p / bulk + first(j - g)
        return stored(energy) + of_pressure, energy + p * g - of_pressure, less

    def stress_of(self, density: Any) -> Any:
        """P = ∂W/∂F (Pa) of a density of the measures of the energy, as UFL."""
        return self._invariants.stress(density)

    def cauchy_of(self, density: Any) -> Any:
        """σ = P Fᵀ/J (Pa) of such a density."""
        F, J = self.spatial
        return self.stress_of(density) * F.T / J

    def _variation_of(self, density: Any) -> Any:
        """First variation of a density of its measures and the pressure: P : ∇v, and that of the pressure."""
        work = ufl.inner(self.stress_of(density), ufl.grad(self.test))
        first = self._invariants.to_first_order
        return work if self._pressure is None else work + first(ufl.diff(density, self._pressure)) * self._test_pressure

    def derivative(self, form: Any, direction: Any | None = None) -> Any:
        """Gâteaux derivative of a functional with respect to all unknowns, along a direction or any variation."""
        return self._invariants.derivative(form, self.unknown, self._variation if direction is None else direction)

    @cached_property
    def volume(self) -> float:
        """Volume (m³) of the undeformed mesh; smaller than that of the body if linear tetrahedra cut its faces."""
        return self.scalar(spaces.constant(self.mesh, 1.0) * self.dx)()

    def surface(self, boundary: str, degree: int | None = None) -> Any:
        """Measure of a named boundary, with at least a degree of quadrature."""
        finest = max(degree or 0, self.spec.body.quadrature)
        return self._ds(self._tags[boundary], metadata={"quadrature_degree": finest})

    def vector(self, form: Any, *, often: bool = False) -> assembly.VectorAssembler:
        """Compile a linear form."""
        return assembly.VectorAssembler(self._invariants.inserted(form), self.unknowns, self.comm, often=often)

    def by_vertices(self, form: Any) -> assembly.VectorAssembler:
        """Compile a form that is linear in values at the vertices."""
        return assembly.VectorAssembler(self._invariants.inserted(form), None, self.comm)

    def scalar(self, form: Any) -> assembly.ScalarAssembler:
        """Compile a functional."""
        return assembly.ScalarAssembler(self._invariants.inserted(form), self.comm)

    def at_points(self, expression: Any, *, often: bool = False) -> assembly.PointValues:
        """Compile an expression for evaluation at the quadrature points."""
        return self.at(expression, spaces.quadrature(self.space, self.spec.body.quadrature)[0], often=often)

    def at(self, expression: Any, points: FloatArray, *, often: bool = False) -> assembly.PointValues:
        """Compile an expression for evaluation at points (q, 3) of the reference cell."""
        return assembly.PointValues(self._invariants.inserted(expression), points, self.space, self.comm, often=often)

    def written_out(self, form: Any) -> Any:
        """Return a form in state, constants, fields and places alone, with all derivatives carried out."""
        expand = ufl.algorithms.expand_derivatives
        return expand(expand(self._invariants.inserted(form)))

    def boundary_of(self, integral: Any) -> str:
        """Return the name of the boundary that an integral of a form is over."""
        tag = np.ravel(integral.subdomain_id())[0]  # a tuple in newer versions
        return next(name for name, one in self._tags.items() if one == tag)

    @property
    def size_of_value(self) -> int:
        """Number of values that a state has at a point: 3, in the mixed form 4."""
        return 3 if self.p is None else 4

    def on_facets(self, expression: Any, boundary: str, degree: int) -> assembly.FacetValues:
        """Compile an expression for evaluation at the quadrature points of a boundary."""
        inserted = self._invariants.inserted(expression)
        return assembly.FacetValues(inserted, self.facets[boundary], degree, self.space, self.comm)

    def _bilinear(self, form: Any) -> Any:
        return compile.compile_form(self._invariants.inserted(form), self.comm)

    def _works_of_loads(self) -> list[Any]:
        """Forms of the virtual works of the loads, with the sign of the imbalance.

        In load steps the numbers of a load are scaled if it is linear in them, otherwise the whole load; tools move.
        """
        works = []
        for load in self.spec.loads:
            if not load.written:
                works.append(ufl.Form([]))
                continue
            numbers = self._numbers(f"loads.{load.label}")
            if load.contact:
                numbers |= {"depth": self._load * numbers["depth"]}
                work, at = self._out_of_balance(load, numbers), self.place(numbers, load.label)
                rubbing = load.rubbing(at)
                if rubbing is not None:
                    self._rubbing.append((rubbing, load, at))
                    work += rubbing
                self._tools.append((work, load, at))
                works.append(self._touched * work)
                continue
            work = self._out_of_balance(load, {name: self._load * number for name, number in numbers.items()})
            if not _linear(work, numbers.values()):
                self._proportional = False
                work = self._load * self._out_of_balance(load, numbers)
            works.append(work)
        return works

    @property
    def virtual_work_of_energy(self) -> Any:
        """Form of the virtual work of the stresses."""
        return self._variation_of(self._potential) * self.dx

    def is_dead(self, work: Any, paths: Collection[str]) -> bool:
        """Whether the virtual work of a load is a sum of its numbers, each times a force that never changes."""
        if self.unknown in work.coefficients() or any(
            field.inside(one.integrand()) for field in self.fields for one in work.integrals()
        ):
            return False
        return _linear(work, [self._variables[path] for path in paths])

    def place(self, numbers: dict[str, Any], label: str = "") -> Place:
        """Return what a load with these numbers, a tool of this name, is written with."""
        since = None
        if self._before is not None and label in self._shifts:
            u, _ = self.unknowns.split(self._before)
            since = Since(u, self._share, self._shifts[label], self.increments)
        return Place(
            u=self.u,
            v=self.test,
            F=self.spatial[0],
            J=self.spatial[1],
            X=ufl.SpatialCoordinate(self.mesh),
            normal=ufl.FacetNormal(self.mesh),
            dx=self.dx,
            on=self.surface,
            numbers=numbers,
            density=self._factor_of("density"),
            constant=lambda value: spaces.constant(self.mesh, value),
            ops=OPS,
            modulus=lambda: self.spec.contact_modulus,
            bounds=self.spec.body.bounds,
            stiffer=self._stiffer,
            since=since,
            last=tuple(self.unknowns.split(one)[0] for one in self._last) or None,
            left=self._left.get(label, 0.0),
        )

    def tool(self, label: str) -> tuple[Any, Place]:
        """Return a tool among the loads by its label, and what it is written with."""
        (load,) = (load for load in self.spec.loads if load.label == label)
        return load, self.place(self._numbers(f"loads.{label}"), label)

    @cached_property
    def _gaps(self) -> list[tuple[Term, assembly.FacetValues]]:
        """Tools, with their gaps (m) at the quadrature points under them."""
        return [
            (load, self.on_facets(load.touch(at, at.X + at.u).gap, load.on, load.degree))  # type: ignore[attr-defined]
            for _, load, at in self._tools
        ]

    def _out_of_balance(self, load: Term, numbers: dict[str, Any]) -> Any:
        at = self.place(numbers)
        potential = load.potential(at)
        if potential is None:
            return load.virtual_work(at)
        return ufl.algorithms.expand_derivatives(ufl.derivative(potential, self.unknown, self._variation))

    def _imbalance_form(self, change: Callable[[Any], Any | None] = lambda integrand: integrand) -> Any | None:
        """Virtual work of all forces, with each integrand replaced by its `change`; None if all vanish."""
        density = change(self._potential)
        terms = [] if density is None else [self._variation_of(density) * self.dx]
        for integral in (integral for work in self.virtual_works for integral in work.integrals()):
            changed = change(integral.integrand())
            if changed is not None:
                terms.append(ufl.Form([integral.reconstruct(changed)]))
        return sum(terms[1:], terms[0]) if terms else None

    def stiffness_form(self, imbalance: Any) -> Any:
        """Derivative of the imbalance by the state, with tools as they are or without their curvature."""
        trial = ufl.TrialFunction(self.unknowns.whole)
        exact = self.derivative(imbalance, trial)
        along, _ = self.unknowns.split(trial)
        for work, load, at in self._tools:
            exact += (1 - self._curved) * (load.expected(at, along)[0] - self.derivative(work, trial))
        return exact

    @cached_property
    def _weighted_imbalance(self) -> assembly.VectorAssembler:
        form = self._imbalance_form()
        hat = ufl.TestFunction(spaces.scalar_space(self.mesh, 1))
        return self.by_vertices(ufl.replace(form, {self._variation: hat * self._along}))

    @cached_property
    def _stiffness_action(self) -> assembly.VectorAssembler:
        return self.vector(self.derivative(self._imbalance_form(), self._along), often=True)

    @cached_property
    def _transposed_action(self) -> assembly.VectorAssembler:
        if self.symmetric:
            return self._stiffness_action
        return self.vector(self.derivative(ufl.action(self._imbalance_form(), self._along)))

    @cached_property
    def stresses_at_vertices(self) -> assembly.PointValues:
        """P (n_cells, 4 · 9) (Pa) at the vertices of this rank's tetrahedra, at the state that is set."""
        corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        return self.at(self.stress_of(self._potential), corners)

    @cached_property
    def gradients(self) -> assembly.NodalAverages:
        """Deformation gradients (3, 3, n_owned) at the nodes, at the current state."""
        return assembly.NodalAverages(self.spatial[0], (3, 3), self.space, self.comm, often=True)

    @cached_property
    def stresses_at_nodes(self) -> assembly.NodalAverages:
        """Cauchy stresses (Pa) and Green–Lagrange strains (2, 6, n_owned) at the nodes, at the current state.

        σ = P Fᵀ/J and E = (FᵀF − I)/2, components xx, yy, zz, xy, yz, xz.
        """
        cauchy = self._invariants.inserted(self.cauchy_of(self._potential))
        strain = (self.F.T * self.F - ufl.Identity(3)) / 2
        both = ufl.as_vector([tensor[i, j] for tensor in (cauchy, strain) for i, j in SYMMETRIC])
        return assembly.NodalAverages(both, (2, 6), self.space, self.comm)


def _linear(work: Any, numbers: Collection[Any]) -> bool:
    """Whether a form is proportional to all of these numbers, which are variables, together."""
    integrands = [integral.integrand() for integral in work.integrals()]
    zero = {number.expression(): ufl.as_ufl(0.0) for number in numbers}
    slopes = [ufl.algorithms.expand_derivatives(ufl.diff(one, number)) for one in integrands for number in numbers]
    if any(c in zero for slope in slopes for c in ufl.algorithms.analysis.extract_constants(slope)):
        return False
    return all(ufl.replace(ufl.algorithms.strip_variables(one), zero) == 0 for one in integrands)
