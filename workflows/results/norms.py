"""Integrals over a body of fields given at its nodes: norms that do not depend on the mesh.

The field on a cell is the polynomial through its values at the nodes, and so is the place: |u|² is integrated by Gauss'
rule, exactly on cells with plane faces and parallel edges (O. C. Zienkiewicz et al., The Finite Element Method (2013),
section 5.11).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from workflows.results.surfaces import lattice

POINTS = 4  # of Gauss' rule along each direction: exact up to degree 7
CELLS = 2000  # that are integrated at once


def squares(nodes: FloatArray, cells: NDArray[np.int64], fields: FloatArray) -> tuple[FloatArray, float]:
    """Return ∫|u|² dX (k,) of fields u (k, N, 3), and the volume.

    Nodes are places (N, 3), cells the nodes of each (n_cells, 4, 10, 8 or 27), the vertices first, in VTK's order.
    """
    total, volume = np.zeros(len(fields)), 0.0
    for part, shapes, measure in _parts(nodes, cells):
        volume += float(measure.sum())
        for i, field in enumerate(fields):
            values = np.einsum("qk,nkx->nqx", shapes, field[part])
            total[i] += float((measure * (values**2).sum(axis=2)).sum())
    return total, volume


def node_volumes(nodes: FloatArray, cells: NDArray[np.int64]) -> FloatArray:
    """Return the volume (N,) that each node represents: Σ_n v_n f_n is ∫f dX of a quantity known only at nodes.

    Of hexahedra these are the integrals of the shape functions: on bricks of degree 2 Simpson's rule. Of tetrahedra of
    degree 2 they would be negative at the vertices; there f is linear on the eight parts that the midpoints of the
    edges make, on average over the ways to cut the inner ones. Nodes and cells are as of `squares`.
    """
    found = np.zeros(len(nodes))
    parts = np.full(10, 7 / 48)
    parts[:4] = 1 / 32
    for part, shapes, measure in _parts(nodes, cells):
        shares = measure.sum(axis=1)[:, None] * parts if cells.shape[1] == len(parts) else measure @ shapes
        found += np.bincount(part.ravel(), shares.ravel(), minlength=len(nodes))
    return found


def _parts(nodes: FloatArray, cells: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], FloatArray, FloatArray]]:
    """Go through parts (n, k) of the cells, with shape functions (q, k) and volumes (n, q) of Gauss' points."""
    shapes, slopes, weights = _basis(nodes, cells)
    for part in np.array_split(cells, max(1, -(-len(cells) // CELLS))):
        jacobians = np.einsum("aqk,nkx->nqxa", slopes, nodes[part])
        yield part, shapes, np.abs(np.linalg.det(jacobians)) * weights


def _basis(nodes: FloatArray, cells: NDArray[np.int64]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the shape functions (q, k) and their slopes (3, q, k) at Gauss' points, and the weights (q,) of these."""
    tetrahedra = cells.shape[1] in {4, 10}
    places = lattice(nodes[cells[0]], hexahedral=not tetrahedra)
    degree = places.max()
    powers = np.array([p for p in product(range(degree + 1), repeat=3) if not tetrahedra or sum(p) <= degree])
    basis = np.linalg.inv(_monomials(places / degree, powers))
    points, weights = _rule(tetrahedra=tetrahedra)
    lower = np.maximum(powers - np.eye(3, dtype=np.int64)[:, None], 0)  # of derivatives along each axis
    slopes = np.array([(_monomials(points, lower[k]) * powers[:, k]) @ basis for k in range(3)])
    return _monomials(points, powers) @ basis, slopes, weights


def _monomials(points: FloatArray, powers: NDArray[np.int64]) -> FloatArray:
    return np.asarray(np.prod(points[:, None, :] ** powers[None], axis=2))


def _rule(*, tetrahedra: bool) -> tuple[FloatArray, FloatArray]:
    """Gauss' rule on the unit cube, or on the tetrahedron, onto which the cube is collapsed."""
    x, w = np.polynomial.legendre.leggauss(POINTS)  # type: ignore[no-untyped-call]
    x, w = (x + 1) / 2, w / 2
    a, b, c = (part.ravel() for part in np.meshgrid(x, x, x, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel()
    if not tetrahedra:
        return np.column_stack([a, b, c]), weights
    points = np.column_stack([a, b * (1 - a), c * (1 - a) * (1 - b)])
    return points, weights * (1 - a) ** 2 * (1 - b)
