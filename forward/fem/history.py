"""A body on which tools rub, or items remember: the load grows in increments, each found from the one before.

With the states u_i at their ends, F_i(u_i, u_{i−1}, ω) = 0. Tangents go forward through the increments,
K_i du_i = −∂F_i/∂ω dω − C_i du_{i−1} with C_i = ∂F_i/∂u_{i−1}, and adjoints back, K_iᵀλ_i = ∂ψ/∂u_i − C_{i+1}ᵀλ_{i+1}:
they are those of the path as it is computed, for one factor of each increment. What items keep stands behind u_i.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Never

import numpy as np

from forward.combine import side_by_side
from forward.fem.body import STIFFER, DiscreteBody, not_estimated
from forward.fem.equations import Discretisation
from forward.fem.space import JoinedSpace
from forward.loaded import LoadedBody
from forward.model import FloatArray, Guess, SolveError, Stability, Work
from forward.pointwise import OneByOne
from forward.solvers.acceptance import Diverged, Search
from forward.solvers.newton import newton
from forward.terms.acting import Past

SMALLEST = 1 / 64  # of an increment, to which it may be divided where Newton's method fails


class Increment(NamedTuple):
    """Where a load is at the end of an increment.

    Attributes
    ----------
    time
        Steps that are passed: 1 at the end of the first.
    load
        Fraction of the loads.
    numbers
        Values of the numbers that have steps.
    """

    time: float
    load: float
    numbers: FloatArray

    @property
    def returned(self) -> bool:
        """Whether it ends at a step, whose outputs count."""
        return self.time == round(self.time)


class Passed(NamedTuple):
    """An increment with the equilibrium (U_local,) at its end, and what items leave there to the next."""

    at: Increment
    state: FloatArray
    residual: float
    stability: Stability
    left: tuple[Past, ...] = ()


class HistoryModel(DiscreteBody["HistorySolution"], OneByOne):
    """A body on which tools rub or items remember, along a path or under one load, as a `ForwardModel`.

    Every increment is solved from the one before by Newton's method, so that predictions of states are not used.
    Parameters as of `DiscreteBody`; the equations have the numbers with steps too.
    """

    def __init__(self, spec: LoadedBody, comm: Any, parameters: tuple[str, ...]) -> None:
        steps = spec.stepped
        super().__init__(spec.whole, comm, (*parameters, *steps))
        self.spec, self.parameters = spec, parameters
        self.outputs = tuple(output.name for output in spec.returned)
        self.values = np.array(list(steps.values())).T if steps else np.zeros((1, 0))  # (steps, numbers with steps)
        self._each = spec.increments // len(self.values)
        self.equations.increments = spec.increments
        self.space = JoinedSpace(self.space, len(self.values), self.along, self.space.displacements)

    def along(self, direction: FloatArray) -> FloatArray:
        """Return a direction (…, d) of the parameters as one of the parameters of the body."""
        return np.concatenate([direction, np.zeros((*direction.shape[:-1], self.values.shape[1]))], axis=-1)

    @property
    def _schedule(self) -> Iterator[Increment]:
        """The increments: the loads grow to those of the first step, then numbers change to those of the next."""
        for k, (before, here) in enumerate(zip([self.values[0], *self.values[:-1]], self.values, strict=True)):
            for j in range(1, self._each + 1):
                part = j / self._each
                yield Increment(k + part, part if k == 0 else 1.0, before + part * (here - before))

    def last(self, passed: Sequence[Passed]) -> Passed:
        """Return the last of the increments that are passed; before the first, the body at rest."""
        start = Increment(0.0, 0.0, self.values[0])
        return passed[-1] if passed else Passed(start, np.zeros(self.equations.size), 0.0, Stability.NOT_TESTED)

    def set_increment(self, parameters: FloatArray, here: Increment, before: Passed, stiffer: float) -> None:
        """Set parameters (d,), load and what tools have moved since the increment before."""
        equations = self.equations
        equations.set_parameters(np.append(parameters, here.numbers), stiffer)
        equations.at_load(here.load)
        moved = dict(self._shifts(here.numbers - before.at.numbers))
        equations.set_before(before.state, (here.load - before.at.load) / here.load, moved)
        equations.items.follow(before.left, here.time)

    def _shifts(self, changes: FloatArray) -> Iterator[tuple[str, FloatArray]]:
        """What each tool moves (m) where its place or its depth is a number with steps."""
        moved = dict(zip(self.spec.stepped, changes, strict=True))
        for load in (load for load in self.equations.spec.loads if load.contact):
            yield load.label, np.array([moved.get(f"loads.{load.label}.{of}", 0.0) for of in (*"xyz", "depth")])

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> HistorySolution:
        """Find the equilibria of all increments at `parameters` (d,), each from the one before; collective.

        Raises
        ------
        SolveError
            With the place on the path where it stops, and the outputs before.
        """
        equations, settings = self.equations, self.spec.solver
        equations.linearisation_point.begin()
        self.require_admissible(np.append(parameters, self.values[-1]))
        equations.work = Work()
        search, stiffer, passed = Search(equations, settings), 1.0, list[Passed]()
        with equations.time_limit(settings.solve_seconds):
            try:
                while not self._passes(search, parameters, passed, stiffer):
                    passed, stiffer = [], stiffer * STIFFER  # states depend on those before: all are found again
            except SolveError as error:  # what is raised has the outputs of the steps that were reached
                known = HistorySolution(self, parameters, tuple(passed), equations.work, stiffer).outputs
                labels = self.spec.labels
                stop = error.within(labels[len(known) // len(self.functionals)]) if labels else error
                found = reached([known], len(self.outputs))
                raise type(error)(stop.reason, search.history, equations.work, error.stability, found) from error
        return HistorySolution(self, parameters, tuple(passed), equations.work, stiffer)

    def _passes(self, search: Search, parameters: FloatArray, passed: list[Passed], stiffer: float) -> bool:
        """Go through all increments; stop where the body enters a tool too far, and say whether it does not."""
        for increment in self._schedule:
            self._pass(search, parameters, increment, passed, stiffer)
            if increment.returned:
                self.refuse_sharp(passed[-1].state)
                if self.enters(passed[-1].state, stiffer):
                    return False
        return True

    def _pass(
        self, search: Search, parameters: FloatArray, whole: Increment, passed: list[Passed], stiffer: float
    ) -> None:
        """Go to the end of an increment, in parts where Newton's method fails."""
        start, left = self.last(passed).at, [whole]
        while left:
            here, before = left[-1], self.last(passed)
            self.set_increment(parameters, here, before, stiffer)
            try:
                found, _ = newton(search, self._predicted(here, passed), here.load)
            except Diverged as stop:
                last = before.at
                size = here.time - last.time
                if size / 2 < SMALLEST * (whole.time - start.time):
                    share = 100 * last.time / len(self.values)
                    words = self.equations.in_words(last.load) if len(self.values) == 1 else ""
                    message = f"stopped at {share:.4g} % of the path{words}: {stop}"
                    raise SolveError(message, search.history, self.equations.work) from None
                numbers = (last.numbers + here.numbers) / 2
                left.append(Increment((last.time + here.time) / 2, (last.load + here.load) / 2, numbers))
                continue
            self.equations.work.load_steps += 1
            passed.append(
                Passed(here, found.state, found.residual, found.stability, self.equations.items.left(found.state))
            )
            left.pop()

    def _predicted(self, here: Increment, passed: list[Passed]) -> FloatArray:
        """The state (U_local,) that follows the last two within a step; else the last."""
        last = self.last(passed)
        if len(passed) < 2 or last.at.returned:
            return last.state
        before = passed[-2]
        share = (here.time - last.at.time) / (last.at.time - before.at.time)
        return last.state + share * (last.state - before.state)


