"""What flat facets hide of a curved surface, estimated from the mesh alone.

The vertices of a mesh lie on the surface of the body, its facets below it: by e·K e/8 in the middle of an edge e, with
the second fundamental form K of the surface (k h²/8 for a curvature k), and by a third of the sum over its edges on the
average of a facet. K is found at each vertex as the quadratic surface through it that is nearest to its neighbours
(S. Petitjean, A survey of methods for recovering quadrics in triangle meshes, ACM Computing Surveys 34 (2002) 211–262).
To first order what the missing layer does to an output is ∮ g δn dS with a smooth g, whatever the shape of the layer.
So a body whose vertices are moved outwards by the mean heights above their facets has what facets hide, with the same
mesh. Where the surface is creased, its parts are looked at apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from forward.bodies.location import locate, shapes
from forward.bodies.mesh import IntArray, Loaded, edges_of, surface_of
from forward.model import FloatArray

CREASE = np.cos(np.radians(50.0))  # cosine of the angle between facets from which on they are of two parts
FLAT = 1 - 1e-6  # that above which they are in one plane
ROUND = 6  # neighbours at least, of the five numbers of such a surface
PARALLEL = 0.2  # singular value below which normals of parts that meet are the same


def lifted(mesh: Loaded) -> Loaded | None:
    """Return a body with the same cells, moved so that facets hide nothing on average; None where facets hide nothing.

    Vertices inside follow those of the surface. Of a mesh that was made from another one, the facets of that one count:
    most of its own lie in one plane with their neighbours.
    """
    if mesh.lift is not None:
        return replace(mesh, points=mesh.points + mesh.lift, lift=None) if mesh.lift.any() else None
    facets, owners = surface_of(mesh.cells, mesh.cell)
    corners = mesh.points[facets]
    normals = _crossed(corners)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    outwards = corners.mean(axis=1) - mesh.points[mesh.cells[owners]].mean(axis=1)
    normals[(outwards * normals).sum(axis=1) < 0] *= -1
    pairs = _neighbours(facets)
    turns = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1)  # cosines
    smooth = turns > CREASE
    joined = csr_matrix((np.ones(smooth.sum()), pairs[smooth].T), shape=(len(facets),) * 2)
    _, part = connected_components(joined, directed=False)
    bent = np.zeros(part.max() + 1, dtype=bool)
    bent[part[pairs[smooth & (turns < FLAT), 0]]] = True
    if not bent.any():
        return None
    seen: dict[int, list[tuple[FloatArray, float]]] = {}  # normals of the parts at a vertex, and heights along them
    for number in range(len(bent)):
        own, normal = facets[part == number], normals[part == number]
        vertices = np.unique(own)
        if bent[number]:
            along, heights = _heights(mesh.points[vertices], np.searchsorted(vertices, own), normal)
        else:
            along, heights = np.tile(normal[0], (len(vertices), 1)), np.zeros(len(vertices))
        for vertex, one, height in zip(vertices.tolist(), along, heights.tolist(), strict=True):
            seen.setdefault(vertex, []).append((one, height))
    shifts = np.zeros(mesh.points.shape)
    for vertex, parts in seen.items():
        shifts[vertex] = np.linalg.pinv([one for one, _ in parts], rcond=PARALLEL) @ [height for _, height in parts]
    return replace(mesh, points=mesh.points + _followed(mesh, np.array(sorted(seen)), shifts))


def lift_of(mesh: Loaded, whole: Loaded, points: FloatArray) -> FloatArray:
    """Return what facets of tetrahedra hide at points (n, 3) in them, linear between vertices that were moved."""
    at = locate(mesh.points[mesh.cells], points)
    shifts = (whole.points - mesh.points)[mesh.cells[at.cells]]
    return np.asarray(np.einsum("nk,nka->na", shapes(at.local, 4), shifts))


def _crossed(corners: FloatArray) -> FloatArray:
    """Normals (n, 3) of facets with these corners (n, 3 or 4, 3), twice as long as they are large."""
    return np.asarray(np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1]))


def _neighbours(facets: IntArray) -> IntArray:
    """Pairs (k, 2) of facets that share an edge."""
    around = np.stack([facets, np.roll(facets, -1, axis=1)], axis=2).reshape(-1, 2)
    which = np.unique(np.sort(around, axis=1), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(which, kind="stable")
    same = np.flatnonzero(which[order[1:]] == which[order[:-1]])
    return np.asarray(np.column_stack([order[same], order[same + 1]]) // facets.shape[1])


def _heights(points: FloatArray, facets: IntArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (n, 3) of a curved part at its vertices, and mean heights (n,) of the surface above the facets there.

    Of its points (n, 3), and its facets (k, 3 or 4) with their normals (k, 3).
    """
    n, (count, corners) = len(points), facets.shape
    around = csr_matrix((np.ones(facets.size), (facets.ravel(), np.repeat(np.arange(count), corners))), (n, count))
    near = around @ around.T
    wider = csr_matrix(near @ near)
    along, forms = around @ normals, np.zeros((n, 3, 3))
    for i in range(n):
        others = wider.indices[wider.indptr[i] : wider.indptr[i + 1]]
        if len(others) <= ROUND:
            others = csr_matrix(wider[[i]] @ wider).indices
        along[i], forms[i] = _quadratic(points[others[others != i]] - points[i], along[i])
    ends = np.stack([facets, np.roll(facets, -1, axis=1)], axis=2)  # of the edges around each facet
    edges = points[ends[..., 1]] - points[ends[..., 0]]
    heights = -np.einsum("fei,fekij,fej->f", edges, forms[ends], edges) / 48  # means of both ends
    areas = np.linalg.norm(_crossed(points[facets]), axis=1)
    return along, (around @ (areas * heights)) / (around @ areas)


