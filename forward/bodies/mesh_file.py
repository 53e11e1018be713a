"""Bodies meshed by other programs: gmsh's .msh, XDMF, VTK and VTU files with named boundaries and regions.

Meshes that are refined here are files of NumPy's (.npz), written by `forward.bodies.tetrahedra`.

A study stores, beside the name of the file, what it needs to know about it (`Contents`), so that results can be read
without the file; a hash tells whether it is the same file.

Most of the module describes what may be wrong with a file, each mistake in words.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import lru_cache
from io import StringIO
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Self

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.bodies import hexahedra
from forward.bodies.elements import default_quadrature, node_count
from forward.machine import out_of_memory
from forward.model import FloatArray, ModelError
from forward.settings import Settings, nearest, one_line

if TYPE_CHECKING:
    import meshio

Point = tuple[float, float, float]
IntArray = NDArray[np.int64]
LARGE, SMALL = 2.0, 1e-3  # m: bodies of tissue are between these
FLAT = 1e-10  # volume of a cell over the cube of its longest edge that counts as zero
MOST_LEVELS = 6  # 262 144 cells for each of the file
MOST_NODES = 20_000_000
QUARTER = 0.25  # where an edge that leaves a boundary is divided, towards which cells are to be thinner
CLOSE = 1e-9  # distance, over the extent of the body, within which points coincide
ALL, SURFACE = "body", "surface"  # names of the only region and of the only boundary, where the file has no numbers
BOUNDARY = "boundary "  # before the name of a boundary, in a mesh of our own
_SURFACES = {"tetrahedron": "triangle", "hexahedron": "quad"}
_MESHIO = {"tetra": "tetrahedron", "hexahedron": "hexahedron"}
_TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "CellEntityIds")  # arrays of tags that programs write
_FACES = {
    "tetrahedron": [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]],
    "hexahedron": hexahedra.FACES.tolist(),
}
_EDGES = {
    "tetrahedron": [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]],
    "hexahedron": hexahedra.EDGES.tolist(),
}
_TETRAHEDRA = {
    "tetrahedron": [[0, 1, 2, 3]],
    "hexahedron": [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]],
}
# Corners of hexahedra with their neighbours, in an order that makes all determinants positive.
_CORNERS = [
    [0, 1, 3, 4],
    [1, 2, 0, 5],
    [2, 3, 1, 6],
    [3, 0, 2, 7],
    [4, 7, 5, 0],
    [5, 4, 6, 1],
    [6, 5, 7, 2],
    [7, 6, 4, 3],
]


@dataclass(frozen=True, eq=False)
class Loaded:
    """A mesh in memory.

    Attributes
    ----------
    points
        Vertices (n, 3) in m.
    cells
        Vertices of each cell, in VTK's order.
    cell
        "tetrahedron" or "hexahedron".
    boundaries
        Facets (k, 3 or 4) of the surface of the body by name.
    regions
        Names of the regions.
    region
        Number of the region of each cell.
    """

    points: FloatArray
    cells: IntArray
    cell: Literal["tetrahedron", "hexahedron"]
    boundaries: dict[str, IntArray]
    regions: tuple[str, ...]
    region: IntArray


class Contents(Settings):
    """What a file holds, found when it is read.

    Parameters
    ----------
    digest
        Hash of the file.
    cell
        Shape of the cells.
    cells, vertices, edges, faces
        How many there are.
    bounds
        Smallest and largest coordinate (m) along each axis.
    longest_edge
        Of all cells (m); of those that a study divides, what it is at most.
    boundaries
        Names of the boundaries, each with up to four points (m) that span it.
    areas
        Names of the boundaries, each with its area (m²).
    regions
        Names of the regions, each with its volume (m³).
    """

    digest: str
    cell: Literal["tetrahedron", "hexahedron"]
    cells: int
    vertices: int
    edges: int
    faces: int
    bounds: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    longest_edge: float
    boundaries: dict[str, tuple[Point, ...]]
    areas: dict[str, float]
    regions: dict[str, float]


class MeshFile(Settings):
    """A body from a file with a mesh of linear tetrahedra or hexahedra.

    Boundaries and regions are gmsh's physical groups by their names; in other formats, and where a group has no name,
    the numbers that an array of the cells gives to triangles or quadrilaterals (boundaries) and to cells (regions).
    A triangle may be in several groups, a cell in only one. In files of Abaqus, sets of elements are regions, and sets
    of nodes boundaries: the faces of the surface all of whose nodes are in the set.

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
    contents
        What the file holds; it need not be given.
    """

    kind: Literal["mesh"] = "mesh"
    file: str
    unit: Annotated[float, Gt(0)] = 1.0
    degree: Literal[1, 2] = 2
    quadrature_degree: Annotated[int, Field(ge=1, le=12)] | None = None
    names: dict[Annotated[str, Field(pattern=r"^[^.\s]+$")], int] = Field(default={})
    tags: str | None = None
    levels: Annotated[int, Field(ge=0, le=MOST_LEVELS)] = 0
    divide: tuple[str, ...] | None = None
    contents: Contents | None = None

    @model_validator(mode="after")
    def _read(self) -> MeshFile:
        if self.contents is None:
            object.__setattr__(self, "contents", contents(self.load(), _digest(self.file)))
        lowest = {("tetrahedron", 1): 1, ("tetrahedron", 2): 2, ("hexahedron", 1): 2, ("hexahedron", 2): 4}
        needed = lowest[self.cell, self.degree]
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
        digest = _digest(self.file)
        if self.contents is not None and digest != self.contents.digest:
            message = f"model.body.file: {self.file} is not the file that the study was made for: it has changed"
            raise ModelError(message)
        loaded = _load(self.file, digest, self.unit, tuple(self.names.items()), self.tags)
        for _ in range(self.levels):
            loaded = divided(loaded, ())
        return loaded if self.divide is None else divided(loaded, self.divide)

    def finer(self, times: float, towards: tuple[str, ...], grading: float, beside: float) -> Self:
        """Return the body with every cell divided into eight, thinner ones at some boundaries.

        Raises
        ------
        ModelError
            If it is divided already.
        """
        if self.divide is not None:
            message = "its mesh is divided already"
            raise ModelError(message)
        return self.model_validate(self.model_dump(exclude={"contents"}) | {"divide": towards})

    @property
    def found(self) -> Contents:
        """What the file holds."""
        assert self.contents is not None
        return self.contents

    @property
    def cell(self) -> Literal["tetrahedron", "hexahedron"]:
        """Shape of the cells."""
        return self.found.cell

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.found.cells

    @property
    def cells_in_words(self) -> str:
        """How many cells there are."""
        return f"{self.cell_count:,}"

    @property
    def boundaries(self) -> tuple[str, ...]:
        """Names of the boundaries."""
        return tuple(self.found.boundaries)

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the regions."""
        return tuple(self.found.regions)

    @property
    def nodes(self) -> int:
        """Number of nodes of the displacement."""
        found = self.found
        return node_count(found.cell, self.degree, found.vertices, found.edges, found.faces, found.cells)

    @property
    def vertex_count(self) -> int:
        """Number of vertices of the mesh."""
        return self.found.vertices

    @property
    def quadrature(self) -> int:
        """The degree of quadrature in force."""
        return self.quadrature_degree or default_quadrature(self.cell, self.degree)

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Smallest and largest coordinate (m) along each axis."""
        return self.found.bounds

    @property
    def vertices(self) -> tuple[Point, ...]:
        """Corners (m) of a box around the body."""
        return tuple((x, y, z) for z, y, x in product(*self.bounds[::-1]))

    @property
    def longest_edge(self) -> float:
        """Length (m) of the longest edge of a cell."""
        return self.found.longest_edge

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
            "boundaries": ", ".join(f"{name} ({area:.3g} m²)" for name, area in self.found.areas.items()),
            "regions": ", ".join(f"{name} ({volume:.3g} m³)" for name, volume in self.found.regions.items()),
        }

    @property
    def warnings(self) -> Iterator[str]:
        """What is unusual about it without being wrong."""
        extent = max(high - low for low, high in self.bounds)
        if not SMALL <= extent <= LARGE:
            yield (
                f"model.body.unit = {self.unit:g} makes the body {extent:.3g} m long: "
                "is that meant? Coordinates in millimetres have unit = 1e-3"
            )

    def contains(self, point: Point) -> bool:
        """Whether a point (m) lies in a box around the body; where the mesh is made, it must lie in a cell."""
        return all(low <= x <= high for x, (low, high) in zip(point, self.bounds, strict=True))

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the places (n, 3) of the undeformed body that are nearest to points (n, 3) in or beside it (m)."""
        mesh = self.load()
        tetrahedra = mesh.points[mesh.cells[:, _TETRAHEDRA[mesh.cell]].reshape(-1, 4)]
        outer = self.surface
        triangles = np.concatenate([outer[:, [0, *pair]] for pair in ((1, 2), (2, 3))[: outer.shape[1] - 2]])
        lows, highs = tetrahedra.min(axis=1), tetrahedra.max(axis=1)
        slack = CLOSE * max(high - low for low, high in self.bounds)
        found = np.array(points, dtype=float)
        for i, point in enumerate(found):
            near = ((lows <= point + slack) & (point - slack <= highs)).all(axis=1)
            a, b, c, d = np.moveaxis(tetrahedra[near], 1, 0)
            shares = np.linalg.solve(np.stack([b - a, c - a, d - a], axis=2), (point - a)[..., None])[..., 0]
            if ((shares >= -CLOSE).all(axis=1) & (shares.sum(axis=1) <= 1 + CLOSE)).any():
                continue
            places = nearest_of(triangles, point)
            found[i] = places[((places - point) ** 2).sum(axis=1).argmin()]
        return found

    @property
    def surface(self) -> FloatArray:
        """Corners (n, 3 or 4, 3) of all faces that belong to one cell (m)."""
        mesh = self.load()
        faces = mesh.cells[:, _FACES[mesh.cell]].reshape(-1, len(_FACES[mesh.cell][0]))
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        return np.asarray(mesh.points[faces[first[count == 1]]])

    def corners_of(self, boundary: str) -> list[Point]:
        """Points (m) that span a boundary."""
        return list(self.found.boundaries[boundary])

    def enriched(self) -> Self:
        """Return the same body on the same mesh with elements of one degree more, for estimates of its error."""
        degree = self.degree + 1  # beyond what a study may ask for
        quadrature = max(self.quadrature, default_quadrature(self.cell, degree))
        return self.model_copy(update={"degree": degree, "quadrature_degree": quadrature})

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
        found = self.found
        for _ in range(level):
            found = _divided_contents(found)
        blocks = self.model_dump() | {"levels": self.levels + level, "contents": found}
        return self.model_validate(blocks)


