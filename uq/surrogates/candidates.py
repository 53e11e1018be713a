"""Sets of polynomials that a regression may choose from: whole bases, and dictionaries to select from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import IntArray, by_degree, hyperbolic, hyperbolic_count

TRUNCATIONS = (0.5, 0.75, 1.0)
ROWS_PER_TERM = 2  # rows of the regression for each unknown, at least
FULL = 8  # number of parameters up to which whole bases are tried; above, functions are selected one by one
DICTIONARY = 2000  # functions to select from, at most


def rows_of(inputs: Inputs, *, gradients: bool) -> int:
    """Number of rows of one sample."""
    return 1 + len(inputs.names) if gradients else 1


@dataclass(frozen=True)
class Candidate:
    """Some functions of the largest basis, by index, with the order and q of their set.

    If `sparse`, they are a dictionary from which functions are selected.
    """

    order: int
    q: float
    which: IntArray
    sparse: bool = False


@dataclass(frozen=True)
class Candidates:
    """Sets of functions to choose from; `all` (P, d) is their union."""

    all: IntArray
    sets: tuple[Candidate, ...]


def whole(inputs: Inputs, order: int) -> Candidates:
    """Return the full basis of one order as the only choice."""
    indices = hyperbolic(len(inputs.names), order, 1.0)
    return Candidates(indices, (Candidate(order, 1.0, np.arange(len(indices))),))


def candidates_of(inputs: Inputs, max_order: int, rows: int, dictionary: int) -> Candidates:
    """Return the bases that `rows` rows may determine, and for each q a set of up to `dictionary` to select from."""
    d = len(inputs.names)
    max_order = min(max_order, inputs.largest_degree)
    most = max(rows // ROWS_PER_TERM, d + 1)
    found: dict[tuple[bool, bytes], tuple[IntArray, int, float]] = {}
    determined = False
    for q in reversed(TRUNCATIONS):
        counts = {order: hyperbolic_count(d, order, q) for order in range(1, max_order + 1)}
        if d <= FULL:
            for order, count in counts.items():
                if count <= most or order == 1:
                    indices = hyperbolic(d, order, q)
                    found.setdefault((False, indices.tobytes()), (indices, order, q))
        order = max(order for order, count in counts.items() if count <= dictionary or order == 1)
        widest = order
        while not determined and order > 0:
            indices = hyperbolic(d, order, q)
            found.setdefault((True, indices.tobytes()), (indices, order, q))
            # With fewer rows than functions, smaller dictionaries help.
            order = order - 1 if rows < counts[order] and order > 2 else 0
        # With as many rows as functions, nothing is lost by selecting from all.
        determined = determined or (widest == max_order and counts[widest] <= rows)
    union = by_degree(np.unique(np.concatenate([indices for indices, *_ in found.values()]), axis=0))
    number = {index.tobytes(): i for i, index in enumerate(union)}
    sets = [
        Candidate(order, q, np.array([number[index.tobytes()] for index in indices]), sparse)
        for (sparse, _), (indices, order, q) in found.items()
    ]
    return Candidates(union, tuple(sets))
