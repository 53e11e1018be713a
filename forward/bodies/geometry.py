"""Bodies with named boundaries, as specifications; the mesh itself is made in `forward.fem.dolfinx`.

Boxes and blocks share one parametrisation by the unit cube, and so one file.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection, Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from annotated_types import Gt
from pydantic import AfterValidator, Field, model_validator

from forward.bodies.location import locate
from forward.bodies.mesh import default_quadrature
from forward.bodies.mesh_file import MeshFile
from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import told
from forward.settings import Settings, usually

Axis = Literal["x", "y", "z"]
Face = Literal["x-min", "x-max", "y-min", "y-max", "z-min", "z-max"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
Length = Annotated[float, Gt(0)]
Count = Annotated[int, Gt(0)]
Vector = tuple[float, float, float]
ROUNDING = 1e-6  # of the distance that counts as inaccuracy: a distance that counts as rounding
NEARBY = 1e-3  # of the diagonal of a body: distance from it that counts as inaccuracy of positions


def _has_length(direction: Vector) -> Vector:
    if not any(direction):
        raise ValueError("has length zero, expected a vector such as [0, -1, 0]")
    return direction


Direction = Annotated[Vector, AfterValidator(_has_length)]


def unit_vector(direction: Vector) -> Vector:
    """Return a direction with length one."""
    x, y, z = direction
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


class _SixSided(Settings):
    """The image of a box with a structured mesh: x-min, x-max, y-min … are the images of its faces.

    Parameters
    ----------
    cells
        Number of cells along each edge (a cell is six tetrahedra where `cell` is "tetrahedron").
    cell
        Shape of the cells.
    degree
        Polynomial degree of the displacement.
    quadrature_degree
        Degree of quadrature; by default the lowest that preserves the order of convergence. Less than 2
        (quadratic tetrahedra, linear hexahedra) or 4 (quadratic hexahedra) leaves deformations without energy.
    grading
        By face: how many times thinner the cells there are than at the opposite face or, if that has a grading too,
        than in the middle between both. Edges of cells grow geometrically: ``{ z-min = 8 }`` for a body that is clamped
        there, since stresses change fast beside the rim of a clamp.
    """

    structured: ClassVar[bool] = True  # whether cells lie along edges of the body, and any number of them
    boundaries: ClassVar[tuple[str, ...]] = tuple(f"{axis}-{end}" for axis in AXES for end in ("min", "max"))
    # There are no named regions, there is no file whose contents could be listed, and nothing is unusual about it.
    regions: ClassVar[tuple[str, ...]] = ()
    listed: ClassVar[dict[str, str]] = {}
    findings: ClassVar[tuple[Finding, ...]] = ()
    kind: str
    cells: tuple[Count, Count, Count]
    cell: Literal["hexahedron", "tetrahedron"] = "hexahedron"
    degree: Literal[1, 2] = 2
    quadrature_degree: Annotated[int, Field(ge=1, le=12)] | None = None
    grading: dict[Face, Annotated[float, Field(ge=1, le=1e4)]] = Field(default={})

    @property
    @abstractmethod
    def meshed(self) -> tuple[Length, Length, Length]:
        """Edge lengths of the box that is meshed."""

    @property
    @abstractmethod
    def vertices(self) -> tuple[Vector, ...]:
        """The images (m) of the corners of that box: x goes first, then y, then z."""

    @property
    @abstractmethod
    def description(self) -> str:
        """The shape in words."""

    @abstractmethod
    def shaped(self, points: FloatArray) -> FloatArray:
        """Map points (n, 3) of the box that is meshed into the body (m), without the grading."""

    def place(self, points: FloatArray) -> FloatArray:
        """Map points (n, 3) of the box with equal cells into the body (m); nested meshes stay nested."""
        if not self.grading:
            return self.shaped(points)
        axes = zip(points.T, self.meshed, AXES, strict=True)
        moved = [length * _graded(x / length, *self._grades(axis)) for x, length, axis in axes]
        return self.shaped(np.column_stack(moved))

    def _grades(self, axis: str) -> tuple[float, float]:
        """How many times thinner cells are at the ends of an axis."""
        given = {str(face): value for face, value in self.grading.items()}
        return given.get(f"{axis}-min", 1.0), given.get(f"{axis}-max", 1.0)

    def finer(self, times: float, towards: tuple[str, ...], grading: float, beside: float) -> Self:
        """Return the same body with so many times the cells along each edge, graded to some faces and those beside.

        Where the body is graded more than that, it stays so.

        Raises
        ------
        ValidationError
            If the mesh is too large.
        """
        cells = tuple(math.ceil(times * n) for n in self.cells)
        graded = {}
        for face in self.boundaries:
            rims = any(face[0] != other[0] for other in towards)
            least = grading if face in towards else beside if rims else 1.0
            graded[face] = max(least, self._grades(face[0])[face.endswith("max")])
        return self.model_validate(self.model_dump() | {"cells": cells, "grading": graded})

    def with_cells(self, times: float, kept: Collection[Axis] = ()) -> Self:
        """Return the same body with so many times the cells along each edge, rounded up, but for some axes.

        Raises
        ------
        ValidationError
            If the mesh is too large.
        """
        cells = tuple(
            n if axis in kept else math.ceil(times * n * (1 - 1e-9)) for axis, n in zip(AXES, self.cells, strict=True)
        )
        return self.model_validate(self.model_dump() | {"cells": cells})

    def coarser(self, times: float, degree: Literal[1, 2] | None) -> Self:
        """Return the same body with cells that are so many times as long, or less, perhaps of another degree."""
        elements = {} if degree is None else {"degree": degree, "quadrature_degree": None}
        return self.model_validate(self.with_cells(1 / times).model_dump() | elements)

    @abstractmethod
    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the places (n, 3) of the undeformed body that are nearest to points (n, 3) in or beside it (m)."""

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        a, b, c = self.cells
        return a * b * c * (6 if self.cell == "tetrahedron" else 1)

    @property
    def cells_in_words(self) -> str:
        """How many cells there are along each edge."""
        return " × ".join(f"{n}" for n in self.cells)

    @property
    def nodes(self) -> int:
        """Number of nodes of the displacement."""
        a, b, c = (self.degree * n + 1 for n in self.cells)
        return a * b * c

    @property
    def vertex_count(self) -> int:
        """Number of vertices of the mesh."""
        a, b, c = self.cells
        return (a + 1) * (b + 1) * (c + 1)

    @property
    def quadrature(self) -> int:
        """The degree of quadrature in force."""
        return self.quadrature_degree or default_quadrature(self.cell, self.degree)

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Smallest and largest coordinate (m) along each axis."""
        return tuple((min(along), max(along)) for along in zip(*self.vertices, strict=True))

    @property
    def longest_edge(self) -> float:
        """Length (m) of the longest edge of a cell (the diagonals of tetrahedra apart)."""
        corners = np.reshape(self.vertices, (2, 2, 2, 3))  # by z, y and x
        edges = []
        for a, n in enumerate(self.cells):
            share = np.diff(_graded(np.linspace(0, 1, n + 1), *self._grades(AXES[a]))).max()
            edges.append(np.linalg.norm(np.diff(corners, axis=2 - a), axis=-1).max() * share)
        return float(max(edges))

    def enriched(self) -> Self:
        """Return the same body on the same mesh with elements of one degree more, for estimates of its error."""
        degree = self.degree + 1  # beyond what a study may ask for
        quadrature = max(self.quadrature, default_quadrature(self.cell, degree))
        return self.model_copy(update={"degree": degree, "quadrature_degree": quadrature})

    def refined(self, level: int) -> Self:
        """Return the same body with every cell divided by 2^level along each edge: its mesh is nested.

        Raises
        ------
        ValidationError
            If the mesh is too large.
        """
        return self.with_cells(2**level)

    def corners_of(self, boundary: str) -> list[Vector]:
        """The four corners (m) of a boundary."""
        axis, end = boundary.split("-")
        bit = 1 << "xyz".index(axis)
        return [corner for k, corner in enumerate(self.vertices) if bool(k & bit) == (end == "max")]

    @model_validator(mode="after")
    def _check_mesh(self) -> _SixSided:
        if self.nodes > 20_000_000:
            message = f"cells = {list(self.cells)} gives {3 * self.nodes:,} unknowns, expected at most 60 million"
            raise ValueError(message)
        needed = self.degree * (2 if self.cell == "hexahedron" else 1)
        if self.quadrature < needed:
            raise ValueError(
                f"quadrature_degree = {self.quadrature} leaves deformations of {self.cell} cells of degree "
                f"{self.degree} without energy, expected at least {needed}"
            )
        return self


class Box(_SixSided):
    """A box [0, size]; its boundaries are x-min, x-max, y-min, y-max, z-min and z-max.

    Parameters
    ----------
    size
        Edge lengths in m.
    cells, cell, degree, quadrature_degree, grading
        The mesh, as of every body with six sides.
    """

    kind: Literal["box"] = "box"
    size: tuple[Length, Length, Length]

    @property
    def meshed(self) -> tuple[Length, Length, Length]:
        return self.size

    @property
    def vertices(self) -> tuple[Vector, ...]:
        """The corners (m): x goes first, then y, then z."""
        a, b, c = self.size
        return tuple((x, y, z) for z in (0.0, c) for y in (0.0, b) for x in (0.0, a))

    @property
    def description(self) -> str:
        return f"box of {' × '.join(f'{x:g}' for x in self.size)} m"

    def shaped(self, points: FloatArray) -> FloatArray:
        """Leave points (n, 3) where they are."""
        return points

    def nearest(self, points: FloatArray) -> FloatArray:
        return np.asarray(np.clip(points, 0.0, self.size))


def _graded(s: FloatArray, first: float, last: float) -> FloatArray:
    """Map [0, 1] to itself with a slope that grows geometrically, `first` times from 0 and `last` times from 1.

    With one of them it does so from end to end; with both, from either end to the middle.
    """
    if first == 1 or last == 1:
        if first == last:
            return s
        return _grown(s, first) if last == 1 else 1 - _grown(1 - s, last)
    halves = [(1 - 1 / ratio) / np.log(ratio) for ratio in (first, last)]  # lengths where the slope in the middle is 1
    middle = halves[0] / sum(halves)
    low, high = np.minimum(2 * s, 1), np.minimum(2 * (1 - s), 1)
    return np.asarray(np.where(s <= 0.5, middle * _grown(low, first), 1 - (1 - middle) * _grown(high, last)))


def _grown(s: FloatArray, ratio: float) -> FloatArray:
    return np.asarray((ratio**s - 1) / (ratio - 1))


class Block(_SixSided):
    """A block with eight given corners: the trilinear image of a cube.

    Its boundaries x-min, x-max, y-min, y-max, z-min and z-max are the images of the faces of the cube, whatever their
    direction in space. Linear tetrahedra cut off parts of curved faces.

    Parameters
    ----------
    corners
        The images (m) of the corners of the cube, in the order (0,0,0), (1,0,0), (0,1,0), (1,1,0), (0,0,1), (1,0,1),
        (0,1,1), (1,1,1): x goes first, then y, then z.
    cells, cell, degree, quadrature_degree
        The mesh, as of every body with six sides.
    """

    kind: Literal["block"] = "block"
    corners: tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector, Vector]

    @property
    def meshed(self) -> tuple[Length, Length, Length]:
        return 1.0, 1.0, 1.0

    @property
    def vertices(self) -> tuple[Vector, ...]:
        """The corners (m): x goes first, then y, then z."""
        return self.corners

    @property
    def description(self) -> str:
        return f"block with the corners {', '.join('(' + ', '.join(f'{x:g}' for x in c) + ')' for c in self.corners)} m"

    def shaped(self, points: FloatArray) -> FloatArray:
        """Map points (n, 3) of the cube into the body (m)."""
        return self._trilinear(*(np.stack([1 - x, x], axis=-1) for x in points.T))

    def nearest(self, points: FloatArray) -> FloatArray:
        from scipy.optimize import lsq_linear

        steps = np.linspace(0, 1, 5)
        guesses = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
        images = self.shaped(guesses)
        found = np.empty_like(points)
        for i, point in enumerate(points):
            # Gauss and Newton's method in the cube, the steps of which end at its faces.
            x = guesses[[np.linalg.norm(images - point, axis=1).argmin()]]
            for _ in range(20):
                gap = point - self.shaped(x)[0]
                step = lsq_linear(self._slopes(x)[0], gap, (np.minimum(-x[0], -1e-300), np.maximum(1 - x[0], 1e-300))).x
                x = np.clip(x + step, 0, 1)
                if np.abs(step).max() < 1e-12:
                    break
            found[i] = self.shaped(x)[0]
        return found

    def _trilinear(self, x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        """Sum the corners with weights (n, 2) of the two ends along each axis."""
        corners = np.reshape(self.corners, (2, 2, 2, 3))
        return np.asarray(np.einsum("ni,nj,nk,kjia->na", x, y, z, corners))

    def _slopes(self, points: FloatArray) -> FloatArray:
        """Derivative (n, 3, 3) of the map: the last axis is that of the cube."""
        ends = [np.stack([1 - x, x], axis=-1) for x in points.T]
        slope = np.broadcast_to([-1.0, 1.0], (len(points), 2))
        columns = [self._trilinear(*(slope if a == axis else ends[a] for a in range(3))) for axis in range(3)]
        return np.stack(columns, axis=-1)

    @model_validator(mode="after")
    def _check_corners(self) -> Block:
        steps = (0.0, 0.5, 1.0)
        slopes = self._slopes(np.array([(x, y, z) for z in steps for y in steps for x in steps]))
        # Volume relative to that of a right-angled cell with the same edges.
        edges = np.linalg.norm(slopes, axis=1).prod(axis=1)
        if not (np.linalg.det(slopes) > 1e-9 * edges).all():
            raise ValueError(
                "the corners enclose no volume or turn the block inside out, expected the images of (0,0,0), (1,0,0), "
                "(0,1,0), (1,1,0), (0,0,1), (1,0,1), (0,1,1), (1,1,1) of a cube, in this order"
            )
        return self


Body = Annotated[Box | Block | MeshFile, Field(discriminator="kind"), usually("box")]


def tolerance(body: Body) -> float:
    """Distance (m) up to which a point outside a body counts as lying on it: a thousandth of its diagonal."""
    return NEARBY * float(np.linalg.norm([high - low for low, high in body.bounds]))


def outside(body: Body, point: Vector) -> float:
    """How far (m) a point lies outside the undeformed body; for a mesh from a file, outside the box around it."""
    at, rounding = np.array([point]), ROUNDING * tolerance(body)
    if body.kind == "block" and locate(np.array([body.corners]), at).distances[0] <= rounding:
        return 0.0  # where its nearest place is less exact
    place = np.clip(at, *np.transpose(body.bounds)) if body.kind == "mesh" else body.nearest(at)
    gap = float(np.linalg.norm(place - at))
    return gap if gap > rounding else 0.0


def moved_points(body: Body, points: Mapping[str, Vector]) -> tuple[Finding, ...]:
    """Say how far points (m) outside a body, given by name, are moved onto it."""
    distances = {name: outside(body, point) for name, point in points.items()}
    far = {name: distance for name, distance in distances.items() if distance}
    if not far:
        return ()
    name = max(far, key=far.__getitem__)
    moved = (
        f"{len(far)} points lie outside the body and are" if len(far) > 1 else "1 point lies outside the body and is"
    )
    return (Finding("points-moved", "note", {"moved": moved, "far": told(far[name], "m"), "name": name}),)


def extent(body: Body) -> str:
    """Say in which box a body lies."""
    return " × ".join(f"[{low:g}, {high:g}]" for low, high in body.bounds) + " m"


def holds(body: Body, point: Vector) -> bool:
    """Whether a point (m) lies in the undeformed body, or no farther outside than `tolerance`.

    For a mesh from a file, the box around it is tested here; once it is meshed, the point must be near a cell.
    """
    return outside(body, point) <= tolerance(body)
