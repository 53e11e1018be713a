"""Which data are neighbours: residuals of a wrong model agree there.

Two places are neighbours if no third one is nearer to both than they are to each other (the relative neighbourhood
graph: G. T. Toussaint, Pattern Recognit. 12 (1980) 261–268). Along a line these are the places that follow one another,
on a grid those along its axes, and everywhere the graph is connected. It depends on distances only: not on the order of
the data, nor on the choice of axes. Data at the same place are neighbours of each other, and of those at the next ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

Neighbours = tuple[NDArray[np.int64], NDArray[np.int64]]
NEAREST = 16  # other places that are tested from each
DRAWS = 4000  # of independent errors, for the distribution of `agreement`
SAME = 1e-9  # relative difference of distances that counts as rounding


def neighbours(places: FloatArray, kinds: NDArray[np.int64]) -> Neighbours:
    """Pair neighbouring data at places (n, k), each pair once; only those of the same kind (n,) can be compared."""
    pairs: set[tuple[int, int]] = set()
    for kind in np.unique(kinds):
        members = np.flatnonzero(kinds == kind)
        pairs |= {(int(members[i]), int(members[j])) for i, j in _related(places[members])}
    ordered = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    return ordered[:, 0], ordered[:, 1]


def agreement(r: FloatArray, neighbours: Neighbours) -> FloatArray:
    """Return Σ r_i r_j/Σ r² (k,) over pairs i, j of neighbours, for residuals (k, n)."""
    return np.asarray((r[:, neighbours[0]] * r[:, neighbours[1]]).sum(axis=1) / (r**2).sum(axis=1))


def _related(points: FloatArray) -> set[tuple[int, int]]:
    """Pairs i < j of related points (n, k)."""
    distinct, of_point = np.unique(points, axis=0, return_inverse=True)
    members = [np.flatnonzero(of_point.ravel() == place) for place in range(len(distinct))]
    pairs = {(i, j) for at in members for i in at.tolist() for j in at.tolist() if i < j}
    for p, place in enumerate(distinct):
        far = np.linalg.norm(distinct - place, axis=1)
        reach = np.partition(far, NEAREST)[NEAREST] if len(far) > NEAREST + 1 else np.inf
        near = np.flatnonzero((far <= reach * (1 + SAME)) & (far > 0))
        # Whatever is nearer to both than they are to each other is nearer to p than q is, and so among these.
        between = np.linalg.norm(distinct[near, None] - distinct[None, near], axis=2)
        nearer = np.maximum(far[near][:, None], between) < far[near] * (1 - SAME)
        for q in near[~nearer.any(axis=0)].tolist():
            pairs |= {(min(i, j), max(i, j)) for i in members[p].tolist() for j in members[q].tolist()}
    return pairs
