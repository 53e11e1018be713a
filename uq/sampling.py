"""Designs: points of the unit cube that depend on the seed and the index of the sample only."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray


def random_points(seed: int, start: int, stop: int, dimension: int) -> FloatArray:
    """Return the pseudo-random points number `start` to `stop` (stop − start, dimension) of the stream `seed`.

    A point is the same whichever range it is drawn in, and lies strictly inside the unit cube.
    """
    bits = np.random.PCG64(seed)
    bits.advance(start * dimension)
    points = np.random.Generator(bits).random((stop - start, dimension))
    return np.clip(points, 2.0**-54, 1 - 2.0**-53)