def _digest(file: str) -> str:
    """Return the hash of a file, including the files in which an XDMF file stores its numbers."""
    try:
        whole = Path(file).read_bytes()
        if file.endswith(".xdmf"):
            others = sorted(set(re.findall(rb"([^\s<>\"]+\.h5):", whole)))
            whole += b"".join(
                path.read_bytes() for path in (Path(file).parent / os.fsdecode(other) for other in others)
            )
        return hashlib.sha256(whole).hexdigest()
    except OSError as error:
        raise ModelError(one_line(f"file: {error.filename or file}: cannot be read: {error.strerror}")) from None


@lru_cache(maxsize=1)
def _load(file: str, digest: str, unit: float, names: tuple[tuple[str, int], ...], tags: str | None) -> Loaded:
    """Read a file of known hash."""

    def refuse(problem: str) -> NoReturn:
        raise ModelError(one_line(f"file: {file}: {problem}"))

    if file.endswith(".npz"):
        return _of_ours(file, unit, refuse)
    import meshio

    printed = StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(StringIO()):  # meshio prints empty lines, and what is wrong
            mesh = _with_groups(meshio.read(file)) if file.endswith(".inp") else meshio.read(file)
    except SystemExit:
        said = (printed.getvalue().strip().splitlines() or [f"it is no {Path(file).suffix} file that meshio reads"])[0]
        refuse(f"cannot be read as a mesh: {said}{', try .vtu' if file.endswith('.vtk') else ''}")
    except Exception as error:  # readers fail in many ways
        if out_of_memory(error):
            raise
        said = (str(error).splitlines() or [""])[0]
        if "gmsh:physical" in said:
            refuse("has cells in no physical group, expected what belongs to one (gmsh: Mesh.SaveAll = 0)")
        refuse(f"cannot be read as a mesh: {said or type(error).__name__}")
    kinds = [_MESHIO[block.type] for block in mesh.cells if block.type in _MESHIO]
    others = {block.type for block in mesh.cells if block.dim == 3 and block.type not in _MESHIO}
    if others or len(set(kinds)) != 1:
        have = ", ".join(sorted(others | set(kinds))) or "no solid cells"
        linear = " (gmsh: Mesh.ElementOrder = 1; `degree` is that of the displacement)" if others else ""
        refuse(f"holds {have}, expected linear tetrahedra or linear hexahedra alone{linear}")
    cell: Literal["tetrahedron", "hexahedron"] = "tetrahedron" if kinds[0] == "tetrahedron" else "hexahedron"
    numbers = _numbers(mesh, tags, refuse)
    words = _words(mesh, file, names, numbers, refuse)
    _check_groups(mesh, refuse)
    cells, region_numbers = _gathered(mesh, numbers, next(k for k, v in _MESHIO.items() if v == cell), refuse)
    facets, facet_numbers = _gathered(mesh, numbers, _SURFACES[cell], refuse)
    used, cells = np.unique(cells, return_inverse=True)
    cells = cells.reshape(-1, len(_CORNERS) if cell == "hexahedron" else 4)
    points = unit * np.asarray(mesh.points, dtype=float)[used]
    if points.shape[1] != 3 or not np.isfinite(points).all():
        refuse("its points are not finite ones in three dimensions")
    _check_geometry(points, cells, cell, refuse)
    _check_joints(points, cells, cell, refuse)
    new = np.full(len(mesh.points), -1)
    new[used] = np.arange(len(used))
    present = np.unique(facet_numbers)
    groups = _sets(mesh, _SURFACES[cell])
    for n in present.tolist():
        word = words.get((2, n), SURFACE if len(present) == 1 and not n else f"{n}")
        groups[word] = groups.get(word, False) | (facet_numbers == n)
    boundaries = _outer(new[facets], groups, cells, cell)
    if not boundaries:
        refuse(f"names no boundary, expected {_SURFACES[cell]}s of the surface with numbers (gmsh: physical surfaces)")
    present = np.unique(region_numbers)
    regions = tuple(words.get((3, int(n)), ALL if len(present) == 1 and not n else f"{n}") for n in present)
    return Loaded(points, cells, cell, boundaries, regions, np.searchsorted(present, region_numbers))


