"""The surface of a body as arrays, for what is looked at before it is meshed: facets of boundaries, nearest places."""

from __future__ import annotations

import numpy as np

from forward.bodies.geometry import AXES, Body
from forward.bodies.location import nearest_of
from forward.bodies.mesh import fan
from forward.model import FloatArray

NEAREST = 4  # triangles that are tried first
AT_ONCE = 200_000  # pairs of a point and a triangle
FINE = 12  # parts of the edge of a facet at which it is looked at closely


def facets(body: Body, boundary: str) -> FloatArray:
    """Return the corners (n, 3 or 4, 3) (m) of the facets of a boundary, those of a quadrilateral one after another."""
    if body.kind == "mesh":
        mesh = body.load()
        return np.asarray(mesh.points[mesh.boundaries[boundary]])
    axis, end = AXES.index(boundary[0]), boundary.endswith("max")
    across = [a for a in range(3) if a != axis]
    lattice = np.zeros((*(body.cells[a] + 1 for a in across), 3))
    lattice[..., axis] = body.meshed[axis] if end else 0.0
    for k, a in enumerate(across):
        steps = np.linspace(0, body.meshed[a], body.cells[a] + 1)
        lattice[..., a] = steps[:, None] if k == 0 else steps
    lattice = body.place(lattice.reshape(-1, 3)).reshape(lattice.shape)
    corners = [lattice[:-1, :-1], lattice[1:, :-1], lattice[1:, 1:], lattice[:-1, 1:]]
    return np.asarray(np.stack(corners, axis=2).reshape(-1, 4, 3))


def edges(corners: FloatArray) -> FloatArray:
    """Return the length (n,) of the longest edge of each facet (n, k, 3)."""
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1))


def points(corners: FloatArray, near: FloatArray, along: FloatArray) -> FloatArray:
    """Return points (n, 3) of facets (k, m, 3): corners, centres, where a line pierces them, and many near a point.

    Parameters
    ----------
    corners
        The facets (m).
    near, along
        The point (3,) (m), and the direction (3,) of the line through it.
    """
    centres = corners.mean(axis=1)
    close = np.linalg.norm(centres - near, axis=1) <= 1.5 * edges(corners)
    s, t = (part.ravel() for part in np.meshgrid(*[np.linspace(0, 1, FINE + 1)] * 2))
    if corners.shape[1] == 4:
        weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=1)
    else:
        inside = s + t <= 1 + 1e-9
        weights = np.stack([1 - s - t, s, t], axis=1)[inside]
    fine = np.einsum("pk,nkx->npx", weights, corners[close]).reshape(-1, 3)
    return np.concatenate([corners.reshape(-1, 3), centres, fine, _pierced(corners, near, along)])


def _pierced(corners: FloatArray, start: FloatArray, along: FloatArray) -> FloatArray:
    """Return where the line through a point (3,) along a direction (3,) pierces facets, divided into triangles."""
    a, b, c = np.moveaxis(fan(corners), 1, 0)
    sides = np.stack([b - a, c - a, np.broadcast_to(-along, a.shape)], axis=2)
    steep = np.abs(np.linalg.det(sides)) > 1e-12 * np.linalg.norm(sides, axis=1).prod(axis=1)
    s, t, far = np.linalg.solve(sides[steep], (start - a[steep])[..., None])[..., 0].T
    inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
    return np.asarray(start + far[inside, None] * along)


class Surface:
    """The whole surface of a body: corners (n, 3, 3) of its triangles (m)."""

    def __init__(self, triangles: FloatArray) -> None:
        from scipy.spatial import cKDTree

        self.triangles = triangles
        centres = triangles.mean(axis=1)
        self._reach = float(np.linalg.norm(triangles - centres[:, None], axis=2).max())
        self._centres = cKDTree(centres)

    @classmethod
    def of(cls, body: Body) -> Surface:
        """Make that of a body."""
        corners = [body.surface] if body.kind == "mesh" else [facets(body, name) for name in body.boundaries]
        return cls(np.concatenate([fan(one) for one in corners]))

    @property
    def middle(self) -> FloatArray:
        """Centre (3,) of the box around it (m)."""
        points = self.triangles.reshape(-1, 3)
        return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)

    def nearest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the places (n, 3) nearest to points (n, 3) (m), and the unit normals (n, 3) there, of either sign."""
        few = min(NEAREST, len(self.triangles))
        first = self._centres.query(points, few)[1].reshape(len(points), few)
        tried = [nearest_of(self.triangles[one], points) for one in first.T]
        far = np.min([np.linalg.norm(one - points, axis=1) for one in tried], axis=0)
        near = self._centres.query_ball_point(points, far * (1 + 1e-9) + self._reach)
        point = np.repeat(np.arange(len(points)), [len(found) for found in near])
        triangle = np.concatenate([np.asarray(found, dtype=np.int64) for found in near])
        parts = np.array_split(np.arange(len(point)), -(-len(point) // AT_ONCE))
        places = np.concatenate([nearest_of(self.triangles[triangle[one]], points[point[one]]) for one in parts])
        distance = ((places - points[point]) ** 2).sum(axis=1)
        order = np.lexsort((triangle, distance, point))
        best = order[np.searchsorted(point[order], np.arange(len(points)))]
        a, b, c = np.moveaxis(self.triangles[triangle[best]], 1, 0)
        normal = np.cross(b - a, c - a)
        return places[best], normal / np.linalg.norm(normal, axis=1, keepdims=True)
