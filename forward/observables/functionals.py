"""Functionals that several outputs are made of; they import UFL, so outputs import them when they are evaluated."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import ufl

from forward.model import FloatArray
from forward.observables.observable import DiscreteBody


class Linear:
    """ψ = ⟨g, u⟩ with a fixed g (U_local,)."""

    def __init__(self, body: DiscreteBody, g: FloatArray) -> None:
        self._body = body
        self._g = g

    def value(self) -> float:
        """Return ψ."""
        return self._body.dot(self._g, self._body.state())

    def gradient(self) -> FloatArray:
        """Return ∂ψ/∂u (U_local,)."""
        return self._g

    def partial(self) -> FloatArray:
        """Return ∂ψ/∂ω (d,)."""
        return np.zeros(len(self._body.parameters))


class Integral:
    """ψ = 1/size ∫ density(u, ω), over the body or, by its measure, over a boundary."""

    def __init__(self, body: DiscreteBody, density: Any, size: float = 1.0, measure: Any | None = None) -> None:
        self._body = body
        self._density = density
        self.size = size
        self._measure = body.dx if measure is None else measure
        self._value = body.scalar(density * self._measure)

    def value(self) -> float:
        """Return ψ."""
        return float(self._value() / self.size)

    # What is compiled lives as long as the output that it belongs to.
    @cached_property
    def _gradient(self) -> Any:
        return self._body.vector(self._body.derivative(self._density * self._measure))

    @cached_property
    def _partial(self) -> Any:
        return self._body.scalar(self._body.along_parameters(self._density) * self._measure)

    @cached_property
    def _by_fields(self) -> tuple[tuple[Any, Any], ...]:
        """The random fields that the density depends on, with its derivative by their values at the vertices."""
        body = self._body
        return tuple(
            (
                field,
                body.by_vertices(field.test * ufl.diff(self._density, field.log) * self._measure),
            )
            for field in body.fields
            if field.inside(self._density)
        )

    def gradient(self) -> FloatArray:
        """Return ∂ψ/∂u (U_local,)."""
        return np.asarray(self._gradient()) / self.size

    def partial(self) -> FloatArray:
        """Return ∂ψ/∂ω (d,)."""
        body = self._body
        slopes = np.zeros(len(body.parameters))
        if body.along_parameters(self._density) is None:
            return slopes
        if len(body.scalars):
            slopes[body.scalars] = [self._partial() for _ in body.unit_directions()]
        for field, assemble in self._by_fields:
            slopes[field.positions] = field.pull(assemble())
        return slopes / self.size