def _with_groups(mesh: meshio.Mesh) -> meshio.Mesh:
    """Return a mesh of Abaqus with its sets as groups: those of solid elements regions, those of nodes boundaries.

    A boundary has the faces of the surface all of whose nodes are in a set. Sets of all elements, beside others, are
    no regions, and elements in no set are the region "body".
    """
    import meshio

    solid = [i for i, block in enumerate(mesh.cells) if block.type in _MESHIO]
    kinds = {_MESHIO[mesh.cells[i].type] for i in solid}
    if len(kinds) != 1:  # which is refused elsewhere
        return mesh
    (cell,) = kinds
    cells = np.concatenate([mesh.cells[i].data for i in solid])
    members = {}
    for name, parts in mesh.cell_sets.items():
        inside = [np.isin(np.arange(len(mesh.cells[i].data)), parts[i]) for i in solid if parts[i] is not None]
        if len(inside) == len(solid) and np.concatenate(inside).any():
            members[name] = np.concatenate(inside)
    some = {name: member for name, member in members.items() if not member.all()}
    members = some or dict(list(members.items())[:1])
    faces = cells[:, _FACES[cell]].reshape(-1, len(_FACES[cell][0]))
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[first[count == 1]]
    groups = {
        f"{name}-nodes" if name in members else name: found
        for name, nodes in mesh.point_sets.items()
        if (found := np.isin(outer, nodes).all(axis=1)).any()
    }
    if groups:
        outer = outer[np.any(list(groups.values()), axis=0)]
    numbers = np.zeros(len(cells), dtype=np.int64)
    for number, member in enumerate(members.values(), start=1):
        numbers[member] = number
    of_faces = np.zeros(len(outer), dtype=np.int64)
    nothing = np.zeros(0, dtype=np.int64)
    beside, titles = {}, {ALL: np.array([0, 3])} | {name: np.array([k, 3]) for k, name in enumerate(members, start=1)}
    for number, (name, found) in enumerate(groups.items(), start=1):
        member = found[np.any(list(groups.values()), axis=0)]
        of_faces[member] = number
        beside[name], titles[name] = [nothing, np.flatnonzero(member)], np.array([number, 2])
    within = {name: [np.flatnonzero(member), nothing] for name, member in members.items()}
    shape = mesh.cells[solid[0]].type
    return meshio.Mesh(
        mesh.points,
        [(shape, cells), (_SURFACES[cell], outer)],
        cell_data={_TAGS[0]: [numbers, of_faces]},
        field_data=titles,
        cell_sets=within | beside,
    )


