"""The factor of a reference state as an approximate inverse of the stiffness at other states.

Between two states of a slender body it is mostly the orientation of its parts that changes. So the reference factor K̄
is turned along with them: K(u)⁻¹ ≈ R K̄⁻¹ Rᵀ, where R holds at each node the rotation from the reference state to u. On
the published beam this halves the number of corrections (docs/decisions/0004-turned-reference.md). The rotations are
those of the polar decompositions of the deformation gradients: N. J. Higham, SIAM J. Sci. Stat. Comput. 7 (1986)
1160–1174, scaled by determinants: R. Byers, H. Xu, SIAM J. Matrix Anal. Appl. 30 (2008) 822–843.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.solvers.anderson import Inverse
from forward.solvers.steps import Steps


def rotations(F: FloatArray) -> FloatArray:
    """Return the rotations (3, 3, n) in deformation gradients F (3, 3, n); the identity where det F is negative."""
    good = _determinant(_cofactors(F), F) > 0
    X = np.where(good, F, np.eye(3)[:, :, None])
    for _ in range(30):
        cofactors = _cofactors(X)
        determinant = _determinant(cofactors, X)
        scale = np.cbrt(determinant)
        before, X = X, X * (0.5 / scale)
        cofactors *= 0.5 * scale / determinant  # over the determinant, they are the transposed inverse
        X += cofactors
        if np.abs(X - before).max(initial=0.0) < 1e-4:  # the error is its square
            break
    return X


def _cofactors(F: FloatArray) -> FloatArray:
    cofactors = np.empty(F.shape)
    for i in range(3):  # rows are vector products of the other two; indices count from the end
        b, c = F[i - 2], F[i - 1]
        for j in range(3):
            np.multiply(b[j - 2], c[j - 1], out=cofactors[i, j])
            cofactors[i, j] -= b[j - 1] * c[j - 2]
    return cofactors


def _determinant(cofactors: FloatArray, F: FloatArray) -> FloatArray:
    return np.asarray(F[0, 0] * cofactors[0, 0] + F[0, 1] * cofactors[0, 1] + F[0, 2] * cofactors[0, 2])


def turn(x: FloatArray, R: FloatArray) -> FloatArray:
    """Return x (n,) or rows (k, n) with nodal vectors turned by R (3, 3, n_owned); the rest is unchanged."""
    n = 3 * R.shape[2]
    y = np.array(x)
    for row in y.reshape(-1, y.shape[-1]):  # products of long vectors: much faster than many small matrices
        components = np.ascontiguousarray(row[:n].reshape(-1, 3).T)
        row[:n].reshape(-1, 3)[:] = np.einsum("ijn,jn->in", R, components).T
    return y


@dataclass(frozen=True, eq=False)
class Turned:
    """x → R K̄⁻¹ Rᵀ x on the free unknowns, and the identity on the prescribed ones.

    Attributes
    ----------
    R
        Rotations (3, 3, n_owned) of the nodes, for the first 3 n_owned unknowns.
    fixed
        Positions of the prescribed unknowns.
    """

    R: FloatArray
    fixed: NDArray[np.int64]

    def _back(self, x: FloatArray) -> FloatArray:
        y = turn(x, self.R.swapaxes(0, 1))
        y[..., self.fixed] = 0
        return y

    def _forth(self, solution: FloatArray, x: FloatArray) -> FloatArray:
        y = turn(solution, self.R)
        y[..., self.fixed] = x[..., self.fixed]
        return y

    def __call__(self, x: FloatArray) -> Steps[FloatArray]:
        """Apply it to (n,), asking for the back-substitution."""
        return self._forth((yield self._back(x)), x)

    def by(self, inverse: Inverse) -> Inverse:
        """Return it as a function, given K̄⁻¹."""
        return lambda x: self._forth(inverse(self._back(x)), x)
