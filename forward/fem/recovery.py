"""Where the stresses of a solution jump: an indicator of errors that knows nothing of outputs.

O. C. Zienkiewicz, J. Z. Zhu, A simple error estimator and adaptive procedure for practical engineering analysis,
Int. J. Numer. Meth. Eng. 24 (1987) 337–357: stresses averaged at the vertices, interpolated inside the cells, are
nearer to the right ones than those of the elements, so that the difference of both says how wrong the latter are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

if TYPE_CHECKING:
    from forward.bodies.mesh import Loaded


def squares(mesh: Loaded, stresses: FloatArray) -> NDArray[np.float64]:
    """Return ∫|P* − P|² dX of each tetrahedron, from P (c, 4, 9) at its vertices.

    P* is linear in a cell; at a vertex it is the mean of P over the cells of one region that meet there, by volume:
    across an interface of materials stresses do jump.
    """
    at = mesh.points[mesh.cells]
    volumes = np.abs(np.linalg.det(at[:, 1:] - at[:, :1])) / 6
    vertices = (mesh.cells * len(mesh.regions) + mesh.region[:, None]).ravel()
    shares = np.repeat(volumes, 4)
    size = len(mesh.points) * len(mesh.regions)
    total = np.bincount(vertices, weights=shares, minlength=size)
    found = np.zeros(len(mesh.cells))
    for component in np.moveaxis(stresses, 2, 0):
        sums = np.bincount(vertices, weights=shares * component.ravel(), minlength=size)
        recovered = np.divide(sums, total, out=np.zeros(size), where=total > 0)
        jump = recovered[vertices].reshape(component.shape) - component
        # ∫ λ_i λ_j dX = (1 + δ_ij) V/20 of barycentric coordinates λ.
        found += volumes / 20 * ((jump**2).sum(axis=1) + jump.sum(axis=1) ** 2)
    return found
