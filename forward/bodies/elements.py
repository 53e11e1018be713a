"""Lagrange elements of any degree on tetrahedra and hexahedra: their nodes, and the quadrature that they need."""

from __future__ import annotations

from math import comb
from typing import Literal


def default_quadrature(cell: Literal["tetrahedron", "hexahedron"], degree: int) -> int:
    """Return the lowest degree of quadrature that keeps the order of convergence of elements of a degree."""
    return 2 * degree + (1 if cell == "hexahedron" else -1)


def node_count(
    cell: Literal["tetrahedron", "hexahedron"], degree: int, vertices: int, edges: int, faces: int, cells: int
) -> int:
    """Return the number of nodes of elements of a degree on a mesh with so many entities."""
    inside = [comb(degree - 1, k) if cell == "tetrahedron" else (degree - 1) ** k for k in (1, 2, 3)]
    return vertices + edges * inside[0] + faces * inside[1] + cells * inside[2]
