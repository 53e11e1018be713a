"""Facets of named boundaries as arrays, for what is checked before a body is meshed."""

from __future__ import annotations

import numpy as np

from forward.bodies.geometry import AXES, Body
from forward.bodies.mesh_file import MeshFile
from forward.model import FloatArray

FINE = 12  # parts of the edge of a facet at which it is looked at closely


def facets(body: Body, boundary: str) -> FloatArray:
    """Return the corners (n, 3 or 4, 3) (m) of the facets of a boundary, those of a quadrilateral one after another."""
    if isinstance(body, MeshFile):
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
    fan = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
    a, b, c = np.moveaxis(np.concatenate(fan), 1, 0)
    sides = np.stack([b - a, c - a, np.broadcast_to(-along, a.shape)], axis=2)
    steep = np.abs(np.linalg.det(sides)) > 1e-12 * np.linalg.norm(sides, axis=1).prod(axis=1)
    s, t, far = np.linalg.solve(sides[steep], (start - a[steep])[..., None])[..., 0].T
    inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
    return np.asarray(start + far[inside, None] * along)
