"""Local modes of a body in blocks, coupled at their interfaces: component mode synthesis with modes from snapshots.

The cells of a body are shared among blocks. A node inside a block belongs to it alone, one on an interface to several;
nodes with the same blocks make one interface (a face between two blocks, an edge between four). A field of
displacements is the sum of

- for every interface, what it has there and zero on the others, carried on into the blocks with the least energy, and
- for every block, what is left, which is zero on all interfaces.

Both are continuous. Fields inside different blocks are orthogonal in the stiffness at rest, and orthogonal to all that
comes from interfaces (W. C. Hurty, AIAA J. 3 (1965) 678–685; R. R. Craig, M. C. C. Bampton, AIAA J. 6 (1968)
1313–1319). The modes of each are those of the parts of the snapshots; of all of them the most important ones are taken.
A block may be kept in full, with its interfaces: then all displacements of the finite elements in it are unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, ModelError
from forward.reduced import basis

MOST_IN_FULL = 1500  # displacements of blocks that are kept in full: the model has as many unknowns


@dataclass(frozen=True, eq=False)
class Partition:
    """Which nodes are where.

    Attributes
    ----------
    of_node
        The part (n,) to which each node belongs.
    blocks
        Which blocks (parts, B) each part lies in: one of the inside of a block, several of an interface.
    full
        Which parts (parts,) are kept in full.
    """

    of_node: NDArray[np.int64]
    blocks: NDArray[np.bool_]
    full: NDArray[np.bool_]

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which parts (parts,) are insides of blocks."""
        return np.asarray(self.blocks.sum(axis=1) == 1)


def cut(cells: NDArray[np.int64], places: FloatArray, numbers: tuple[int, int, int]) -> NDArray[np.int64]:
    """Return the block of each cell (n_cells, k) with nodes at places (n, 3): so many boxes along each axis."""
    middle = places[cells].mean(axis=1)
    low, high = places.min(axis=0), places.max(axis=0)
    at = (middle - low) / np.where(high > low, high - low, 1.0) * numbers
    i, j, k = np.clip(at.astype(np.int64), 0, np.array(numbers) - 1).T
    return np.asarray((i * numbers[1] + j) * numbers[2] + k)


def partition(
    labels: NDArray[np.int64], cells: NDArray[np.int64], places: FloatArray, full: FloatArray | None = None
) -> Partition:
    """Share nodes at places (n, 3) among blocks, from the block of each cell (n_cells, k).

    Parameters
    ----------
    full
        Places (f, 3): the blocks with the nearest cells are kept in full.
    """
    names, block = np.unique(labels, return_inverse=True)
    touched = np.zeros((len(places), len(names)), dtype=bool)
    touched[cells.ravel(), np.repeat(block, cells.shape[1])] = True
    blocks, of_node = np.unique(touched, axis=0, return_inverse=True)
    kept = np.zeros(len(names), dtype=bool)
    middle = places[cells].mean(axis=1)
    for place in np.zeros((0, 3)) if full is None else full:
        kept[block[int(np.argmin(((middle - place) ** 2).sum(axis=1)))]] = True
    return Partition(of_node.ravel(), blocks, (blocks & kept).any(axis=1))


def modes(parts: Partition, stiffness: Any, free: NDArray[np.bool_], rows: FloatArray, most: int) -> FloatArray:
    """Return modes (k, U) from snapshots (s, U): all of the parts in full, and then the most important others.

    They are orthonormal in the stiffness, the first ones among themselves too, and nested.

    Parameters
    ----------
    stiffness
        Sparse matrix (U, U) of the body at rest; the displacements of a node follow each other.
    free
        Which unknowns (U,) are not prescribed.
    most
        Largest number of modes, those of parts in full not counted.

    Raises
    ------
    ModelError
        If parts in full have more than `MOST_IN_FULL` displacements.
    """
    of_unknown = np.repeat(parts.of_node, 3)
    count = int((parts.full[of_unknown] & free).sum())
    if count > MOST_IN_FULL:
        message = f"blocks kept in full have {count:,} displacements, expected at most {MOST_IN_FULL:,}: cut finer"
        raise ModelError(message)

    def inner(some: FloatArray) -> FloatArray:
        products = np.asarray((stiffness @ some.T).T)
        products[:, ~free] = 0
        return products

    carried = _carrier(stiffness, free & parts.inside[of_unknown], free & ~parts.inside[of_unknown])
    rest = rows - carried(rows)
    whole: list[FloatArray] = []
    others: list[tuple[FloatArray, FloatArray]] = []
    for number, inside in enumerate(parts.inside):
        here = free & (of_unknown == number)
        if not here.any():
            continue
        if parts.full[number]:
            units = np.zeros((int(here.sum()), len(free)))
            units[np.arange(len(units)), np.flatnonzero(here)] = 1.0
            whole.append(units if inside else carried(units))
            continue
        local = np.where(here, rest if inside else rows, 0.0)
        found, squares = basis.orthonormal(local if inside else carried(local), inner, rows[:0], most)
        others.append((squares[: len(found)], found))
    important = np.concatenate([squares for squares, _ in others] or [np.zeros(0)])
    chosen = np.vstack([found for _, found in others] or [rows[:0]])[np.argsort(-important, kind="stable")[:most]]
    return _in_order(np.vstack([*whole, chosen]), inner)


def _carrier(
    stiffness: Any, inside: NDArray[np.bool_], between: NDArray[np.bool_]
) -> Callable[[FloatArray], FloatArray]:
    """Return what carries rows (k, U) on from the interfaces into the blocks with the least energy."""
    from scipy.sparse.linalg import splu

    factor = splu(stiffness[inside][:, inside].tocsc())
    coupling = stiffness[inside][:, between]

    def carried(rows: FloatArray) -> FloatArray:
        found = np.zeros_like(rows)
        found[:, between] = rows[:, between]
        found[:, inside] = -factor.solve(np.ascontiguousarray(coupling @ rows[:, between].T)).T
        return found

    return carried


def _in_order(rows: FloatArray, inner: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return rows that are orthonormal, each a sum of those before it and its own; those that others make left out."""
    kept: FloatArray = rows[:0]
    sizes = np.sqrt(np.maximum((rows * inner(rows)).sum(axis=1), 1e-300))
    scaled = rows / sizes[:, None]
    gram = scaled @ inner(scaled).T
    try:
        kept = np.linalg.solve(np.linalg.cholesky((gram + gram.T) / 2), scaled)
    except np.linalg.LinAlgError:  # some are sums of others
        kept = basis.orthonormal(scaled, inner, rows[:0], len(rows))[0]
    return kept