def _of_ours(file: str, unit: float, refuse: Any) -> Loaded:
    """Read a mesh that was refined here."""
    try:
        with np.load(file) as arrays:
            points, cells, region = unit * arrays["points"], arrays["cells"], arrays["region"]
            regions = tuple(map(str, arrays["regions"]))
            boundaries = {
                name.removeprefix(BOUNDARY): arrays[name] for name in arrays.files if name.startswith(BOUNDARY)
            }
            _check_geometry(points, cells, "tetrahedron", refuse)
    except ModelError:
        raise
    except Exception as error:  # a file may be anything
        if out_of_memory(error):
            raise
        refuse(f"cannot be read as a mesh: {(str(error).splitlines() or [type(error).__name__])[0]}")
    return Loaded(points, cells, "tetrahedron", boundaries, regions, region)


def _numbers(mesh: meshio.Mesh, tags: str | None, refuse: Any) -> list[IntArray]:
    """Return the numbers that the file gives to the cells of each block; zeros if it gives none."""
    arrays = {
        name: [v[:, 0] if v.ndim == 2 and v.shape[1] == 1 else v for v in values]  # as VTK's old format has them
        for name, values in mesh.cell_data.items()
        if all(np.issubdtype(v.dtype, np.number) for v in values)
    }
    if tags is not None and tags not in arrays:
        refuse(f"has no array '{tags}'; {nearest(tags, tuple(arrays))}")
    usual = [name for name in _TAGS if name in arrays]
    whole = [
        name
        for name, values in arrays.items()
        if not name.startswith("gmsh:") and all(v.ndim == 1 and (v == np.round(v)).all() for v in values)
    ]
    chosen = tags or (usual[0] if usual else whole[0] if len(whole) == 1 else None)
    if chosen is None and len(whole) > 1:
        refuse(f"has several arrays of numbers, expected tags = one of: {', '.join(whole)}")
    if chosen is None:
        return [np.zeros(len(block.data), dtype=np.int64) for block in mesh.cells]
    return [np.asarray(values).astype(np.int64) for values in arrays[chosen]]


