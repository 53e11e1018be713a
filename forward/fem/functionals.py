"""Evaluation of the outputs of a finite-element solution, with their derivatives.

Each functional has a value ψ(u, ω), its gradient ∂ψ/∂u over all unknowns (in the mixed form, pressures too), and its
explicit partial derivative ∂ψ/∂ω. They read the state and the parameters that the discretisation is currently set to.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Protocol, assert_never

import numpy as np
import ufl

from forward.bodies.geometry import AXES, tolerance
from forward.bodies.mesh_file import OwnMesh
from forward.fem import ranks
from forward.fem.dolfinx import assembly, spaces
from forward.materials import kinematics
from forward.model import FloatArray, ModelError
from forward.observables.outputs import (
    MaxDisplacement,
    MaxVonMises,
    MeanDisplacement,
    Output,
    PointDisplacement,
    Reaction,
    StrainEnergy,
    VolumeChange,
)

if TYPE_CHECKING:
    from forward.fem.equations import Discretisation
    from forward.fem.vertex_fields import VertexField


class Functional(Protocol):
    """An output ψ(u, ω) of a discretised body; every method is collective over its ranks."""

    def value(self) -> float:
        """Return ψ, the same on every rank."""

    def gradient(self) -> FloatArray:
        """Return this rank's part (U_local,) of ∂ψ/∂u, over free and prescribed unknowns."""

    def partial(self) -> FloatArray:
        """Return the explicit derivative ∂ψ/∂ω (d,)."""


def functional(output: Output, body: Discretisation) -> Functional:
    """Prepare the evaluation of an output."""
    match output:
        case MaxDisplacement():
            return _Extreme(body, None if output.component == "magnitude" else AXES.index(output.component))
        case PointDisplacement():
            return _at_point(body, output)
        case MeanDisplacement():
            return _mean_over_boundary(body, output)
        case Reaction():
            return _Reaction(body, output)
        case StrainEnergy():
            return _Integral(body, body.stored_energy, 1.0)
        case VolumeChange():
            return _Integral(body, body.dilation, _volume(body))
        case MaxVonMises():
            return _MaxVonMises(body)
        case _:
            assert_never(output)


class _Linear:
    """ψ = ⟨g, u⟩ with a fixed g (U_local,)."""

    def __init__(self, body: Discretisation, g: FloatArray) -> None:
        self._body = body
        self._g = g

    def value(self) -> float:
        return self._body.dot(self._g, self._body.state())

    def gradient(self) -> FloatArray:
        return self._g

    def partial(self) -> FloatArray:
        return np.zeros(len(self._body.parameters))


def _at_point(body: Discretisation, output: PointDisplacement) -> _Linear:
    (found,), (distance,) = spaces.point_weights(body.space, np.array([output.at]))
    spec = body.spec.body
    # Points beside bodies with six sides were refused before; the mesh may cut their curved faces.
    most = tolerance(spec) if isinstance(spec, OwnMesh) else max(tolerance(spec), spec.longest_edge)
    if distance > most:
        where = ", ".join(f"{x:g}" for x in output.at)
        message = (
            f"output '{output.name}': the point ({where}) lies {distance:.3g} m outside the body, "
            f"expected at most {most:.3g} m"
        )
        raise ModelError(message)
    probe = spaces.function(body.space)
    if found is not None:
        nodes, weights = found
        probe.x.array[3 * nodes + AXES.index(output.component)] = weights
    # Weights of ghost nodes travel to the ranks that own them.
    return _Linear(body, body.with_pressures(spaces.sum_ghosts(probe)))


def _mean_over_boundary(body: Discretisation, output: MeanDisplacement) -> _Linear:
    axis = spaces.constant(body.mesh, np.eye(3)[AXES.index(output.component)])
    surface = body.surface(output.on)
    weights = body.vector(ufl.inner(axis, body.test) * surface)()
    area = body.dot(weights, np.ones_like(weights))
    return _Linear(body, weights / area)


def _volume(body: Discretisation) -> float:
    """Volume of the undeformed mesh, which is not that of the body where linear tetrahedra cut its faces."""
    return body.scalar(spaces.constant(body.mesh, 1.0) * body.dx)()


class _Extreme:
    """ψ = max over the nodes of |u_c|, or of |u|; of nodes that tie, the first in the canonical order counts."""

    def __init__(self, body: Discretisation, axis: int | None) -> None:
        self._body = body
        self._axis = axis

    def _candidates(self) -> FloatArray:
        u = self._body.displacements()
        return np.asarray(np.linalg.norm(u, axis=1) if self._axis is None else np.abs(u[:, self._axis]))

    def value(self) -> float:
        return -ranks.smallest(self._body.comm, -self._candidates().max(initial=0.0))

    def gradient(self) -> FloatArray:
        candidates, top = self._candidates(), self.value()
        ties = np.flatnonzero(candidates >= top * (1 - 1e-10))
        position = self._body.layout.positions[ties]
        first = ranks.smallest(self._body.comm, float(position.min(initial=np.iinfo(np.int64).max)))
        g = np.zeros((len(candidates), 3))
        if top > 0:
            for node in ties[position == first]:
                u = self._body.displacements()[node]
                if self._axis is None:
                    g[node] = u / np.linalg.norm(u)
                else:
                    g[node, self._axis] = np.sign(u[self._axis])
        return self._body.with_pressures(g.ravel())

    def partial(self) -> FloatArray:
        return np.zeros(len(self._body.parameters))


