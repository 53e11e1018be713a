"""Surfaces of meshes, and where a function is zero; cells cut into tetrahedra, and rigid tools at their depth."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from math import comb
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.bodies.mesh import TETRAHEDRA
from forward.model import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from forward.terms.indenter import Indenter

IntArray = NDArray[np.int64]
POINTS = 40  # of the lattice on which distances are computed, along each axis
SHOWN = 0.35  # part of the body's extent that a tool without end is drawn over, to each side
SHARP = np.cos(np.radians(40))  # of the angle between faces from which an edge is one
# The corners of each face, seen from outside against the clock.
QUADRILATERALS = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (3, 7, 6, 2), (0, 4, 7, 3), (1, 2, 6, 5))
TRIANGLES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
HEXAHEDRA = (12, 29, 72)  # kinds of cells of VTK
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])  # of VTK


def tools_of(dataset: xr.Dataset) -> Iterator[Indenter]:
    """Return the tools of a study, along a path at the last step."""
    model = tomllib.loads(dataset.attrs.get("config", "")).get("model", {})
    loads = [load for load in model.get("loads", ()) if load.get("kind") == "indenter"]
    if not loads:
        return
    from forward.terms.indenter import Indenter

    means: dict[str, float] = {}
    if "parameter_mean" in dataset:
        names = [str(name) for name in dataset["parameter"].values]
        means = dict(zip(names, map(float, dataset["parameter_mean"].values), strict=True))
    means |= {path: values[-1] for path, values in model.get("steps", {}).items()}
    for load in loads:
        block = load | {"depth": np.ravel(load["depth"])[-1].item()}
        label = Indenter.model_construct(**block).label
        own = {path.rpartition(".")[2]: v for path, v in means.items() if path.rpartition(".")[0] == f"loads.{label}"}
        block["at"] = [own.pop(axis, value) for axis, value in zip("xyz", block["at"], strict=True)]
        yield Indenter.model_validate(block | own)


def surface(tool: Indenter, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return points (n, 3) and triangles (t, 3) of the surface of a tool at its depth: where the distance is zero.

    Tools without end are drawn as far as the body reaches, which has these points (n, 3) (m).
    """
    low, high = points.min(axis=0), points.max(axis=0)
    extent, d = float((high - low).max()), np.array(tool.along)
    tip, middle = np.array(tool.at) + tool.depth * d, (low + high) / 2
    if tool.shape == "plane":
        centre = tip + (np.eye(3) - np.outer(d, d)) @ (middle - tip)
        one = np.cross(d, np.eye(3)[int(np.abs(d).argmin())])
        one *= 0.55 * extent / np.linalg.norm(one)
        other = np.cross(d, one) / np.linalg.norm(d)
        corners = centre + np.array([one + other, other - one, -one - other, one - other])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])
    half = min(1.2 * (tool.radius or np.inf), SHOWN * extent)
    lengths = np.full(3, half)
    if tool.axis is not None:  # it is longer than the body
        along = np.abs(tool.axis) / np.linalg.norm(tool.axis)
        lengths = np.maximum(lengths, along * (extent / 2 + 0.2 * half))
        tip = tip + np.outer(tool.axis, tool.axis) @ (middle - tip) / np.dot(tool.axis, tool.axis)
    centre = tip - (half - 0.05 * half) * d
    return level(tool.gaps, centre - lengths, centre + lengths, POINTS)


def lattice(places: FloatArray, *, hexahedral: bool) -> IntArray:
    """Return where (k, 3) nodes at places (k, 3) of a cell are in the reference cell, in steps from 0 to its degree.

    Cells of a body have straight sides, and nodes at equal distances; their corners come first, in VTK's order.
    """
    degree = 1
    while ((degree + 1) ** 3 if hexahedral else comb(degree + 3, 3)) < len(places):
        degree += 1
    steps = np.array([at for at in product(range(degree + 1), repeat=3) if hexahedral or sum(at) <= degree])
    if hexahedral:
        shares = np.prod(np.where(CORNERS, steps[:, None] / degree, 1 - steps[:, None] / degree), axis=2)
    else:
        shares = np.column_stack([1 - steps.sum(axis=1) / degree, steps / degree])
    images = shares @ places[: shares.shape[1]]
    nearest = np.linalg.norm(places[:, None] - images, axis=2).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(places), "the nodes of a cell are not where they are expected"
    return np.asarray(steps[nearest])


