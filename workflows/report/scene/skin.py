"""Surfaces of meshes as triangles between their nodes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from forward.model import FloatArray
from workflows.results.surfaces import HEXAHEDRA, IntArray, lattice

SHARP = np.cos(np.radians(40))  # of the angle between faces from which an edge is one
# The corners of each face, seen from outside against the clock.
QUADRILATERALS = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (3, 7, 6, 2), (0, 4, 7, 3), (1, 2, 6, 5))
TRIANGLES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))


@dataclass(frozen=True)
class Skin:
    """A surface of triangles whose vertices are nodes of a mesh.

    Attributes
    ----------
    triangles
        Vertices (t, 3), seen from outside against the clock.
    nodes
        The node (v,) of each vertex; a node on a sharp edge is several vertices, one for each smooth part.
    edges
        Nodes (e, 2) of the sharp edges.
    """

    triangles: IntArray
    nodes: IntArray
    edges: IntArray


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
