"""Finite-element model of a hyperelastic body: how its equilibria are found, one by one or many together.

What is known at one of them, with tangents and adjoints, is in `forward.fem.solution`.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from itertools import chain, groupby, islice, repeat

import numpy as np

from forward.fem.body import STIFFER, DiscreteBody
from forward.fem.calibration import FinerMesh
from forward.fem.cost import Linear, together
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import Observation
from forward.model import FloatArray, Guess, ReferenceSolution, Solution, SolveError, Work
from forward.pointwise import OneByOne
from forward.solvers.equilibrium import solving
from forward.solvers.steps import Steps, Task, finish, finish_all
from forward.solvers.system import Found
from forward.solvers.way import Way


class HyperelasticModel(DiscreteBody[FiniteElementSolution], OneByOne):
    """A hyperelastic body as a `ForwardModel`; parameters as of `DiscreteBody`."""

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
            found = finish(self._steps(guess, way), equations.solve if way is None else self.reference.solve)
            stiffer = 1.0
            if found.converged and equations.contact:
                self.refuse_sharp(found.state)
                # Steps of a factor, so that most samples of a study have the same stiffness of tools, and all their
                # derivatives are exact.
                while self.enters(found.state, stiffer):
                    stiffer *= STIFFER
                    equations.set_parameters(parameters, stiffer)
                    found = finish(self._steps(Guess(found.state), None), equations.solve)
        solution = FiniteElementSolution(self, parameters, found, equations.work, way, stiffer)
        point = equations.linearisation_point
        if equations.symmetric and point.factorised_at is found.state:  # to count its eigenvalues
            point.factorised = solution
        return solution

    def finer_mesh(self, spare: float) -> FinerMesh:
        return FinerMesh(self, spare)

    def way(self, parameters: FloatArray, guess: Guess) -> Way | None:
        """Return the path from the reference of a guess, whose factor is computed if it is another's; None without."""
        without = self.spec.solver.kind == "newton" or self.equations.linear == Linear.MULTIGRID
        if without or guess.state is None or guess.reference is None:
            return None
        self.reference.prepare(guess.reference)
        screen = not self.spec.solver.accept_unstable and self.reference.prepare_screen()
        return Way(self.equations, self.reference, guess.reference, parameters, screen=screen)

    def _steps(self, guess: Guess, way: Way | None) -> Steps[Found]:
        """Return what finds the equilibrium from a guess, at the parameters that are set."""
        equations, settings = self.equations, self.spec.solver
        zero = np.zeros(equations.size)
        return solving(equations, settings, zero, guess.state, way, guess.iterations, audit=guess.audit)

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
        last: ReferenceSolution | None = None

        def reference(pair: tuple[FloatArray, Guess]) -> ReferenceSolution | None:
            """That from which the state is predicted: one object for all that follow each other with equal ones."""
            nonlocal last
            _, guess = pair
            if guess.state is None or guess.reference is None:
                return None
            if last is None or not last.same(guess.reference):
                last = guess.reference
            return last

        pairs = ((point, guess or Guess()) for point, guess in zip(points, guesses or repeat(None), strict=False))
        for near, group in groupby(pairs, reference):
            rest = iter(group)
            some = list(islice(rest, 0 if near is None or self.together == 1 else 2))
            if len(some) == 2:
                yield from self._solve_together(chain(some, rest))
            else:
                for point, guess in chain(some, rest):
                    yield from super().solve_many(point[None], [guess])

    def _solve_together(self, starts: Iterable[tuple[FloatArray, Guess]]) -> Iterator[Solution | SolveError]:
        begun: deque[tuple[FloatArray, Way, Work]] = deque()

        def steps(point: FloatArray, guess: Guess, way: Way) -> Steps[Found]:
            self.require_admissible(point)
            return (yield from self._steps(guess, way))

        def tasks() -> Iterator[Task[Found]]:
            for point, guess in starts:
                way, work = self.way(point, guess), Work()
                assert way is not None
                begun.append((point, way, work))
                yield Task(steps(point, guess, way), partial(way.resume, work))

        def solve(right: FloatArray) -> FloatArray:
            if self.reference.prepare(begun[0][1].reference):  # others may have had theirs meanwhile
                self.reference.prepare_screen()
            return self.reference.solve_uncounted(right)

        for found in finish_all(tasks(), solve, self.together):
            self.equations.linearisation_point.begin()  # the last factor may be that of any of them
            point, way, work = begun.popleft()
            yield found if isinstance(found, SolveError) else FiniteElementSolution(self, point, found, work, way)
