"""Values of functions of one space at the nodes of another on the same mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem

from forward.fem.dolfinx import version
from forward.fem.dolfinx.spaces import cell_element, owned_nodes, sum_ghosts
from forward.model import FloatArray


class Transfer:
    """Interpolation from one continuous Lagrange space into another on the same mesh, as a sparse matrix.

    It is exact where the first space lies in the second. Values (n,) are those of this rank's nodes, interleaved by
    component; both calls are collective.
    """

    def __init__(self, source: Any, target: Any) -> None:
        self._source = fem.Function(source)
        self._components = int(source.dofmap.index_map_bs)
        here, there = cell_element(source), cell_element(target)
        # DOLFINx permutes the nodes of cells, so that those of all cells stand as on the reference cell.
        values = here.tabulate(0, there.points)[0, :, :, 0]
        values[np.abs(values) < 1e-14] = 0
        from_nodes = version.nodes_of_cells(source, len(here.points))
        to_nodes = version.nodes_of_cells(target, len(there.points))
        owned = owned_nodes(target)
        every = to_nodes.ravel()
        first = np.empty(every.max(initial=-1) + 1, dtype=np.int64)
        first[every[::-1]] = np.arange(len(every))[::-1]  # of several places the first is written last
        cells, places = np.divmod(first[:owned], to_nodes.shape[1])
        index_map = source.dofmap.index_map
        columns = from_nodes[cells]
        ends = columns.shape[1] * np.arange(owned + 1)
        from scipy.sparse import csr_matrix

        shape = (owned, index_map.size_local + index_map.num_ghosts)
        self._matrix = csr_matrix((values[places].ravel(), columns.ravel(), ends), shape=shape)
        self._matrix.eliminate_zeros()
        self._transposed = self._matrix.T.tocsr()

    def __call__(self, values: FloatArray) -> FloatArray:
        """Interpolate."""
        carrier = self._source
        carrier.x.array[: len(values)] = values
        carrier.x.scatter_forward()
        found: FloatArray = (self._matrix @ carrier.x.array.reshape(-1, self._components)).ravel()
        return found

    def transposed(self, values: FloatArray) -> FloatArray:
        """Apply the transpose."""
        carrier = self._source
        carrier.x.array[:] = (self._transposed @ values.reshape(-1, self._components)).ravel()
        return sum_ghosts(carrier)
