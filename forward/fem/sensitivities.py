"""How the equations of a body depend on parameters, and on what the increment before has left: ∂F/∂ω and ∂F/∂past."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np
import ufl

from forward.fem.dolfinx import assembly
from forward.fem.linearisation import Linearisation
from forward.fem.vertex_fields import VertexField
from forward.model import FloatArray


class Sensitivities(Linearisation):
    """Derivatives of the forces by all that is not the state, assembled at the current state and parameters.

    Vectors as of `Linearisation`.
    """

    def along_parameters(self, integrand: Any) -> Any | None:
        """Σ_i (∂ integrand/∂ω_i) dω_i along the direction dω that is set; None if it depends on no parameter."""
        present = set(ufl.algorithms.analysis.extract_constants(integrand * self.dx))
        terms = [
            direction * ufl.diff(integrand, self._variables[path])
            for path, direction in self._directions.items()
            if self.constants[path] in present
        ]
        terms += [field.direction * ufl.diff(integrand, field.log) for field in self.fields if field.inside(integrand)]
        return sum(terms[1:], terms[0]) if terms else None

    @cached_property
    def _parameter_force(self) -> assembly.VectorAssembler | None:
        form = self._imbalance_form(self.along_parameters)
        return None if form is None else self.vector(form, often=True)

    @cached_property
    def _field_forces(self) -> tuple[tuple[VertexField, assembly.VectorAssembler], ...]:
        """The fields on which forces depend, each with ∂(wᵀF)/∂m by its values m at the vertices, with w = `_along`."""
        found = []
        for field in self.fields:

            def by_vertices(integrand: Any, field: VertexField = field) -> Any | None:
                return field.test * ufl.diff(integrand, field.log) if field.inside(integrand) else None

            form = self._imbalance_form(by_vertices)
            if form is not None:
                form = ufl.replace(form, {self._variation: self._along})
                found.append((field, self.by_vertices(form)))
        return tuple(found)

    def unit_directions(self) -> Iterator[str]:
        """Set the direction to each unit vector of the s parameters that are numbers of the model in turn."""
        for field in self.fields:
            field.set_direction(np.zeros(len(self.parameters)))
        for i in self.scalars:
            path = self.parameters[i]
            for other, direction in self._directions.items():
                direction.value = 1.0 if other == path else 0.0
            yield path

    def parameter_forces(self) -> FloatArray:
        """∂F/∂ω (s, U_local) over all unknowns, at the state that is set, by the numbers of the model."""
        forces = np.zeros((len(self.scalars), self.size))
        for i, path in enumerate(self.unit_directions()):
            if path in self._directions and self._parameter_force is not None:
                self.work.residuals += 1
                forces[i] = self._parameter_force()
        if self.items:
            rows = {self.parameters[i]: row for i, row in zip(self.scalars, forces, strict=True)}
            for path, force in self.items.by_number():
                if path in rows:
                    rows[path] += force
        return forces

    def right_sides(self) -> FloatArray:
        """Right-hand sides (s, U_local) of the tangents at the state that is set: K du/dω_i = b_i."""
        right = -self.parameter_forces()
        for i, path in enumerate(self.parameters[j] for j in self.scalars):
            right[i, self.fixed] = 0
            if path in self.movers:
                w = np.zeros(right.shape[1])
                w[self.fixed] = float(self._load.value) * self.movers[path]
                right[i] -= self.stiffness_times(w)
                right[i, self.fixed] = w[self.fixed]
        return right

    def right_sides_along(self, directions: FloatArray) -> FloatArray:
        """Right-hand sides (k, U_local) of the tangents along directions (k, d) of the parameters, at the state set."""
        right = directions[:, self.scalars] @ self.right_sides()
        return right + self.field_right_sides(directions) if self.fields else right

    def field_right_sides(self, directions: FloatArray) -> FloatArray:
        """Right-hand sides (k, U_local) of tangents along the fields' part of directions (k, d), at the state set."""
        right = np.zeros((len(directions), self.size))
        for direction in self._directions.values():
            direction.value = 0.0
        positions = np.concatenate([field.positions for field in self.fields])
        for row, direction in zip(right, directions, strict=True):
            if self._parameter_force is not None and direction[positions].any():
                for field in self.fields:
                    field.set_direction(direction)
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
            products[field.positions] = field.vjp(assemble())
        return products

    def set_before(self, u: FloatArray, share: float, shifts: Mapping[str, FloatArray]) -> None:
        """Set the state (U_local,) at the end of the increment before, and what tools have moved since.

        The load has grown by `share` since, and tools have moved by these shifts (m) besides.
        """
        self.linearisation_point.solution = None
        self.unknowns.give(self._before, u)
        self._share.value = share
        for label, shift in shifts.items():
            self._shifts[label].value = shift

    def derivative_before(self, form: Any) -> assembly.VectorAssembler | None:
        """Derivative of a functional by the state at the end of the increment before; None if it depends on none."""
        if self._before is None or self._before not in form.coefficients():
            return None
        return self.vector(ufl.derivative(form, self._before, self._variation))

    @property
    def _rubbing_work(self) -> Any:
        return sum((work for work, _, _ in self._rubbing[1:]), self._rubbing[0][0])

    @cached_property
    def _rubbing_action(self) -> assembly.VectorAssembler:
        """Derivative of the imbalance by the state before, along `_along`."""
        return self.vector(ufl.derivative(self._rubbing_work, self._before, self._along))

    @cached_property
    def _rubbing_transposed(self) -> assembly.VectorAssembler:
        """Its transpose."""
        return self.vector(ufl.derivative(ufl.action(self._rubbing_work, self._along), self._before, self._variation))

    @property
    def size_before(self) -> int:
        """Number of values on this rank that an increment leaves: its unknowns, and what items keep behind them."""
        return self.size + self.items.kept_size if self.items else self.size

    def rubbed(self, w: FloatArray, *, transpose: bool = True) -> FloatArray:
        """Product of the derivative of the imbalance by what the increment before has left with such a vector.

        Or of its transpose with w (U_local,).
        """
        found = np.zeros(self.size)
        if self._rubbing:
            self.unknowns.give(self._along, w[: self.size])
            self.work.residuals += 1
            found = (self._rubbing_transposed if transpose else self._rubbing_action)()
        if not self.items:
            return found
        if transpose:
            return np.append(found, self.items.to_past(w))
        return found + self.items.from_past(w[self.size :])

    def left(self, states: FloatArray, before: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the changes of what the increment that is set leaves.

        By those of its state (k, U_local), of what the one before has left, and of the parameters (k, d).
        """
        if not self.items:
            return states
        return np.hstack([states, self.items.kept_along(states, before[:, self.size :], directions)])

    def left_adjoint(self, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the transpose of `left` for weights (k, size_before): by state, by what was left before, (k, d)."""
        states, before = weights[:, : self.size], np.zeros_like(weights)
        if not self.items:
            return states, before, np.zeros((len(weights), len(self.parameters)))
        of_states, before[:, self.size :], of_parameters = self.items.kept_adjoint(weights[:, self.size :])
        return states + of_states, before, of_parameters
