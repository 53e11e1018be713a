"""Pressure that follows the surface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from annotated_types import Unit

from forward.terms.term import Place, Term


class Pressure(Term):
    """Pressure of `size` (Pa) on a boundary, normal to the *deformed* surface and pushing inwards."""

    kind: Literal["pressure"] = "pressure"
    on: str
    size: Annotated[float, Unit("Pa")]

    def virtual_work(self, at: Place) -> Any:
        """Virtual work ∫ p n·v ds, with Nanson's formula: the deformed area element n ds is J F⁻ᵀ N dS."""
        import ufl

        normal = ufl.dot(at.J * ufl.inv(at.F).T, at.normal)
        return at.numbers["size"] * ufl.dot(normal, at.v) * at.on(self.on)

    def words(self, numbers: Mapping[str, str]) -> str:
        """Describe it for reports."""
        return f"pressure on {self.on}: {numbers['size']}"
