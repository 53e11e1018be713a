"""The factor of a reference state as an approximate inverse of the stiffness at other states.

Between two states of a slender body it is mostly the orientation of its parts that changes. So the reference factor K̄
is turned along with them: K(u)⁻¹ ≈ R K̄⁻¹ Rᵀ, where R holds at each node the rotation from the reference state to u. On
the published beam this halves the number of corrections (docs/decisions/0004-turned-reference.md). The rotations are
those of the polar decompositions of the deformation gradients: N. J. Higham, SIAM J. Sci. Stat. Comput. 7 (1986)
1160–1174, scaled by norms: A. A. Dubrulle, ETNA 8 (1999) 21–25. Both are in C (`rotations.c`): with many samples in
lockstep nothing of them stays in the cache, and each pass of NumPy reads it again.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forward.machine import StopError
from forward.model import FloatArray
from forward.native import FLAGS, library
from forward.solvers.anderson import Inverse
from forward.solvers.steps import Steps


def rotations(F: FloatArray, since: FloatArray | None = None) -> FloatArray:
    """Return the rotations (3, 3, n) in deformation gradients F (3, 3, n), perhaps from those of an earlier state.

    Where det F is negative, the identity is taken for the rotation in F.
    """
    F = np.ascontiguousarray(F)
    before = None if since is None else np.ascontiguousarray(since)
    found = np.empty_like(F)
    _compiled().rotations(F.shape[2], F.ctypes.data, None if before is None else before.ctypes.data, found.ctypes.data)
    return found


def turn(x: FloatArray, R: FloatArray, *, back: bool = False) -> FloatArray:
    """Return x (n,) or rows (k, n) with nodal vectors turned by R (3, 3, n_owned), or back; the rest is unchanged."""
    x, R = np.ascontiguousarray(x), np.ascontiguousarray(R)
    y = np.empty_like(x)
    n, numbers = R.shape[2], x.shape[-1]
    _compiled().turn(n, R.ctypes.data, back, x.size // max(numbers, 1), numbers, x.ctypes.data, y.ctypes.data)
    return y


@cache
def _compiled() -> ctypes.CDLL:
    # At -O2, as forms are compiled, loops over three stay loops, and rotations take ten times as long.
    found = library(Path(__file__).with_suffix(".c").read_text(encoding="utf-8"), flags=(*FLAGS, "-O3"))
    if found is None:
        raise StopError("rotations.c cannot be compiled: a C compiler is needed, as for the forms of FEniCSx")
    long, array = ctypes.c_long, ctypes.c_void_p
    found.rotations.argtypes = [long, array, array, array]
    found.turn.argtypes = [long, array, ctypes.c_int, long, long, array, array]
    found.rotations.restype = found.turn.restype = None
    return found


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
        y = turn(x, self.R, back=True)
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
