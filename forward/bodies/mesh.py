"""Meshes as arrays: what a body from a file is in memory, what a study knows about it, and how cells are divided."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from forward.model import FloatArray, ModelError
from forward.settings import Settings, nearest

Point = tuple[float, float, float]
IntArray = NDArray[np.int64]
T = TypeVar("T", bound=np.generic)
SHIFT = 32  # bits of a vertex in the key of an edge
QUARTER = 0.25  # where an edge that leaves a boundary is divided, towards which cells are to be thinner
CLOSE = 1e-9  # distance, over the extent of the body, within which points coincide
APART = 1e-6, 1e-3  # how far lips of closed slits are drawn apart, over that extent, and at most over the shortest edge
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])  # VTK's
X_FIRST = [0, 1, 3, 2, 4, 5, 7, 6]  # these, x first, then y, then z
FACES = {
    "tetrahedron": [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]],
    "hexahedron": [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [3, 2, 6, 7], [0, 3, 7, 4], [1, 2, 6, 5]],  # in circles
}
EDGES = {
    "tetrahedron": [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]],
    "hexahedron": [[a, b] for a in range(8) for b in range(a, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1],
}
TETRAHEDRA = {
    "tetrahedron": [[0, 1, 2, 3]],
    "hexahedron": [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]],
}
# Corners with their neighbours, in an order that makes all determinants positive; of a tetrahedron one is enough.
AT_CORNERS = {
    "tetrahedron": [[0, 1, 2, 3]],
    "hexahedron": [
        [0, 1, 3, 4],
        [1, 2, 0, 5],
        [2, 3, 1, 6],
        [3, 0, 2, 7],
        [4, 7, 5, 0],
        [5, 4, 6, 1],
        [6, 5, 7, 2],
        [7, 6, 4, 3],
    ],
}


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
    slits
        Areas (m²) of closed slits by the names of their boundaries; "" for what is in none.
    lift
        What facets hide at the vertices (n, 3) in m (`forward.bodies.facets`), if it is known of the mesh that this one
        was made from.
    """

    points: FloatArray
    cells: IntArray
    cell: Literal["tetrahedron", "hexahedron"]
    boundaries: dict[str, IntArray]
    regions: tuple[str, ...]
    region: IntArray
    slits: dict[str, float] = field(default_factory=dict)
    lift: FloatArray | None = None


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
    slits
        Areas (m²) of closed slits by the names of their boundaries; "" for what is in none.
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
    slits: dict[str, float] = Field(default={}, exclude_if=operator.not_)


def places_of(points: FloatArray) -> IntArray:
    """Return the number (n,) of the place of each of points (n, 3): equal for those that coincide."""
    grid = np.round((points - points.min(axis=0)) / (CLOSE * np.ptp(points, axis=0).max())).astype(np.int64)
    return np.asarray(np.unique(grid, axis=0, return_inverse=True)[1].ravel())


def twins_of(points: FloatArray) -> int:
    """Return how many of points (n, 3) lie where others lie."""
    return len(points) - int(places_of(points).max()) - 1


def edges_of(cells: IntArray, cell: str) -> tuple[IntArray, IntArray]:
    """Return the edges (n, 2) of cells, the lower vertex first, and their numbers (c, 6 or 12) for each cell."""
    edges = np.sort(cells[:, EDGES[cell]].reshape(-1, 2), axis=1)
    found, number = np.unique(edges, axis=0, return_inverse=True)
    return found, number.reshape(len(cells), -1)


def keys_of(edges: IntArray) -> IntArray:
    """Return one number for each edge (…, 2), the same in both directions: the lower vertex, then the higher one."""
    return np.asarray(edges.min(axis=-1) << SHIFT | edges.max(axis=-1))


def faces_of(cells: IntArray, cell: str) -> IntArray:
    """Return the faces (n, 3 or 4) of all cells, one cell after the other, by their vertices."""
    return np.asarray(cells[:, FACES[cell]].reshape(-1, len(FACES[cell][0])))


