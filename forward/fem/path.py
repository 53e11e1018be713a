"""A body in several steps: one mesh and one set of forms, a state for every step, each found from the one before."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import eye

from forward.combine import JoinedSolution, MappedSolution, Sparse, together
from forward.fem.calibration import FinerMesh
from forward.fem.model import HyperelasticModel
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import BodySpace, gather_each, scatter_each
from forward.model import FloatArray, Guess, OneByOne, ReferenceSolution, Saturation, SolveError, Work
from forward.path import Path

FEW = 16  # parameters up to which derivatives of the states of all steps are kept


class PathModel(OneByOne):
    """A body along a path as a `ForwardModel`.

    Its outputs are those of the first step, then of the second, and so on. A state holds that of the last step, so that
    fields are those there, then those of the others in their order. Every step keeps a factor at its reference.

    Parameters
    ----------
    spec
        The body and its steps.
    comm, parameters
        As in `HyperelasticModel`.
    """

    def __init__(self, spec: Path, comm: object, parameters: tuple[str, ...]) -> None:
        self.spec, self.parameters = spec, parameters
        self.outputs = tuple(output.name for output in spec.returned)
        whole = HyperelasticModel(spec.whole, comm, (*parameters, *spec.steps))
        self.steps = tuple(whole.with_own_reference() for _ in range(spec.count))
        self.values = np.array(list(spec.steps.values())).T  # (steps, numbers that have steps)
        self.equations = whole.equations
        extended = eye(len(parameters) + len(spec.steps), len(parameters), format="csr")
        self._maps = [Sparse(extended, np.append(np.zeros(len(parameters)), values)) for values in self.values]
        self.space = PathSpace(whole.space, spec.count, self._maps[0].along)
        self.differentiable = True

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> PathSolution:
        """Find the equilibria of all steps at `parameters` (d,), as `HyperelasticModel.solve` does; collective.

        Raises
        ------
        SolveError
            With the step at which the path stops, and the outputs before.
        """
        solutions: list[StepSolution] = []
        directions = np.eye(len(self.parameters))
        soon = guess is not None and guess.derivatives and len(directions) <= FEW
        for k, (model, given) in enumerate(zip(self.steps, self._guesses(guess or Guess()), strict=True)):
            known = given if given.state is not None else Guess(self._continued(solutions), iterations=given.iterations)
            try:
                by = self._maps[k]
                found = StepSolution(model.solve(by.values(parameters[None])[0], known), by)
                if soon:  # while its factor is at hand: the next step needs the room
                    found = replace(found, slopes=found.state_tangent(directions))
                solutions.append(found)
            except SolveError as error:
                reached = np.full(len(self.outputs), np.nan)
                for i, solution in enumerate(solutions):
                    reached[i * len(model.outputs) : (i + 1) * len(model.outputs)] = solution.outputs
                where = ", ".join(f"{path} = {v:g}" for path, v in zip(self.spec.steps, self.values[k], strict=True))
                message = f"step {k + 1} of {len(self.steps)} ({where}): {error.reason}"
                work = Work.sum_of([*(one.work for one in solutions), error.work])
                raise type(error)(message, error.history, work, error.stability, reached) from error
        return PathSolution(tuple(solutions), len(parameters), self)

    def _continued(self, solutions: Sequence[StepSolution]) -> FloatArray | None:
        """Predict the state (U_local,) of the next step from the last two."""
        if not solutions:
            return None
        last = solutions[-1].state
        if len(solutions) == 1:
            return last
        before, here, there = self.values[len(solutions) - 2 : len(solutions) + 1]
        along = here - before
        ahead: float = (there - here) @ along / (along @ along)
        return last + ahead * (last - solutions[-2].state)

    def _guesses(self, guess: Guess) -> Iterator[Guess]:
        """Split a guess into those of the steps."""
        near = guess.reference
        for k, values in enumerate(self.values):
            state = None if guess.state is None else self.states(guess.state)[k]
            if near is None:
                yield Guess(state, iterations=guess.iterations)
            else:
                spread = None
                if near.spread is not None:
                    spread = np.concatenate([near.spread, np.zeros((*near.spread.shape[:-1], len(values)))], axis=-1)
                there = np.append(near.parameters, values)
                reference = ReferenceSolution(there, self.states(near.state)[k], spread, near.joined)
                yield Guess(state, reference, guess.iterations, audit=guess.audit)

    def states(self, rows: FloatArray) -> list[FloatArray]:
        """Split states (…, U) or parts of them into those of the steps, in their order."""
        last, *others = np.split(rows, len(self.steps), axis=-1)
        return [*others, last]


def joined(parts: Sequence[FloatArray]) -> FloatArray:
    """Join the states of the steps (…, U), the last first."""
    *others, last = parts
    return np.concatenate([last, *others], axis=-1)


class PathSpace:
    """The `NodalSpace` of a path: a state begins with the displacements of the last step.

    Parameters
    ----------
    one
        That of the body.
    count
        Number of steps.
    along
        Extends parameters (…, d) of the path to those of the body.
    """

    def __init__(self, one: BodySpace, count: int, along: Callable[[FloatArray], FloatArray]) -> None:
        self.coordinates, self.displacements = one.coordinates, one.displacements
        self.cells, self.regions, self.variance_kept = one.cells, one.regions, one.variance_kept
        self._one, self._all, self._along = one, [one] * count, along

    def gather(self, rows: FloatArray) -> FloatArray | None:
        """Collect (k, U_local) as (k, U) on the first rank."""
        return gather_each(self._all, np.split(rows, len(self._all), axis=1))

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Take this rank's part (k, U_local) of (k, U)."""
        return scatter_each(self._all, rows)

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d); collective."""
        return self._one.factors(self._along(points), degree)


@dataclass(frozen=True, eq=False)
class StepSolution(MappedSolution):
    """The equilibrium of a step, with derivatives (d, U_local) of its state where they were found with it."""

    solution: FiniteElementSolution
    slopes: FloatArray | None = None

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state (U_local,) along a `direction` (d,), or (k, U_local); collective."""
        return super().state_tangent(direction) if self.slopes is None else direction @ self.slopes

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        return self.solution.along(self.state_tangent(direction), self._along(direction))


@dataclass(frozen=True, eq=False)
class PathSolution(JoinedSolution):
    """The equilibria of all steps with their linearisations."""

    solutions: tuple[StepSolution, ...]
    model: PathModel

    def side_by_side(self, states: Sequence[FloatArray]) -> FloatArray:
        """Join states of the steps (…, U_local), the last first."""
        return joined(states)

    def touched(self) -> dict[str, FloatArray]:
        """What each tool touches at the last step, as of `FiniteElementSolution`; collective."""
        return self.solutions[-1].solution.touched()

    def stressed(self) -> FloatArray | None:
        """Stresses and strains at the last step, as of `FiniteElementSolution`; collective."""
        return self.solutions[-1].solution.stressed()

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the error of the mesh, step by step on one finer mesh; collective."""
        finer = FinerMesh(self.model.steps[0], spare)
        return together([(len(one.outputs), one.solution.saturation(spare, finer)) for one in self.solutions])
