"""The body at rest, at its mean parameters: its stiffness measures fields, which modes are chosen in.

In the mixed form that stiffness is [[A, Bᵀ], [B, −C]], and the norm of a displacement and a pressure that of A and of
κ/μ C, so that a pressure is measured against the shear modulus.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.fem.model import HyperelasticModel
from forward.materials.admissible import moduli
from forward.materials.material import constants
from forward.model import FloatArray, ModelError
from forward.reduced import basis, blocks

CLOSE = 1e-3  # what conjugate gradients may leave of the supports of pressures


class AtRest:
    """A body at rest, in one process.

    Parameters
    ----------
    model
        The body.
    nominal
        Means (d,) of its parameters.
    """

    def __init__(self, model: HyperelasticModel, nominal: FloatArray) -> None:
        self.model, self._nominal = model, nominal
        self.equations = model.equations
        self._displacements = 3 * self.equations.nodes_owned  # of the unknowns, which begin with them
        self.lifts = self._lifted()

    def set(self) -> None:
        """Set the equations to it."""
        equations = self.equations
        equations.latest.begin()
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
            As of `forward.reduced.basis.orthonormal`; of displacements.
        """
        n = self._displacements
        if self.equations.p is None:
            return basis.orthonormal(rows, self.inner, beside, most)
        of_displacements, of_pressures = rows.copy(), rows.copy()
        of_displacements[:, n:] = 0
        of_pressures[:, :n] = 0
        moved, squares = basis.orthonormal(of_displacements, self.inner, beside, most)
        pressed = basis.orthonormal(of_pressures, self.inner, beside, len(moved))[0]
        there = np.vstack([beside, moved])
        support = basis.orthonormal(self.normed(self._supports(pressed)), self.inner, there, len(pressed))[0]
        return np.vstack([moved, pressed, support]), squares

    def _supports(self, pressures: FloatArray) -> FloatArray:
        """Return the displacements (k, U_local) that pressures (k, U_local) work on most."""
        from scipy.sparse import diags
        from scipy.sparse.linalg import cg

        A, B, _ = self._parts
        free = np.setdiff1d(np.arange(self._displacements), self.equations.fixed)
        inside = A[free][:, free]
        scaling = diags(1 / inside.diagonal())
        found = np.zeros_like(pressures)
        for row, pressure in zip(found, pressures, strict=True):
            row[free] = cg(inside, (B.T @ pressure[self._displacements :])[free], tol=CLOSE, M=scaling)[0]
        return found

    def of_blocks(
        self, rows: FloatArray, labels: NDArray[np.int64], full: FloatArray, most: int, more: int
    ) -> tuple[FloatArray, int, NDArray[np.bool_]]:
        """Return modes (k, U_local) of blocks, how many of them a model has, and which cells are kept in full.

        Parameters
        ----------
        rows
            Snapshots (s, U_local).
        labels
            The block of each cell.
        full
            Places (f, 3) whose blocks are kept in full.
        most, more
            How many modes the model has besides those of such blocks, and the larger one besides.

        Raises
        ------
        ModelError
            If too much is kept in full, or in the mixed form.
        """
        layout, equations = self.equations.layout, self.equations
        if equations.p is not None:
            message = "a body in the mixed form is not cut into blocks, expected none of them"
            raise ModelError(message)
        cells, _ = layout.cells()
        parts = blocks.partition(labels, cells, layout.coordinates, full)
        self.set()
        canonical = np.round(layout.scatter(np.arange(float(equations.size))[None])[0]).astype(np.int64)
        local = np.argsort(canonical)
        stiffness = equations.sparse_stiffness()[local][:, local]
        free = np.ones(equations.size, dtype=bool)
        free[canonical[equations.fixed]] = False
        whole = layout.gather(rows)
        assert whole is not None
        found = blocks.modes(parts, stiffness, free, whole, most + more)
        in_full = parts.full[parts.of_node]
        kept = np.zeros(len(cells), dtype=bool)
        kept[layout.by_cell(np.arange(len(cells)))] = in_full[cells].all(axis=1)
        return layout.scatter(found), int((np.repeat(in_full, 3) & free).sum()) + most, kept
