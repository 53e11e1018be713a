"""A specimen as a model: every load case has its own model, and with it its own factor.

Products with the derivatives of all cases, in any order, use the factors of one solution. The observations of a case
are Bu with a sparse B; other outputs of a case, such as the force of a tool, follow its displacements.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from forward.bodies.geometry import AXES
from forward.combine import JoinedSolution, farthest
from forward.fem.dolfinx import spaces
from forward.fem.enriched import Enriched, EnrichedState, relative
from forward.fem.equations import Discretisation
from forward.fem.layout import Layout, vertices_of
from forward.fem.model import HyperelasticModel
from forward.fem.saturation import factors, typical
from forward.fem.solution import FiniteElementSolution
from forward.fem.space import BodySpace, gather_each, log_factor, scatter_each
from forward.model import FloatArray, Guess, MeshError, OneByOne, ReferenceSolution, Saturation, Work
from forward.specimen import Observed, Specimen, of_case

SMALL = 0.05  # error of a datum, over the largest, below which it has no factor of its own


class SpecimenModel(OneByOne):
    """A specimen as a `ForwardModel`: its outputs are the observations of all cases, its states those of all cases.

    Attributes
    ----------
    parameters, outputs
        Names.
    places
        Points (n, 3) at which the outputs are observed (m, undeformed); NaN of those at no point.
    axes
        Their components (n,): 0, 1 or 2; 3 and more are the other outputs of the load case, in its order.
    directions
        Unit vectors (n, 3) along which these are measured; zeros of other outputs.
    cases
        Their load cases (n,), by number.
    models
        The models of the cases.
    positions
        Indices of the parameters of each case among all.
    observations
        B (n, U_local) of each case, sparse.
    others, which
        Of each case, which of its observations are other outputs than displacements, and their numbers among these.
    distances
        Distances (n,) of the points from the mesh (m); outside it, the displacement of the nearest point is observed.
    """

    def __init__(self, spec: Specimen, comm: Any, parameters: tuple[str, ...]) -> None:
        self.spec = spec
        self.parameters = parameters
        known = {*spec.scalars, *spec.coefficients}
        for path in parameters:
            if path not in known:
                message = f"'{path}' is not a number of any load case, expected one of: {', '.join(spec.scalars)}"
                raise ValueError(message)
        bodies = [spec.loaded(case) for case in spec.cases]
        self.positions = [np.flatnonzero(np.isin(parameters, [*body.scalars, *body.coefficients])) for body in bodies]
        self.models: tuple[HyperelasticModel, ...] = tuple(
            body.build(comm, tuple(parameters[i] for i in where))
            for body, where in zip(bodies, self.positions, strict=True)
        )
        self.space = SpecimenSpace(self)
        self.differentiable = True
        names: list[str] = []
        places: list[FloatArray] = []
        axes: list[int] = []
        cases: list[int] = []
        for number, (case, model) in enumerate(zip(spec.cases, self.models, strict=True)):
            for item in spec.seen(case):
                where = _places(model, item)
                names += [f"{case.name}.{item.label}.{i}.{axis}" for i in range(len(where)) for axis in item.components]
                places.append(np.repeat(where, len(item.components), axis=0))
                axes += [AXES.index(axis) for axis in item.components] * len(where)
                cases += [number] * len(where) * len(item.components)
            names += [f"{case.name}.{output.name}" for output in case.outputs]
            places.append(np.full((len(case.outputs), 3), np.nan))
            axes += [len(AXES) + i for i in range(len(case.outputs))]
            cases += [number] * len(case.outputs)
        where = np.concatenate(places) if places else np.zeros((0, 3))
        self._observing(where, axes, cases, _directions(axes), tuple(names))

    def observing(
        self, places: FloatArray, axes: Sequence[int], cases: Sequence[int], directions: FloatArray | None = None
    ) -> SpecimenModel:
        """Return the same model with other outputs, sharing meshes, forms and factors; collective.

        Parameters
        ----------
        places
            Points (n, 3) at which displacements are observed, in the undeformed body (m); those of other outputs do
            not count.
        axes
            Their components (n,): 0, 1 or 2; 3 and more are the other outputs of the load case, in its order.
        cases
            Their load cases (n,) by number, in ascending order.
        directions
            Unit vectors (n, 3) along which the components are measured, by default the axes of the body; zeros of other
            outputs.
        """
        other = copy.copy(self)
        along = _directions(axes) if directions is None else directions
        of_cases = [(case.name, (*AXES, *(output.name for output in case.outputs))) for case in self.spec.cases]
        labels = [(of_cases[case][0], of_cases[case][1][axis]) for case, axis in zip(cases, axes, strict=True)]
        names = tuple(f"{case}.{i}.{axis}" for i, (case, axis) in enumerate(labels))
        other._observing(places, axes, cases, along, names)
        return other

    def _observing(
        self,
        places: FloatArray,
        axes: Sequence[int],
        cases: Sequence[int],
        directions: FloatArray,
        names: tuple[str, ...],
    ) -> None:
        self.outputs, self.places, self.directions = names, places, directions
        self.axes, self.cases = (np.array(numbers, dtype=np.int64) for numbers in (axes, cases))
        numbers = range(len(self.models))
        self._ends = np.searchsorted(self.cases, numbers, side="right")[:-1]
        axes_of = [self.axes[self.cases == number] for number in numbers]
        self.others = [np.flatnonzero(mine >= len(AXES)) for mine in axes_of]
        self.which = [mine[rows] - len(AXES) for mine, rows in zip(axes_of, self.others, strict=True)]
        found = [
            _interpolation(model.equations, self.places[self.cases == number], self.directions[self.cases == number])
            for number, model in zip(numbers, self.models, strict=True)
        ]
        self.observations: list[csr_matrix] = [matrix for matrix, _ in found]
        self._enriched_observations: dict[int, list[csr_matrix]] = {}
        self.distances = np.concatenate([distances for _, distances in found])

    def enriched_observations(self, bodies: Sequence[Enriched]) -> list[csr_matrix]:
        """Return the B (n, U⁺_local) of each case in elements of a higher degree; collective."""
        degree = bodies[0].equations.spec.body.degree
        if degree not in self._enriched_observations:
            self._enriched_observations[degree] = [
                _interpolation(body.equations, self.places[self.cases == n], self.directions[self.cases == n])[0]
                for n, body in enumerate(bodies)
            ]
        return self._enriched_observations[degree]

    def observed_of(self, fields: Sequence[FloatArray]) -> list[FloatArray]:
        """Return what is observed (n, k) of fields (k, U) of each case; of other outputs 0; collective."""
        parts = zip(self.models, self.observations, fields, strict=True)
        return [case.equations.total((B @ case.space.scatter(rows).T).T).T for case, B, rows in parts]

    @property
    def equations(self) -> Discretisation:
        """Those of the first case; all share the mesh."""
        return self.models[0].equations

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
        solutions = []
        guesses = self._guesses(guess or Guess())
        for case, model, where, known in zip(self.spec.cases, self.models, self.positions, guesses, strict=True):
            with of_case(case.name):
                solutions.append(model.solve(parameters[where], known))
        return SpecimenSolution(tuple(solutions), len(parameters), self)

    def _guesses(self, guess: Guess) -> Iterator[Guess]:
        """Split a guess into those of the cases."""
        near = guess.reference
        for k, where in enumerate(self.positions):
            state = None if guess.state is None else self.states(guess.state)[k]
            if near is None:
                yield Guess(state, iterations=guess.iterations)
            else:
                spread = None if near.spread is None else near.spread[..., where]
                reference = ReferenceSolution(near.parameters[where], self.states(near.state)[k], spread, near.joined)
                yield Guess(state, reference, guess.iterations, audit=guess.audit)

    def states(self, rows: FloatArray) -> list[FloatArray]:
        """Split this rank's states (…, U_local) into those of the cases."""
        return np.split(rows, np.cumsum([model.equations.size for model in self.models])[:-1], axis=-1)

    def values(self, rows: FloatArray) -> list[FloatArray]:
        """Split observations (…, n) into those of the cases."""
        return np.split(rows, self._ends, axis=-1)


