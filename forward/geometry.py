"""Bodies with named boundaries, as specifications; the mesh itself is made in `fenicsx`."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Gt
from pydantic import Field, model_validator

from forward.settings import Settings

Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
Length = Annotated[float, Gt(0)]
Count = Annotated[int, Gt(0)]
Vector = tuple[float, float, float]


class Box(Settings):
    """A box [0, size] with a structured mesh; its boundaries are x-min, x-max, y-min, y-max, z-min and z-max.

    Parameters
    ----------
    size
        Edge lengths in m.
    cells
        Number of cells along each edge (a cell is six tetrahedra where `cell` is "tetrahedron").
    cell
        Shape of the cells.
    degree
        Polynomial degree of the displacement.
    quadrature_degree
        Degree that the integrals are exact for; by default the lowest that keeps the order of convergence. Less than 2
        (quadratic tetrahedra, linear hexahedra) or 4 (quadratic hexahedra) leaves deformations without energy.
    """

    kind: Literal["box"] = "box"
    size: tuple[Length, Length, Length]
    cells: tuple[Count, Count, Count]
    cell: Literal["hexahedron", "tetrahedron"] = "hexahedron"
    degree: Literal[1, 2] = 2
    quadrature_degree: Annotated[int, Field(ge=1, le=12)] | None = None

    @property
    def boundaries(self) -> tuple[str, ...]:
        """Names of the boundaries."""
        return tuple(f"{axis}-{end}" for axis in AXES for end in ("min", "max"))

    @property
    def nodes(self) -> int:
        """Number of nodes of the displacement."""
        a, b, c = (self.degree * n + 1 for n in self.cells)
        return a * b * c

    @property
    def quadrature(self) -> int:
        """The degree of quadrature in force."""
        default = {("tetrahedron", 1): 1, ("tetrahedron", 2): 3, ("hexahedron", 1): 3, ("hexahedron", 2): 5}
        return self.quadrature_degree or default[self.cell, self.degree]

    @property
    def volume(self) -> float:
        """Volume in m³."""
        a, b, c = self.size
        return a * b * c

    def corners(self, boundary: str) -> list[Vector]:
        """Corners of a boundary, in units of the edge lengths."""
        axis, end = boundary.split("-")
        place = {"min": 0.0, "max": 1.0}[end]
        corners = [(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]
        return [corner for corner in corners if corner["xyz".index(axis)] == place]

    def contains(self, point: Vector) -> bool:
        """Whether a point (m) lies in the undeformed body."""
        return all(-1e-12 * length <= x <= length * (1 + 1e-12) for x, length in zip(point, self.size, strict=True))

    @model_validator(mode="after")
    def _check(self) -> Box:
        if self.nodes > 20_000_000:
            message = f"cells = {list(self.cells)} gives {3 * self.nodes:,} unknowns, expected at most 60 million"
            raise ValueError(message)
        lowest = {("tetrahedron", 1): 1, ("tetrahedron", 2): 2, ("hexahedron", 1): 2, ("hexahedron", 2): 4}
        needed = lowest[self.cell, self.degree]
        if self.quadrature < needed:
            message = (
                f"quadrature_degree = {self.quadrature} leaves deformations of {self.cell} cells of degree "
                f"{self.degree} without energy, expected at least {needed}"
            )
            raise ValueError(message)
        return self
