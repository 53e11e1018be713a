"""Surfaces where a function is zero, and cells cut into tetrahedra."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

IntArray = NDArray[np.int64]
HEXAHEDRA = (12, 29, 72)  # kinds of cells of VTK
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
# Six tetrahedra around a diagonal of a hexahedron.
SIX = np.array([[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]])


def tetrahedra(cells: IntArray, kind: int) -> IntArray:
    """Return tetrahedra (t, 4) between the corners of cells."""
    return cells[:, SIX].reshape(-1, 4) if kind in HEXAHEDRA else cells[:, :4]


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
    corner_steps = np.array([numbers[tuple(corner)] for corner in CORNERS])
    cells = starts[:, None] + corner_steps
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
    """Return the points (n, 3) and triangles (t, 3) where values at nodes (N, 3) are zero, linear in tetrahedra (m, 4).

    The triangles are turned either way.
    """
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
