"""Bodies meshed by other programs: gmsh's .msh, XDMF, VTK and VTU files with named boundaries and regions.

Meshes that are refined here are files of NumPy's (.npz), written by `forward.bodies.tetrahedra`.

A study stores, beside the name of the file, what it needs to know about it (`Contents`), so that results can be read
without the file; a hash tells whether it is the same file.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from math import comb
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from annotated_types import Gt
from pydantic import Field, model_validator

from forward.bodies.location import locate, nearest_of
from forward.bodies.mesh import (
    CLOSE,
    TETRAHEDRA,
    Contents,
    Loaded,
    Point,
    contents,
    default_quadrature,
    divided,
    divided_contents,
    fan,
    surface_of,
)
from forward.bodies.mesh_reading import digest_of, load
from forward.findings import Finding
from forward.model import FloatArray, ModelError
from forward.readable import told
from forward.settings import Settings

LARGE, SMALL = 2.0, 1e-3  # m: bodies of tissue are between these
MOST_LEVELS = 6  # 262 144 cells for each of the file
MOST_NODES = 20_000_000


def _loaded(digest: str, known: Mapping[str, Any]) -> Loaded:
    """Read the file of a body, of known hash, and divide its cells as the fields of the body say."""
    mesh = load(known["file"], digest, known["unit"], tuple(known["names"].items()), known["tags"])
    return _divided(mesh, known)


def _divided(mesh: Loaded, known: Mapping[str, Any]) -> Loaded:
    for _ in range(known["levels"]):
        mesh = divided(mesh, ())
    return mesh if known["divide"] is None else divided(mesh, known["divide"])


def _contents(known: dict[str, Any]) -> Contents:
    """Read what a study does not say of a file; a mistake in it is one of the body."""
    digest = digest_of(known["file"])
    return contents(_loaded(digest, known), digest)


class MeshFile(Settings):
    """A body from a file with a mesh of linear tetrahedra or hexahedra.

    Boundaries and regions are gmsh's physical groups by their names; in other formats, and where a group has no name,
    the numbers that an array of the cells gives to triangles or quadrilaterals (boundaries) and to cells (regions).
    A triangle may be in several groups, a cell in only one. In files of Abaqus, sets of elements are regions, and
    surfaces and sets of nodes boundaries: of these, the faces of the body all of whose nodes are in the set.

    Parameters
    ----------
    file
        The file (.msh, .xdmf, .vtk, .vtu, Abaqus's .inp, or whatever else meshio reads), beside the study.
    unit
        Length (m) of one unit of its coordinates: 1e-3 for millimetres.
    degree
        Polynomial degree of the displacement.
    quadrature_degree
        Degree of quadrature, as for other bodies.
    names
        Names for numbers of boundaries and regions: ``{ vessel = 3 }``.
    tags
        Name of the array with the numbers, if it is neither a usual name nor the only array.
    levels
        Divide every cell into eight this many times. Faces that are plane in the file stay plane: the surface of
        a curved body does not become more accurate.
    divide
        Then divide every cell into eight once more, with thinner ones at these boundaries (``[]``: uniformly).
    slits
        Names of boundaries that are closed slits: faces that lie on each other but have points of their own, so that
        they can part. Where the file has others, a finding says so.
    contents
        What the file holds; it need not be given.
    """

    kind: Literal["mesh"] = "mesh"
    structured: ClassVar[bool] = False  # whether cells lie along edges of the body, and any number of them
    file: str
    unit: Annotated[float, Gt(0)] = 1.0
    degree: Literal[1, 2] = 2
    quadrature_degree: Annotated[int, Field(ge=1, le=12)] | None = None
    names: dict[Annotated[str, Field(pattern=r"^[^.\s]+$")], int] = Field(default={})
    tags: str | None = None
    levels: Annotated[int, Field(ge=0, le=MOST_LEVELS)] = 0
    divide: tuple[str, ...] | None = None
    slits: tuple[str, ...] = Field(default=(), exclude_if=operator.not_)
    contents: Contents = Field(default_factory=_contents)

    @model_validator(mode="after")
    def _check(self) -> MeshFile:
        wrong = [name for name in self.slits if name not in self.contents.slits]
        if wrong:
            there = ", ".join(filter(None, self.contents.slits)) or "none in this file"
            message = f"slits: '{wrong[0]}' is no boundary whose faces lie on each other, expected such a one: {there}"
            raise ValueError(message)
        needed = self.degree * (2 if self.cell == "hexahedron" else 1)
        if self.quadrature < needed:
            message = f"quadrature_degree = {self.quadrature} leaves deformations without energy, expected {needed}"
            raise ValueError(message)
        if self.nodes > MOST_NODES:
            message = f"{self.cell_count:,} cells have {3 * self.nodes:,} unknowns, expected at most {3 * MOST_NODES:,}"
            raise ValueError(message)
        return self

    def load(self) -> Loaded:
        """Read the file.

        Raises
        ------
        ModelError
            If that is not possible, or if the file is not the one that the study was made for.
        """
        digest = digest_of(self.file)
        if digest != self.contents.digest:
            message = f"model.body.file: {self.file} is not the file that the study was made for: it has changed"
            raise ModelError(message)
        return _loaded(digest, vars(self))

    def lifted(self) -> Loaded | None:
        """Return the mesh with its surface moved by what facets hide (`forward.bodies.facets`); None where they do not.

        These are the facets of the file: of cells that were divided, most lie in one plane with their neighbours.
        """
        from forward.bodies.facets import lifted  # SciPy, which `tissuq check` does without

        whole = lifted(self.model_copy(update={"levels": 0, "divide": None}).load())
        return None if whole is None else replace(self.load(), points=_divided(whole, vars(self)).points)

    def finer(self, times: float, towards: tuple[str, ...], grading: float, beside: float) -> Self:
        """Return the body with every cell divided into eight, thinner ones at some boundaries.

        Raises
        ------
        ModelError
            If it is divided already.
        """
        if self.divide is not None:
            raise ModelError("its mesh is divided already")
        return self.model_validate(self.model_dump(exclude={"contents"}) | {"divide": towards})

    @property
    def cell(self) -> Literal["tetrahedron", "hexahedron"]:
        """Shape of the cells."""
        return self.contents.cell

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.contents.cells

    @property
    def cells_in_words(self) -> str:
        """How many cells there are."""
        return f"{self.cell_count:,}"

    @property
    def boundaries(self) -> tuple[str, ...]:
        """Names of the boundaries."""
        return tuple(self.contents.boundaries)

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the regions."""
        return tuple(self.contents.regions)

    @property
    def nodes(self) -> int:
        """Number of nodes of the displacement."""
        found, n = self.contents, self.degree - 1  # n of them inside an edge
        on_edge, on_face, inside = (comb(n, k) if self.cell == "tetrahedron" else n**k for k in (1, 2, 3))
        return found.vertices + found.edges * on_edge + found.faces * on_face + found.cells * inside

    @property
    def vertex_count(self) -> int:
        """Number of vertices of the mesh."""
        return self.contents.vertices

    @property
    def quadrature(self) -> int:
        """The degree of quadrature in force."""
        return self.quadrature_degree or default_quadrature(self.cell, self.degree)

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Smallest and largest coordinate (m) along each axis."""
        return self.contents.bounds

    @property
    def vertices(self) -> tuple[Point, ...]:
        """Corners (m) of a box around the body."""
        return tuple((x, y, z) for z, y, x in product(*self.bounds[::-1]))

    @property
    def longest_edge(self) -> float:
        """Length (m) of the longest edge of a cell."""
        return self.contents.longest_edge

    @property
    def description(self) -> str:
        """The body in words."""
        return "; ".join(f"{what}: {found}" if what != "body" else found for what, found in self.listed.items())

    @property
    def listed(self) -> dict[str, str]:
        """What the file holds, in words: the body, its boundaries, its regions."""
        extents = " × ".join(f"{high - low:.3g}" for low, high in self.bounds)
        return {
            "body": f"mesh {Path(self.file).name} of {extents} m",
            "boundaries": ", ".join(f"{name} ({area:.3g} m²)" for name, area in self.contents.areas.items()),
            "regions": ", ".join(f"{name} ({volume:.3g} m³)" for name, volume in self.contents.regions.items()),
        }

    @property
    def findings(self) -> Iterator[Finding]:
        """What is unusual about it without being wrong."""
        extent = max(high - low for low, high in self.bounds)
        if not SMALL <= extent <= LARGE:
            yield Finding("body-size", "warning", {"unit": self.unit, "extent": told(extent, "m", 3)})
        for name, area in self.contents.slits.items():
            if name not in self.slits:
                named = f" on '{name}'" if name else ""
                yield Finding("slit", "warning", {"area": f"{area:.3g} m²", "named": named})

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the places (n, 3) of the undeformed body that are nearest to points (n, 3) in or beside it (m)."""
        mesh, triangles = self.load(), fan(self.surface)
        found = np.array(points, dtype=float)
        located = locate(mesh.points[mesh.cells[:, TETRAHEDRA[mesh.cell]].reshape(-1, 4)], found)
        for i in np.flatnonzero(located.distances > CLOSE * max(high - low for low, high in self.bounds)):
            places = nearest_of(triangles, found[i])
            found[i] = places[((places - found[i]) ** 2).sum(axis=1).argmin()]
        return found

    @property
    def surface(self) -> FloatArray:
        """Corners (n, 3 or 4, 3) of all faces that belong to one cell (m)."""
        mesh = self.load()
        return np.asarray(mesh.points[surface_of(mesh.cells, mesh.cell)[0]])

    def corners_of(self, boundary: str) -> list[Point]:
        """Points (m) that span a boundary."""
        return list(self.contents.boundaries[boundary])

    def enriched(self) -> Self:
        """Return the same body on the same mesh with elements of one degree more, for estimates of its error."""
        degree = self.degree + 1  # beyond what a study may ask for
        quadrature = max(self.quadrature, default_quadrature(self.cell, degree))
        return self.model_copy(update={"degree": degree, "quadrature_degree": quadrature})

    def coarser(self, times: float, degree: Literal[1, 2] | None) -> Self:
        """Return the same body divided less often, for cells that are so many times as long, perhaps of another degree.

        Raises
        ------
        ModelError
            If it was not divided as often.
        """
        fewer = math.log2(times)
        if self.divide is not None and fewer:
            fewer -= 1
        if fewer != round(fewer) or fewer > self.levels:
            divided = self.levels + (self.divide is not None)
            raise ModelError(f"cells {times:g} times as long: its mesh was divided {divided} times; expected 1, 2, 4 …")
        kept = {"levels": self.levels - round(fewer), "divide": None if times > 1 else self.divide}
        elements = {} if degree is None else {"degree": degree, "quadrature_degree": None}
        contents = {"contents": self.contents} if times == 1 else {}
        return self.model_validate(self.model_dump(exclude={"contents"}) | kept | elements | contents)

    def refined(self, level: int) -> Self:
        """Return the same body with every cell divided into eight `level` times, when it is meshed.

        Raises
        ------
        ModelError
            If it is divided towards boundaries.
        ValidationError
            If the mesh is too large.
        """
        if not level:
            return self
        if self.divide is not None:
            message = "its mesh is divided already, expected a body of kind 'box' or 'block', or one without 'divide'"
            raise ModelError(message)
        found = self.contents
        for _ in range(level):
            found = divided_contents(found)
        blocks = self.model_dump() | {"levels": self.levels + level, "contents": found}
        return self.model_validate(blocks)