class SpecimenSpace:
    """The `NodalSpace` of a specimen: states hold those of its cases, one after the other."""

    def __init__(self, model: SpecimenModel) -> None:
        self._model = model
        first = model.models[0].space
        self.coordinates, self.cells, self.regions = first.coordinates, first.cells, first.regions
        self.variance_kept = first.variance_kept
        self.displacements = 0  # states of several cases are not one displacement field

    def gather(self, rows: FloatArray) -> FloatArray | None:
        """Collect (k, U_local) as (k, U), case after case, on the first rank."""
        return gather_each([case.space for case in self._model.models], self._model.states(rows))

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Take this rank's part (k, U_local) of (k, U)."""
        return scatter_each([case.space for case in self._model.models], rows)

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d), which all cases share; collective."""
        return self._model.models[0].space.factors(points[:, self._model.positions[0]], degree)


@dataclass(frozen=True, eq=False)
class SpecimenSolution(JoinedSolution):
    """The equilibria of all cases with their linearisations; k derivatives of a case are solved for together."""

    solutions: tuple[FiniteElementSolution, ...]
    model: SpecimenModel

    def __post_init__(self) -> None:
        self.outputs.flags.writeable = False  # found here, on all ranks, since that is collective

    def side_by_side(self, states: Sequence[FloatArray]) -> FloatArray:
        """Return the states (…, U_local) of the cases, one after the other."""
        return np.concatenate(states, axis=-1)

    @cached_property
    def outputs(self) -> FloatArray:
        """What is observed (n,)."""
        states, outputs = [one.state for one in self.solutions], [one.outputs for one in self.solutions]
        return self._observe(states, self.model.observations, outputs)

    def _observe(
        self, states: list[FloatArray], observations: list[csr_matrix], outputs: Sequence[FloatArray | None]
    ) -> FloatArray:
        """What is observed (…, n) of states (…, U_local) and other outputs (…, m) of the cases."""
        model = self.model
        found = [
            case.equations.total((B @ u.T).T) for case, B, u in zip(model.models, observations, states, strict=True)
        ]
        for seen, rows, which, values in zip(found, model.others, model.which, outputs, strict=True):
            if len(rows):
                assert values is not None
                seen[..., rows] = values[..., which]
        return np.concatenate(found, axis=-1)

    def _state_tangents(self, direction: FloatArray) -> list[FloatArray]:
        parts = zip(self.solutions, self.model.positions, strict=True)
        return [solution.state_tangent(direction[..., where]) for solution, where in parts]

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the states (U_local,) along a `direction` (d,), or (k, U_local); collective."""
        return self.side_by_side(self._state_tangents(direction))

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (n,) along a `direction` (d,), or (k, n) for k of them; collective."""
        states, model = self._state_tangents(direction), self.model
        parts = zip(self.solutions, states, model.positions, model.others, strict=True)
        outputs = [one.along(du, direction[..., where]) if len(rows) else None for one, du, where, rows in parts]
        return self._observe(states, model.observations, outputs)

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (n,), or (k, d) for k of them; collective."""
        model = self.model
        gradients = np.zeros((*np.shape(weights)[:-1], len(model.parameters)))
        parts = zip(self.solutions, model.positions, model.observations, model.values(weights), strict=True)
        for k, (solution, where, B, w) in enumerate(parts):
            loads, rows = (B.T @ w.T).T, model.others[k]
            if len(rows):
                of_outputs = w[..., rows] @ (model.which[k][:, None] == np.arange(len(solution.outputs)))
                loads = loads + solution.loads(of_outputs)
                gradients[..., where] += solution.directly(of_outputs)
            gradients[..., where] += solution.state_adjoint(loads)
        return gradients

    def _enriched_outputs(self, bodies: Sequence[Enriched], states: Sequence[EnrichedState]) -> list[FloatArray | None]:
        """The other outputs of the cases, where they are observed, at states in elements of a higher degree."""
        parts = zip(self.solutions, bodies, states, self.model.others, strict=True)
        return [body.values(one, state) if len(rows) else None for one, body, state, rows in parts]

    def mesh_error(self) -> MeshError:
        """Estimate the error of the mesh in the observations and the states of all cases; collective.

        Raises
        ------
        SolveError
            If the stiffness in the enriched space is singular.
        """
        model, found = self.model, [solution.enriched_state for solution in self.solutions]
        observations = model.enriched_observations([case.enriched for case in model.models])
        others = self._enriched_outputs([case.enriched for case in model.models], found)
        outputs = self._observe([one.state for one in found], observations, others) - self.outputs
        parts = zip(model.models, found, strict=True)
        state = np.concatenate([case.enriched.down(one.change) for case, one in parts])
        energy, stored = sum(one.energy for one in found), sum(one.stored for one in found)
        far = farthest(one.nonlinearity for one in found)
        return MeshError(
            outputs, state, energy, relative(energy, stored), Work.sum_of(one.work for one in found), nonlinearity=far
        )

    def saturation(self, spare: float = math.inf) -> Saturation:
        """Calibrate estimates of the error of the mesh by elements of two degrees more; collective.

        Data that the mesh hardly changes have the factor of the states. Typical values where it takes too much memory.

        Raises
        ------
        SolveError
            If a stiffness in an enriched space is singular.
        """
        model, found = self.model, [solution.saturated() for solution in self.solutions]
        known = [one for one in found if one is not None]
        seen, degree = self.mesh_error().outputs, model.spec.body.degree
        if len(known) < len(found):
            return typical(seen, degree)
        observations = model.enriched_observations([twice for twice, *_ in known])
        states = [one for _, one, _, _ in known]
        others = self._enriched_outputs([twice for twice, *_ in known], states)
        more = self._observe([one.state for one in states], observations, others) - self.outputs
        of_states = float(np.mean([factor for _, _, factor, _ in known]))
        moved = np.where(model.axes < len(AXES), np.abs(seen), 0.0)  # other outputs have other units
        small = (moved < SMALL * moved.max(initial=0.0)) & (model.axes < len(AXES))
        outputs = np.where(small, of_states, factors(seen, more, degree, of_states))
        return Saturation(outputs, of_states, float(np.mean([factor for *_, factor in known])))


