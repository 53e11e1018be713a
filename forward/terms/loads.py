"""Loads: weight, dead forces on boundaries, and pressures that follow them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Unit

from forward.bodies.geometry import Body, Direction, unit_vector
from forward.bodies.mesh import fan
from forward.bodies.surface import facets
from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import listed, told
from forward.terms.term import Place, Term

WHOLE = 0.9  # share of a spot on its boundary, from which on nothing is said
FINE, MOST = 4, 12  # parts of edges of triangles, over which a spot is integrated: over its width, and at most


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
        return f"gravity: density {numbers['density']} × {self.acceleration:g} m/s² along {listed(self.direction)}"


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
        return f"traction on {self.on}: {numbers['size']} along {listed(self.direction)}"


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
        return f"pressure on {self.on}: {numbers['size']}"


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
        """Say where the spot is too small for the mesh, or beyond the boundary."""
        edge = body.longest_edge / body.degree
        if self.width < edge / 2:
            wide, apart = told(self.width, "m", 6), told(edge, "m", 3)
            yield Finding("spot-narrow", "warning", {"label": self.label, "wide": wide, "apart": apart})
        yield from self.findings_over(body, {})

    def findings_over(self, body: Body, ranges: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
        """Say how much of the force is lost, at most, at the ends of ranges."""
        triangles = fan(facets(body, self.on))
        sides = triangles[:, 1:] - triangles[:, :1]
        finest = FINE * np.sqrt((sides**2).sum(axis=-1).max()) / min(ranges.get("width", (self.width,)))
        centres = _centres(int(np.clip(np.ceil(finest), 1, MOST)))
        points = np.einsum("qk,nka->nqa", centres, triangles).reshape(-1, 3)
        areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
        least, at = 1.0, ""
        for numbers, where in self.at_ends({name: ends for name, ends in ranges.items() if name != "size"}):
            squares = ((points - [numbers[axis] for axis in "xyz"]) ** 2).sum(axis=1) / numbers["width"] ** 2
            density = np.exp(-squares / 2).reshape(len(areas), -1).mean(axis=1)
            share = float(areas @ density) / (2 * math.pi * numbers["width"] ** 2)
            least, at = min((least, at), (share, where))
        if least < WHOLE:
            values = {"label": self.label, "share": f"{100 * least:.2g} %", "boundary": self.on}
            yield Finding("spot-lost", "warning", values | {"where": f" at {at}" if at else ""})

    def words(self, numbers: Mapping[str, str]) -> str:
        place = ", ".join(numbers[name] for name in "xyz")
        force = f"{numbers['size']} along {listed(self.direction)}"
        return f"spot on {self.on}: {force}, within {numbers['width']} of ({place})"


def _centres(parts: int) -> FloatArray:
    """Barycentric coordinates (parts², 3) of the centres of equal triangles that a triangle is divided into."""
    corners = [(i, j, k) for k in (1, 2) for i in range(parts + 1 - k) for j in range(parts + 1 - k - i)]
    i, j, k = np.array(corners).T
    first, second = (3 * i + k) / (3 * parts), (3 * j + k) / (3 * parts)
    return np.column_stack([first, second, 1 - first - second])