def surface_of(cells: IntArray, cell: str) -> tuple[IntArray, IntArray]:
    """Return the faces (n, 3 or 4) that belong to one cell, by their vertices, and the numbers (n,) of these cells."""
    faces = faces_of(cells, cell)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = first[count == 1]
    return np.asarray(faces[outer]), np.asarray(outer // len(FACES[cell]))


def opened(points: FloatArray, cells: IntArray, cell: str) -> tuple[FloatArray, IntArray, int]:
    """Draw the lips of closed slits apart; return the points, the faces (k, 3 or 4) of the lips, and twins that stay.

    Lips are faces of the surface that lie on each other, corner on corner. Of points at one place, that of the cell
    which comes first stays; others move a little into their cells. So each node has a place of its own: the canonical
    order, and whatever looks for places, needs no word about slits; a place on a slit is on the lip that stays.
    Double points elsewhere stay as they are.
    """
    places = places_of(points)
    if places.max() + 1 == len(points):
        return points, np.zeros((0, len(FACES[cell][0])), dtype=np.int64), 0
    outer, _ = surface_of(cells, cell)
    _, which, count = np.unique(np.sort(places[outer], axis=1), axis=0, return_inverse=True, return_counts=True)
    lips = outer[count[which.ravel()] > 1]
    holder = np.full(len(points), len(cells))  # of each point, the cell that comes first
    np.minimum.at(holder, cells, np.arange(len(cells))[:, None])
    staying = np.full(len(points), len(cells))
    np.minimum.at(staying, places, holder)
    moving = np.intersect1d(lips, np.flatnonzero(holder > staying[places]))
    number = np.full(len(points), -1)  # of each point among those that move
    number[moving] = np.arange(len(moving))
    holds, corner = np.nonzero(number[cells] >= 0)
    which = number[cells[holds, corner]]
    edges = points[cells[holds]] - points[cells[holds, corner]][:, None]
    lengths = np.linalg.norm(edges, axis=-1)
    lengths[np.arange(len(holds)), corner] = np.inf
    inwards, shortest = np.zeros((len(moving), 3)), np.full(len(moving), np.inf)
    np.add.at(inwards, which, edges.sum(axis=1))
    np.minimum.at(shortest, which, lengths.min(axis=1))
    steps = np.minimum(APART[0] * np.ptp(points, axis=0).max(), APART[1] * shortest)
    moved = points.copy()
    moved[moving] += (steps / np.linalg.norm(inwards, axis=1))[:, None] * inwards
    return moved, lips, twins_of(moved)


def slits_of(points: FloatArray, lips: IntArray, boundaries: dict[str, IntArray]) -> dict[str, float]:
    """Return the area (m²) of the slits between lips, by the names of boundaries that they are in; "" for none."""
    if not len(lips):
        return {}
    places = places_of(points)
    faces = {tuple(sorted(places[face].tolist())): face for face in lips}
    found, left = {}, set(faces)
    for name, facets in boundaries.items():
        its = {tuple(row) for row in np.sort(places[facets], axis=1).tolist()} & set(faces)
        if its:
            found[name] = area(points[[faces[face] for face in sorted(its)]])
        left -= its
    return found | ({"": area(points[[faces[face] for face in sorted(left)]])} if left else {})


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
        raise ModelError(f"divide: {nearest(unknown[0], tuple(mesh.boundaries))}")
    held = np.zeros(len(mesh.points))
    for name in towards:
        held[mesh.boundaries[name]] = 0.5 - QUARTER
    if mesh.cell == "hexahedron":
        return _hexahedra_divided(mesh, held)
    ends, edge = edges_of(mesh.cells, mesh.cell)
    share = 0.5 + held[ends[:, 1]] - held[ends[:, 0]]  # of the second end
    points = np.concatenate(
        [mesh.points, (1 - share)[:, None] * mesh.points[ends[:, 0]] + share[:, None] * mesh.points[ends[:, 1]]]
    )
    m01, m02, m03, m12, m13, m23 = len(mesh.points) + edge.T
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
    keys = keys_of(ends)

    def quartered(facets: IntArray) -> IntArray:
        ij, jk, ik = (len(mesh.points) + np.searchsorted(keys, keys_of(facets[:, [[0, 1], [1, 2], [0, 2]]]))).T
        i, j, k = facets.T
        parts = [(i, ij, ik), (j, ij, jk), (k, ik, jk), (ij, jk, ik)]
        return np.asarray(np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3))

    boundaries = {name: quartered(facets) for name, facets in mesh.boundaries.items()}
    return replace(
        mesh, points=points, cells=cells.reshape(-1, 4), boundaries=boundaries, region=np.repeat(mesh.region, 8)
    )


