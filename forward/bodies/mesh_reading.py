"""Files with meshes of other programs, read and checked: each mistake that a file may have, in words."""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from forward.bodies.mesh import AT_CORNERS, CORNERS, FACES, IntArray, Loaded, faces_of, opened, slits_of, twins_of
from forward.files import meshes
from forward.machine import out_of_memory
from forward.model import FloatArray, ModelError
from forward.settings import nearest, one_line

if TYPE_CHECKING:
    import meshio

FLAT = 1e-10  # volume of a cell over the cube of its longest edge that counts as zero
ALL, SURFACE = "body", "surface"  # names of the only region and of the only boundary, where the file has no numbers
BOUNDARY = "boundary "  # before the name of a boundary, in a mesh of our own
LIFT = "lift"  # name of the array
_SURFACES = {"tetrahedron": "triangle", "hexahedron": "quad"}
_MESHIO = {"tetra": "tetrahedron", "hexahedron": "hexahedron"}
_TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "CellEntityIds")  # arrays of tags that programs write


def digest_of(file: str) -> str:
    """Return the hash of a file, and of those in which XDMF stores its numbers, or that Abaqus would include."""
    try:
        whole = Path(file).read_bytes()
        whole += b"".join(path.read_bytes() for path in meshes.beside(Path(file)))
        return hashlib.sha256(whole).hexdigest()
    except OSError as error:
        raise ModelError(one_line(f"file: {error.filename or file}: cannot be read: {error.strerror}")) from None


@lru_cache(maxsize=1)
def load(file: str, digest: str, unit: float, names: tuple[tuple[str, int], ...], tags: str | None) -> Loaded:
    """Read a file of known hash."""

    def refuse(problem: str) -> NoReturn:
        raise ModelError(one_line(f"file: {file}: {problem}"))

    if file.endswith(".npz"):
        return _of_ours(file, unit, refuse)
    try:
        mesh = meshes.read(Path(file))
    except (ValueError, ImportError) as error:
        said = str(error)
        if "gmsh:physical" in said:
            refuse("has cells in no physical group, expected what belongs to one (gmsh: Mesh.SaveAll = 0)")
        refuse(f"cannot be read as a mesh: {said}")
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
    cells = cells.reshape(-1, len(CORNERS) if cell == "hexahedron" else 4)
    points = unit * np.asarray(mesh.points, dtype=float)[used]
    if points.shape[1] != 3 or not np.isfinite(points).all():
        refuse("its points are not finite ones in three dimensions")
    given = points
    points, lips, twins = opened(points, cells, cell)
    _check_geometry(points, cells, cell, twins, refuse)
    _check_joints(given, cells, cell, refuse)
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
    slits = {name: float(f"{area:.6g}") for name, area in slits_of(given, lips, boundaries).items()}
    return Loaded(points, cells, cell, boundaries, regions, np.searchsorted(present, region_numbers), slits)


def _of_ours(file: str, unit: float, refuse: Any) -> Loaded:
    """Read a mesh that was refined here."""
    try:
        with np.load(file) as arrays:
            points, cells, region = unit * arrays["points"], arrays["cells"], arrays["region"]
            regions = tuple(map(str, arrays["regions"]))
            boundaries = {
                name.removeprefix(BOUNDARY): arrays[name] for name in arrays.files if name.startswith(BOUNDARY)
            }
            lift = unit * arrays[LIFT] if LIFT in arrays.files else None
            _check_geometry(points, cells, "tetrahedron", twins_of(points), refuse)
    except ModelError:
        raise
    except Exception as error:  # a file may be anything
        if out_of_memory(error):
            raise
        refuse(f"cannot be read as a mesh: {(str(error).splitlines() or [type(error).__name__])[0]}")
    return Loaded(points, cells, "tetrahedron", boundaries, regions, region, lift=lift)


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


def _check_geometry(points: FloatArray, cells: IntArray, cell: str, twins: int, refuse: Any) -> None:
    """Refuse cells without volume, and parts that only appear to be joined."""
    edges = points[cells[:, AT_CORNERS[cell]]]  # cells, corners, 4, 3
    sides = edges[:, :, 1:] - edges[:, :, :1]
    volumes = np.linalg.det(sides)
    size = np.linalg.norm(sides, axis=-1).max(axis=(1, 2)) ** 3
    flat = ~((volumes > FLAT * size[:, None]).all(axis=1) | (volumes < -FLAT * size[:, None]).all(axis=1))
    if flat.any():
        refuse(f"{flat.sum()} of {len(cells)} cells have no volume or are turned inside out")
    _check_twins(twins, refuse)


def _check_twins(twins: int, refuse: Any) -> None:
    """Refuse points that lie where others lie."""
    if twins:
        refuse(
            f"{twins} points lie where others lie: its parts are not joined, expected a mesh without double points, "
            "except on closed slits, whose faces lie on each other"
        )


def _check_joints(points: FloatArray, cells: IntArray, cell: str, refuse: Any) -> None:
    """Refuse overlapping cells, and bodies in several parts: cells are joined only by shared faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = np.sort(faces_of(cells, cell), axis=1)
    owners = np.repeat(np.arange(len(cells)), len(FACES[cell]))
    _, which, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    if (count > 2).any():
        refuse(f"{(count > 2).sum()} faces belong to more than two cells: some cells are there twice")
    inner = np.argsort(which, kind="stable")
    inner = inner[count[which[inner]] == 2].reshape(-1, 2)  # places of both cells in the list of faces
    a, b = owners[inner].T
    parts, part = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(len(cells),) * 2), directed=False)
    if parts > 1:
        _check_twins(twins_of(points), refuse)
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
    faces = np.sort(faces_of(cells, cell), axis=1)
    sorted_facets = np.sort(facets, axis=1)
    unique, which = np.unique(np.concatenate([faces, sorted_facets]), axis=0, return_inverse=True)
    which = which.ravel()
    of_cells = np.bincount(which[: len(faces)], minlength=len(unique))
    outside = of_cells[which[len(faces) :]] == 1
    found = {word: facets[outside & member] for word, member in groups.items()}
    return {word: part for word, part in found.items() if len(part)}
