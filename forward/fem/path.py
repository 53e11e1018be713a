"""A body in several steps: one mesh and one set of forms, a state for every step, each found from the one before."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from forward.fem.calibration import FinerMesh
from forward.fem.model import HyperelasticModel
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import BodySpace, gather_each, scatter_each
from forward.model import (
    FloatArray,
    Guess,
    MeshError,
    OneByOne,
    ReferenceSolution,
    Saturation,
    SolveError,
    Stability,
    Work,
)
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
        self.space = PathSpace(whole.space, spec.count, self.along)
        self.differentiable = True

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> PathSolution:
        """Find the equilibria of all steps at `parameters` (d,), as `HyperelasticModel.solve` does; collective.

        Raises
        ------
        SolveError
            With the step at which the path stops, and the outputs before.
        """
        solutions: list[FiniteElementSolution] = []
        slopes: list[FloatArray] = []
        directions = self.along(np.eye(len(self.parameters)))
        soon = guess is not None and guess.derivatives and len(directions) <= FEW
        for k, (model, given) in enumerate(zip(self.steps, self._guesses(guess or Guess()), strict=True)):
            known = given if given.state is not None else Guess(self._continued(solutions), iterations=given.iterations)
            try:
                solutions.append(model.solve(np.append(parameters, self.values[k]), known))
                if soon:  # while its factor is at hand: the next step needs the room
                    slopes.append(solutions[-1].state_tangent(directions))
            except SolveError as error:
                reached = np.full(len(self.outputs), np.nan)
                for i, solution in enumerate(solutions):
                    reached[i * len(model.outputs) : (i + 1) * len(model.outputs)] = solution.outputs
                where = ", ".join(f"{path} = {v:g}" for path, v in zip(self.spec.steps, self.values[k], strict=True))
                message = f"step {k + 1} of {len(self.steps)} ({where}): {error.reason}"
                work = Work.sum_of([*(one.work for one in solutions), error.work])
                raise type(error)(message, error.history, work, error.stability, reached) from error
        return PathSolution(self, parameters, tuple(solutions), tuple(slopes))

    def _continued(self, solutions: Sequence[FiniteElementSolution]) -> FloatArray | None:
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

    def along(self, direction: FloatArray) -> FloatArray:
        """Return a direction (…, d) of the parameters as one of the parameters of each step."""
        return np.concatenate([direction, np.zeros((*direction.shape[:-1], self.values.shape[1]))], axis=-1)


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


class PathSolution:
    """The equilibria of all steps with their linearisations.

    Parameters
    ----------
    model, parameters, steps
        Where it was found, and what.
    slopes
        Derivatives (d, U_local) of the states by all parameters, where they were found with these; empty otherwise.
    """

    def __init__(
        self,
        model: PathModel,
        parameters: FloatArray,
        steps: tuple[FiniteElementSolution, ...],
        slopes: tuple[FloatArray, ...] = (),
    ) -> None:
        self._model, self.steps, self._slopes = model, steps, slopes
        self.parameters = np.array(parameters, dtype=float)
        self.state = joined([step.state for step in steps])
        self.outputs = np.concatenate([step.outputs for step in steps])
        for array in (self.parameters, self.state, self.outputs):
            array.flags.writeable = False
        self.residual = max(step.residual for step in steps)
        self.converged = all(step.converged for step in steps)

    @property
    def stability(self) -> Stability:
        """That of the step of which least is known; an instability that was missed counts more."""
        return Stability.of_all([step.stability for step in self.steps])

    def touched(self) -> dict[str, FloatArray]:
        """What each tool touches at the last step, as of `FiniteElementSolution`; collective."""
        return self.steps[-1].touched()

    def stressed(self) -> FloatArray | None:
        """Stresses and strains at the last step, as of `FiniteElementSolution`; collective."""
        return self.steps[-1].stressed()

    @property
    def work(self) -> Work:
        """Cost of all steps so far."""
        return Work.sum_of(step.work for step in self.steps)

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the states (U_local,) along a `direction` (d,), or (k, U_local); collective."""
        return joined(self._state_tangents(direction))

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        along, states = self._model.along(direction), self._state_tangents(direction)
        return np.concatenate([step.along(du, along) for step, du in zip(self.steps, states, strict=True)], axis=-1)

    def _state_tangents(self, direction: FloatArray) -> list[FloatArray]:
        """Those of each step."""
        if self._slopes:
            return [direction @ slopes for slopes in self._slopes]
        along = self._model.along(direction)
        return [step.state_tangent(along) for step in self.steps]

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,), or (k, d) for k of them; collective.

        Steps whose outputs have no weight cost nothing.
        """
        d = len(self._model.parameters)
        gradients = np.zeros((*np.shape(weights)[:-1], d))
        for step, own in zip(self.steps, np.split(weights, len(self.steps), axis=-1), strict=True):
            rows, found = np.atleast_2d(own), np.atleast_2d(gradients)
            counted = rows.any(axis=1)
            if counted.any():
                found[counted] += step.adjoint(rows[counted])[:, :d]
        return gradients

    def mesh_error(self) -> MeshError:
        """Estimate the error of the mesh in the outputs and states of all steps; collective.

        Raises
        ------
        SolveError
            If the stiffness in the enriched space is singular.
        """
        found = [step.mesh_error() for step in self.steps]
        far = max((one.nonlinearity for one in found), key=lambda far: (not np.isfinite(far), far))
        return MeshError(
            np.concatenate([one.outputs for one in found]),
            joined([one.state for one in found]),
            sum(one.energy for one in found),
            max(one.relative for one in found),
            Work.sum_of(one.work for one in found),
            nonlinearity=far,
        )

    def saturation(self, spare: float = math.inf) -> Saturation:
        """Calibrate estimates of the error of the mesh, step by step; collective."""
        finer = FinerMesh(self._model.steps[0], spare)
        found = [step.saturation(spare, finer) for step in self.steps]
        return Saturation(
            np.concatenate([one.outputs for one in found]),
            float(np.mean([one.state for one in found])),
            float(np.mean([one.energy for one in found])),
            all(one.measured for one in found),
            np.concatenate([one.shifts if one.shifts is not None else np.zeros(len(one.outputs)) for one in found]),
            np.concatenate(
                [one.doubts if one.doubts is not None else np.full(len(one.outputs), np.nan) for one in found]
            ),
        )
