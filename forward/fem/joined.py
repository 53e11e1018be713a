"""One body several times, as one model: along a path, or in several load cases.

Each time it is a model of its own, with its own state and factor, on one mesh. Of a path there is one set of forms, and
each state is found from the one before. Products with the derivatives of all, in any order, use the factors of one
solution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import lil_matrix

from forward.affine import Sparse
from forward.bodies.geometry import AXES
from forward.combine import CombinedSolution, Joined, Mapped, mapped, taking
from forward.fem.dolfinx import spaces
from forward.fem.enriched import relative
from forward.fem.equations import Discretisation
from forward.fem.history import last_first, reached
from forward.fem.layout import Layout, vertices_of
from forward.fem.model import HyperelasticModel
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import JoinedSpace, Observation, log_factor
from forward.loaded import LoadedBody
from forward.model import FloatArray, Guess, MeshError, NodalSpace, Saturation, SolveError, Work

FEW = 16  # parameters up to which derivatives of the states of all steps are kept
SMALL = 0.05  # error of a datum, over the largest, below which it has no factor of its own
Numbers = Sequence[int] | NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class JoinedBodies(Joined):
    """A body several times as one model.

    Attributes
    ----------
    spec
        The body and its steps, or the specimen (`forward.specimen.Specimen`).
    bodies
        The body as a model each time.
    """

    models: tuple[Mapped, ...]
    _: KW_ONLY
    space: NodalSpace
    spec: Any
    bodies: tuple[HyperelasticModel, ...]

    @property
    def equations(self) -> Discretisation:
        """Those of the first; all share the mesh."""
        return self.bodies[0].equations


@dataclass(frozen=True, eq=False)
class PathModel(JoinedBodies):
    """A body along a path as a `ForwardModel`.

    Its outputs are those of the first step, then of the second, and so on. A state holds that of the last step, so that
    fields are those there, then those of the others in their order. Every step keeps a factor at its reference.

    Attributes
    ----------
    values
        Those (steps, numbers) of the numbers that have steps.
    """

    _: KW_ONLY
    values: FloatArray

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
        for label, model, one, given in zip(self.labels, self.bodies, self.models, self.guesses(guess), strict=True):
            known = given if given.state is not None else Guess(self._continued(solutions), iterations=given.iterations)
            try:
                there = one.by.values(parameters[None])[0]
                found = StepSolution((model.solve(there, mapped(known, one.by)),), len(there), one.by)
                if soon:  # while its factor is at hand: the next step needs the room
                    found = replace(found, slopes=found.state_tangent(directions))
                solutions.append(found)
            except SolveError as error:
                stop = error.within(label)
                stop.work = Work.sum_of([*(before.work for before in solutions), error.work])
                stop.reached = reached([before.outputs for before in solutions], len(self.outputs))
                raise stop from error
        return PathSolution(tuple(solutions), len(parameters), order=self.order, body=self.bodies[0])

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


@dataclass(frozen=True, eq=False)
class StepSolution(CombinedSolution):
    """The equilibrium of a step, with derivatives (d, U_local) of its state where they were found with it."""

    solutions: tuple[FiniteElementSolution]
    slopes: FloatArray | None = None

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state (U_local,) along a `direction` (d,), or (k, U_local); collective."""
        return super().state_tangent(direction) if self.slopes is None else direction @ self.slopes

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them; collective."""
        return self.solutions[0].along(self.state_tangent(direction), self._directions(direction))


@dataclass(frozen=True, eq=False)
class PathSolution(CombinedSolution):
    """The equilibria of all steps with their linearisations."""

    solutions: tuple[StepSolution, ...]
    _: KW_ONLY
    body: HyperelasticModel

    def visit(self) -> Discretisation:
        """Return the equations, set to the last step."""
        return self.solutions[-1].solutions[0].visit()

    def saturations(self, spare: float) -> list[Saturation | None]:
        """Calibrate each step on one finer mesh; collective."""
        finer = self.body.finer_mesh(spare)
        return [one.solutions[0].saturation(spare, finer) for one in self.solutions]


def path(spec: LoadedBody, comm: object, parameters: tuple[str, ...]) -> PathModel:
    """Return a body along a path as a model; collective. Parameters as of `HyperelasticModel`."""
    known = {*spec.scalars, *spec.coefficients}
    own = tuple(path for path in parameters if path in known)
    whole = HyperelasticModel(spec.whole, comm, (*own, *spec.stepped))
    bodies = tuple(copy(whole) for _ in spec.labels)  # each with a reference of its own, as there is none yet
    values = np.array(list(spec.stepped.values())).T
    maps = [_at_step(own, dict(zip(spec.stepped, of_step, strict=True)), parameters) for of_step in values]
    return PathModel(
        tuple(Mapped(body, by, parameters) for body, by in zip(bodies, maps, strict=True)),
        tuple(output.name for output in spec.returned),
        spec.labels,
        last_first(len(spec.labels)),
        space=JoinedSpace(whole.space, len(spec.labels), maps[0].along, whole.space.displacements),
        spec=spec,
        bodies=bodies,
        values=values,
    )


def _at_step(own: Sequence[str], there: Mapping[str, float], parameters: Sequence[str]) -> Sparse:
    """Return what tells a body's own numbers and those `there` at a step, by their paths, of parameters by theirs."""
    A, b = lil_matrix((len(own) + len(there), len(parameters))), np.append(np.zeros(len(own)), list(there.values()))
    for row, path in enumerate((*own, *there)):
        factor = f"steps.{path}"
        if row < len(own):
            A[row, parameters.index(path)] = 1.0
        elif factor in parameters:
            A[row, parameters.index(factor)], b[row] = there[path], 0.0
    return Sparse(A.tocsr(), b)


