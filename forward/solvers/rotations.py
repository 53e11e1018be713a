"""The factor of a reference state as an approximate inverse of the stiffness at other states.

Between two states of a slender body it is mostly the orientation of its parts that changes. So the reference factor K̄
is turned along with them: K(u)⁻¹ ≈ R K̄⁻¹ Rᵀ, where R holds at each node the rotation from the reference state to u. On
the published beam this halves the number of corrections (docs/decisions/0004-turned-reference.md). The rotations are
those of the polar decompositions of the deformation gradients: N. J. Higham, SIAM J. Sci. Stat. Comput. 7 (1986)
1160–1174.
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
    good = _determinant(F) > 0
    identity = np.broadcast_to(np.eye(3)[:, :, None], F.shape)
    X = np.where(good, F, identity)
    for _ in range(30):
        cofactors = _cofactors(X)
        inverse = cofactors / (X[0] * cofactors[0]).sum(axis=0)  # transposed
        scale = ((inverse**2).sum(axis=(0, 1)) / (X**2).sum(axis=(0, 1))) ** 0.25
        before, X = X, (scale * X + inverse / scale) / 2
        if np.abs(X - before).max(initial=0.0) < 1e-4:  # the error is its square
            break
    return X


def _cofactors(F: FloatArray) -> FloatArray:
    a, b, c = F
    return np.array([_cross(b, c), _cross(c, a), _cross(a, b)])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _determinant(F: FloatArray) -> FloatArray:
    return np.asarray((F[0] * _cross(F[1], F[2])).sum(axis=0))


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
