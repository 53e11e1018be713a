"""What acts on nodes of a body and is no form: forces on some nodes, their derivatives, and what it remembers.

An item sees its own nodes only, all of them on every rank, whoever owns them: it may couple nodes that share no cell.
Forces have the sign of the imbalance, ∂E/∂u of a potential E.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray


class Entries(NamedTuple):
    """Entries of a matrix, always at the same places, zeros too; those at one place add."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    values: FloatArray

    @classmethod
    def of(cls, dense: FloatArray) -> Self:
        """All entries of an array (r, c)."""
        rows, columns = np.indices(dense.shape)
        return cls(rows.ravel(), columns.ravel(), dense.ravel())


@dataclass(frozen=True)
class Past:
    """What an earlier step left.

    Attributes
    ----------
    state
        Displacements (n, 3) (m) of the nodes at its end: where they were.
    numbers
        The numbers of the item then, by the names of its fields. One in seconds that has steps is the clock of rates.
    load
        Fraction of the loads.
    time
        Steps of the path that were passed.
    kept
        What the item kept (m,).
    """

    state: FloatArray
    numbers: Mapping[str, float]
    load: float
    time: float
    kept: FloatArray


@dataclass(frozen=True)
class Now:
    """Where an item acts; attributes as of `Past`, which is None at rest and for items that remember nothing."""

    state: FloatArray
    numbers: Mapping[str, float]
    load: float
    time: float
    past: Past | None

    def left(self, kept: FloatArray) -> Past:
        """Return what this leaves to the next step."""
        return Past(self.state, self.numbers, self.load, self.time, kept)


class Kept(NamedTuple):
    """What an item keeps of a step (m,), and its derivatives.

    Attributes
    ----------
    values
        The values (m,).
    by_state, by_past
        By the displacements (m, 3n) now, and by what was kept before (m, m).
    by_number
        By the numbers of the item (m,), now and before alike.
    """

    values: FloatArray
    by_state: Entries
    by_past: Entries
    by_number: Mapping[str, FloatArray]


class Acting:
    """An item on the nodes of a body: what each kind defines; the last two only where something is `kept`.

    Attributes
    ----------
    nodes
        Undeformed places (n, 3) (m) of its nodes, at each of which the mesh has one.
    """

    nodes: FloatArray

    def forces(self, now: Now) -> FloatArray:
        """Return the forces (n, 3) (N) that it adds to the imbalance."""
        raise NotImplementedError

    def stiffness(self, now: Now) -> Entries:
        """Return their derivative (3n, 3n) by the displacements, interleaved by component."""
        raise NotImplementedError

    def by_number(self, now: Now) -> Mapping[str, FloatArray]:
        """Return their derivatives (n, 3) by the numbers of the item, now and before alike, by their names."""
        raise NotImplementedError

    def by_past(self, now: Now) -> Entries:
        """Return their derivative (3n, m) by what was kept before."""
        raise NotImplementedError

    def kept(self, now: Now) -> Kept:
        """Return what it leaves to the next step, besides displacements and numbers."""
        raise NotImplementedError
