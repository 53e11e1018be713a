"""Modes of a body, as a whole or in blocks: few directions that hold many states, in its norm at rest.

The norm is that of the stiffness at the mean parameters. In the mixed form that is [[A, Bᵀ], [B, −C]], and the norm of
a displacement and a pressure that of A and of κ/μ C, so that a pressure is measured against the shear modulus.

Blocks are coupled at their interfaces: component mode synthesis with modes from snapshots. The cells of a body are
shared among blocks. A node inside a block belongs to it alone, one on an interface to several; nodes with the same
blocks make one interface (a face between two blocks, an edge between four). A field of displacements is the sum of

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
from functools import cached_property
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.fem.model import HyperelasticModel
from forward.materials.admissible import moduli
from forward.materials.material import constants
from forward.model import FloatArray, ModelError

LEAST = 1e-7  # norm of what is left of rows, relative to the largest, below which it is rounding
MOST_IN_FULL = 1500  # displacements of blocks that are kept in full: the model has as many unknowns
CLOSE = 1e-3  # what conjugate gradients may leave of the supports of pressures


def orthonormal(
    rows: FloatArray, inner: Callable[[FloatArray], FloatArray], beside: FloatArray, most: int | float
) -> tuple[FloatArray, FloatArray]:
    """Return modes (k, U) of rows (s, U), the most important first, orthonormal to each other and to rows `beside`.

    The modes minimise Σ ‖x − P x‖² over all bases of their number (method of snapshots: L. Sirovich, Q. Appl. Math. 45
    (1987) 561–571). The other array (s,) holds the squares of the singular values, falling.

    Parameters
    ----------
    rows
        Vectors.
    inner
        Product of rows with the matrix of the inner product.
    beside
        Orthonormal rows (b, U) that are there already.
    most
        How many modes are wanted; below 1, what they may leave of the rows: root mean square, relative.
    """
    times = inner(rows)
    largest = float(np.einsum("ij,ij->i", rows, times).max(initial=0.0))
    rest = rows
    if len(beside):
        of_beside = inner(beside)
        for _ in range(2):
            rest = rest - (rest @ of_beside.T) @ beside
        times = inner(rest)
    values, vectors = np.linalg.eigh(rest @ times.T)
    squares = np.maximum(values[::-1], 0.0)
    count = enough(squares, most) if most < 1 else int(most)
    count = min(count, int((squares > LEAST**2 * largest).sum()))
    modes = (vectors[:, ::-1][:, :count] / np.sqrt(squares[:count])).T @ rest
    for _ in range(2):  # what rounding has left
        if len(beside):
            modes = modes - (modes @ of_beside.T) @ beside
        gram = modes @ inner(modes).T
        modes = np.linalg.solve(np.linalg.cholesky((gram + gram.T) / 2), modes)
    return modes, squares


def enough(squares: FloatArray, tolerance: float) -> int:
    """Return how many modes leave no more than a tolerance of the rows, root mean square relative to them."""
    left = np.sqrt(np.maximum(1 - np.cumsum(squares) / squares.sum(), 0)) if squares.sum() > 0 else np.zeros(1)
    few = np.flatnonzero(left <= tolerance)
    return int(few[0]) + 1 if len(few) else len(squares)


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


def boxes(cells: NDArray[np.int64], places: FloatArray, numbers: tuple[int, int, int]) -> NDArray[np.int64]:
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

    The blocks with the cells nearest to places `full` (f, 3) are kept in full.
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


def modes_of_blocks(
    parts: Partition, stiffness: Any, free: NDArray[np.bool_], rows: FloatArray, most: int
) -> FloatArray:
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
        found, squares = orthonormal(local if inside else carried(local), inner, rows[:0], most)
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
    sizes = np.sqrt(np.maximum((rows * inner(rows)).sum(axis=1), 1e-300))
    scaled = rows / sizes[:, None]
    gram = scaled @ inner(scaled).T
    try:
        return np.asarray(np.linalg.solve(np.linalg.cholesky((gram + gram.T) / 2), scaled))
    except np.linalg.LinAlgError:  # some are sums of others
        return orthonormal(scaled, inner, rows[:0], len(rows))[0]


class AtRest:
    """A body at rest, in one process, at the means (d,) of its parameters."""

    def __init__(self, model: HyperelasticModel, nominal: FloatArray) -> None:
        self.model, self._nominal = model, nominal
        self.equations = model.equations
        self._displacements = 3 * self.equations.nodes_owned  # of the unknowns, which begin with them
        self.lifts = self._lifted()

    def set(self) -> None:
        """Set the equations to it."""
        equations = self.equations
        equations.linearisation_point.begin()
        equations.set_parameters(self._nominal)
        equations.at_load(0.0)
        equations.set_state(np.zeros(equations.size))

    def _lifted(self) -> list[tuple[int, float, FloatArray]]:
        """Fields that displacements by one metre make of it: parameter, value otherwise, field."""
        equations, paths = self.equations, self.model.parameters
        found: list[tuple[int, float, FloatArray]] = []
        self.set()
        for path, mover in equations.movers.items():
            number = paths.index(path) if path in paths else -1
            value = equations.number(path)
            if number < 0 and value == 0:
                continue
            if not found:
                self.set()
                equations.factorise(np.zeros(equations.size))
            w = np.zeros(equations.size)
            w[equations.fixed] = mover
            right = -equations.stiffness_times(w)
            right[equations.fixed] = mover
            found.append((number, value, equations.back_substitute(right)))
        return found

    # --- norms -------------------------------------------------------------------------------------------------------

    def inner(self, rows: FloatArray) -> FloatArray:
        """Return the products of rows (k, U_local) with the matrix of the norm, with zeros where the body is held."""
        if self.equations.p is not None:
            A, _, C = self._parts
            n = self._displacements
            found = np.hstack([(A @ rows[:, :n].T).T, (C @ rows[:, n:].T).T])
        else:
            self.set()
            found = np.array([self.equations.stiffness_times(row) for row in rows]).reshape(rows.shape)
        found[:, self.equations.fixed] = 0
        return found

    @cached_property
    def _parts(self) -> tuple[Any, Any, Any]:
        """A, B and κ/μ C of the mixed form, sparse."""
        self.set()
        equations, n = self.equations, self._displacements
        whole = equations.sparse_stiffness()
        kind = equations.spec.energy
        shear, bulk = moduli(kind, {name: equations.number(f"material.{name}") for name in constants(kind)})
        return whole[:n, :n], whole[n:, :n], -float(bulk / shear) * whole[n:, n:]

    def normed(self, rows: FloatArray) -> FloatArray:
        """Return rows (k, U_local) of norm 1."""
        return np.asarray(rows / np.sqrt(np.maximum((rows * self.inner(rows)).sum(axis=1), 1e-300))[:, None])

    def left(self, rows: FloatArray, modes: FloatArray) -> float:
        """What orthonormal modes leave of rows: root mean square, relative."""
        squares = ((rows @ self.inner(modes).T) ** 2).sum()
        return float(np.sqrt(max(1 - squares / max((rows * self.inner(rows)).sum(), 1e-300), 0.0)))

    # --- modes -------------------------------------------------------------------------------------------------------

    def modes(self, rows: FloatArray, beside: FloatArray, most: int | float) -> tuple[FloatArray, FloatArray]:
        """Return modes of rows (k, U_local), orthonormal to each other and to `beside`, and squares of singular values.

        In the mixed form those of displacements, as many of pressures, and for each of these the displacement that it
        works on most, A s = Bᵀπ: then the few equations have one pressure each that they determine, whatever the
        snapshots are (F. Ballarin, A. Manzoni, A. Quarteroni, G. Rozza, Int. J. Numer. Meth. Engng 102 (2015)
        1136–1161).

        Parameters
        ----------
        rows, beside, most
            As of `orthonormal`; of displacements.
        """
        n = self._displacements
        if self.equations.p is None:
            return orthonormal(rows, self.inner, beside, most)
        of_displacements, of_pressures = rows.copy(), rows.copy()
        of_displacements[:, n:] = 0
        of_pressures[:, :n] = 0
        moved, squares = orthonormal(of_displacements, self.inner, beside, most)
        pressed = orthonormal(of_pressures, self.inner, beside, len(moved))[0]
        there = np.vstack([beside, moved])
        support = orthonormal(self.normed(self._supports(pressed)), self.inner, there, len(pressed))[0]
        return np.vstack([moved, pressed, support]), squares

    def _supports(self, pressures: FloatArray) -> FloatArray:
        """Return the displacements (k, U_local) that pressures (k, U_local) work on most."""
        from scipy.sparse import diags
        from scipy.sparse.linalg import cg

        close: dict[str, Any] = {"rtol" if "rtol" in signature(cg).parameters else "tol": CLOSE}  # SciPy renamed it
        A, B, _ = self._parts
        free = np.setdiff1d(np.arange(self._displacements), self.equations.fixed)
        inside = A[free][:, free]
        scaling = diags(1 / inside.diagonal())
        found = np.zeros_like(pressures)
        for row, pressure in zip(found, pressures, strict=True):
            row[free] = cg(inside, (B.T @ pressure[self._displacements :])[free], M=scaling, **close)[0]
        return found

    def of_blocks(
        self, rows: FloatArray, labels: NDArray[np.int64], full: FloatArray, most: int, more: int
    ) -> tuple[FloatArray, int, NDArray[np.bool_]]:
        """Return modes (k, U_local) of blocks, how many of them a model has, and which cells are kept in full.

        Blocks of cells are told by labels, those kept in full by places (f, 3) in them; `most` and `more` are how many
        modes the model has besides those of such blocks, and the larger one besides.

        Raises
        ------
        ModelError
            If too much is kept in full, or in the mixed form.
        """
        layout, equations = self.equations.layout, self.equations
        if equations.p is not None:
            raise ModelError("a body in the mixed form is not cut into blocks, expected none of them")
        cells, _ = layout.cells()
        parts = partition(labels, cells, layout.coordinates, full)
        self.set()
        canonical = np.round(layout.scatter(np.arange(float(equations.size))[None])[0]).astype(np.int64)
        local = np.argsort(canonical)
        stiffness = equations.sparse_stiffness()[local][:, local]
        free = np.ones(equations.size, dtype=bool)
        free[canonical[equations.fixed]] = False
        whole = layout.gather(rows)
        assert whole is not None
        found = modes_of_blocks(parts, stiffness, free, whole, most + more)
        in_full = parts.full[parts.of_node]
        kept = np.zeros(len(cells), dtype=bool)
        kept[layout.by_cell(np.arange(len(cells)))] = in_full[cells].all(axis=1)
        return layout.scatter(found), int((np.repeat(in_full, 3) & free).sum()) + most, kept
