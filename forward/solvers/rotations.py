"""The factor of a reference state as an approximate inverse of the stiffness at other states.

Between two states of a slender body it is mostly the orientation of its parts that changes. So the reference factor K̄
is turned along with them: K(u)⁻¹ ≈ R K̄⁻¹ Rᵀ, where R holds at each node the rotation from the reference state to u. On
the published beam this halves the number of corrections (docs/decisions/0004-turned-reference.md). The rotations are
those of the polar decompositions of the deformation gradients: N. J. Higham, SIAM J. Sci. Stat. Comput. 7 (1986)
1160–1174.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.solvers.anderson import Inverse


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
        if np.abs(X - before).max(initial=0.0) < 1e-6:  # the error is its square
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
    for i in range(3):  # nine products of long vectors: much faster than many small matrices
        y[..., i:n:3] = R[i, 0] * x[..., 0:n:3] + R[i, 1] * x[..., 1:n:3] + R[i, 2] * x[..., 2:n:3]
    return y


def turned(inverse: Inverse, R: FloatArray, fixed: NDArray[np.int64]) -> Inverse:
    """Return x → R K̄⁻¹ Rᵀ x on the free unknowns, and the identity on the prescribed ones.

    Parameters
    ----------
    inverse
        Applies K̄⁻¹.
    R
        Rotations (3, 3, n_owned) of the nodes, for the first 3 n_owned unknowns.
    fixed
        Positions of the prescribed unknowns.
    """
    back = R.swapaxes(0, 1)

    def correct(x: FloatArray) -> FloatArray:
        known = x[..., fixed]
        y = turn(x, back)
        y[..., fixed] = 0
        y = turn(inverse(y), R)
        y[..., fixed] = known
        return y

    return correct
