"""Which cell of a mesh a point lies in, and where in it.

Every point gets a cell: the one in which it lies or else the nearest one, with the nearest place in it. So no point is
lost by rounding, of coordinates written with few digits or of computed nodes; the distance of a point from the mesh is
returned, and the caller decides how far is too far.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.bodies.mesh import FACES
from forward.model import FloatArray

ROUNDING = 1e-12  # of the extent of the mesh: distance that counts as rounding
STEPS = 30  # of Newton's method in a hexahedron
NEAREST = 8  # cells that are tried for a point in no cell
AT_ONCE = 2048  # points
FEW = 2**21  # pairs of a point and a cell, all of which are looked at


class Located(NamedTuple):
    """Where points lie.

    Attributes
    ----------
    cells
        Number (n,) of the cell.
    local
        Coordinates (n, 3) in the reference cell, never outside.
    distances
        Distance (n,) of that place from the point (m); zero for rounding, infinite if there are no cells.
    """

    cells: NDArray[np.int64]
    local: FloatArray
    distances: FloatArray


def locate(corners: FloatArray, points: FloatArray) -> Located:
    """Find the cells in which points lie, or else the nearest ones.

    Corners (n_cells, 4 or 8, 3) are those of tetrahedra or hexahedra, x first, then y, then z.
    """
    n = len(points)
    if not len(corners) or not n:
        return Located(np.zeros(n, dtype=np.int64), np.zeros((n, 3)), np.full(n, np.inf))
    lows, highs = corners.min(axis=1), corners.max(axis=1)
    tiny = ROUNDING * float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    parts = [_some(corners, (lows, highs), part, tiny) for part in np.array_split(points, -(-n // AT_ONCE))]
    return Located(*map(np.concatenate, zip(*parts, strict=True)))


def _some(corners: FloatArray, boxes: tuple[FloatArray, FloatArray], points: FloatArray, tiny: float) -> Located:
    point, cell = _candidates(*boxes, points)
    of_cells = corners[cell]
    local = (_in_tetrahedra if corners.shape[1] == 4 else _in_hexahedra)(of_cells, points[point])
    gap = np.einsum("nk,nka->na", shapes(local, corners.shape[1]), of_cells) - points[point]
    distance = np.linalg.norm(gap, axis=1)
    distance[distance < tiny] = 0.0
    order = np.lexsort((cell, distance, point))
    best = order[np.searchsorted(point[order], np.arange(len(points)))]
    return Located(cell[best], local[best], distance[best])


def _candidates(lows: FloatArray, highs: FloatArray, points: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of a point and a cell that may hold it, or may be the nearest, sorted by point."""
    slack = 0.05 * (highs - lows)
    lowest, highest = lows - slack, highs + slack
    if len(points) * len(lows) <= FEW:
        within = np.ones((len(points), len(lows)), dtype=bool)
        for x, low, high in zip(points.T, lowest.T, highest.T, strict=True):
            within &= (x[:, None] >= low) & (x[:, None] <= high)
        point, cell = np.nonzero(within)
    else:
        from scipy.spatial import cKDTree

        reach = float(np.linalg.norm(highs - lows, axis=1).max()) * 0.55
        near = cKDTree((lows + highs) / 2).query_ball_point(points, reach)
        point = np.repeat(np.arange(len(points)), [len(cells) for cells in near])
        cell = np.concatenate([np.asarray(cells, dtype=np.int64) for cells in near])
        inside = ((lowest[cell] <= points[point]) & (points[point] <= highest[cell])).all(axis=1)
        point, cell = point[inside], cell[inside]
    lost = np.setdiff1d(np.arange(len(points)), point)
    pairs = [(point, cell)]
    for i in lost:
        far = np.linalg.norm(np.maximum(np.maximum(lows - points[i], points[i] - highs), 0), axis=1)
        found = np.argsort(far, kind="stable")[:NEAREST]
        pairs.append((np.full(len(found), i), found))
    point, cell = (np.concatenate(part) for part in zip(*pairs, strict=True))
    order = np.argsort(point, kind="stable")
    return point[order], cell[order]


def shapes(local: FloatArray, corners: int) -> FloatArray:
    """Values (n, 4 or 8) of the linear shape functions of the corners at reference coordinates (n, 3)."""
    if corners == 4:
        return np.column_stack([1 - local.sum(axis=1), local])
    ends = np.stack([1 - local, local], axis=1)  # (n, 2, 3)
    return np.asarray(np.einsum("ni,nj,nk->nkji", ends[..., 0], ends[..., 1], ends[..., 2]).reshape(-1, 8))


def _mapped(corners: FloatArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return places (n, 3) in hexahedra and their derivatives (n, 3, 3), coordinates first; axis by axis."""
    x, y, z = local.T[:, :, None]
    along_z = corners[:, 4:] - corners[:, :4]
    of_z = corners[:, :4] + z[:, None] * along_z
    of_yz, slopes_z = (part[:, :2] + y[:, None] * (part[:, 2:] - part[:, :2]) for part in (of_z, along_z))
    slopes_y = of_z[:, 2:] - of_z[:, :2]
    slopes_x = of_yz[:, 1] - of_yz[:, 0]
    others = (part[:, 0] + x * (part[:, 1] - part[:, 0]) for part in (slopes_y, slopes_z))
    return of_yz[:, 0] + x * slopes_x, np.stack([slopes_x, *others], axis=2)


def _in_tetrahedra(corners: FloatArray, points: FloatArray) -> FloatArray:
    def shares(places: FloatArray, corners: FloatArray) -> FloatArray:
        edges = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 2)
        x = np.linalg.solve(edges, (places - corners[:, 0])[..., None])[..., 0]
        return np.column_stack([1 - x.sum(axis=1), x])

    found = shares(points, corners)
    out = np.flatnonzero((found < 0).any(axis=1))
    if len(out):
        faces = np.array([nearest_of(corners[out][:, face], points[out]) for face in FACES["tetrahedron"]])
        best = ((faces - points[out]) ** 2).sum(axis=2).argmin(axis=0)
        found[out] = np.maximum(shares(faces[best, np.arange(len(out))], corners[out]), 0.0)
    return np.asarray((found / found.sum(axis=1, keepdims=True))[:, 1:])


def _in_hexahedra(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Newton's method in the reference cell, the steps of which end at its faces."""
    x = np.full((len(points), 3), 0.5)
    left = np.arange(len(points))
    for _ in range(STEPS):
        places, slopes = _mapped(corners[left], x[left])
        step = np.linalg.solve(slopes, (points[left] - places)[..., None])[..., 0]
        new = np.clip(x[left] + step, 0.0, 1.0)
        moved = np.abs(new - x[left]).max(axis=1, initial=0.0)
        x[left] = new
        left = left[~(moved < 1e-14)]
        if not len(left):
            break
    return x


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
