"""What part of an error elements of one degree more see, from what elements of two degrees more see of it.

Beside edges and corners, where stresses are singular, errors fall with a power of the degree p, C p^−β, and twice as
fast in p as in the size of cells (I. Babuška, M. Suri, The p and h-p versions of the finite element method, SIAM Rev.
36 (1994) 578–632). Values in three degrees tell β and with it the rest. An extrapolation, so bounded: no factor is
trusted beyond that of β ≈ 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from forward.model import FloatArray, Saturation

LEAST, MOST = 0.5, 3.0  # factors
# Where finding them takes too much memory: of linear elements, which see most, and of others at edges that are held.
TYPICAL = {1: 1.1, 2: 1.35}
RATES = np.geomspace(1e-3, 60.0, 2000)  # β


def factors(seen: ArrayLike, more: ArrayLike, degree: int, otherwise: float = 1.0) -> FloatArray:
    """Return what errors seen in elements of one degree more are to be multiplied by.

    Parameters
    ----------
    seen, more
        Errors (m,) as elements of one and of two degrees more see them.
    degree
        Of the body.
    otherwise
        The factor of what is too small beside the others to have one of its own.
    """
    one, two = np.atleast_1d(np.asarray(seen, dtype=float)), np.atleast_1d(np.asarray(more, dtype=float))
    p = float(degree)
    first = p**-RATES - (p + 1) ** -RATES
    ratios = ((p + 1) ** -RATES - (p + 2) ** -RATES) / first  # falls with β
    found = np.full(one.shape, otherwise)
    good = np.isfinite(one) & np.isfinite(two) & (one != 0)
    step = (two[good] - one[good]) / one[good]
    powers = np.interp(step, ratios[::-1], (p**-RATES / first)[::-1])
    found[good] = np.clip(np.where(step > 0, powers, 1 + step), LEAST, MOST)
    found[np.isnan(one)] = math.nan
    return found


def typical(seen: FloatArray, degree: int) -> Saturation:
    """Return what is typical of elements of a degree, for outputs whose errors (m,) are seen."""
    factor = TYPICAL[degree]
    return Saturation(np.where(np.isnan(seen), np.nan, factor), factor, factor, measured=False)
