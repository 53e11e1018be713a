"""A model restricted to its measured outputs, in the order of the measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

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


@dataclass(frozen=True)
class MeasuredModel(OneByOne):
    """A model restricted to the outputs of the data.

    Parameters
    ----------
    model
        The model.
    which
        Numbers (m,) of its outputs; one may be there several times.
    """

    model: ForwardModel
    which: tuple[int, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.model.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, numbered if they occur several times."""
        names = [self.model.outputs[i] for i in self.which]
        return tuple(
            f"{name}.{names[:k].count(name)}" if names.count(name) > 1 else name for k, name in enumerate(names)
        )

    @property
    def differentiable(self) -> bool:
        """Whether solutions have tangents and adjoints."""
        return self.model.differentiable

    @property
    def space(self) -> NodalSpace | None:
        """Where the states live."""
        return self.model.space

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> MeasuredSolution:
        """Solve as the model does."""
        return MeasuredSolution(self.model.solve(parameters, guess), list(self.which), len(self.model.outputs))


@dataclass(frozen=True)
class MeasuredSolution:
    """A solution restricted to some outputs."""

    solution: Solution
    which: list[int]
    size: int

    @property
    def outputs(self) -> FloatArray:
        """Values of the outputs (m,)."""
        return np.asarray(self.solution.outputs)[self.which]

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
        """Return the derivative of the outputs (m,) along a `direction` (d,); (k, m) for (k, d)."""
        return np.asarray(self.solution.tangent(direction))[..., self.which]

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,); (k, d) for (k, m)."""
        whole = np.zeros((*np.shape(weights)[:-1], self.size))
        for i, column in enumerate(self.which):
            whole[..., column] += np.asarray(weights)[..., i]
        return self.solution.adjoint(whole)

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state along a `direction` (d,), or of k of them."""
        return self.solution.state_tangent(direction)

    def mesh_error(self) -> MeshError | None:
        """Estimate the error that the mesh makes; None without a mesh."""
        found = self.solution.mesh_error()
        if found is None:
            return None
        return replace(found, outputs=found.outputs[self.which])

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the error of the mesh; None without a mesh."""
        found = self.solution.saturation(spare)
        return None if found is None else found.of(self.which)
