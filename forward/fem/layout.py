"""The canonical order of nodes: sorted by position, so that fields are the same on any number of ranks.

A state (U,) in canonical order holds the displacements of the nodes, interleaved by component, and then, in the mixed
form, the pressures of the vertices.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.bodies.geometry import Body
from forward.fem.dolfinx import assembly, spaces
from forward.model import FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class Layout:
    """Positions of this rank's nodes and unknowns in the canonical order (by x, then y, then z).

    Attributes
    ----------
    positions
        Canonical positions (n_owned,) of the nodes that this rank owns.
    coordinates
        Coordinates (N, 3) of all nodes in canonical order, in m, on every rank.
    """

    def __init__(self, space: Any, comm: Any, pressure: Any | None = None) -> None:
        self._space = space
        self._comm = comm
        self.coordinates, self._canonical, self.positions = sorted_by_place(space, comm)
        self.size = self.coordinates.size
        self._unknowns = (3 * self.positions[:, None] + np.arange(3)).ravel()
        if pressure is not None:
            vertices, _, positions = sorted_by_place(pressure, comm)
            self._unknowns = np.concatenate([self._unknowns, self.size + positions])
            self.size += len(vertices)

    def gather(self, rows: FloatArray) -> FloatArray | None:
        """Collect (k, U_local) as (k, U) in canonical order on the first rank."""
        return gathered(self._comm, self._unknowns, rows)

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Take this rank's part (k, U_local) of (k, U) in canonical order."""
        return np.ascontiguousarray(rows[:, self._unknowns])

    def nodes(self) -> NDArray[np.int64]:
        """Return the canonical positions of this rank's nodes, ghosts included."""
        return np.asarray(self._canonical[spaces.global_node_numbers(self._space)])

    def cells(self) -> tuple[NDArray[np.int64], int]:
        """Return all cells (n_cells, k) as canonical nodes in VTK's order, and VTK's number of the type; collective."""
        cells, kind = self._cells()
        everywhere = np.concatenate(self._comm.allgather(cells))
        return everywhere[np.lexsort(everywhere.T[::-1])], kind

    def by_cell(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of this rank's cells for all cells (n_cells,), in the order of `cells`; collective."""
        own, _ = self._cells()
        cells, found = (np.concatenate(self._comm.allgather(part)) for part in (own, values[: len(own)]))
        return np.asarray(found[np.lexsort(cells.T[::-1])])

    def _cells(self) -> tuple[NDArray[np.int64], int]:
        local, kind = spaces.vtk_cells(self._space)
        return self.nodes()[local], kind


def gathered(comm: Any, positions: NDArray[np.int64], rows: FloatArray) -> FloatArray | None:
    """Collect rows (k, n), of which each rank has those at canonical positions (n,), on the first rank."""
    parts = [(positions, rows)] if comm.size == 1 else comm.gather((positions, rows))
    if parts is None:
        return None
    whole = np.empty((len(rows), sum(len(theirs) for theirs, _ in parts)), dtype=rows.dtype)
    for theirs, part in parts:
        whole[:, theirs] = part
    return whole


def vertices_of(equations: Any) -> Layout:
    """Return the vertices of a mesh in the canonical order, and its cells; collective."""
    return Layout(spaces.scalar_space(equations.mesh, 1), equations.comm)


def sorted_by_place(space: Any, comm: Any) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Return sorted coordinates (N, 3) of all nodes of a space, and canonical numbers: by global number, and ours."""
    parts = comm.allgather(spaces.node_coordinates(space))
    everywhere = np.concatenate(parts)
    # Coordinates that differ by rounding only must sort the same way on every rank; the shift keeps nodes, which lie
    # at simple fractions of the largest extent, away from the ends of the intervals.
    step = 1e-9 * np.ptp(everywhere, axis=0).max()
    keys = np.floor(everywhere / step + 1 / np.pi).astype(np.int64)
    order = np.lexsort(keys.T[::-1])
    canonical = np.empty(len(order), dtype=np.int64)
    canonical[order] = np.arange(len(order))
    before = sum(len(part) for part in parts[: comm.rank])
    return everywhere[order], canonical, canonical[before : before + len(parts[comm.rank])]


def vertex_matrices(body: Body) -> tuple[csr_matrix, csr_matrix, csr_matrix, FloatArray]:
    """Return ∫vw dX, ∫∇v·∇w dX and ∫vw dS (N, N) of a body, and its vertices (N, 3), in canonical order.

    They use trilinear hexahedra, whatever the cells of the body: with tetrahedra on these vertices, correlations would
    depend on how the hexahedra are cut.
    Each calling process makes its own mesh: the numbers do not depend on how others share theirs.
    """
    space, matrices = assembly.trilinear_elements(body)
    places, canonical, _ = sorted_by_place(space, space.mesh.comm)
    order = np.argsort(canonical)
    mass, laplacian, surface = (matrix[order][:, order] for matrix in matrices)
    return mass, laplacian, surface, places