def _words(
    mesh: meshio.Mesh, file: str, names: tuple[tuple[str, int], ...], numbers: list[IntArray], refuse: Any
) -> dict[tuple[int, int], str]:
    """Return names by dimension and number: those of the file, and the given ones."""
    words = {(int(dim), int(number)): _word(name) for name, (number, dim) in _named_groups(mesh)}
    if file.endswith(".msh"):  # where a name stands twice, as of a volume and of its surface, meshio keeps one
        section = Path(file).read_bytes().partition(b"$PhysicalNames")[2].partition(b"$EndPhysicalNames")[0]
        for dim, number, name in re.findall(r'^\s*(\d) (\d+) "(.*)"', section.decode(errors="replace"), re.MULTILINE):
            words[int(dim), int(number)] = _word(name)
    present = {int(n) for part in numbers for n in np.unique(part)}
    for name, number in names:
        if number not in present:
            refuse(f"has no number {number} (names.{name}), expected one of: {', '.join(map(str, sorted(present)))}")
        words |= {(dim, number): name for dim in (2, 3)}
    return words


def _word(name: str) -> str:
    """Return the name of a group as paths can have it."""
    return name.strip().replace(" ", "-").replace(".", "-")


def _sets(mesh: meshio.Mesh, kind: str) -> dict[str, NDArray[np.bool_]]:
    """Return which cells of a kind are in each named group of gmsh, of which one cell may have several."""
    dim = 2 if kind in _SURFACES.values() else 3
    found = {}
    for name, (_, of) in _named_groups(mesh):
        if int(of) == dim and name in mesh.cell_sets:
            blocks = zip(mesh.cells, mesh.cell_sets[name], strict=True)
            parts = [np.isin(np.arange(len(block.data)), part) for block, part in blocks if block.type == kind]
            found[_word(name)] = np.concatenate(parts) if parts else np.zeros(0, dtype=bool)
    return found