def _quadratic(around: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal (3,) and second fundamental form (3, 3) of the quadratic surface through 0 that is nearest to points.

    The normal given is about that, of any length.
    """
    normal = normal / np.linalg.norm(normal)
    tangents = np.linalg.svd(normal[None])[2][1:]
    x, y = (around @ tangents.T).T
    squares = (around**2).sum(axis=1)
    weights = 1 / np.sqrt(squares + squares.mean())
    terms = np.column_stack([x, y, x * x / 2, x * y, y * y / 2]) * weights[:, None]
    sizes = np.linalg.norm(terms, axis=0)
    sizes[sizes == 0] = 1.0
    *slopes, xx, xy, yy = np.linalg.lstsq(terms / sizes, weights * (around @ normal), rcond=1e-6)[0] / sizes
    normal = normal - slopes @ tangents
    return normal / np.linalg.norm(normal), tangents.T @ np.array([[xx, xy], [xy, yy]]) @ tangents


def _followed(mesh: Loaded, outer: IntArray, shifts: FloatArray) -> FloatArray:
    """Shifts (n, 3) of all vertices: those inside are at rest between springs along the edges, stiffer where short."""
    edges, _ = edges_of(mesh.cells, mesh.cell)
    n, stiff = len(mesh.points), 1 / ((mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]]) ** 2).sum(axis=1)
    both = np.concatenate([edges, edges[:, ::-1]]).T
    springs = csr_matrix((np.concatenate([stiff, stiff]), both), shape=(n, n))
    inner = np.setdiff1d(np.arange(n), outer)
    if not len(inner):
        return shifts
    between = csr_matrix(springs[inner])
    diagonal = np.asarray(between.sum(axis=1)).ravel()
    matrix, right = diags(diagonal) - between[:, inner], between[:, outer] @ shifts[outer]
    found = shifts.copy()
    for axis in range(3):
        found[inner, axis] = cg(matrix, right[:, axis], M=diags(1 / diagonal))[0]
    return found
