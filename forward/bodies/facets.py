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

from forward.bodies.mesh import EDGES, FACES, IntArray, Loaded
from forward.model import FloatArray

CREASE = np.cos(np.radians(40.0))  # cosine of the angle between facets from which on they are of two parts
FLAT = 1e-6  # of the length of an edge: heights of facets that are rounding
FITS = 3  # of a quadratic surface, each with the normal of the one before
ROUND = 6  # neighbours at least, of the five numbers of such a surface
PARALLEL = 0.2  # singular value below which normals of parts that meet are the same


def lifted(mesh: Loaded) -> Loaded | None:
    """Return a body with the same cells, moved so that facets hide nothing on average; None where facets hide nothing.

    Vertices inside follow those of the surface.
    """
    facets, normals = _surface(mesh)
    pairs = _neighbours(facets)
    turns = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1)  # cosines
    smooth = turns > CREASE
    joined = csr_matrix((np.ones(smooth.sum()), pairs[smooth].T), shape=(len(facets),) * 2)
    _, part = connected_components(joined, directed=False)
    bent = np.zeros(part.max() + 1, dtype=bool)
    bent[part[pairs[smooth & (turns < 1 - FLAT), 0]]] = True
    if not bent.any():
        return None
    n = len(mesh.points)
    seen: dict[int, list[tuple[FloatArray, float]]] = {}  # normals of the parts at a vertex, and heights along them
    for number in range(len(bent)):
        own = facets[part == number]
        vertices = np.unique(own)
        if bent[number]:
            along, heights = _heights(mesh.points, own, vertices, _normals_at(vertices, own, normals[part == number]))
        else:
            along, heights = np.tile(normals[part == number][0], (len(vertices), 1)), np.zeros(len(vertices))
        for vertex, normal, height in zip(vertices.tolist(), along, heights.tolist(), strict=True):
            seen.setdefault(vertex, []).append((normal, height))
    shifts = np.zeros((n, 3))
    for vertex, parts in seen.items():
        shifts[vertex] = np.linalg.pinv([one for one, _ in parts], rcond=PARALLEL) @ [height for _, height in parts]
    longest = np.linalg.norm(np.ptp(mesh.points[facets], axis=1), axis=1).max()
    if np.abs(shifts).max() < FLAT * longest:
        return None
    return replace(mesh, points=mesh.points + _followed(mesh, np.array(sorted(seen)), shifts))


def _surface(mesh: Loaded) -> tuple[IntArray, FloatArray]:
    """Facets (n, 3 or 4) of the surface, and their normals (n, 3) outwards."""
    faces = mesh.cells[:, FACES[mesh.cell]]
    flat = faces.reshape(-1, faces.shape[2])
    _, first, count = np.unique(np.sort(flat, axis=1), axis=0, return_index=True, return_counts=True)
    outer = first[count == 1]
    facets, corners = flat[outer], mesh.points[flat[outer]]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inside = mesh.points[mesh.cells].mean(axis=1)[outer // faces.shape[1]]
    inwards = ((corners.mean(axis=1) - inside) * normals).sum(axis=1) < 0
    return facets, np.where(inwards[:, None], -normals, normals)


def _neighbours(facets: IntArray) -> IntArray:
    """Pairs (k, 2) of facets that share an edge."""
    around = np.stack([facets, np.roll(facets, -1, axis=1)], axis=2).reshape(-1, 2)
    which = np.unique(np.sort(around, axis=1), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(which, kind="stable")
    same = np.flatnonzero(which[order[1:]] == which[order[:-1]])
    return np.asarray(np.column_stack([order[same], order[same + 1]]) // facets.shape[1])


def _normals_at(vertices: IntArray, facets: IntArray, normals: FloatArray) -> FloatArray:
    """Means (n, 3) of the normals of the facets around vertices."""
    sums = np.zeros((len(vertices), 3))
    for corner in facets.T:
        np.add.at(sums, np.searchsorted(vertices, corner), normals)
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def _heights(
    points: FloatArray, facets: IntArray, vertices: IntArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normals (n, 3) of a curved part at its vertices, and mean heights (n,) of the surface above the facets there."""
    local = np.searchsorted(vertices, facets)
    n, corners = len(vertices), local.shape[1]
    links = np.stack([np.repeat(local, corners, axis=1).ravel(), np.tile(local, (1, corners)).ravel()])
    near = csr_matrix((np.ones(links.shape[1]), links), shape=(n, n))
    wider = csr_matrix(near @ near)
    at = points[vertices]
    normals, forms = normals.copy(), np.zeros((n, 3, 3))
    for i in range(n):
        around = wider.indices[wider.indptr[i] : wider.indptr[i + 1]]
        if len(around) <= ROUND:
            around = csr_matrix(wider[[i]] @ wider).indices
        normals[i], forms[i] = _quadratic(at[around[around != i]] - at[i], normals[i])
    ends = np.stack([local, np.roll(local, -1, axis=1)], axis=2)  # of the edges around each facet
    edges = at[ends[..., 1]] - at[ends[..., 0]]
    bent = np.einsum("fei,fekij,fej->fek", edges, forms[ends], edges)
    heights = -bent.mean(axis=2).sum(axis=1) / 24
    first, last = at[local[:, 2]] - at[local[:, 0]], at[local[:, -1]] - at[local[:, 1]]
    areas = np.linalg.norm(np.cross(first, last), axis=1)
    weights, sums = np.zeros(n), np.zeros(n)
    for corner in local.T:
        np.add.at(weights, corner, areas)
        np.add.at(sums, corner, areas * heights)
    return normals, sums / weights


def _quadratic(around: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal (3,) and second fundamental form (3, 3) of the quadratic surface through 0 that is nearest to points."""
    squares = (around**2).sum(axis=1)
    weights = 1 / np.sqrt(squares + squares.mean())
    form = np.zeros((3, 3))
    for _ in range(FITS):
        tangents = np.linalg.svd(normal[None])[2][1:]
        x, y = (around @ tangents.T).T
        terms = np.column_stack([x, y, x * x / 2, x * y, y * y / 2])
        sizes = np.linalg.norm(terms * weights[:, None], axis=0)
        sizes[sizes == 0] = 1.0
        found = np.linalg.lstsq(terms * weights[:, None] / sizes, weights * (around @ normal), rcond=1e-6)[0] / sizes
        slopes, (xx, xy, yy) = found[:2], found[2:]
        form = tangents.T @ np.array([[xx, xy], [xy, yy]]) @ tangents
        normal = normal - slopes @ tangents
        normal = normal / np.linalg.norm(normal)
    return normal, form


def _followed(mesh: Loaded, outer: IntArray, shifts: FloatArray) -> FloatArray:
    """Shifts (n, 3) of all vertices: those inside are at rest between springs along the edges, stiffer where short."""
    edges = np.unique(np.sort(mesh.cells[:, EDGES[mesh.cell]].reshape(-1, 2), axis=1), axis=0)
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