def _places(model: HyperelasticModel, item: Observed) -> FloatArray:
    """Points (n, 3) at which displacements are observed; collective."""
    if item.on is None:
        return np.array(item.at)
    equations, layout = model.equations, model.equations.layout
    mine = layout.nodes()[spaces.boundary_nodes(equations.space, equations.facets[item.on])]
    return np.asarray(layout.coordinates[np.unique(np.concatenate(equations.comm.allgather(mine)))])


def _directions(axes: Sequence[int]) -> FloatArray:
    """Axes (n, 3) of components; zeros of other outputs."""
    known = np.eye(len(AXES) + 1, len(AXES))
    return np.asarray(known[np.minimum(np.asarray(axes, dtype=np.int64), len(AXES))].reshape(-1, 3))


def _interpolation(
    equations: Discretisation, places: FloatArray, directions: FloatArray
) -> tuple[csr_matrix, FloatArray]:
    """Return B (n, U_local) of components along directions (n, 3) at points (n, 3), and their distances (n,).

    Distances are from the mesh; rows without a direction, of other outputs, are empty; collective.

    Raises
    ------
    ValueError
        If a point is farther from the mesh than the mesh can be from the body.
    """
    layout = equations.layout
    moving = np.flatnonzero(directions.any(axis=1))
    none = (places[:0], np.arange(0))
    different, which = np.unique(places[moving], axis=0, return_inverse=True) if len(moving) else none
    which = which.ravel()
    held, distances = BodySpace(equations).interpolation(different)
    local = np.full(len(layout.coordinates), -1)
    local[layout.positions] = np.arange(len(layout.positions))
    rows, columns, values = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    for row, i, along in zip(moving, which, directions[moving], strict=True):
        at, w = held[i]
        owned = local[at] >= 0
        for axis in np.flatnonzero(along):
            rows.append(np.full(owned.sum(), row))
            columns.append(3 * local[at][owned] + axis)
            values.append(along[axis] * w[owned])
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    far = np.zeros(len(places))
    far[moving] = distances[which]
    return csr_matrix(entries, shape=(len(places), equations.size)), far
