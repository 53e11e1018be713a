"""Dead forces on a boundary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from annotated_types import Unit

from forward.bodies.geometry import Direction, unit_vector
from forward.terms.term import Place, Term
from forward.words import listed


class Traction(Term):
    """Dead traction of `size` (Pa, per undeformed area) along `direction` on a boundary."""

    direction: Direction
    kind: Literal["traction"] = "traction"
    on: str
    size: Annotated[float, Unit("Pa")]

    def potential(self, at: Place) -> Any:
        """Potential −∫ t·u dS."""
        import ufl

        return -at.numbers["size"] * ufl.dot(at.constant(unit_vector(self.direction)), at.u) * at.on(self.on)

    def words(self, numbers: Mapping[str, str]) -> str:
        """Say what it is, for reports."""
        return f"traction on {self.on}: {numbers['size']} along {listed(self.direction)}"
