"""Functionals shared by several outputs."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from forward.model import FloatArray
from forward.observables.observable import Equations


class Linear:
    """ψ = ⟨g, u⟩ with a fixed g (U_local,)."""

    reduced_as = "linear"

    def __init__(self, equations: Equations, g: FloatArray) -> None:
        self._equations = equations
        self._g = g

    def value(self) -> float:
        """Return ψ."""
        return float(self._equations.dot(self._g, self._equations.state()))

    def gradient(self) -> FloatArray:
        """Return ∂ψ/∂u (U_local,)."""
        return self._g

    def partial(self) -> FloatArray:
        """Return ∂ψ/∂ω (d,)."""
        return np.zeros(len(self._equations.parameters))


class Integral:
    """ψ = 1/size ∫ density(u, ω), over the body or, by its measure, over a boundary."""

    reduced_as = "integral"

    def __init__(self, equations: Equations, density: Any, size: float = 1.0, measure: Any | None = None) -> None:
        self._equations = equations
        self.density = density
        self.size = size
        self.measure = equations.dx if measure is None else measure
        self._value = equations.scalar(density * self.measure)

    def value(self) -> float:
        """Return ψ."""
        return float(self._value() / self.size)

    # Compiled forms live as long as the output that they belong to.
    @cached_property
    def _gradient(self) -> Any:
        return self._equations.vector(self._equations.derivative(self.density * self.measure))

    @cached_property
    def _partial(self) -> Any:
        return self._equations.scalar(self._equations.along_parameters(self.density) * self.measure)

    @cached_property
    def _by_fields(self) -> tuple[tuple[Any, Any], ...]:
        """The random fields on which the density depends, with its derivative by their values at the vertices."""
        import ufl

        equations = self._equations
        return tuple(
            (field, equations.by_vertices(field.test * ufl.diff(self.density, field.log) * self.measure))
            for field in equations.fields
            if field.inside(self.density)
        )

    def gradient(self) -> FloatArray:
        """Return ∂ψ/∂u (U_local,)."""
        return np.asarray(self._gradient()) / self.size

    @cached_property
    def _gradient_before(self) -> Any:
        return self._equations.derivative_before(self.density * self.measure)

    def gradient_before(self) -> FloatArray:
        """Return ∂ψ/∂u by what the increment before has left: of that, by the state at its end."""
        found = np.zeros(self._equations.size_before)
        if self._gradient_before is not None:
            found[: self._equations.size] = np.asarray(self._gradient_before()) / self.size
        return found

    def partial(self) -> FloatArray:
        """Return ∂ψ/∂ω (d,)."""
        equations = self._equations
        slopes = np.zeros(len(equations.parameters))
        if equations.along_parameters(self.density) is None:
            return slopes
        if len(equations.scalars):
            slopes[equations.scalars] = [self._partial() for _ in equations.unit_directions()]
        for field, assemble in self._by_fields:
            slopes[field.positions] = field.vjp(assemble())
        return slopes / self.size


class AsIntegral:
    """ψ whose derivatives are those of an integral, which depends on the state that is set."""

    def _here(self) -> Integral:
        """Return the integral."""
        raise NotImplementedError

    def gradient(self) -> FloatArray:
        """Return ∂ψ/∂u (U_local,)."""
        return self._here().gradient()

    def partial(self) -> FloatArray:
        """Return ∂ψ/∂ω (d,)."""
        return self._here().partial()
