"""Discrete equations of a hyperelastic body: F(u, ω) = 0, its stiffness K = ∂F/∂u and ∂F/∂ω.

F = ∂Π/∂u (plus follower pressures) on the free unknowns and u = target on the prescribed ones.

Displacement form: Π = ∫ W dX − loads. Mixed form: u holds displacements and then pressures p (tension is positive), and
Π = ∫ W_iso + p g(J) − p²/(2κ) dX − loads, the perturbed Lagrangian of W = W_iso + κ/2 g(J)². There g is J−1, or what a
stated volumetric part makes it, and then p g'(J) is the pressure. K is symmetric and indefinite. Forces (N) and volumes
(m³), metres and pascals share vectors, so norms are of one kind only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.fem import ranks
from forward.fem.dolfinx import spaces
from forward.fem.forms import Forms
from forward.fem.sensitivities import Sensitivities
from forward.fem.vertex_fields import PressuresAtVertices
from forward.loaded import LoadedBody
from forward.materials.admissible import moduli
from forward.materials.material import constants
from forward.model import FloatArray, SolveError, Work
from forward.solvers.rotations import rotations
from forward.solvers.system import Residual

NUDGE = 1e-6  # of the extent of the body, for products with the stiffness by differences
STRETCH = 1e-6  # of the body, to see how stiff it is
KEPT = 64  # sizes of loads
VOLUME_ROUNDING = 1e-12  # ‖∫q (J−1 − p/κ) dX‖/‖∫q dX‖ that counts as rounding, over displacements relative to the body


class Discretisation(Sensitivities):
    """The discrete equations of a body, set to one state and one parameter vector at a time.

    It is the `System` on which Newton's method works. Meshes, compiled forms and solver objects are made once.
    """

    _deadline: tuple[float, float] | None = None  # when the time of a solve ends, and its length
    _deformed: tuple[FloatArray, FloatArray] | None = None  # a state, and the deformation gradients there

    def __init__(self, spec: LoadedBody, comm: Any, parameters: tuple[str, ...], beside: Forms | None = None) -> None:
        super().__init__(spec, comm, parameters, beside)
        self._jacobians = self.at_points(self.spatial[1], often=True)
        self._external = 0.0
        self._full_targets = np.zeros(len(self.fixed))
        self._sizes: dict[tuple[float, ...], float] = {}
        self._nudge = NUDGE * float(np.ptp(np.array(spec.body.vertices), axis=0).max())

    def set_parameters(self, parameters: FloatArray, stiffer: float = 1.0) -> None:
        """Set the values (d,) of the parameters, and a factor on the stiffness of tools."""
        self.linearisation_point.rounding = None
        if float(self._stiffer.value) != stiffer:
            self._stiffer.value = stiffer
            self.linearisation_point.solution = None
        before = self.linearisation_point.parameters
        if before is not None and (parameters == before).all():
            return
        self.linearisation_point.parameters = np.array(parameters, dtype=float)
        self.linearisation_point.solution = None
        for i, path, place in self._settable:  # the other numbers stay
            self._values[path] = value = float(parameters[i])
            if place is not None:
                place[()] = value
        targets = (self._values[path] * mover for path, mover in self.movers.items())
        self._full_targets = sum(targets, np.zeros(len(self.fixed)))
        self._moves = any(self._values[path] != 0 for path in self.movers)
        self._external = self._size_of_loads()
        for field in self.fields:  # the size of the loads is their size without random fluctuations
            field.set(parameters)

    @cached_property
    def _settable(self) -> tuple[tuple[int, str, FloatArray | None], ...]:
        """Position and path of each parameter that is a number, and the constant's own memory in compiled forms.

        In lockstep they are set at every step of a sample, which by DOLFINx's own way takes 5 to 18 % of its time.
        """
        paths = ((int(i), self.parameters[i]) for i in self.scalars)
        return tuple((i, path, self.constants[path].value if path in self.constants else None) for i, path in paths)

    def _size_of_loads(self) -> float:
        """Norm (N) of the complete loads on the undeformed body, without tools and items.

        That of the last points is kept: many points at once are set again and again.
        """
        key = tuple(self._values.values())
        if key not in self._sizes:
            external = np.zeros(self.size) if self._proportional else self._forces_at_rest()
            # A load that is not finite has no finite residual, which the solver reports.
            with np.errstate(invalid="ignore"):
                for path, force in self._unit_loads.items() if self._proportional else ():
                    external += self._values.get(path, 1.0) * force
            if len(self._sizes) >= KEPT:
                self._sizes.pop(next(iter(self._sizes)))
            self._sizes[key] = self.norm(external)
        return self._sizes[key]

    def _forces_at_rest(self) -> FloatArray:
        """Forces (U_local,) on the undeformed body due to the complete loads, without tools and items."""
        kept = self._load.value.copy()
        self._load.value, self._touched.value = 1.0, 0.0
        self.set_state(np.zeros(self.size))
        self.work.residuals += 1
        forces = self._residual()
        forces[self.fixed] = 0
        self._load.value, self._touched.value = kept, 1.0
        return forces

    @property
    def contact(self) -> bool:
        """Whether tools touch the body."""
        return bool(self._tools)

    def number(self, path: str) -> float:
        """The value of a number of the model that is set."""
        return self._values[path]

    def penetrations(self) -> dict[str, float]:
        """How deep (m) the body enters each tool, by their labels, at the state that is set."""
        return {load.label: -ranks.smallest(self.comm, float(gaps().min(initial=0.0))) for load, gaps in self._gaps}

    def stressed(self) -> FloatArray | None:
        """Cauchy stresses (Pa) and Green–Lagrange strains (2, N, 6) at all nodes in canonical order; collective.

        On the first rank only. Components xx, yy, zz, xy, yz, xz; averages over the cells that meet at a node.
        """
        rows = np.zeros((4, self.size))  # as parts of states, which have three numbers at a node
        found = self.stresses_at_nodes().reshape(4, 3, -1)
        rows[:, : found[0].size] = np.moveaxis(found, 1, 2).reshape(4, -1)
        whole = self.layout.gather(rows)
        if whole is None:
            return None
        parts = whole[:, : self.layout.coordinates.size].reshape(2, 2, -1, 3)
        return np.asarray(np.concatenate([parts[:, 0], parts[:, 1]], axis=2))

    def touched(self) -> dict[str, FloatArray]:
        """Undeformed places (m) and pressures (Pa), (n, 4), at the vertices of the boundary of each tool; collective.

        Those of all ranks, on every rank.
        """
        found = {}
        places = spaces.node_coordinates(spaces.scalar_space(self.mesh, 1))
        for load in (load for load in self.spec.loads if load.contact):
            pressures = PressuresAtVertices(self, load.label)
            rows = np.column_stack([places, pressures()])[pressures.areas > 0]
            found[load.label] = np.concatenate(self.comm.allgather(rows))
        return found

    @cached_property
    def _contact_forces(self) -> Callable[[], FloatArray] | None:
        """Forces (U_local,) of all tools, at the state that is set; None without tools."""
        works = [work for work, _, _ in self._tools]
        return self.vector(sum(works[1:], works[0])) if works else None

    @cached_property
    def _unit_loads(self) -> dict[str, FloatArray]:
        """Forces (U_local,) on the undeformed body: those of each load of size one, and ("") those without a size.

        All energies are free of stress there.
        """
        tools = tuple(f"loads.{load.label}." for load in self.spec.loads if load.contact)
        paths = [path for path in self.constants if path.startswith("loads.") and not path.startswith(tools)]
        forces: dict[str, FloatArray] = {}
        work, self.work = self.work, Work()  # the first solution is charged no more than the others
        for path in ("", *paths):
            for other in paths:
                self.constants[other].value = float(other == path)
            forces[path] = self._forces_at_rest() - forces.get("", 0.0)
            if path == "" and self.norm(forces[path]) <= self.rounding(np.zeros(self.size), 0.0):
                forces[path][:] = 0
        for path in paths:
            self.constants[path].value = self._values[path]
        self.work = work
        return forces

    def in_words(self, fraction: float) -> str:
        """Say what a fraction of the load is in which tools move: how far they have; empty without them."""
        tools = [(load.label, self.number(f"loads.{load.label}.depth")) for load in self.spec.loads if load.contact]
        moved = [f"tool '{name}' at {1e3 * fraction * deep:.4g} of {1e3 * deep:.4g} mm" for name, deep in tools if deep]
        return f" ({', '.join(moved)})" if moved else ""

    @cached_property
    def pushing(self) -> NDArray[np.bool_]:
        """Which parameters (d,) are sizes of loads or prescribed displacements: without them, the body rests."""
        return np.array([path.startswith(("loads.", "displacements.")) for path in self.parameters], dtype=bool)

    def at_load(self, fraction: float) -> None:
        """Scale all loads and prescribed displacements."""
        self.linearisation_point.solution = None
        self._load.value = fraction
        self._targets = fraction * self._full_targets

    def set_to(self, parameters: FloatArray, state: FloatArray, stiffer: float = 1.0) -> None:
        """Set parameters (d,), all of the load, and a state (U_local,); the factor as of `set_parameters`."""
        self.set_parameters(parameters, stiffer)
        self.at_load(1.0)
        self.set_state(state)

    def on_target(self, u: FloatArray) -> FloatArray:
        """Return u (U_local,) with the prescribed unknowns at their targets."""
        v = np.array(u)
        v[self.fixed] = self._targets
        return v

    def _imbalance(self, u: FloatArray) -> FloatArray:
        self.set_state(u)
        self.work.residuals += 1
        return self.imbalance()

    def imbalance(self) -> FloatArray:
        """Imbalance (U_local,) at the current state; on prescribed unknowns, the reactions."""
        return self._residual() + self.items.forces() if self.items else self._residual()

    def residual(self, u: FloatArray) -> Residual:
        """Return the imbalance at u (U_local,).

        Raises
        ------
        SolveError
            If `time_limit` has passed.
        """
        if self._deadline is not None:
            end, seconds = self._deadline
            if ranks.smallest(self.comm, end - time.monotonic()) < 0:  # all ranks agree
                raise SolveError(f"the solve took longer than solve_seconds = {seconds:g}", work=self.work)
        r = self._imbalance(u)
        reactions = r[self.fixed]
        gap = u[self.fixed] - self._targets
        r[self.fixed] = 0
        forces, volumes = r[: 3 * self.nodes_owned], r[3 * self.nodes_owned :]
        squares = [forces @ forces, reactions @ reactions, gap @ gap, volumes @ volumes]
        free, fixed, apart, lacking = np.sqrt(self.total(np.array(squares))).tolist()
        r[self.fixed] = gap
        scale = self.load * self._external
        if self._moves:
            scale = max(scale, fixed)
        if self._contact_forces is not None:
            scale = max(scale, self.norm(self._contact_forces()))
        if self.items:
            scale = max(scale, self.norm(self.items.forces()))
        volume = 0.0  # if it is rounding, too
        if self.p is not None:
            rounding = VOLUME_ROUNDING * min(1.0, self.norm(u) / self._extent) * self._volumes[0]
            volume = 0.0 if lacking <= rounding else lacking * self._force_per_volume()
        return Residual(r, free, scale, apart, volume)

    @contextmanager
    def time_limit(self, seconds: float | None) -> Iterator[None]:
        """In this context, residuals are refused after so many seconds."""
        self._deadline = None if seconds is None else (time.monotonic() + seconds, seconds)
        try:
            yield
        finally:
            self._deadline = None

    def curvature(self, move: FloatArray, change: FloatArray) -> float:
        """Second difference of the energy along a move (U_local,), from the change of the imbalance.

        The energy has a saddle in displacements and pressures, so the pressures count with the opposite sign.
        """
        n = 3 * self.nodes_owned
        return float(self.total(np.array([move[:n] @ change[:n] - move[n:] @ change[n:]]))[0])

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest J over the quadrature points of all ranks."""
        self.set_state(u)
        return ranks.smallest(self.comm, float(self._jacobians().min(initial=np.inf)))

    @cached_property
    def _planes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Nodes and axes along which planes hold them, apart from nodes that are held along all axes.

        Where a plane holds them across its normal only, they are stretched along that axis by nothing.
        """
        nodes, axes = np.divmod(self.fixed, 3)
        held = np.bincount(nodes, minlength=self.nodes_owned)[nodes] < 3
        return nodes[held], axes[held]

    def gradients_at(self, u: FloatArray) -> FloatArray:
        """Deformation gradients (3, 3, n_owned) at the nodes of a state u (U_local,), which nobody changes in place.

        Those of the last state are remembered; the state that is set is u only where they were not.
        """
        if self._deformed is None or self._deformed[0] is not u:
            self.set_state(u)
            self._deformed = (u, self.gradients())
        return self._deformed[1]

    def crossed(self, u: FloatArray) -> bool:
        """Whether n·Fn ≤ 0 at a node that is held along an axis n."""
        nodes, axes = self._planes
        if ranks.smallest(self.comm, -float(len(nodes))) == 0:
            return False
        return not ranks.smallest(self.comm, float(self.gradients_at(u)[axes, axes, nodes].min(initial=np.inf))) > 0

    def rotations(self, u: FloatArray) -> FloatArray:
        """Rotations (3, 3, n_owned) of the nodes from rest to a state u (U_local,)."""
        return rotations(self.gradients_at(u))

    def angle(self, R: FloatArray, Q: FloatArray) -> float:
        """Largest angle (rad) between rotations (3, 3, n_owned) of the nodes of all ranks."""
        trace = ranks.smallest(self.comm, float(np.einsum("abn,abn->n", R, Q).min(initial=3.0)))
        return float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)))

    def has_factor(self, u: FloatArray) -> bool:
        """Whether the factor at hand is that of the stiffness at this very array u."""
        return self.linearisation_point.factorised_at is u

    def stiffness_near(self, u: FloatArray, imbalance: FloatArray, rows: FloatArray) -> FloatArray:
        """Products (k, U_local) of the stiffness of the free unknowns at u (U_local,) with rows, to a few digits.

        They are differences from the `imbalance` at u (that of a `Residual`).
        """
        products = np.empty_like(rows)
        for i, row in enumerate(rows):
            moved = row[: 3 * self.nodes_owned]
            size = -ranks.smallest(self.comm, min(float(moved.min(initial=0.0)), -float(moved.max(initial=0.0))))
            step = self._nudge / max(size, float(np.finfo(float).tiny))
            np.subtract(self._imbalance(u + step * row), imbalance, out=products[i])
            products[i] /= step
        products[:, self.fixed] = 0
        return products

    def weights(self) -> FloatArray:
        """Weights that turn an imbalance (U_local,) into forces (N): one on displacements."""
        weights = np.ones(self.size)
        if self.p is not None:
            weights[3 * self.nodes_owned :] = self._force_per_volume()
        return weights

    def rounding(self, u: FloatArray, scale: float) -> float:
        """Size below which a residual with this scale (N) cannot be expected to fall at u (U_local,).

        Measures keep their digits however small u is, so the rounding error is that due to the last digits of u:
        ‖F(u (1 ± ε)) − F(u)‖, limited so that four digits of the loads remain. A body without loads has no such scale;
        there, stresses of the size of the stiffness are rounded: a few ε ‖F(δX)‖/δ, where δX is a small stretch (more
        of them if it is along one axis only).
        """
        if scale == 0:
            point = self.linearisation_point
            if point.rounding is None:
                load = self._load.value.copy()
                self._load.value = 0.0
                few = 4 if self.p is None else 16
                point.rounding = few * float(np.finfo(float).eps) * self.norm(self._imbalance(self._stretch)) / STRETCH
                self._load.value = load
            return point.rounding
        last_digits = np.where(np.arange(self.size) % 2 == 0, 1.0, -1.0) * np.finfo(float).eps
        change = self._imbalance(u * (1 + last_digits)) - self._imbalance(u)
        change[self.fixed] = 0
        left = 2 * self.norm(change)
        # A body that moves as a rigid body has no forces except from rounding.
        return min(left, 1e-4 * scale) if self._external > 0 else left

    @cached_property
    def _stretch(self) -> FloatArray:
        """Stretch the body a little; in the mixed form only along x, since without pressure nothing else resists."""
        places = STRETCH * spaces.node_coordinates(self.space)
        if self.p is not None:
            places[:, 1:] = 0
        return self.with_pressures(places.ravel())

    @cached_property
    def _extent(self) -> float:
        """Norm of the distances (m) of the nodes from their mean, with which displacements are compared."""
        places = spaces.node_coordinates(self.space)
        count, *sums = self.total(np.array([len(places), *places.sum(axis=0)])).tolist()
        return self.norm(self.with_pressures((places - np.array(sums) / count).ravel()))

    @cached_property
    def _volumes(self) -> tuple[float, float]:
        """Norm of the volumes ∫q dX (m³) of the test functions q of all pressures; edge (m) of a cube as their mean."""
        kept = self.state()
        self.set_state(self._stretch)
        volumes = self._residual()[3 * self.nodes_owned :] / STRETCH
        self.set_state(kept)
        mean = self.total(np.array([volumes.sum()]))[0] / self.unknowns.pressures
        return float(np.sqrt(self.dot(volumes, volumes))), float(mean ** (1 / 3))

    def _force_per_volume(self) -> float:
        """Factor that turns residual volumes v (m³) into forces (N): κ v/h³ is the pressure that they cause.

        It acts on an area h². If the whole boundary is held, the pressure is off by this much; otherwise by less.
        """
        values = {name: self._values[f"material.{name}"] for name in constants(self.spec.energy)}
        _, edge = self._volumes
        return float(moduli(self.spec.energy, values)[1] / edge)