def tetrahedra(cells: IntArray, kind: int) -> IntArray:
    """Return tetrahedra (t, 4) between the corners of cells."""
    return cells[:, TETRAHEDRA["hexahedron"]].reshape(-1, 4) if kind in HEXAHEDRA else cells[:, :4]


def level(
    distance: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, count: int = 28
) -> tuple[FloatArray, IntArray]:
    """Return the points (n, 3) and triangles (t, 3) where a function of places (n, 3) is zero, within a box.

    By marching tetrahedra on a lattice of `count` points along each axis; inside, the function is negative.
    """
    axes = [np.linspace(low[i], high[i], count) for i in range(3)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.asarray(distance(lattice), dtype=float)
    values = np.where(values == 0, 1e-300, values)
    numbers = np.arange(count**3).reshape(count, count, count)
    starts = numbers[:-1, :-1, :-1].ravel()
    cells = starts[:, None] + numbers[tuple(CORNERS.T)]
    signs = values[cells] < 0
    cells = cells[signs.any(axis=1) & ~signs.all(axis=1)]
    points, triangles = crossing(lattice, values, tetrahedra(cells, 12))
    # Outward is where the function grows.
    normal = np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2)))
    middle, step = points[triangles].mean(axis=1), 1e-3 * float(np.linalg.norm(high - low))
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    ahead, behind = (np.asarray(distance(middle + s * step * normal / length)) for s in (1, -1))
    triangles[ahead < behind] = triangles[ahead < behind][:, ::-1]
    return points, triangles


def crossing(nodes: FloatArray, values: FloatArray, four: IntArray) -> tuple[FloatArray, IntArray]:
    """Return points (n, 3) and triangles (t, 3), turned any way, where values at nodes (N, 3) of tetrahedra are 0."""
    inside = values[four] < 0
    counts = inside.sum(axis=1)
    pairs: list[IntArray] = []
    for how_many in (1, 3):
        chosen = counts == how_many
        odd = np.argsort(inside[chosen] != (how_many == 1), axis=1, kind="stable")  # the one that differs comes first
        t = np.take_along_axis(four[chosen], odd, axis=1)
        pairs.append(np.stack([t[:, [0, 1]], t[:, [0, 2]], t[:, [0, 3]]], axis=1))
    chosen = counts == 2
    t = np.take_along_axis(four[chosen], np.argsort(~inside[chosen], axis=1, kind="stable"), axis=1)
    pairs.append(np.stack([t[:, [0, 2]], t[:, [0, 3]], t[:, [1, 3]]], axis=1))
    pairs.append(np.stack([t[:, [0, 2]], t[:, [1, 3]], t[:, [1, 2]]], axis=1))
    ends = np.sort(np.concatenate(pairs).reshape(-1, 2), axis=1)
    unique, inverse = np.unique(ends, axis=0, return_inverse=True)
    v = values[unique]
    share = v[:, 0] / (v[:, 0] - v[:, 1])
    points = nodes[unique[:, 0]] + share[:, None] * (nodes[unique[:, 1]] - nodes[unique[:, 0]])
    return points, inverse.reshape(-1, 3)


@dataclass(frozen=True)
class Skin:
    """A surface of triangles whose vertices are nodes of a mesh."""

    triangles: IntArray  # vertices (t, 3), seen from outside against the clock
    nodes: IntArray  # of each vertex (v,); a node on a sharp edge is several vertices, one for each smooth part
    edges: IntArray  # nodes (e, 2) of the sharp edges


def skin(points: FloatArray, cells: IntArray, kind: int) -> Skin:
    """Return the surface of cells (c, k) of a kind of VTK, with nodes (n, 3)."""
    if not len(cells):
        none = np.zeros((0, 3), dtype=np.int64)
        return Skin(none, none[:, 0], none[:, :2])
    return split(points, outer(cells, faces(points, cells, kind))[0])