def _check_groups(mesh: meshio.Mesh, refuse: Any) -> None:
    """Refuse cells in several groups: their constants would be ambiguous."""
    for kind in _MESHIO:
        groups = _sets(mesh, kind)
        shared = sum((member.astype(int) for member in groups.values()), np.zeros(1, dtype=int)) > 1
        if shared.any():
            names = ", ".join(name for name, member in groups.items() if (member & shared).any())
            refuse(f"{shared.sum()} cells are in several groups of volumes ({names}), expected one region for each")


def _named_groups(mesh: meshio.Mesh) -> list[tuple[str, Any]]:
    return [(name, values) for name, values in mesh.field_data.items() if np.size(values) == 2]


def _gathered(mesh: meshio.Mesh, numbers: list[IntArray], kind: str, refuse: Any) -> tuple[IntArray, IntArray]:
    """Collect the cells of a kind, with their numbers."""
    parts = [(block.data, n) for block, n in zip(mesh.cells, numbers, strict=True) if block.type == kind]
    if not parts:
        return np.zeros((0, 4 if kind == "quad" else 3), dtype=np.int64), np.zeros(0, dtype=np.int64)
    blocks, found = zip(*parts, strict=True)
    cells = np.concatenate(blocks).astype(np.int64)
    if cells.size and not 0 <= cells.min() <= cells.max() < len(mesh.points):
        refuse(f"has cells with corners that are not among its {len(mesh.points)} points")
    return cells, np.concatenate(found)


def _check_geometry(points: FloatArray, cells: IntArray, cell: str, refuse: Any) -> None:
    """Refuse cells without volume, and parts that only appear to be joined."""
    corners = [[0, 1, 2, 3]] if cell == "tetrahedron" else _CORNERS
    edges = points[cells[:, corners]]  # cells, corners, 4, 3
    sides = edges[:, :, 1:] - edges[:, :, :1]
    volumes = np.linalg.det(sides)
    size = np.linalg.norm(sides, axis=-1).max(axis=(1, 2)) ** 3
    flat = ~((volumes > FLAT * size[:, None]).all(axis=1) | (volumes < -FLAT * size[:, None]).all(axis=1))
    if flat.any():
        refuse(f"{flat.sum()} of {len(cells)} cells have no volume or are turned inside out")
    grid = np.round((points - points.min(axis=0)) / (CLOSE * np.ptp(points, axis=0).max())).astype(np.int64)
    twins = len(points) - len(np.unique(grid, axis=0))
    if twins:
        refuse(f"{twins} points lie where others lie: its parts are not joined, expected a mesh without double points")