@dataclass(frozen=True, eq=False)
class SpecimenModel(JoinedBodies):
    """A specimen as a `ForwardModel`: its outputs are the observations of all cases, its states those of all cases.

    Attributes
    ----------
    places
        Points (n, 3) at which the outputs are observed (m, undeformed); NaN of those at no point.
    axes
        Their components (n,): 0, 1 or 2; 3 and more are the other outputs of the load case, in its order.
    directions
        Unit vectors (n, 3) along which these are measured; zeros of other outputs.
    cases
        Their load cases (n,), by number.
    """

    _: KW_ONLY
    places: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    axes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    directions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    cases: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def observing(
        self,
        places: FloatArray,
        axes: Numbers,
        cases: Numbers,
        directions: FloatArray | None = None,
        names: Sequence[str] = (),
    ) -> SpecimenModel:
        """Return the same model with other outputs, sharing meshes, forms and factors; collective.

        Parameters
        ----------
        places, axes, cases, directions
            As of the class. Cases are in ascending order; directions are the axes of the body by default.
        names
            Names of the outputs; by default load case, number and component.

        Raises
        ------
        ValueError
            If a place is farther from the mesh than the mesh can be from the body.
        """
        of_axes, of_cases = (np.array(numbers, dtype=np.int64) for numbers in (axes, cases))
        if directions is None:
            directions = np.eye(len(AXES) + 1, len(AXES))[np.minimum(of_axes, len(AXES))]
        if not names:
            of_case = [(*AXES, *(output.name for output in case.outputs)) for case in self.spec.cases]
            pairs = enumerate(zip(cases, axes, strict=True))
            names = [f"{self.spec.cases[case].name}.{i}.{of_case[case][axis]}" for i, (case, axis) in pairs]
        bodies = []
        for number, body in enumerate(self.bodies):
            mine = np.flatnonzero(of_cases == number)
            rows = Observation(places[mine], directions[mine], of_axes[mine] - len(AXES))
            bodies.append(body.with_rows(rows, tuple(names[i] for i in mine)))
        return replace(
            self,
            models=tuple(replace(one, model=body) for one, body in zip(self.models, bodies, strict=True)),
            bodies=tuple(bodies),
            outputs=tuple(names),
            places=places,
            axes=of_axes,
            directions=directions,
            cases=of_cases,
        )

    @cached_property
    def vertices(self) -> Layout:
        """The vertices of the mesh in the canonical order, and its cells; collective when first used."""
        return vertices_of(self.equations)

    def log_fields(self, points: FloatArray) -> FloatArray:
        """Return ln (n, N) of the random factor on the stiffness at the vertices at parameters (n, d); collective.

        The factor is the product of all random fields; on every rank.
        """
        return log_factor(self, points, "stiffness")

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> SpecimenSolution:
        """Find the equilibria of all cases at `parameters` (d,), as `HyperelasticModel.solve` does; collective.

        Raises
        ------
        SolveError
            With the name of the case that failed.
        """
        found = super().solve(parameters, guess)
        places = self.axes < len(AXES)
        return SpecimenSolution(found.solutions, found.count, order=found.order, of_places=places)


