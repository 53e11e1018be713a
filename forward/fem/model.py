"""Finite-element model of a hyperelastic body: how its equilibria are found, one by one or many together.

What is known at one of them, with tangents and adjoints, is in `forward.fem.solution`.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from itertools import chain, groupby, islice, repeat
from typing import Any, TypeVar

import numpy as np

from forward.fem.body import DiscreteBody
from forward.fem.calibration import FinerMesh
from forward.fem.cost import Linear, together
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import Observation
from forward.loaded import LoadedBody
from forward.materials.admissible import Admission
from forward.model import FloatArray, Guess, InadmissibleError, ReferenceSolution, Solution, SolveError, Work
from forward.pointwise import OneByOne
from forward.solvers.equilibrium import solve, solving
from forward.solvers.steps import Task, failed, finish_all
from forward.solvers.system import Found
from forward.solvers.way import Way

AT_REST = 1e-12  # norm of displacements over the extent of a body that nothing has moved
UNSEEN = 0.02  # of the depth, by which a tool may enter a body that nothing has moved
STIFFER, RAISES = 4.0, 3  # factor on the stiffness of tools that the body enters too far, and how often it is raised


P = TypeVar("P")


def by_reference(pairs: Iterable[tuple[P, Guess | None]]) -> Iterator[tuple[bool, Iterator[tuple[P, Guess]]]]:
    """Group consecutive points, with their guesses, by the reference from which their states are predicted.

    Yields
    ------
    tuple
        Whether states of the group are predicted from one reference, and the group.
    """
    last: ReferenceSolution | None = None

    def reference(pair: tuple[P, Guess | None]) -> ReferenceSolution | None:
        nonlocal last
        guess = pair[1]
        if guess is None or guess.state is None or guess.reference is None:
            return None
        if last is None or not last.same(guess.reference):
            last = guess.reference
        return last

    for one, group in groupby(pairs, reference):
        yield one is not None, ((point, guess or Guess()) for point, guess in group)


class HyperelasticModel(DiscreteBody[FiniteElementSolution], OneByOne):
    """A hyperelastic body as a `ForwardModel`; parameters as of `DiscreteBody`."""

    def __init__(self, spec: LoadedBody, comm: Any, parameters: tuple[str, ...]) -> None:
        super().__init__(spec, comm, parameters)
        self._admission = Admission(spec, parameters)
        self._extent = max(high - low for low, high in spec.body.bounds)
        self.differentiable = True

    def with_rows(self, rows: Observation, names: tuple[str, ...]) -> HyperelasticModel:
        """Return the same model whose outputs, of these names, are what is observed; collective.

        Raises
        ------
        ValueError
            If a place is farther from the mesh than the mesh can be from the body.
        """
        rows.matrix(self.equations)
        _ = self.reference  # which both share
        other = copy.copy(self)
        other.outputs, other.rows = names, rows
        return other

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> FiniteElementSolution:
        """Find the equilibrium at `parameters` (d,); collective.

        The state of the guess is corrected with the factor at its reference, which is computed when the reference is
        first given and kept until another is. Iterations are corrections with that factor (Newton steps without a
        reference, or with ``solver = "newton"``); if their number is limited, derivatives are those of the equations
        linearised at the state reached.

        Raises
        ------
        SolveError
            With the load fraction where the solver stopped, the reason, and the history of its iterations.
        """
        equations = self.equations
        equations.linearisation_point.begin()
        self.require_admissible(parameters)
        guess = guess or Guess()
        way = self.way(parameters, guess)
        equations.work = Work()
        equations.set_parameters(parameters)
        with equations.time_limit(self.spec.solver.solve_seconds):
            zero = np.zeros(equations.size)
            found = solve(equations, self.spec.solver, zero, guess.state, way, guess.iterations, audit=guess.audit)
            stiffer = 1.0
            if found.converged and equations.contact:
                found, stiffer = self._kept_out(found, parameters)
        solution = self.solution(parameters, found, equations.work, way, stiffer)
        if (
            equations.symmetric and equations.linearisation_point.factorised_at is found.state
        ):  # to count its eigenvalues
            equations.linearisation_point.factorised = solution
        return solution

    def finer_mesh(self, spare: float) -> FinerMesh:
        """Return the body on a finer mesh, which may cost so many solves."""
        return FinerMesh(self, spare)

    def way(self, parameters: FloatArray, guess: Guess) -> Way | None:
        """Return the path from the reference of a guess, whose factor is computed if it is another's; None without."""
        if self.spec.solver.kind == "newton" or self.equations.linear == Linear.MULTIGRID:
            return None
        if guess.state is None or guess.reference is None:
            return None
        self.reference.prepare(guess.reference)
        screen = not self.spec.solver.accept_unstable and self.reference.prepare_screen()
        return Way(self.equations, self.reference, guess.reference, parameters, screen=screen)

    def solution(
        self, parameters: FloatArray, found: Found, work: Work, way: Way | None, stiffer: float = 1.0
    ) -> FiniteElementSolution:
        """Return what was found at `parameters` (d,) as a solution."""
        # If Newton's method had to take over, the reference is too far away for the derivatives too.
        return FiniteElementSolution(self, parameters, found, work, way if found.corrected else None, stiffer)

    @cached_property
    def together(self) -> int:
        """How many points `solve_many` corrects together; 1 where each needs the equations for itself."""
        solver = self.spec.solver
        alone = self.equations.contact or solver.kind == "newton" or solver.solve_seconds is not None
        alone = alone or self.equations.linear == Linear.MULTIGRID
        return 1 if alone else together(self.equations.layout.size)

    def solve_many(
        self, points: FloatArray, guesses: Iterable[Guess | None] | None = None
    ) -> Iterator[Solution | SolveError]:
        """Find the equilibria at points (n, d); some of those from one reference are found `together`; collective.

        Which are corrected together depends only on the points and their guesses.
        """
        pairs = zip(points, guesses or repeat(None), strict=False)
        for predicted, group in by_reference(pairs):
            some = list(islice(group, 2 if predicted and self.together > 1 else 0))
            if len(some) == 2:
                yield from self._solve_together(chain(some, group))
            else:
                for point, guess in chain(some, group):
                    yield from super().solve_many(point[None], [guess])

    def _solve_together(self, starts: Iterable[tuple[FloatArray, Guess]]) -> Iterator[Solution | SolveError]:
        equations, zero = self.equations, np.zeros(self.equations.size)
        begun: deque[tuple[FloatArray, Way | None, Work]] = deque()

        def tasks() -> Iterator[Task[Found]]:
            for point, guess in starts:
                way, work = None, Work()
                try:
                    self.require_admissible(point)
                except InadmissibleError as error:
                    one = Task[Found](failed(error), lambda _: None)
                else:
                    way = self.way(point, guess)
                    assert way is not None
                    settings, known = self.spec.solver, guess.iterations
                    steps = solving(equations, settings, zero, guess.state, way, known, audit=guess.audit)
                    one = Task(steps, partial(way.resume, work))
                begun.append((point, way, work))
                yield one

        def solve(right: FloatArray) -> FloatArray:
            way = begun[0][1]
            if way is not None and self.reference.prepare(way.reference):  # others may have had theirs meanwhile
                self.reference.prepare_screen()
            return self.reference.solve_uncounted(right)

        for found in finish_all(tasks(), solve, self.together):
            equations.linearisation_point.begin()  # the last factor may be that of any of them
            point, way, work = begun.popleft()
            yield found if isinstance(found, SolveError) else self.solution(point, found, work, way)

    def require_admissible(self, parameters: FloatArray) -> None:
        """Refuse parameters (d,) for which there is no model."""
        self._admission.require(parameters)

    def _kept_out(self, found: Found, parameters: FloatArray) -> tuple[Found, float]:
        """Raise the stiffness of the tools until the body enters none too far; return its factor too.

        Steps of a factor, so that most samples of a study have the same stiffness and all their derivatives are exact.
        """
        equations, stiffer = self.equations, 1.0
        self.refuse_sharp(found)
        while said := self.entered(found):
            if stiffer >= STIFFER**RAISES:
                raise SolveError(self.too_far(said, stiffer), work=equations.work)
            stiffer *= STIFFER
            equations.set_parameters(parameters, stiffer)
            found = solve(equations, self.spec.solver, np.zeros(equations.size), found.state)
        return found, stiffer

    def too_far(self, said: str, stiffer: float) -> str:
        """Say why there is no answer where even stiffer tools are entered too far."""
        return (
            f"{said}, even with tools {stiffer:g} times as stiff as the depth and the constants as stated ask for: "
            "pressures are far above these; state constants, or a depth, near those of the samples"
        )

    def entered(self, found: Found) -> str:
        """Say how far the body enters a tool where that is more than is aimed at; empty where it is not."""
        equations = self.equations
        equations.set_state(found.state)
        for label, penetration in equations.penetrations().items():
            depth, aim = equations.number(f"loads.{label}.depth"), self._aims[label]
            if depth > 0 and penetration > aim * depth:
                share = penetration / depth
                return f"the body enters the tool '{label}' by {share:.2g} of its depth, where {aim:g} is aimed at"
        return ""

    @cached_property
    def _aims(self) -> dict[str, float]:
        """Penetrations that are aimed at, relative to the depth, by the labels of the tools."""
        return {load.label: load.penetration for load in self.spec.loads if load.contact}  # type: ignore[attr-defined]

    def refuse_sharp(self, found: Found) -> None:
        """Refuse a body that nothing has moved though a tool is inside it, between the points that are looked at."""
        equations = self.equations
        if equations.norm(found.state) > AT_REST * self._extent:
            return
        for load in (load for load in self.spec.loads if load.contact):
            numbers = {name: equations.number(f"loads.{load.label}.{name}") for name in load.scalars}
            if load.entered(self.spec.body, numbers) > UNSEEN * numbers["depth"]:  # type: ignore[attr-defined]
                message = (
                    f"the tool '{load.label}' enters the body between the points at which contact is looked for: it is "
                    "too sharp, or its depth too small, for the mesh; refine the mesh there"
                )
                raise SolveError(message, work=equations.work)
