"""A body in several steps: one mesh and one set of forms, a state for every step, each found from the one before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from scipy.sparse import eye

from forward.combine import DerivedSolution, Joined, JoinedSolution, Mapped, Sparse, mapped
from forward.fem.calibration import FinerMesh
from forward.fem.equations import Discretisation
from forward.fem.model import HyperelasticModel
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import JoinedSpace
from forward.loaded import LoadedBody
from forward.model import FloatArray, Guess, Saturation, SolveError, Work

FEW = 16  # parameters up to which derivatives of the states of all steps are kept


@dataclass(frozen=True, eq=False)
class PathModel(Joined):
    """A body along a path as a `ForwardModel`.

    Its outputs are those of the first step, then of the second, and so on. A state holds that of the last step, so that
    fields are those there, then those of the others in their order. Every step keeps a factor at its reference.

    Attributes
    ----------
    spec
        The body and its steps.
    steps
        The body as a model at each step.
    values
        Values (steps, numbers) of the numbers that have steps.
    """

    models: tuple[Mapped, ...]
    _: KW_ONLY
    spec: LoadedBody
    steps: tuple[HyperelasticModel, ...]
    values: FloatArray

    @property
    def equations(self) -> Discretisation:
        """Those of all steps."""
        return self.steps[0].equations

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> PathSolution:
        """Find the equilibria of all steps at `parameters` (d,), as `HyperelasticModel.solve` does; collective.

        Raises
        ------
        SolveError
            With the step at which the path stops, and the outputs before.
        """
        solutions: list[StepSolution] = []
        directions = np.eye(len(parameters))
        soon = guess is not None and guess.derivatives and len(directions) <= FEW
        for label, model, one, given in zip(self.labels, self.steps, self.models, self.guesses(guess), strict=True):
            known = given if given.state is not None else Guess(self._continued(solutions), iterations=given.iterations)
            try:
                found = StepSolution(model.solve(one.by.values(parameters[None])[0], mapped(known, one.by)), one.by)
                if soon:  # while its factor is at hand: the next step needs the room
                    found = replace(found, slopes=found.state_tangent(directions))
                solutions.append(found)
            except SolveError as error:
                stop = error.within(label)
                stop.work = Work.sum_of([*(before.work for before in solutions), error.work])
                stop.reached = reached([before.outputs for before in solutions], len(self.outputs))
                raise stop from error
        return PathSolution(tuple(solutions), len(parameters), self.order, self.steps[0])

    def _continued(self, solutions: Sequence[StepSolution]) -> FloatArray | None:
        """Predict the state (U_local,) of the next step from the last two."""
        if not solutions:
            return None
        last = solutions[-1].state
        if len(solutions) == 1:
            return last
        before, here, there = self.values[len(solutions) - 2 : len(solutions) + 1]
        step = here - before
        ahead: float = (there - here) @ step / (step @ step)
        return last + ahead * (last - solutions[-2].state)


def built(spec: LoadedBody, comm: object, parameters: tuple[str, ...]) -> PathModel:
    """Return a body along a path as a model; collective. Parameters as of `HyperelasticModel`."""
    whole = HyperelasticModel(spec.whole, comm, (*parameters, *spec.stepped))
    steps = tuple(whole.with_own_reference() for _ in range(len(spec.labels)))
    values = np.array(list(spec.stepped.values())).T
    extended = eye(len(parameters) + len(spec.stepped), len(parameters), format="csr")
    maps = [Sparse(extended, np.append(np.zeros(len(parameters)), of_step)) for of_step in values]
    return PathModel(
        tuple(Mapped(step, by, parameters) for step, by in zip(steps, maps, strict=True)),
        tuple(output.name for output in spec.returned),
        spec.labels,
        last_first(len(spec.labels)),
        JoinedSpace(whole.space, len(spec.labels), maps[0].along, whole.space.displacements),
        spec=spec,
        steps=steps,
        values=values,
    )


def last_first(count: int) -> tuple[int, ...]:
    """Return the order of the states of steps."""
    return count - 1, *range(count - 1)


def reached(known: Sequence[FloatArray], count: int) -> FloatArray:
    """Return the outputs of the first steps among all, which are NaN."""
    found = np.full(count, np.nan)
    before = np.concatenate([found[:0], *known])
    found[: len(before)] = before
    return found


@dataclass(frozen=True, eq=False)
class StepSolution(DerivedSolution):
    """The equilibrium of a step, with derivatives (d, U_local) of its state where they were found with it."""

    solution: FiniteElementSolution
    slopes: FloatArray | None = None

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state (U_local,) along a `direction` (d,), or (k, U_local); collective."""
        return super().state_tangent(direction) if self.slopes is None else direction @ self.slopes

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        return self.solution.along(self.state_tangent(direction), self._directions(direction))


@dataclass(frozen=True, eq=False)
class PathSolution(JoinedSolution):
    """The equilibria of all steps with their linearisations."""

    solutions: tuple[StepSolution, ...]
    body: HyperelasticModel

    def visit(self) -> Discretisation:
        """Return the equations, set to the last step."""
        return self.solutions[-1].solution.visit()

    def saturations(self, spare: float) -> list[Saturation | None]:
        """Calibrate each step on one finer mesh; collective."""
        finer = FinerMesh(self.body, spare)
        return [one.solution.saturation(spare, finer) for one in self.solutions]
