"""Items on the nodes of a discrete body: what acts there and is no form (`forward.terms.acting`).

What items keep for the next step stands on the first rank, behind the state that an increment leaves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import block_diag, csr_matrix
from scipy.spatial import cKDTree

from forward.fem import ranks
from forward.model import FloatArray, ModelError
from forward.terms.acting import Entries, Kept, Now, Past

NONE = Entries(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))
NEAR = 1e-6  # of the extent of a body, by which the node of an item may be elsewhere than stated


class Items:
    """All items on a body, at the state and the numbers that its equations are set to.

    Vectors hold this rank's part (U_local,), as those of the equations.

    Raises
    ------
    ModelError
        If the mesh has no node where an item has one.
    """

    def __init__(self, equations: Any) -> None:
        self._equations = equations
        loads = [load for load in equations.spec.loads if not load.written]
        self.acting = [(load, load.acting(equations)) for load in loads]
        self._counts = [len(acting.nodes) for _, acting in self.acting]
        self._components = [3 * count for count in self._counts]
        self._past: Sequence[Past | None] = [None] * len(loads)
        self._time = 1.0
        if not loads:
            return
        layout = equations.layout
        places = np.concatenate([np.asarray(acting.nodes, dtype=float) for _, acting in self.acting])
        apart, found = cKDTree(layout.coordinates).query(places)
        for load, far in zip(np.repeat([load.label for load in loads], self._counts), apart, strict=True):
            if far > NEAR * np.ptp(layout.coordinates, axis=0).max():
                message = f"the load '{load}' acts {1e3 * far:.3g} mm from the nearest node of the mesh, not at one"
                raise ModelError(message)
        local = np.full(len(layout.coordinates), -1)
        local[layout.positions] = np.arange(equations.nodes_owned)
        unknowns = (3 * local[found][:, None] + np.arange(3)).ravel()
        self._mine = np.flatnonzero(np.repeat(local[found] >= 0, 3))  # components of nodes of this rank
        self._unknowns = unknowns[self._mine]
        self._size = len(unknowns)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.acting)

    # --- between items and vectors -----------------------------------------------------------------------------------

    def _taken(self, vector: FloatArray) -> FloatArray:
        """Components (3n,) of a vector at the nodes of all items, on every rank; collective."""
        found = np.zeros(self._size)
        found[self._mine] = vector[self._unknowns]
        return ranks.total(self._equations.comm, found)

    def _given(self, components: FloatArray) -> FloatArray:
        """Return the vector of which these are the components (3n,): those at one node add."""
        vector = np.zeros(self._equations.size)
        np.add.at(vector, self._unknowns, components[self._mine])
        return vector

    def _now(self) -> list[tuple[Any, Any, Now]]:
        """Each load with what acts, and where that is; collective."""
        equations = self._equations
        states = np.split(self._taken(equations.state()).reshape(-1, 3), np.cumsum(self._counts)[:-1])
        found = []
        for (load, acting), state, past in zip(self.acting, states, self._past, strict=True):
            numbers = {name: equations.number(f"loads.{load.label}.{name}") for name in load.scalars}
            found.append((load, acting, Now(state, numbers, equations.load, self._time, past)))
        return found

    # --- forces ------------------------------------------------------------------------------------------------------

    def forces(self) -> FloatArray:
        """Forces that they add to the imbalance; collective."""
        return self._given(np.concatenate([acting.forces(now).ravel() for _, acting, now in self._now()]))

    def stiffness(self) -> csr_matrix:
        """Their derivative (3n, 3n) by the displacements of the nodes of all items, on every rank; collective."""
        return _by_item([acting.stiffness(now) for _, acting, now in self._now()], self._components, self._components)

    def stiffness_times(self, w: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product of their stiffness, or its transpose, with a vector; collective."""
        stiffness = self.stiffness()
        return self._given((stiffness.T if transpose else stiffness) @ self._taken(w))

    def by_number(self) -> Iterator[tuple[str, FloatArray]]:
        """Paths of their numbers with the derivatives of the forces; collective."""
        for i, (load, acting, now) in enumerate(self._now()):
            for name, forces in acting.by_number(now).items():
                parts = [np.zeros(count) for count in self._components]
                parts[i] = forces.ravel()
                yield f"loads.{load.label}.{name}", self._given(np.concatenate(parts))

    def entries(self, numbers: FloatArray, *, symmetric: bool) -> Entries:
        """Entries of their stiffness in rows of this rank, by rows and columns of a matrix; collective.

        `numbers` are the rows (U_local,) that the unknowns are; prescribed ones have none.
        """
        free = np.array(numbers)
        free[self._equations.fixed] = -1
        every = self._taken(free).astype(np.int64)
        mine = np.zeros(self._size, dtype=bool)
        mine[self._mine] = True
        found = self.stiffness().tocoo()
        rows, columns, values = found.row, found.col, found.data
        if symmetric and not all(load.symmetric for load, _ in self.acting):
            rows, columns = np.concatenate([rows, columns]), np.concatenate([columns, rows])
            values = np.concatenate([values, values]) / 2
        kept = mine[rows] & (every[rows] >= 0) & (every[columns] >= 0)
        return Entries(every[rows[kept]], every[columns[kept]], values[kept])

    # --- what is kept ------------------------------------------------------------------------------------------------

    def follow(self, past: Sequence[Past], time: float) -> None:
        """Set what the increment before has left, nothing at rest, and how many steps of the path are passed."""
        self._past, self._time = past or [None] * len(self.acting), time

    def left(self, u: FloatArray) -> tuple[Past, ...]:
        """What they leave to the next increment at a state (U_local,), which is then set; collective."""
        if not self:
            return ()
        self._equations.set_state(u)
        return tuple(
            now.left(acting.kept(now).values if load.remembers else np.zeros(0)) for load, acting, now in self._now()
        )

    def _kept(self) -> list[Kept]:
        """What they keep, with derivatives; collective."""
        nothing = Kept(np.zeros(0), NONE, NONE, {})
        return [acting.kept(now) if load.remembers else nothing for load, acting, now in self._now()]

    @cached_property
    def _sizes(self) -> list[int]:
        return [len(one.values) for one in self._kept()]

    @cached_property
    def kept_size(self) -> int:
        """How many numbers this rank holds of what they keep; collective."""
        every = sum(self._sizes)
        return every if self._equations.comm.rank == 0 else 0

    def _everywhere(self, kept: FloatArray) -> FloatArray:
        """Rows (k, M) of what is kept on every rank; collective."""
        return np.asarray(self._equations.comm.bcast(kept))

    def _by_past(self) -> csr_matrix:
        """Derivative (3n, M) of the forces by what was kept before."""
        found = [
            acting.by_past(now) if load.remembers and now.past is not None else NONE
            for load, acting, now in self._now()
        ]
        return _by_item(found, self._components, self._sizes)

    def from_past(self, kept: FloatArray) -> FloatArray:
        """Forces due to changes (M_local,) of what was kept before; collective."""
        return self._given(self._by_past() @ self._everywhere(kept))

    def to_past(self, w: FloatArray) -> FloatArray:
        """Return the transpose of `from_past`; collective."""
        found: FloatArray = self._by_past().T @ self._taken(w)
        return found[: self.kept_size]

    def _derivatives(self) -> tuple[csr_matrix, csr_matrix, FloatArray]:
        """Derivatives of what is kept: by the state (M, 3n), by what was kept before (M, M), by parameters (M, d)."""
        found, parameters = self._kept(), self._equations.parameters
        by_state = _by_item([one.by_state for one in found], self._sizes, self._components)
        pairs = zip(found, self._past, strict=True)
        by_past = _by_item([NONE if past is None else one.by_past for one, past in pairs], self._sizes, self._sizes)
        by_number = np.zeros((sum(self._sizes), len(parameters)))
        ends = np.cumsum(self._sizes)
        for (load, _), one, end in zip(self.acting, found, ends, strict=True):
            for name, slopes in one.by_number.items():
                if (path := f"loads.{load.label}.{name}") in parameters:
                    by_number[end - len(slopes) : end, parameters.index(path)] = slopes
        return by_state, by_past, by_number

    def kept_along(self, states: FloatArray, before: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the changes (k, M_local) of what is kept; collective.

        By those of the state (k, U_local), of what was kept before (k, M_local) and of the parameters (k, d).
        """
        by_state, by_past, by_number = self._derivatives()
        moved = np.array([self._taken(row) for row in states])
        found: FloatArray = moved @ by_state.T + self._everywhere(before) @ by_past.T + directions @ by_number.T
        return found[:, : self.kept_size]

    def kept_adjoint(self, kept: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the transpose of `kept_along` for weights (k, M_local); collective.

        Of states (k, U_local), of what was kept before (k, M_local), and of parameters (k, d), whole on every rank.
        """
        by_state, by_past, by_number = self._derivatives()
        weights = self._everywhere(kept)
        states = np.array([self._given(row) for row in weights @ by_state])
        return states, (weights @ by_past)[:, : self.kept_size], weights @ by_number


def _by_item(entries: Sequence[Entries], rows: Sequence[int], columns: Sequence[int]) -> csr_matrix:
    """Return the matrix whose blocks on the diagonal, with so many rows and columns, are those of the items."""
    each = zip(entries, rows, columns, strict=True)
    return block_diag(
        [csr_matrix((one.values, (one.rows, one.columns)), shape=(m, n)) for one, m, n in each], format="csr"
    )
