"""Models made of models, with the chain rule written once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from forward.model import (
    FloatArray,
    ForwardModel,
    Guess,
    MeshError,
    NodalSpace,
    OneByOne,
    Saturation,
    Solution,
    Stability,
    Work,
)


def times(matrix: csr_matrix, rows: FloatArray) -> FloatArray:
    """Return the product (…, n) of a matrix (n, m) with a vector (m,), or with each of k rows (k, m)."""
    return np.asarray((matrix @ np.asarray(rows).T).T)


@dataclass(frozen=True, eq=False)
class Rows(OneByOne):
    """A model whose outputs are sums y = S o of the outputs o of another one.

    Parameters
    ----------
    model
        The other one.
    S
        Weights (n, m) in the sums.
    outputs
        Names of the sums.
    """

    model: ForwardModel
    S: csr_matrix
    outputs: tuple[str, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.model.parameters

    @property
    def differentiable(self) -> bool:
        """Whether solutions have tangents and adjoints."""
        return self.model.differentiable

    @property
    def space(self) -> NodalSpace | None:
        """Where the states live."""
        return self.model.space

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> RowsSolution:
        """Solve as the other model does."""
        return RowsSolution(self.model.solve(parameters, guess), self.S)


def selected(model: ForwardModel, which: Sequence[int]) -> Rows:
    """Return the model of some outputs, by number; names are numbered where one is there several times."""
    names = [model.outputs[i] for i in which]
    numbered = tuple(
        f"{name}.{names[:k].count(name)}" if names.count(name) > 1 else name for k, name in enumerate(names)
    )
    entries = np.ones(len(names)), np.array(which, dtype=np.int64), np.arange(len(names) + 1)
    return Rows(model, csr_matrix(entries, shape=(len(names), len(model.outputs))), numbered)


@dataclass(frozen=True, eq=False)
class RowsSolution:
    """Sums of the outputs of a solution."""

    solution: Solution
    S: csr_matrix

    @property
    def outputs(self) -> FloatArray:
        """Values of the sums (n,)."""
        return times(self.S, self.solution.outputs)

    @property
    def state(self) -> FloatArray:
        """This rank's part of the state."""
        return self.solution.state

    @property
    def residual(self) -> float:
        """Relative residual of the state."""
        return self.solution.residual

    @property
    def converged(self) -> bool:
        """Whether that meets the solver's tolerance."""
        return self.solution.converged

    @property
    def stability(self) -> Stability:
        """What is known of the stability of the equilibrium."""
        return self.solution.stability

    @property
    def work(self) -> Work:
        """What it has cost so far."""
        return self.solution.work

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the sums (n,) along a `direction` (d,); (k, n) for (k, d)."""
        return times(self.S, self.solution.tangent(direction))

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the sums weighted by `weights` (n,); (k, d) for (k, n)."""
        return self.solution.adjoint(times(self.S.T, weights))

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state along a `direction` (d,), or of k of them."""
        return self.solution.state_tangent(direction)

    def mesh_error(self) -> MeshError | None:
        """Estimate the error that the mesh makes; None without a mesh."""
        found = self.solution.mesh_error()
        if found is None:
            return None
        seen = None if found.seen is None else times(self.S, found.seen)
        return replace(found, outputs=times(self.S, found.outputs), seen=seen)

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the error of the mesh; None without a mesh.

        The factor of a sum of several outputs is that by which its error grows where theirs grow by their own.
        """
        found = self.solution.saturation(spare)
        if found is None:
            return None
        alone = np.diff(self.S.indptr) == 1
        factors = np.ones(len(alone))
        factors[alone] = found.outputs[self.S.indices[self.S.indptr[:-1][alone]]]
        if not alone.all():
            error = self.solution.mesh_error()
            assert error is not None  # of a model with a mesh
            before, after = times(self.S, error.outputs), times(self.S, found.outputs * error.outputs)
            some = ~alone & (before != 0)
            factors[some] = after[some] / before[some]
        shifts = None if found.shifts is None else times(self.S, found.shifts)
        doubts = None if found.doubts is None else times(abs(self.S), found.doubts)
        return replace(found, outputs=factors, shifts=shifts, doubts=doubts)
