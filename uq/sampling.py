"""Designs: points of the unit cube that depend on the seed and the index of the sample only."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray


def random_points(seed: int | tuple[int, ...], start: int, stop: int, dimension: int) -> FloatArray:
    """Return the pseudo-random points number `start` to `stop` (stop − start, dimension) of the stream `seed`.

    A point is the same whichever range it is drawn in, and lies strictly inside the unit cube. Several numbers make one
    seed: (s, 1), (s, 2), … are independent streams.
    """
    bits = np.random.PCG64(seed)
    bits.advance(start * dimension)
    points = np.random.Generator(bits).random((stop - start, dimension))
    return np.clip(points, 2.0**-54, 1 - 2.0**-53)


def sobol_points(seed: int, scramble: int, start: int, stop: int, dimension: int) -> FloatArray:
    """Return the Sobol' points number `start` to `stop` (stop − start, dimension) of one of the scrambles of `seed`.

    A point is the same whichever range it is drawn in and however many scrambles there are. Each is uniform in the
    cube by itself (a random linear scramble and a digital shift of 52 bits); different scrambles are independent.
    """
    from scipy.stats import qmc

    engine = qmc.Sobol(dimension, scramble=True, bits=52, seed=np.random.default_rng([seed, scramble]))
    # Balance, which scipy warns of, is a matter of whole powers of two.
    points = engine.random(1 << (stop - 1).bit_length())[start:stop]
    # The points are lower corners of cells of this size: the centres lie strictly inside the cube.
    return np.asarray(points + 2.0**-53, dtype=float)


def power_of_two(limit: int) -> int:
    """Return the largest power of two up to `limit`, at least 1."""
    return 1 << max(limit.bit_length() - 1, 0)


def check_scrambles(samples: int | None, scrambles: int) -> None:
    """Raise ValueError if so many samples, where a number is given, are not scrambles of a power of two each."""
    if samples is not None and samples != scrambles * power_of_two(samples // scrambles):
        below = scrambles * power_of_two(samples // scrambles)
        nearest = f"{below} or {2 * below}" if samples > scrambles else str(scrambles)
        message = f"samples = {samples}, expected scrambles = {scrambles} times a power of two, such as {nearest}"
        raise ValueError(message)
