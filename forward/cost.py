"""What a body costs: memory and processor time of its factorisations, solves and derivatives, before it is built.

Entries and operations of a factor follow from nested dissection of the lattice of nodes: A. George, SIAM J. Numer.
Anal. 10 (1973) 345–363. A box is cut across its longest direction by a layer of nodes, and so on; a layer of s unknowns
that borders on r others (of the layers before it) takes s³/3 + s²r + sr² operations and s²/2 + sr entries. The
constants turn them into those of MUMPS with an ordering of its choice (`python -m benchmarks predictions`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Protocol

ENTRIES = 1.4  # of MUMPS over those of the model
OPERATIONS = 1.6
# Displacements that one is coupled with on average, inside a large body.
ROW = {("hexahedron", 1): 81.0, ("hexahedron", 2): 192.0, ("tetrahedron", 1): 45.0, ("tetrahedron", 2): 84.0}
SMALLEST = 3.0  # nodes across a part of the lattice that is not cut any more
BYTES_PER_ENTRY = 18.0  # of the working memory of a factorisation, with the room that pivoting may want
BYTES_PER_NONZERO = 16.0  # of the matrix
BYTES_PER_UNKNOWN = 3e3  # mesh, spaces, vectors
BYTES_OF_PROGRAM = 2.5e8  # Python with all libraries
ADDRESSES_OF_PROGRAM = 8e8  # the same in addresses, most of which are never touched


class Meshed(Protocol):
    """What is asked of a body."""

    @property
    def cell(self) -> str:
        """Kind of the cells."""

    @property
    def degree(self) -> int:
        """Of the displacement."""

    @property
    def cell_count(self) -> int:
        """Number of cells."""

    @property
    def nodes(self) -> int:
        """Number of nodes of displacements."""

    @property
    def vertex_count(self) -> int:
        """Number of vertices."""

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Extent along each axis (m)."""


@dataclass(frozen=True)
class Factor:
    """The factor of a stiffness: its entries, the operations that it takes, and the non-zeros of the matrix."""

    entries: float
    operations: float
    nonzeros: float

    @property
    def bytes(self) -> float:
        """Memory while and after it is made, with that of the matrix."""
        return BYTES_PER_ENTRY * self.entries + BYTES_PER_NONZERO * self.nonzeros


def factor(body: Meshed, *, mixed: bool) -> Factor:
    """Predict the factor of a body's stiffness."""
    cells = getattr(body, "cells", None)
    if cells is not None:
        lattice = [body.degree * n + 1.0 for n in cells]
    else:  # as many nodes, spread evenly over a box around them
        extents = [high - low for low, high in body.bounds]
        spacing = (math.prod(extents) / body.nodes) ** (1 / 3)
        lattice = [max(extent / spacing, 1.0) for extent in extents]
    pressures = body.vertex_count / body.nodes if mixed else 0.0
    operations, entries = _dissected(tuple(sorted(lattice)), (0, 0, 0), 3 + pressures)
    return Factor(
        ENTRIES * entries,
        OPERATIONS * operations,
        ROW[body.cell, min(body.degree, 2)] * 3 * body.nodes * (1 + pressures / 3) ** 2,
    )


@cache
def _dissected(size: tuple[float, ...], borders: tuple[int, ...], dofs: float) -> tuple[float, float]:
    """Operations and entries of a part of the lattice; `borders` says how many of its ends are layers before it."""

    def area(axis: int) -> float:
        return math.prod(size) / size[axis]

    longest = max(range(3), key=lambda axis: size[axis])
    r = dofs * sum(borders[axis] * area(axis) for axis in range(3))
    whole = size[longest] <= SMALLEST
    s = dofs * (math.prod(size) if whole else area(longest))
    operations, entries = s**3 / 3 + s**2 * r + s * r**2, s**2 / 2 + s * r
    if not whole:
        half = tuple((n - 1) / 2 if axis == longest else n for axis, n in enumerate(size))
        for ends in ((borders[longest] + 1) // 2, borders[longest] // 2):  # of the two halves, beside the new layer
            inside = tuple(ends + 1 if axis == longest else n for axis, n in enumerate(borders))
            more = _dissected(half, inside, dofs)
            operations, entries = operations + more[0], entries + more[1]
    return operations, entries
