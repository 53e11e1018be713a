"""Designs: points of the unit cube that depend only on the seed and the index of the sample."""

from __future__ import annotations

from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

FEW = 10  # dimensions
BITS = 52  # of each coordinate of a Sobol' point


def random_points(seed: int | tuple[int, ...], start: int, stop: int, dimension: int) -> FloatArray:
    """Return the pseudo-random points number `start` to `stop` (stop − start, dimension) of the stream `seed`.

    A point does not depend on the range in which it is drawn, and lies strictly inside the unit cube. Several numbers
    make one seed: (s, 1), (s, 2), … are independent streams.
    """
    bits = np.random.PCG64(seed)
    bits.advance(start * dimension)
    points = np.random.Generator(bits).random((stop - start, dimension))
    return np.clip(points, 2.0**-54, 1 - 2.0**-53)


def latin_points(seed: int | tuple[int, ...], count: int, dimension: int) -> FloatArray:
    """Return a Latin hypercube (count, dimension): in every coordinate, each of so many equal parts has one point.

    M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239–245. For a few points: to import Sobol's
    takes half a second.
    """
    random = np.random.default_rng(seed)
    parts = random.permuted(np.tile(np.arange(count), (dimension, 1)), axis=1).T
    return np.asarray((parts + random.random(parts.shape)) / count)


def even_points(count: int, dimension: int) -> FloatArray:
    """Return points (count, d) that fill the unit cube evenly: Sobol' points, or up to ten dimensions a sequence.

    That is Kronecker's, k α mod 1 with α = (1/g, 1/g², …) and g^(d+1) = g + 1 (M. Roberts, 2018), which in few
    dimensions is as even and needs nothing to be imported.
    """
    if dimension > FEW:
        return sobol_points(0, 0, 0, count, dimension)
    g = 2.0
    for _ in range(64):
        g = (1 + g) ** (1 / (dimension + 1))
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] * g ** -np.arange(1.0, dimension + 1)) % 1)


def sobol_points(seed: int, scramble: int, start: int, stop: int, dimension: int) -> FloatArray:
    """Return the Sobol' points number `start` to `stop` (stop − start, dimension) of one of the scrambles of `seed`.

    A point depends neither on the range in which it is drawn nor on the number of scrambles. Each is uniform in the
    cube (a random linear scramble and a digital shift); different scrambles are independent.
    """
    directions = _directions(dimension, (stop - 1).bit_length())
    shift, directions = _scramble(directions, np.random.default_rng([seed, scramble]))
    points = shift[None]
    for direction in directions:
        points = np.concatenate([points, points[::-1] ^ direction])
    # The points are lower corners of cells of this size: the centres lie strictly inside the cube.
    return points[start:stop] * 2.0**-BITS + 2.0 ** -(BITS + 1)


@cache
def _table() -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return primitive polynomials (D,) and first numbers (D, k) of each, as scipy ships them.

    To import scipy.stats takes longer than many a study, and to unpack the table longer than most solves of a point.
    """
    import scipy

    with np.load(Path(scipy.__file__).parent / "stats" / "_sobol_direction_numbers.npz") as table:
        return table["poly"].astype(np.uint64), table["vinit"].astype(np.uint64)


@lru_cache(maxsize=16)
def _directions(dimension: int, count: int) -> NDArray[np.uint64]:
    """Return the first direction numbers (count, d) of Sobol' points, of `BITS` bits.

    S. Joe, F. Y. Kuo, SIAM J. Sci. Comput. 30 (2008) 2635–2654. scipy has no more dimensions either.
    """
    polynomials, firsts = _table()
    if dimension > len(polynomials):
        raise ValueError(f"{dimension} dimensions, expected at most {len(polynomials)} for Sobol' points")
    found = np.ones((count, dimension), dtype=np.uint64)  # odd numbers m, below 2^(k+1) in row k
    degrees = np.array([int(p).bit_length() - 1 for p in polynomials[:dimension]])
    for degree in np.unique(degrees[1:]):  # the first dimension has all ones
        columns = np.flatnonzero(degrees == degree)
        columns = columns[columns > 0]
        known = min(degree, count)
        found[:known, columns] = firsts[columns, :known].T
        for row in range(degree, count):
            new = found[row - degree, columns]
            for back in range(1, degree + 1):
                chosen = polynomials[columns] >> np.uint64(degree - back) & np.uint64(1)
                new ^= chosen * (found[row - back, columns] << np.uint64(back))
            found[row, columns] = new
    found <<= (BITS - 1 - np.arange(count)).astype(np.uint64)[:, None]
    found.flags.writeable = False  # all scrambles begin with it
    return found


def _scramble(directions: NDArray[np.uint64], random: np.random.Generator) -> tuple[NDArray[np.uint64], ...]:
    """Return a random shift (d,), and direction numbers (k, d) times random lower triangular matrices over GF(2).

    J. Matoušek, On the L2-discrepancy for anchored boxes, J. Complexity 14 (1998).
    """
    dimension = directions.shape[1]
    places = np.arange(BITS, dtype=np.uint64)
    weights = np.uint64(1) << places
    shift = random.integers(2, size=(dimension, BITS), dtype=np.uint64) @ weights
    matrices = np.tril(random.integers(2, size=(dimension, BITS, BITS), dtype=np.uint64))
    matrices[:, places, places] = 1
    digits = directions[..., None] >> places[::-1] & np.uint64(1)  # the first after the point first
    scrambled = np.einsum("dpq,kdq->kdp", matrices, digits) % 2
    return shift, scrambled @ weights[::-1]


def power_of_two(limit: int) -> int:
    """Return the largest power of two up to `limit`, at least 1."""
    return 1 << max(limit.bit_length() - 1, 0)


def check_scrambles(samples: int | None, scrambles: int) -> None:
    """Raise ValueError if the number of samples, if given, is not the number of scrambles times a power of two."""
    if samples is not None and samples != (below := scrambles * power_of_two(samples // scrambles)):
        nearest = f"{below} or {2 * below}" if samples > scrambles else str(scrambles)
        message = f"samples = {samples}, expected scrambles = {scrambles} times a power of two, such as {nearest}"
        raise ValueError(message)


def in_order(values: NDArray[Any]) -> NDArray[Any]:
    """Flatten (R, n, …) of scrambles to (n R, …), first points of all of them first: a shorter study is a prefix."""
    return np.ascontiguousarray(values.swapaxes(0, 1)).reshape(-1, *values.shape[2:])
