"""Weight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Unit

from forward.bodies.geometry import Direction, unit_vector
from forward.terms.term import Place, Term
from forward.words import listed


class Gravity(Term):
    """Weight of the body: density (kg/m³) × acceleration (m/s²) along `direction`."""

    of_density: ClassVar[bool] = True
    direction: Direction = (0.0, 0.0, -1.0)
    kind: Literal["gravity"] = "gravity"
    density: Annotated[float, Ge(0), Unit("kg/m³")]
    acceleration: Annotated[float, Ge(0)] = 9.81

    def potential(self, at: Place) -> Any:
        """Potential −∫ ρ g·u dX."""
        import ufl

        pull = at.constant(self.acceleration * np.array(unit_vector(self.direction)))
        return -at.numbers["density"] * at.density * ufl.dot(pull, at.u) * at.dx

    def words(self, numbers: Mapping[str, str]) -> str:
        """Describe it for reports."""
        return f"gravity: density {numbers['density']} × {self.acceleration:g} m/s² along {listed(self.direction)}"
