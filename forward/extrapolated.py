"""What finer and finer meshes tend to: a model on two meshes, from whose difference the rest is extrapolated.

Where the error of a mesh falls as h^p, and the cells of a fine mesh are t times smaller than those of a coarse one of
the same kind, what the fine one still misses is the difference ψ_f − ψ_c times 1/(t^p − 1) (L. F. Richardson, Phil.
Trans. R. Soc. A 226 (1927) 299–361). The difference itself is an output too: it says how far that may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from forward.model import FloatArray, ForwardModel, Guess, OneByOne, Solution, SolveError, Stability, WithoutMesh, Work

Begun = tuple[tuple[FloatArray, FloatArray], ...]
# Where all cells are halved, errors at held faces fall slowly, whatever the degree: 1/(2^1.6 − 1).
HALVED = 0.5
TANGENTS = 20  # parameters up to which a state is predicted from the first one with its derivatives


@dataclass(frozen=True)
class Extrapolated(OneByOne):
    """A model on two meshes.

    Parameters
    ----------
    fine, coarse
        The model on each, with the same parameters and m outputs.
    share
        1/(t^p − 1).
    start
        Parameters (d,) that are solved for first: other solves begin at what their linearisation predicts.
    begun
        States there, and their derivatives, on both meshes, once they are known; models of the same meshes share it.
    otherwise
        The same on other meshes, for parameters at which these have no answer; for all if they have none at the start.

    Notes
    -----
    There are 2m outputs: ψ_f + share (ψ_f − ψ_c), and then ψ_f − ψ_c.
    """

    fine: ForwardModel
    coarse: ForwardModel
    share: float
    start: FloatArray | None = None
    begun: list[Begun | None] = field(default_factory=list)
    otherwise: Extrapolated | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.fine.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, and of the differences."""
        return (*self.fine.outputs, *(f"{name} (between the meshes)" for name in self.fine.outputs))

    @property
    def differentiable(self) -> bool:
        """Whether solutions have derivatives."""
        return self.fine.differentiable and self.coarse.differentiable

    @property
    def space(self) -> None:
        """States of two meshes are none of one."""
        return

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> ExtrapolatedSolution:
        """Solve on both meshes at `parameters` (d,).

        Raises
        ------
        SolveError
            Where one of them has no answer, and the others have none.
        """
        if self.otherwise is None:
            return self._solve(parameters)
        if self.begun and self.begun[0] is None:
            return self.otherwise.solve(parameters)
        try:
            return self._solve(parameters)
        except SolveError:
            return self.otherwise.solve(parameters)

    def _solve(self, parameters: FloatArray) -> ExtrapolatedSolution:
        if self.start is not None and not self.begun:
            at_start = np.array_equal(parameters, self.start)
            try:
                here = self._begin(self.start)
            except SolveError:
                self.begun.append(None)
                if at_start or self.otherwise is not None:
                    raise
            else:
                if at_start:
                    return here
        guesses: list[Guess | None] = [None, None]
        if self.start is not None and self.begun and self.begun[0] is not None:
            step = parameters - self.start
            guesses = [Guess(state + step @ slopes if slopes.size else state) for state, slopes in self.begun[0]]
        fine, coarse = (
            model.solve(parameters, near) for model, near in zip((self.fine, self.coarse), guesses, strict=True)
        )
        return ExtrapolatedSolution(self, fine, coarse)

    def _begin(self, start: FloatArray) -> ExtrapolatedSolution:
        """Solve at the start, once, and keep the states with their derivatives."""
        d = len(start)
        found = ExtrapolatedSolution(self, self.fine.solve(start), self.coarse.solve(start))
        few = d <= TANGENTS and self.differentiable
        both = (found.fine, found.coarse)
        kept = tuple((one.state, one.state_tangent(np.eye(d)) if few else np.zeros((d, 0))) for one in both)
        self.begun.append(kept)
        return found


@dataclass(frozen=True)
class ExtrapolatedSolution(WithoutMesh):
    """Solutions on both meshes."""

    model: Extrapolated
    fine: Solution
    coarse: Solution

    def _joined(self, fine: FloatArray, coarse: FloatArray) -> FloatArray:
        gap = fine - coarse
        return np.concatenate([fine + self.model.share * gap, gap], axis=-1)

    @property
    def outputs(self) -> FloatArray:
        """Extrapolated outputs and differences (2m,)."""
        return self._joined(np.asarray(self.fine.outputs), np.asarray(self.coarse.outputs))

    @property
    def state(self) -> FloatArray:
        """None."""
        return np.zeros(0)

    @property
    def residual(self) -> float:
        """The larger one."""
        return max(self.fine.residual, self.coarse.residual)

    @property
    def converged(self) -> bool:
        """Whether both meet the solver's tolerance."""
        return self.fine.converged and self.coarse.converged

    @property
    def stability(self) -> Stability:
        """What is known of the one of which less is known."""
        known = [self.fine.stability, self.coarse.stability]
        return max(known) if Stability.MISSED in known else min(known)

    @property
    def work(self) -> Work:
        """What both have cost so far."""
        return Work(*(self.fine.work.as_array() + self.coarse.work.as_array()).tolist())

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (2m,) along a `direction` (d,); (k, 2m) for (k, d)."""
        return self._joined(self.fine.tangent(direction), self.coarse.tangent(direction))

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (2m,); (k, d) for (k, 2m)."""
        outputs, gaps = np.split(np.asarray(weights), 2, axis=-1)
        between = self.model.share * outputs + gaps
        return self.fine.adjoint(outputs + between) - self.coarse.adjoint(between)

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """There is no state."""
        return np.zeros((*np.shape(direction)[:-1], 0))