def _check_joints(points: FloatArray, cells: IntArray, cell: str, refuse: Any) -> None:
    """Refuse overlapping cells, and bodies in several parts: cells are joined only by shared faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    shapes = np.array(_FACES[cell])
    faces = np.sort(cells[:, shapes].reshape(-1, shapes.shape[1]), axis=1)
    owners = np.repeat(np.arange(len(cells)), len(shapes))
    _, which, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    if (count > 2).any():
        refuse(f"{(count > 2).sum()} faces belong to more than two cells: some cells are there twice")
    inner = np.argsort(which, kind="stable")
    inner = inner[count[which[inner]] == 2].reshape(-1, 2)  # places of both cells in the list of faces
    a, b = owners[inner].T
    parts, part = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(len(cells),) * 2), directed=False)
    if parts > 1:
        sizes = ", ".join(f"{n:,}" for n in sorted(np.bincount(part).tolist(), reverse=True)[:5])
        refuse(f"its cells are {parts} parts that share no face (of {sizes} cells), expected one body")
    corners = points[faces[inner[:, 0]]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sides = [((points[cells[k]].mean(axis=1) - corners.mean(axis=1)) * normal).sum(axis=1) for k in (a, b)]
    wrong = int((sides[0] * sides[1] > 0).sum())
    if wrong:
        refuse(f"{wrong} pairs of neighbouring cells lie on the same side of their common face: some are inside out")


def _outer(facets: IntArray, groups: dict[str, NDArray[np.bool_]], cells: IntArray, cell: str) -> dict[str, IntArray]:
    """Return the facets of each group that belong to only one cell: those on the surface of the body."""
    faces = np.sort(cells[:, _FACES[cell]].reshape(-1, facets.shape[1]), axis=1)
    sorted_facets = np.sort(facets, axis=1)
    unique, which = np.unique(np.concatenate([faces, sorted_facets]), axis=0, return_inverse=True)
    which = which.ravel()
    of_cells = np.bincount(which[: len(faces)], minlength=len(unique))
    outside = of_cells[which[len(faces) :]] == 1
    found = {word: facets[outside & member] for word, member in groups.items()}
    return {word: part for word, part in found.items() if len(part)}


def divided(mesh: Loaded, towards: tuple[str, ...]) -> Loaded:
    """Divide every cell into eight, thinner ones at some boundaries.

    Edges that leave these boundaries are divided at a quarter, nearer to the boundary, others in the middle (graded
    meshes for singularities: H. Li, A. Mazzucato, V. Nistor, Electron. Trans. Numer. Anal. 37 (2010) 41–69). The
    octahedron inside a tetrahedron is cut along the diagonal that leaves its smallest part largest; of equal ones, as
    all are where edges are divided in the middle, along the shortest (as J. Bey, Tetrahedral grid refinement,
    Computing 55 (1995) 355–378, keeps the shapes of cells).

    Raises
    ------
    ModelError
        If there is no such boundary.
    """
    unknown = [name for name in towards if name not in mesh.boundaries]
    if unknown:
        message = f"divide: {nearest(unknown[0], tuple(mesh.boundaries))}"
        raise ModelError(message)
    held = np.zeros(len(mesh.points))
    for name in towards:
        held[mesh.boundaries[name]] = 0.5 - QUARTER
    if mesh.cell == "hexahedron":
        found = hexahedra.divided(mesh.points, mesh.cells, mesh.boundaries, held)
        return replace(mesh, **found._asdict(), region=np.repeat(mesh.region, 8))
    ends, which = np.unique(
        np.sort(mesh.cells[:, _EDGES["tetrahedron"]].reshape(-1, 2), axis=1), axis=0, return_inverse=True
    )
    number = len(mesh.points) + which.reshape(-1, 6)
    share = 0.5 + held[ends[:, 1]] - held[ends[:, 0]]  # of the second end
    points = np.concatenate(
        [mesh.points, (1 - share)[:, None] * mesh.points[ends[:, 0]] + share[:, None] * mesh.points[ends[:, 1]]]
    )
    m01, m02, m03, m12, m13, m23 = number.T
    v0, v1, v2, v3 = mesh.cells.T
    corners = [(v0, m01, m02, m03), (v1, m01, m12, m13), (v2, m02, m12, m23), (v3, m03, m13, m23)]
    cuts = []
    for a, b, around in (
        (m01, m23, (m02, m12, m13, m03)),
        (m02, m13, (m01, m12, m23, m03)),
        (m03, m12, (m01, m02, m23, m13)),
    ):
        cuts.append(np.stack([np.stack([a, b, around[k], around[k - 1]], axis=1) for k in range(4)], axis=1))
    inner = np.array(cuts)  # (3, n, 4, 4)
    at = points[inner]
    volumes = np.abs(np.linalg.det(at[..., 1:, :] - at[..., :1, :])).min(axis=2)
    lengths = np.linalg.norm(at[:, :, 0, 1] - at[:, :, 0, 0], axis=-1)
    rounded = np.round(lengths / (CLOSE * lengths.max()))  # equal ones are, whatever rounding does to them
    largest = volumes >= (1 - 1e-9) * volumes.max(axis=0)
    best = inner[np.where(largest, rounded, np.inf).argmin(axis=0), np.arange(len(mesh.cells))]
    cells = np.concatenate([np.stack([np.stack(corner, axis=1) for corner in corners], axis=1), best], axis=1)
    keys = ends[:, 0] << 32 | ends[:, 1]

    def quartered(facets: IntArray) -> IntArray:
        pairs = np.sort(facets[:, [[0, 1], [1, 2], [0, 2]]], axis=2)
        ij, jk, ik = (len(mesh.points) + np.searchsorted(keys, pairs[..., 0] << 32 | pairs[..., 1])).T
        i, j, k = facets.T
        parts = [(i, ij, ik), (j, ij, jk), (k, ik, jk), (ij, jk, ik)]
        return np.asarray(np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3))

    boundaries = {name: quartered(facets) for name, facets in mesh.boundaries.items()}
    return Loaded(points, cells.reshape(-1, 4), mesh.cell, boundaries, mesh.regions, np.repeat(mesh.region, 8))


def _divided_contents(found: Contents) -> Contents:
    """Say what a mesh holds whose cells are divided into eight.

    Every edge is halved. A triangle has three new ones and a tetrahedron one: the shortest of the three that join the
    middles of opposite edges, the squares of which are a quarter of the sum of those of the six edges. A quadrilateral
    has four, a hexahedron six.
    """
    if found.cell == "hexahedron":
        return found.model_copy(
            update={
                "vertices": found.vertices + found.edges + found.faces + found.cells,
                "edges": 2 * found.edges + 4 * found.faces + 6 * found.cells,
                "faces": 4 * found.faces + 12 * found.cells,
                "cells": 8 * found.cells,
                "longest_edge": found.longest_edge / 2,
            }
        )
    return found.model_copy(
        update={
            "vertices": found.vertices + found.edges,
            "edges": 2 * found.edges + 3 * found.faces + found.cells,
            "faces": 4 * found.faces + 8 * found.cells,
            "cells": 8 * found.cells,
            "longest_edge": found.longest_edge / 2**0.5,
        }
    )


def contents(mesh: Loaded, digest: str) -> Contents:
    """Return what a study needs to know about a mesh."""
    points, cells = mesh.points, mesh.cells
    edges = np.unique(np.sort(cells[:, _EDGES[mesh.cell]].reshape(-1, 2), axis=1), axis=0)
    faces = np.unique(
        np.sort(cells[:, _FACES[mesh.cell]].reshape(len(cells) * len(_FACES[mesh.cell]), -1), axis=1), axis=0
    )
    corners = [[0, 1, 2, 3]] if mesh.cell == "tetrahedron" else _CORNERS
    at = points[cells[:, corners]]
    # Of a hexahedron, the mean of the volumes at its corners: near enough to be shown.
    share = 6 if mesh.cell == "tetrahedron" else 1
    volumes = np.abs(np.linalg.det(at[:, :, 1:] - at[:, :, :1])).mean(axis=1) / share
    sums = np.bincount(mesh.region, weights=volumes, minlength=len(mesh.regions))
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return Contents(
        digest=digest,
        cell=mesh.cell,
        cells=len(cells),
        vertices=len(points),
        edges=len(edges),
        faces=len(faces),
        bounds=((low[0], high[0]), (low[1], high[1]), (low[2], high[2])),
        longest_edge=float(np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1).max()),
        boundaries={name: _spanning(points[np.unique(facets)]) for name, facets in mesh.boundaries.items()},
        areas={name: float(f"{_area(points[facets]):.6g}") for name, facets in mesh.boundaries.items()},
        regions={name: float(f"{volume:.6g}") for name, volume in zip(mesh.regions, sums, strict=True)},
    )


def _area(corners: FloatArray) -> float:
    """Return the area of facets (n, 3 or 4, 3) together."""
    around = [[0, k, k + 1] for k in range(1, corners.shape[1] - 1)]
    a, b, c = np.moveaxis(corners[:, around], 2, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2)


def nearest_of(triangles: FloatArray, point: FloatArray) -> FloatArray:
    """Return the place (n, 3) of each triangle (n, 3, 3) that is nearest to a point (3,), or to one (n, 3) each."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    square = (normal**2).sum(axis=1)
    foot = point - (((point - a) * normal).sum(axis=1) / square)[:, None] * normal
    inside = np.ones(len(triangles), dtype=bool)
    best, least = foot, np.full(len(triangles), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        inside &= (np.cross(along, foot - start) * normal).sum(axis=1) >= 0
        share = np.clip(((point - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
        place = start + share[:, None] * along
        distance = ((place - point) ** 2).sum(axis=1)
        best = np.where((distance < least)[:, None], place, best)
        least = np.minimum(least, distance)
    return np.where(inside[:, None], foot, best)


def _spanning(points: FloatArray) -> tuple[Point, ...]:
    """Return up to four points, each as far as possible from the span of those before it."""
    chosen = [points[0]]
    directions: list[FloatArray] = []
    extent = np.ptp(points, axis=0).max()
    for _ in range(3):
        apart = points - chosen[0]
        for direction in directions:
            apart = apart - np.outer(apart @ direction, direction)
        lengths = np.linalg.norm(apart, axis=1)
        k = int(lengths.argmax())
        if lengths[k] <= 1e-9 * extent:
            break
        chosen.append(points[k])
        directions.append(apart[k] / lengths[k])
    return tuple((float(x), float(y), float(z)) for x, y, z in chosen)
