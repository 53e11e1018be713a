"""Reduced models of the load cases of a specimen, as one model of what is observed of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.combine import JoinedSolution
from forward.model import FloatArray, Guess, OneByOne
from forward.reduced.model import ReducedModel, ReducedSolution
from forward.specimen import of_case

if TYPE_CHECKING:
    from forward.fem.specimen import SpecimenModel


@dataclass(frozen=True, eq=False)
class ReducedSpecimen(OneByOne):
    """A specimen by a reduced model of each load case, with the parameters and the outputs of the specimen itself.

    Attributes
    ----------
    parameters, outputs, cases
        Names.
    models
        The models of the cases.
    positions
        Indices of the parameters of each case among all.
    seen
        What is observed (n, N) of the coordinate fields of each case.
    others, which
        Of each case, which of its observations are other outputs than displacements, and their numbers among these.
    """

    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    cases: tuple[str, ...]
    models: tuple[ReducedModel, ...]
    positions: Sequence[NDArray[np.int64]]
    seen: Sequence[FloatArray]
    others: Sequence[NDArray[np.int64]]
    which: Sequence[NDArray[np.int64]]

    differentiable, space = True, None

    @classmethod
    def of(cls, observed: SpecimenModel, models: tuple[ReducedModel, ...]) -> ReducedSpecimen:
        """Observe what a specimen does; collective over its ranks."""
        seen = observed.observed_of([model.data.fields[: model.level.count] for model in models])
        cases = tuple(case.name for case in observed.spec.cases)
        own = observed.positions, seen, observed.others, observed.which
        return cls(observed.parameters, observed.outputs, cases, models, *own)

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> ReducedSpecimenSolution:
        """Find the equilibria of all cases at `parameters` (d,).

        Raises
        ------
        SolveError
            With the name of the case that failed.
        """
        solutions = []
        for case, model, where in zip(self.cases, self.models, self.positions, strict=True):
            with of_case(case):
                solutions.append(model.reduced(parameters[where]))
        return ReducedSpecimenSolution(tuple(solutions), len(parameters), self)


@dataclass(frozen=True, eq=False)
class ReducedSpecimenSolution(JoinedSolution):
    """The equilibria of all cases, with derivatives of what is observed."""

    solutions: tuple[ReducedSolution, ...]
    model: ReducedSpecimen

    @cached_property
    def outputs(self) -> FloatArray:
        """What is observed (n,)."""
        found = np.concatenate(
            self._observed([one.c for one in self.solutions], [one.outputs for one in self.solutions])
        )
        found.flags.writeable = False
        return found

    def _observed(self, coordinates: Sequence[FloatArray], outputs: Sequence[FloatArray]) -> list[FloatArray]:
        """What is observed (n, …) of coordinates (N, …) and other outputs (m, …) of each case."""
        model = self.model
        found = [seen @ c for seen, c in zip(model.seen, coordinates, strict=True)]
        for rows, others, which, values in zip(found, model.others, model.which, outputs, strict=True):
            rows[others] = values[which]
        return found

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivatives (n, d) of the outputs."""
        found = self._observed([one.slopes for one in self.solutions], [one.jacobian for one in self.solutions])
        whole = [np.zeros((len(rows), self.count)) for rows in found]
        for to, rows, where in zip(whole, found, self.model.positions, strict=True):
            to[:, where] = rows
        return np.concatenate(whole)

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (n,) along a `direction` (d,), or (k, n) for k of them."""
        return np.asarray(direction) @ self.jacobian.T

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (n,), or (k, d) for k of them."""
        return np.asarray(weights) @ self.jacobian

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state, of which there is none: (0,), or (k, 0)."""
        return np.zeros((*np.shape(direction)[:-1], 0))
