"""Hexahedra divided into eight each: a mesh of trilinear cells whose body stays the same."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

IntArray = NDArray[np.int64]
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])  # VTK's
EDGES = np.array([(a, b) for a in range(8) for b in range(a, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1])
FACES = np.array([(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (3, 2, 6, 7), (0, 3, 7, 4), (1, 2, 6, 5)])  # in circles


class Divided(NamedTuple):
    """Vertices (n, 3) of the finer mesh, its cells (8 c, 8) in the order of the coarse ones, and facets by boundary."""

    points: FloatArray
    cells: IntArray
    boundaries: dict[str, IntArray]


def divided(points: FloatArray, cells: IntArray, boundaries: dict[str, IntArray], nearer: FloatArray) -> Divided:
    """Divide every hexahedron into eight.

    Parameters
    ----------
    points, cells, boundaries
        Vertices (n, 3), cells (c, 8) in VTK's order, and quadrilaterals (k, 4) of each boundary.
    nearer
        How far (n,) the point that divides an edge lies from its middle towards each vertex, over its length, beyond
        the other end. Points on faces and inside are at the mean shares of the edges along them.
    """
    ends, edge = np.unique(np.sort(cells[:, EDGES].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    around = cells[:, FACES].reshape(-1, 4)
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
    lattice_of_corners = np.argsort(CORNERS @ [1, 2, 4])
    whole = np.concatenate([points, on_edges, on_faces, _at(points, cells[:, lattice_of_corners], *inside)])

    numbers = np.empty((len(cells), 3, 3, 3), dtype=np.int64)  # of the 27 points of each cell
    numbers[:, 1, 1, 1] = starts[2] + np.arange(len(cells))
    for k, at in enumerate(CORNERS):
        numbers[:, *(2 * at)] = cells[:, k]
    for of, offset, entities in ((edge, starts[0], EDGES), (face, starts[1], FACES)):
        for k, corners in enumerate(entities):
            middle = 2 * CORNERS[corners].sum(axis=0) // len(corners)
            numbers[:, *middle] = offset + of.reshape(len(cells), -1)[:, k]
    parts = [np.stack([numbers[:, *(low + corner)] for corner in CORNERS], axis=1) for low in CORNERS]
    edge_keys, side_keys = ends[:, 0] << 32 | ends[:, 1], {tuple(side): n for n, side in enumerate(sides.tolist())}

    def quartered(facets: IntArray) -> IntArray:
        which = np.array([side_keys[tuple(sorted(facet))] for facet in facets.tolist()])
        around = circles[which]
        pairs = np.sort(np.stack([around, np.roll(around, -1, axis=1)], axis=2), axis=2)
        after = starts[0] + np.searchsorted(edge_keys, pairs[..., 0] << 32 | pairs[..., 1])
        before = np.roll(after, 1, axis=1)
        quads = [np.stack([around[:, k], after[:, k], starts[1] + which, before[:, k]], axis=1) for k in range(4)]
        return np.asarray(np.stack(quads, axis=1).reshape(-1, 4))

    found = {name: quartered(facets) for name, facets in boundaries.items()}
    return Divided(whole, np.stack(parts, axis=1).reshape(-1, 8), found)


def _at(points: FloatArray, corners: IntArray, *shares: FloatArray) -> FloatArray:
    """Return multilinear combinations of corners (c, 2^k), x first, at shares (c,) along each of k axes."""
    found = points[corners]
    for share in shares[::-1]:
        low, high = np.split(found, 2, axis=1)
        found = low + share[:, None, None] * (high - low)
    return np.asarray(found[:, 0])
