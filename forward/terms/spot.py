"""A dead force spread over a spot of a boundary, whose place is a number: a tool that moves over a surface."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from annotated_types import Gt, Unit

from forward.bodies.geometry import Body, Direction, unit_vector
from forward.findings import Finding
from forward.readable import told
from forward.terms.term import Place, Term
from forward.words import listed


class Spot(Term):
    """Dead force of `size` (N) along `direction`, spread over a boundary around the place `x`, `y`, `z` (m).

    Its density per undeformed area falls with the distance as exp(−r²/(2 width²)) and has the integral `size` over a
    plane; where the spot reaches over an edge of the boundary, that part is lost.
    """

    direction: Direction
    kind: Literal["spot"] = "spot"
    on: str
    size: Annotated[float, Unit("N")]
    x: Annotated[float, Unit("m")]
    y: Annotated[float, Unit("m")]
    z: Annotated[float, Unit("m")]
    width: Annotated[float, Gt(0), Unit("m")]

    def potential(self, at: Place) -> Any:
        """Potential −∫ t·u dS."""
        import ufl

        place = ufl.as_vector([at.numbers[name] for name in "xyz"])
        away, width = at.X - place, at.numbers["width"]
        density = at.numbers["size"] * ufl.exp(-ufl.dot(away, away) / (2 * width**2)) / (2 * math.pi * width**2)
        return -density * ufl.dot(at.constant(unit_vector(self.direction)), at.u) * at.on(self.on)

    def findings(self, body: Body) -> Iterator[Finding]:
        """Say where the spot is too small for the mesh."""
        edge = body.longest_edge / body.degree
        if self.width < edge / 2:
            wide, apart = told(self.width, "m", 6), told(edge, "m", 3)
            yield Finding("spot-narrow", "warning", {"label": self.label, "wide": wide, "apart": apart})

    def words(self, numbers: Mapping[str, str]) -> str:
        """Say what it is, for reports."""
        place = ", ".join(numbers[name] for name in "xyz")
        force = f"{numbers['size']} along {listed(self.direction)}"
        return f"spot on {self.on}: {force}, within {numbers['width']} of ({place})"
