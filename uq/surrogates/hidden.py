"""What functions that a fit lacks in the tails of parameters would do to the standard deviations that it states.

If a function ψ of norm 1 that the basis lacks is part of an output with the norm t, then the fit leaves it out, and its
coefficients c take up what of ψ looks like the basis at the samples: with the columns A = QR of the regression they are
off by t R⁻¹Qᵀψ, and the standard deviation σ by t c·R⁻¹Qᵀψ/σ (without the constant) and t²/(2σ). For t stands the
most that the residuals allow, see `uq.surrogates.regression.Regression.missing`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.indices import shares
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import Basis, IntArray, orthonormal
from uq.surrogates.least_squares import Data, Fit

PULLS = 2.0  # times the largest effect of such a function that is claimed, since others are missing too
LEAST = 1 / 3  # of the norm that is missing: claimed whatever the functions that were looked at would do


def of_std(
    inputs: Inputs, tails: NDArray[np.bool_], basis: Basis, data: Data, fit: Fit, missing: FloatArray
) -> FloatArray:
    """Return errors (m,) of standard deviations by what a fit lacks in tails.

    Parameters
    ----------
    tails
        Which parameters (d,) have some.
    missing
        Norms (m,) of what is missed, by the next powers of single parameters.
    """
    from scipy.linalg import solve_triangular

    left = data.left(basis)
    q, triangle = np.linalg.qr(left.reshape(-1, left.shape[2]))
    columns = data.left(orthonormal(inputs, np.array(list(_neighbours(basis.indices, tails))))).reshape(len(q), -1)
    along = q.T @ columns
    sizes = ((columns - q @ along) ** 2).sum(axis=0)
    varying = (basis.indices != 0).any(axis=1)
    moved = solve_triangular(triangle, along)[varying]
    c = fit.coefficients[varying]
    std = np.linalg.norm(c, axis=0)
    pulls = np.abs(shares(moved.T @ c, std))
    norms = np.sqrt(fit.squares * shares(np.ones_like(sizes), sizes)[:, None])
    largest = (norms * pulls).max(axis=0)
    return np.asarray(np.sqrt((PULLS * largest) ** 2 + (LEAST * missing) ** 2 + shares(missing**2, std) ** 2))


def _neighbours(indices: IntArray, tails: NDArray[np.bool_]) -> Iterator[IntArray]:
    """Go through powers (d,) that a basis (P, d) lacks: the next two of a parameter with a tail, alone and in products.

    Products are with one other parameter; with another tail, of what is the highest power alone too.
    """
    known = {tuple(row) for row in indices.tolist()}
    unit = np.eye(indices.shape[1], dtype=np.int64)
    for i in np.flatnonzero(tails):
        following = int(indices[:, i].max()) + 1
        found = [following * unit[i], (following + 1) * unit[i]]
        for j in np.flatnonzero(np.arange(len(tails)) != i):
            found.append(following * unit[i] + unit[j])
            if tails[j]:
                found.append(max(following - 1, 1) * unit[i] + unit[j])
        yield from (one for one in found if tuple(one.tolist()) not in known)