class HistorySolution:
    """The equilibria of all increments, with the derivatives of the path."""

    def __init__(
        self, model: HistoryModel, parameters: FloatArray, passed: tuple[Passed, ...], work: Work, stiffer: float
    ) -> None:
        self._model, self.passed, self.work, self.stiffer = model, passed, work, stiffer
        self.parameters = np.array(parameters, dtype=float)
        steps = [one for one in passed if one.at.returned]
        whole = len(steps) == len(model.values)
        self.state = side_by_side([one.state for one in steps], last_first(len(steps))) if whole else np.zeros(0)
        self.residual = max((one.residual for one in passed), default=0.0)
        self.converged = True
        self.stability = Stability.of_all([one.stability for one in passed] or [Stability.NOT_TESTED])
        found = []
        for i, one in enumerate(passed):
            if one.at.returned:
                self._visit(i)
                found.append([functional.value() for functional in model.functionals])
        self.outputs = np.array(found).ravel()
        for array in (self.parameters, self.state, self.outputs):
            array.flags.writeable = False

    def _visit(self, i: int) -> Discretisation:
        """Set the equations to the end of an increment."""
        model, one = self._model, self.passed[i]
        model.set_increment(self.parameters, one.at, model.last(self.passed[:i]), self.stiffer)
        model.equations.set_state(one.state)
        model.equations.work = self.work
        return model.equations

    def visit(self) -> Discretisation:
        """Return the equations, set to the last step."""
        return self._visit(len(self.passed) - 1)

    def _linearise(self, i: int) -> Discretisation:
        """The same, with the factor of the stiffness there."""
        self._visit(i)
        self._model.equations.factorise(self.passed[i].state)
        return self._model.equations

    def _forward(self, directions: FloatArray) -> Iterator[tuple[int, FloatArray, FloatArray]]:
        """Derivatives (k, U_local) of the state at the end of each increment, and of what the one before has left."""
        along = self._model.along(directions)
        before = np.zeros((len(directions), self._model.equations.size_before))
        for i in range(len(self.passed)):
            equations = self._visit(i)
            right = equations.right_sides_along(along)
            if i:
                changes = np.array([equations.rubbed(row, transpose=False) for row in before])
                changes[:, equations.fixed] = 0
                right -= changes
            here = self._linearise(i).back_substitute(right)
            last, before = before, equations.left(here, before, along)
            yield i, here, last

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the states (U_local,) along a `direction` (d,), or (k, U_local); collective."""
        found = [here for i, here, _ in self._forward(np.atleast_2d(direction)) if self.passed[i].at.returned]
        return side_by_side(found, last_first(len(found))).reshape(*np.shape(direction)[:-1], -1)

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        directions = np.atleast_2d(direction)
        along, total, found = self._model.along(directions), self._model.equations.total, []
        for i, here, before in self._forward(directions):
            if i in self._slopes:
                of_state, of_before, partials = self._slopes[i]
                found.append(total(here @ of_state.T + before @ of_before.T) + along @ partials.T)
        return np.concatenate(found, axis=1).reshape(*np.shape(direction)[:-1], -1)

    @cached_property
    def _slopes(self) -> dict[int, tuple[FloatArray, FloatArray, FloatArray]]:
        """∂ψ/∂u_i (m, U_local), the same by what was left before, and ∂ψ/∂ω (m, d + s) at the end of each step."""
        found = {}
        for i in (i for i, one in enumerate(self.passed) if one.at.returned):
            size = self._visit(i).size_before
            functionals = self._model.functionals
            before = [f.gradient_before() if hasattr(f, "gradient_before") else np.zeros(size) for f in functionals]
            of_state = np.array([f.gradient() for f in functionals])
            found[i] = of_state, np.array(before), np.array([f.partial() for f in functionals])
        return found

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,), or (k, d) for k of them; collective."""
        equations, slopes, rows = self._model.equations, self._slopes, np.atleast_2d(weights)
        own = dict(zip(slopes, np.split(rows, len(slopes), axis=1), strict=True))
        gradients = np.zeros((len(rows), len(equations.parameters)))
        carried = np.zeros((len(rows), equations.size_before))
        for i in reversed(range(len(self.passed))):
            self._linearise(i)
            load, carried, of_parameters = equations.left_adjoint(carried)
            gradients += of_parameters
            if i in own:
                of_state, of_before, partials = slopes[i]
                load = load + own[i] @ of_state
                carried += own[i] @ of_before
                gradients += own[i] @ partials
            multipliers = equations.back_substitute(load, transpose=True)
            self._visit(i)
            gradients[:, equations.scalars] += equations.total(multipliers @ equations.right_sides().T)
            multipliers[:, equations.fixed] = 0
            if equations.fields:
                gradients -= np.array([equations.field_products(row) for row in multipliers])
            if i:
                carried -= np.array([equations.rubbed(row) for row in multipliers])
        return gradients[:, : len(self.parameters)].reshape(*np.shape(weights)[:-1], -1)

    def mesh_error(self, spare: float = math.inf) -> Never:
        """There is no estimate with memory: the states before differ in elements of another degree too."""
        raise not_estimated(self._model.spec.unenriched_with)

    saturation = mesh_error


def last_first(count: int) -> tuple[int, ...]:
    """Return the order of the states of steps."""
    return count - 1, *range(count - 1)


def reached(known: Sequence[FloatArray], count: int) -> FloatArray:
    """Return the outputs of the first steps among all, which are NaN."""
    return np.concatenate([*known, np.full(count - sum(map(len, known)), np.nan)])