def faces(points: FloatArray, cells: IntArray, kind: int) -> list[tuple[IntArray, IntArray]]:
    """Return for each face of a cell its corners, and its triangles (t, 3) between all its nodes; numbers in the cell.

    Where the nodes of a cell are is found from their places in the first cell.
    """
    hexahedral = kind in HEXAHEDRA
    places = lattice(points[cells[0]], hexahedral=hexahedral)
    degree, numbers = int(places.max()), {tuple(at): n for n, at in enumerate(places.tolist())}
    found = []
    for corners in QUADRILATERALS if hexahedral else TRIANGLES:
        first, one, other = (places[corners[k]] for k in (0, 1, -1))
        triangles = []
        for i, j in product(range(degree), repeat=2):
            square = [
                numbers.get(tuple((first + (x * (one - first) + y * (other - first)) // degree).tolist()))
                for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            ]
            if square[1] is None or square[3] is None:
                continue
            if square[2] is None:
                triangles.append([square[0], square[1], square[3]])
            elif hexahedral and (i + j) % 2 == 0:  # diagonals that meet in the middle
                triangles += [[square[0], square[1], square[2]], [square[0], square[2], square[3]]]
            else:
                triangles += [[square[0], square[1], square[3]], [square[1], square[2], square[3]]]
        found.append((np.array(corners), np.array(triangles)))
    return found


def outer(cells: IntArray, faces_: list[tuple[IntArray, IntArray]]) -> tuple[IntArray, IntArray]:
    """Return the triangles (t, 3) of the faces that belong to one cell only, and the numbers (t,) of these cells."""
    keys = np.concatenate([np.sort(cells[:, corners], axis=1) for corners, _ in faces_])
    _, inverse, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    single = (counts[inverse.ravel()] == 1).reshape(len(faces_), len(cells))
    parts = [cells[alone][:, triangles].reshape(-1, 3) for (_, triangles), alone in zip(faces_, single, strict=True)]
    owners = [np.repeat(np.flatnonzero(alone), len(of)) for (_, of), alone in zip(faces_, single, strict=True)]
    return np.concatenate(parts), np.concatenate(owners)


def flat(kind: int) -> list[tuple[IntArray, IntArray]]:
    """Return for each face of a cell of a kind of VTK its corners, and its triangles (t, 3) between these alone."""
    sides = QUADRILATERALS if kind in HEXAHEDRA else TRIANGLES
    return [(np.array(of), np.array([of[:3], (of[0], *of[2:])][: len(of) - 2])) for of in sides]


def split(points: FloatArray, triangles: IntArray) -> Skin:
    """Make vertices of the nodes of triangles (t, 3): shared where the surface is smooth."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(triangles)
    normals = np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2)))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    corner = (3 * np.arange(count)[:, None] + [0, 1, 1, 2, 2, 0]).reshape(-1, 2)
    owner = np.repeat(np.arange(count), 3)
    flipped = ends[:, 0] > ends[:, 1]
    ends, corner = (np.where(flipped[:, None], x[:, ::-1], x) for x in (ends, corner))
    order = np.lexsort(ends.T[::-1])
    ends, corner, owner = ends[order], corner[order], owner[order]
    first = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    smooth = (normals[owner[first]] * normals[owner[first + 1]]).sum(axis=1) > SHARP
    joined = first[smooth]
    a, b = corner[joined].ravel(), corner[joined + 1].ravel()
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(3 * count, 3 * count))
    vertices, of_corner = connected_components(graph, directed=False)
    nodes = np.zeros(vertices, dtype=np.int64)
    nodes[of_corner] = triangles.ravel()
    # Neighbours next to each other: their differences are small, and compress well.
    rank = np.empty(vertices, dtype=np.int64)
    ordered = np.argsort(nodes, kind="stable")
    rank[ordered] = np.arange(vertices)
    lonely = np.ones(len(ends), dtype=bool)
    lonely[joined] = lonely[joined + 1] = False
    return Skin(rank[of_corner].reshape(-1, 3), nodes[ordered], np.unique(ends[lonely], axis=0))