@dataclass(frozen=True, eq=False)
class SpecimenSolution(CombinedSolution):
    """The equilibria of all cases with their linearisations; k derivatives of a case are solved for together.

    Attributes
    ----------
    of_places
        Which outputs (n,) are displacements.
    """

    _: KW_ONLY
    of_places: NDArray[np.bool_]

    def mesh_error(self) -> MeshError | None:
        found = super().mesh_error()
        return None if found is None else replace(found, relative=relative(found.energy, found.stored))

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the error of the mesh by elements of two degrees more; collective.

        Displacements that the mesh hardly changes, beside the largest of all cases, have the factor of the states.
        """
        found, error = super().saturation(spare), self.mesh_error()
        if found is None or error is None:
            return None
        moved = np.abs(error.outputs[self.of_places])  # other outputs have other units
        outputs = np.array(found.outputs)
        outputs[self.of_places] = np.where(moved < SMALL * moved.max(initial=0.0), found.state, outputs[self.of_places])
        return replace(found, outputs=outputs, shifts=None, doubts=None)


def specimen(spec: Any, comm: Any, parameters: tuple[str, ...]) -> SpecimenModel:
    """Return a specimen (`forward.specimen.Specimen`) as a model of some of its numbers, by their paths; collective.

    Raises
    ------
    ValueError
        For a path that is not a number of any load case.
    """
    of_cases = [(case, spec.loaded(case)) for case in spec.cases]
    owns = [
        {path: path for path in (*loaded.scalars, *loaded.coefficients)}
        | {spec.path_in(case, path): path for path in loaded.scalars}
        for case, loaded in of_cases
    ]
    for path in parameters:
        if not any(path in own for own in owns):
            raise ValueError(f"'{path}' is not a number of any load case, expected one of: {', '.join(spec.scalars)}")
    bodies: list[HyperelasticModel] = []
    models: list[Mapped] = []
    for own, (_, loaded) in zip(owns, of_cases, strict=True):
        where = [i for i, path in enumerate(parameters) if path in own]
        bodies.append(loaded.build(comm, tuple(own[parameters[i]] for i in where)))
        models.append(taking(bodies[-1], where, parameters))
    model = SpecimenModel(
        tuple(models),
        (),
        tuple(f"load case '{case.name}'" for case in spec.cases),
        tuple(range(len(bodies))),
        space=JoinedSpace(bodies[0].space, len(bodies), models[0].by.along, 0),  # several states are no field
        spec=spec,
        bodies=tuple(bodies),
    )
    rows = list(spec.rows(lambda boundary: _nodes(bodies[0], boundary)))
    cases, names, axes, places = zip(*rows, strict=True) if rows else ((),) * 4
    return model.observing(np.array(places).reshape(-1, 3), axes, cases, names=names)


def _nodes(model: HyperelasticModel, boundary: str) -> FloatArray:
    """Points (n, 3) of the nodes of a boundary; collective."""
    equations, layout = model.equations, model.equations.layout
    mine = layout.nodes()[spaces.boundary_nodes(equations.space, equations.facets[boundary])]
    return np.asarray(layout.coordinates[np.unique(np.concatenate(equations.comm.allgather(mine)))])