class _Integral:
    """ψ = 1/size ∫ density(u, ω) dX."""

    def __init__(self, body: Discretisation, density: object, size: float) -> None:
        self._body = body
        self._density = density
        self.size = size
        self._value = body.scalar(density * body.dx)

    def value(self) -> float:
        return self._value() / self.size

    # What is compiled lives as long as the output that it belongs to.
    @cached_property
    def _gradient(self) -> assembly.VectorAssembler:
        return self._body.vector(self._body.derivative(self._density * self._body.dx))

    @cached_property
    def _partial(self) -> assembly.ScalarAssembler:
        return self._body.scalar(self._body.along_parameters(self._density) * self._body.dx)

    @cached_property
    def _by_fields(self) -> tuple[tuple[VertexField, assembly.VectorAssembler], ...]:
        """The random fields that the density depends on, with its derivative by their values at the vertices."""
        body = self._body
        return tuple(
            (
                field,
                body.by_vertices(field.test * ufl.diff(self._density, field.log) * body.dx),
            )
            for field in body.fields
            if field.inside(self._density)
        )

    def gradient(self) -> FloatArray:
        return np.asarray(self._gradient()) / self.size

    def partial(self) -> FloatArray:
        body = self._body
        slopes = np.zeros(len(body.parameters))
        if body.along_parameters(self._density) is None:
            return slopes
        if len(body.scalars):
            slopes[body.scalars] = [self._partial() for _ in body.unit_directions()]
        for field, assemble in self._by_fields:
            slopes[field.positions] = field.pull(assemble())
        return slopes / self.size


class _Reaction:
    """ψ = wᵀ r(u, ω), with r the imbalance of all unknowns and w = 1 on a component of a boundary's nodes."""

    def __init__(self, body: Discretisation, output: Reaction) -> None:
        self._body = body
        nodes = spaces.boundary_nodes(body.space, body.facets[output.on])
        owned = nodes[nodes < body.nodes_owned]
        self._w = np.zeros(body.size)
        self._w[3 * owned + AXES.index(output.component)] = 1

    def value(self) -> float:
        return self._body.dot(self._w, self._body.imbalance())

    def gradient(self) -> FloatArray:
        return self._body.stiffness_times(self._w, transpose=True)

    def partial(self) -> FloatArray:
        body = self._body
        slopes = body.field_products(self._w)
        slopes[body.scalars] = [body.dot(self._w, force) for force in body.parameter_forces()]
        return slopes


class _MaxVonMises:
    """ψ = max of the von Mises stress over the quadrature points; of points that tie, the first of the lowest rank.

    The stress at one point is written as the integral ∫ w σ dX / ∫ w dX with w = 1 at that point and 0 at the others,
    so that its derivatives are those of an integral.
    """

    def __init__(self, body: Discretisation) -> None:
        self._body = body
        # A pressure has no deviator: in the mixed form the energy of the change of shape is all that is needed.
        cauchy = body.stress_of(body.energy) * body.F.T / body.J
        stress = kinematics.von_mises(ufl, cauchy, ufl.Identity(3))
        degree = body.spec.body.quadrature
        self._values = body.at_points(stress)
        self._selector = spaces.function(spaces.quadrature_space(body.mesh, degree))
        self._stress = stress

    def value(self) -> float:
        return -ranks.smallest(self._body.comm, -self._values().max(initial=0.0))

    def _at_place(self) -> _Integral:
        """Return the stress at the point where it is largest now."""
        body = self._body
        here = np.argwhere(self._values() >= self.value())
        holders = body.comm.allgather(len(here) > 0)
        self._selector.x.array[:] = 0
        if holders.index(True) == body.comm.rank:
            cell, point = here[0]
            self._selector.x.array[self._selector.function_space.dofmap.cell_dofs(cell)[point]] = 1
        self._selector.x.scatter_forward()
        self._selected.size = self._weight()
        return self._selected

    @cached_property
    def _selected(self) -> _Integral:
        return _Integral(self._body, self._selector * self._stress, 1.0)

    @cached_property
    def _weight(self) -> assembly.ScalarAssembler:
        return self._body.scalar(self._selector * self._body.dx)

    def gradient(self) -> FloatArray:
        return self._at_place().gradient()

    def partial(self) -> FloatArray:
        return self._at_place().partial()
