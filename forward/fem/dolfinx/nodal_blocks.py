"""The 3×3 blocks on the diagonal of a stiffness, from the moduli of the cells, without an element matrix.

Of a cell with moduli 𝔸 = ∂P/∂F and shape functions φ_i, the block of node i is ∫ 𝔸_{akbl} ∂_kφ_i ∂_lφ_i dX. Here 𝔸 and
the Jacobian are means over the cell: for what only preconditions. An element matrix of cubic hexahedra has 36 864
entries, of which these are 576.
"""

from __future__ import annotations

from typing import Any

import basix
import numpy as np
from dolfinx import fem

from forward.fem.dolfinx import spaces, version
from forward.fem.dolfinx.meshes import owned_cells
from forward.model import FloatArray


class NodalBlocks:
    """The blocks of the nodes of a space of displacements.

    Parameters
    ----------
    space
        The space.
    """

    def __init__(self, space: Any) -> None:
        element, cells = spaces.cell_element(space), owned_cells(space.mesh)
        self._carrier = fem.Function(space)
        self._nodes = version.nodes_of_cells(space, len(element.points))[:cells].ravel()
        points, weights = basix.make_quadrature(version.cell_type(space), 2 * version.degree(space))
        slopes = element.tabulate(1, points)[1:, :, :, 0]
        self._products = np.einsum("q,mqi,nqi->mni", weights, slopes, slopes).reshape(9, -1)
        kind = version.cell_type(space)
        corners, middle = basix.geometry(kind), points.T @ weights / weights.sum()
        linear = basix.create_element(basix.ElementFamily.P, kind, 1).tabulate(1, middle[None])[1:, 0, :, 0]
        assert linear.shape[1] == len(corners)
        places = np.asarray(space.mesh.geometry.x[version.corners_of_cells(space.mesh)[:cells]])
        jacobians = np.einsum("mi,cik->ckm", linear, places)
        self._sizes = np.abs(np.linalg.det(jacobians))
        self._slopes = np.linalg.inv(jacobians)  # (c, m, k): of the reference coordinates

    def __call__(self, moduli: FloatArray) -> FloatArray:
        """Return the blocks (n_owned, 3, 3) of moduli (n_cells, a, k, b, l), ∂P_ak/∂F_bl, of this rank's cells."""
        K = self._slopes
        local = np.einsum("c,cakbl,cmk,cnl->cabmn", self._sizes, moduli, K, K, optimize=True)
        parts = (local.reshape(-1, 9) @ self._products).reshape(len(K), 9, -1).swapaxes(0, 1)
        count = len(self._carrier.x.array) // 3
        sums = [np.bincount(self._nodes, weights=part.ravel(), minlength=count) for part in parts]
        rows = [self._owned(np.array(sums[i : i + 3])) for i in (0, 3, 6)]
        return np.asarray(np.stack(rows, axis=1))

    def _owned(self, rows: FloatArray) -> FloatArray:
        """Return values (3, n) of nodes at the n_owned of this rank, with what others hold of them, as (n_owned, 3)."""
        self._carrier.x.array[:] = rows.T.ravel()
        return spaces.sum_ghosts(self._carrier).reshape(-1, 3)