def _hexahedra_divided(mesh: Loaded, nearer: FloatArray) -> Loaded:
    """Divide every hexahedron into eight trilinear ones, which fill the same body.

    The point that divides an edge lies nearer to a vertex than the middle by `nearer` (n,) of its length, less that of
    the other end. Points on faces and inside are at the mean shares of the edges along them.
    """
    points, cells = mesh.points, mesh.cells
    ends, edge = edges_of(cells, mesh.cell)
    around = faces_of(cells, mesh.cell)
    sides, first, face = np.unique(np.sort(around, axis=1), axis=0, return_index=True, return_inverse=True)
    circles = around[first]
    starts = np.cumsum([len(points), len(ends), len(sides)])

    def share(a: IntArray, b: IntArray) -> FloatArray:
        """Of the way from vertices a to b."""
        return np.asarray(0.5 + nearer[b] - nearer[a])

    i, j = ends.T
    on_edges = points[i] + share(i, j)[:, None] * (points[j] - points[i])
    a, b, c, d = circles.T
    on_faces = _at(points, circles[:, [0, 1, 3, 2]], (share(a, b) + share(d, c)) / 2, (share(a, d) + share(b, c)) / 2)
    along = [[(a, b) for a, b in np.ndindex(8, 8) if (CORNERS[b] - CORNERS[a] == unit).all()] for unit in np.eye(3)]
    inside = [np.mean([share(cells[:, p], cells[:, q]) for p, q in pairs], axis=0) for pairs in along]
    whole = np.concatenate([points, on_edges, on_faces, _at(points, cells[:, X_FIRST], *inside)])

    numbers = np.empty((len(cells), 3, 3, 3), dtype=np.int64)  # of the 27 points of each cell
    numbers[:, 1, 1, 1] = starts[2] + np.arange(len(cells))
    for k, at in enumerate(CORNERS):
        numbers[:, *(2 * at)] = cells[:, k]
    for of, offset, entities in ((edge, starts[0], EDGES), (face, starts[1], FACES)):
        for k, corners in enumerate(entities[mesh.cell]):
            middle = 2 * CORNERS[corners].sum(axis=0) // len(corners)
            numbers[:, *middle] = offset + of.reshape(len(cells), -1)[:, k]
    parts = [np.stack([numbers[:, *(low + corner)] for corner in CORNERS], axis=1) for low in CORNERS]
    edge_keys, side_keys = keys_of(ends), {tuple(side): n for n, side in enumerate(sides.tolist())}

    def quartered(facets: IntArray) -> IntArray:
        which = np.array([side_keys[tuple(sorted(facet))] for facet in facets.tolist()])
        around = circles[which]
        pairs = np.stack([around, np.roll(around, -1, axis=1)], axis=2)
        after = starts[0] + np.searchsorted(edge_keys, keys_of(pairs))
        before = np.roll(after, 1, axis=1)
        quads = [np.stack([around[:, k], after[:, k], starts[1] + which, before[:, k]], axis=1) for k in range(4)]
        return np.asarray(np.stack(quads, axis=1).reshape(-1, 4))

    boundaries = {name: quartered(facets) for name, facets in mesh.boundaries.items()}
    divided = np.stack(parts, axis=1).reshape(-1, 8)
    return replace(mesh, points=whole, cells=divided, boundaries=boundaries, region=np.repeat(mesh.region, 8))


def _at(points: FloatArray, corners: IntArray, *shares: FloatArray) -> FloatArray:
    """Return multilinear combinations of corners (c, 2^k), x first, at shares (c,) along each of k axes."""
    found = points[corners]
    for share in shares[::-1]:
        low, high = np.split(found, 2, axis=1)
        found = low + share[:, None, None] * (high - low)
    return np.asarray(found[:, 0])


def divided_contents(found: Contents) -> Contents:
    """Say what a mesh holds whose cells are divided into eight.

    Every edge is halved. A triangle has three new ones and a tetrahedron one: the shortest of the three that join the
    middles of opposite edges, the squares of which are a quarter of the sum of those of the six edges. A quadrilateral
    has four, a hexahedron six.
    """
    hexahedra = found.cell == "hexahedron"
    changes = {
        "vertices": found.vertices + found.edges + (found.faces + found.cells if hexahedra else 0),
        "edges": 2 * found.edges + (4 * found.faces + 6 * found.cells if hexahedra else 3 * found.faces + found.cells),
        "faces": 4 * found.faces + (12 if hexahedra else 8) * found.cells,
        "cells": 8 * found.cells,
        "longest_edge": found.longest_edge / (2 if hexahedra else 2**0.5),
    }
    return found.model_copy(update=changes)


def contents(mesh: Loaded, digest: str) -> Contents:
    """Return what a study needs to know about a mesh."""
    points, cells = mesh.points, mesh.cells
    edges, _ = edges_of(cells, mesh.cell)
    faces = np.unique(np.sort(faces_of(cells, mesh.cell), axis=1), axis=0)
    at = points[cells[:, AT_CORNERS[mesh.cell]]]
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
        areas={name: float(f"{area(points[facets]):.6g}") for name, facets in mesh.boundaries.items()},
        regions={name: float(f"{volume:.6g}") for name, volume in zip(mesh.regions, sums, strict=True)},
        slits=mesh.slits,
    )


def fan(corners: NDArray[T]) -> NDArray[T]:
    """Return the triangles (n (k − 2), 3, …) that facets (n, k, …) are divided into around their first corners."""
    return np.concatenate([corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)])


def area(corners: FloatArray) -> float:
    """Return the area of facets (n, 3 or 4, 3) together."""
    a, b, c = np.moveaxis(fan(corners), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2)


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


def default_quadrature(cell: Literal["tetrahedron", "hexahedron"], degree: int) -> int:
    """Return the lowest degree of quadrature that keeps the order of convergence of elements of a degree."""
    return 2 * degree + (1 if cell == "hexahedron" else -1)
