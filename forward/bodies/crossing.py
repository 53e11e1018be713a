"""Where a deformed body passes through itself, or its surface would crease: no solver sees either.

Contact of a body with itself is not modelled. Every cell keeps its orientation in an equilibrium, so that a vertex of
the surface that lies in a cell which is not its own is where two parts of the body are at once. How deep says the
distance to the surface in front of it, of which the vertex is no part. Cells count with straight edges.

A flat free surface of soft matter that is compressed along itself by 35 % folds into creases as deep as wide, which
begin at points and are finer than any mesh (W. Hong, X. Zhao, Z. Suo, Appl. Phys. Lett. 95 (2009) 111901): solutions
without them are still equilibria, but not those that are observed.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from forward.bodies.location import nearest_of
from forward.bodies.mesh import TETRAHEDRA, IntArray, fan
from forward.model import FloatArray

OUTSIDE = -1e-3  # least barycentric coordinate: where meshes of both sides match, vertices lie on edges of cells
SEEN = 0.05  # of the extent of the cell: depths below are those of straight edges in place of curved ones
CREASED = 0.646  # stretch of a free surface below which creases have less energy
FLAT = 1e-6  # of the largest displacement: what moves less out of its plane is held in it
LOOKED_AT = 64  # vertices whose depth is found, at most


def deepest(
    points: FloatArray, cells: IntArray, cell: Literal["tetrahedron", "hexahedron"], faces: IntArray
) -> tuple[int, float] | None:
    """Return the vertex that lies deepest in another part of a body, and how far (m) behind its surface; None for none.

    Parameters
    ----------
    points
        Places (n, 3) (m) of deformed nodes.
    cells
        Corners (c, 4 or 8) of the cells, in VTK's order.
    cell
        Their kind.
    faces
        Vertices (f, 3 or 4) of the faces of the surface.
    """
    from scipy.spatial import cKDTree

    parts = cells[:, TETRAHEDRA[cell]].reshape(-1, 4)
    corners = points[parts]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    outer = np.unique(faces)
    near = cKDTree(points[outer]).query_ball_point(middles, reach)
    part = np.repeat(np.arange(len(parts)), [len(found) for found in near])
    vertex = outer[np.concatenate([np.asarray(found, dtype=np.int64) for found in near])]
    own = (cells[part // len(TETRAHEDRA[cell])] == vertex[:, None]).any(axis=1)
    part, vertex = part[~own], vertex[~own]
    sides = np.moveaxis(corners[part, 1:] - corners[part, :1], 1, 2)
    solid = np.abs(np.linalg.det(sides)) > np.finfo(float).tiny
    part, vertex, sides = part[solid], vertex[solid], sides[solid]
    inner = np.linalg.solve(sides, (points[vertex] - corners[part, 0])[..., None])[..., 0]
    margin = np.minimum(inner.min(axis=1), 1 - inner.sum(axis=1))
    order = np.argsort(-margin)[: int((margin > OUTSIDE).sum())]
    found: tuple[int, float] | None = None
    for k in order[:LOOKED_AT]:
        depth = _behind(points, faces, int(vertex[k]))
        if depth > SEEN * np.ptp(corners[part[k]], axis=0).max() and (found is None or depth > found[1]):
            found = int(vertex[k]), depth
    return found


def _behind(points: FloatArray, faces: IntArray, vertex: int) -> float:
    """Return the distance (m) of a vertex from the surface without the faces around it."""
    around = np.unique(faces[(faces == vertex).any(axis=1)])
    others = points[fan(faces[~np.isin(faces, around).any(axis=1)])]
    if not len(others):
        return 0.0
    places = nearest_of(others, np.broadcast_to(points[vertex], (len(others), 3)))
    return float(np.linalg.norm(places - points[vertex], axis=1).min())


def least_stretch(points: FloatArray, moved: FloatArray, faces: IntArray) -> tuple[int, float]:
    """Return a vertex where the free surface is compressed most along itself, and the stretch there.

    Parameters
    ----------
    points, moved
        Places (n, 3) (m) of the nodes before and after deformation.
    faces
        Vertices (f, 3 or 4) of the faces of the surface. Those that stay in their planes are held there, and not free.
    """
    triangles = fan(faces)
    before, after = (one[triangles[:, 1:]] - one[triangles[:, :1]] for one in (points, moved))
    normals = np.cross(before[:, 0], before[:, 1])
    out = np.einsum("fkx,fx->fk", (moved - points)[triangles], normals)
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(moved - points, axis=1).max()
    free = np.abs(out).max(axis=1) > FLAT * size
    if not free.any():
        return 0, 1.0
    metric, own = (np.einsum("fix,fjx->fij", one[free], one[free]) for one in (after, before))
    squares = np.linalg.eigvals(np.linalg.solve(own, metric)).real.min(axis=1)
    least = int(squares.argmin())
    return int(triangles[free][least, 0]), float(np.sqrt(max(squares[least], 0.0)))
