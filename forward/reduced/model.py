"""A reduced model as a `ForwardModel`: Newton's method in few coordinates, exact derivatives, estimates of its errors.

No FEniCSx, unless the full model is asked where an estimate exceeds the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from forward.combine import Joined
from forward.materials.admissible import Admission
from forward.model import FloatArray, ForwardModel, Guess, Solution, SolveError, Stability, Work
from forward.pointwise import ExplicitSolution, OneByOne
from forward.reduced.data import ReducedData, ReducedSpace, body_of
from forward.reduced.lockstep import SINGLE, TOGETHER, TOLERANCE, equilibria
from forward.reduced.newton import Way, in_steps, newton, predictor, stable, step_by, under_tools
from forward.reduced.reduced_equations import At, ReducedEquations

if TYPE_CHECKING:
    from forward.fem.joined import SpecimenModel
    from forward.fem.space import Observation

BEYOND = 0.25  # of the range of an output in the snapshots, how far beyond it is cut off


class Estimate(NamedTuple):
    """What the nested larger model says of a solution.

    Attributes
    ----------
    outputs
        Errors (m,) of the outputs, with their signs: added to these they correct them.
    state
        Norm of the error of the state in the inner product of the modes, relative to the state.
    """

    outputs: FloatArray
    state: float


class ReducedModel(OneByOne):
    """A reduced model.

    Parameters
    ----------
    data
        What it consists of.
    parameters
        Paths of the parameters of its vectors; the others keep their means, or the values that are given.
    outputs
        Which of its outputs, by name, in this order; None for all.
    tolerance
        Estimated error of any output, relative to its spread in the snapshots, above which the full model is asked;
        None: never.
    full
        Makes the full model.
    kept
        Values of other parameters, by path, in place of their means.
    alone
        Whether it is the nested larger model, which nothing estimates the errors of.
    tested
        Whether the stability of equilibria is tested. Without, those at many points are found in lockstep.
    unbalanced
        What may be left of the forces in lockstep, relative to what they would be if they did not cancel.
    within
        Whether outputs are cut off a little beyond those of the snapshots, where nothing says that they are right.
    """

    def __init__(
        self,
        data: ReducedData,
        parameters: tuple[str, ...],
        outputs: tuple[str, ...] | None = None,
        tolerance: float | None = None,
        full: Callable[[], ForwardModel] | None = None,
        kept: Mapping[str, float] = MappingProxyType({}),
        *,
        alone: bool = False,
        tested: bool = True,
        unbalanced: float = TOLERANCE,
        within: bool = False,
    ) -> None:
        self.data, self.parameters = data, parameters
        names = [output.name for output in data.outputs]
        self.outputs = tuple(names) if outputs is None else outputs
        self.which = np.array([names.index(name) for name in self.outputs], dtype=np.int64)
        self.places = np.array([data.parameters.index(path) for path in parameters], dtype=np.int64)
        self.base = data.nominal.copy()  # values (d,) of all parameters where nobody says otherwise
        for path, value in kept.items():
            self.base[data.parameters.index(path)] = value
        self.alone = alone
        self.level = ReducedEquations(data, data.levels[-1 if alone else 0], self.which)
        self.spec = body_of(data.spec)
        self.space = ReducedSpace(data, self.places, self.base)
        self.differentiable = True
        self.asked: list[FloatArray] = []  # all parameters (d,) at which the full model was asked
        self.tested = tested and not self.spec.solver.accept_unstable
        self._admission = Admission(self.spec, data.parameters)
        # Energies of displacements and pressures have no minimum.
        self.touched = self.spec.touched
        self.way: Way = under_tools if self.touched and not self.level.pressures else newton
        self._tolerance, self._full, self._unbalanced = tolerance, full, unbalanced
        self.observed: tuple[FloatArray, Observation] | None = None  # what is observed in place of the outputs
        self.range: tuple[FloatArray, FloatArray] | None = None
        if within and "highest" in data.about:  # not in older files
            lowest, highest = (np.array(data.about[name])[self.which] for name in ("lowest", "highest"))
            more = BEYOND * (highest - lowest)
            self.range = lowest - more, highest + more

    @property
    def together(self) -> int:
        """How many points are solved in lockstep; one where the stiffness at each is needed, as under tools."""
        alone = self.tested or self.touched or self._tolerance is not None or self.observed is not None
        return 1 if alone else TOGETHER

    def with_rows(self, seen: FloatArray, rows: Observation, names: tuple[str, ...]) -> ReducedModel:
        """Return the same model with what is observed of it as outputs.

        That is (n, N) of its coordinate fields, and outputs of the body besides.
        """
        other = copy(self)
        other.outputs, other.observed = names, (seen, rows)
        return other

    def solve_many(
        self, points: FloatArray, guesses: Iterable[Guess | None] | None = None
    ) -> Iterator[Solution | SolveError]:
        """Find the equilibria at points (n, d), some in lockstep; which ones depends only on the points."""
        if self.together == 1:
            yield from super().solve_many(points, guesses)
            return
        for i in range(0, len(points), self.together):
            yield from self._solve_together(points[i : i + self.together])

    @cached_property
    def _together(self) -> ReducedEquations:
        """The equations in the precision that lockstep needs."""
        if self._unbalanced < SINGLE:
            return self.level
        return ReducedEquations(self.data, self.data.levels[-1 if self.alone else 0], self.which, np.float32)

    @cached_property
    def _inverse(self) -> FloatArray:
        """Inverse (n, n) of the stiffness at the equilibrium of the nominal parameters."""
        free = self.level.free
        return np.linalg.inv(self.reduced(self.data.nominal[self.places]).stiffness[free, free])

    def _solve_together(self, points: FloatArray) -> Iterator[Solution | SolveError]:
        wholes, refused = np.array([self.whole(point) for point in points]), dict[int, SolveError]()
        for i, whole in enumerate(wholes):
            try:
                self._admission.require(whole)
            except SolveError as error:
                refused[i] = error
        good = [i for i in range(len(points)) if i not in refused]
        starts = np.array([self.first(wholes[i]) for i in good]).reshape(len(good), self.level.modes)
        found, iterations = equilibria(self._together, wholes[good], starts, self._inverse, self._unbalanced)
        ok = np.isfinite(found).all(axis=1)
        outputs = iter(self._together.outputs_together(found[ok], wholes[good][ok]))
        of = {i: (c, Work(residuals=n)) for i, c, n, fine in zip(good, found, iterations, ok, strict=True) if fine}
        for i, point in enumerate(points):
            if i in refused:
                yield refused[i]
            elif i in of:
                c, work = of[i]
                yield ReducedSolution(self, point, wholes[i], c, None, work, next(outputs))
            else:  # Newton's method goes farther
                yield from super().solve_many(point[None])

    @cached_property
    def larger(self) -> ReducedEquations:
        """The nested larger model."""
        return ReducedEquations(self.data, self.data.levels[-1], self.which)

    @cached_property
    def full(self) -> ForwardModel:
        """The model that was reduced; needs FEniCSx."""
        assert self._full is not None
        return self._full()

    def whole(self, parameters: FloatArray) -> FloatArray:
        """Return all parameters (d,) of the reduced model."""
        found = self.base.copy()
        found[self.places] = parameters
        return found

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Find the equilibrium at `parameters` (d,); the snapshots know where to begin.

        Raises
        ------
        SolveError
            Where Newton's method finds none, or the reduced stiffness is not positive definite; with a tolerance, where
            the full model has none.
        """
        try:
            found = self.reduced(np.array(parameters, dtype=float))
        except SolveError:
            if self._tolerance is None:
                raise
        else:
            spread = np.array(self.data.about["spread"])[self.which]
            if self._tolerance is None or (np.abs(found.estimate.outputs) <= self._tolerance * spread).all():
                return found
        self.asked.append(self.whole(np.array(parameters, dtype=float)))
        return self.full.solve(np.array(parameters, dtype=float), None)

    def reduced(self, parameters: FloatArray, start: FloatArray | None = None) -> ReducedSolution:
        """Find the equilibrium of the reduced model, whatever its error; `start` are coordinates of the modes."""
        whole = self.whole(parameters)
        self._admission.require(whole)
        work = Work()
        begin = self.level.coordinates(whole, self.first(whole) if start is None else start)
        found = self.way(self.level, whole, begin, work)
        if found is None:
            found = in_steps(self.way, self.level, self.data, whole, work)
        return ReducedSolution(self, parameters, whole, *found, work)

    @cached_property
    def first(self) -> Callable[[FloatArray], FloatArray]:
        """Returns what the snapshots say of the coordinates of the modes at parameters (d,)."""
        return predictor(self.data, self.level)


class ReducedSolution(ExplicitSolution):
    """An equilibrium of a reduced model, with its linearisation and an estimate of its error."""

    def __init__(
        self,
        model: ReducedModel,
        parameters: FloatArray,
        whole: FloatArray,
        c: FloatArray,
        K: FloatArray | None,
        work: Work,
        outputs: FloatArray | None = None,
    ) -> None:
        self._model, self._whole, self._K, self.work = model, whole, K, work
        self.parameters, self.c = np.array(parameters), c
        self.outputs = model.level.outputs(c, whole) if outputs is None else outputs
        if model.range is not None:
            self.outputs = np.clip(self.outputs, *model.range)
        if model.observed is not None:
            seen, rows = model.observed
            own = self.outputs
            self.outputs = rows.with_outputs(seen @ c, lambda: own)
        self.stability = Stability.NOT_TESTED
        if model.tested:
            # Where the symmetric part of the stiffness is indefinite, so is that of all unknowns. In the mixed form
            # every pressure is one negative eigenvalue of an equilibrium that is stable, and the body may be stabler
            # than the few pressures say.
            if not stable(self.stiffness[model.level.free, model.level.free], model.level.pressures):
                message = "the equilibrium is unstable: the reduced stiffness has a negative eigenvalue"
                raise SolveError(message, work=self.work, stability=Stability.REFUSED) from None
            self.stability = Stability.SCREENED
        for array in (self.parameters, self.c, self.outputs):
            array.flags.writeable = False

    @cached_property
    def stiffness(self) -> FloatArray:
        """Derivative (N, N) of the forces by the coordinates."""
        if self._K is None:
            self.work.assemblies += 1
            return self._model.level.stiffness(self.c, self._whole)[1]
        return self._K

    @cached_property
    def state(self) -> FloatArray:
        found = self.c @ self._model.data.fields[: len(self.c)]
        found.flags.writeable = False
        return np.asarray(found)

    @cached_property
    def _F(self) -> FloatArray:
        return self._model.level.by_parameters(self.c, self._whole, self.stiffness)

    @cached_property
    def slopes(self) -> FloatArray:
        """Derivatives (N, d) of the coordinates by the parameters of the model."""
        slopes = _slopes(self._model.level, self.stiffness, self._F)
        self.work.factorisations += 1
        self.work.back_substitutions += slopes.shape[1]
        return slopes[:, self._model.places]

    @cached_property
    def jacobian(self) -> FloatArray:
        if self._model.observed is None:
            return self._own_jacobian()
        seen, rows = self._model.observed
        return rows.with_outputs((seen @ self.slopes).T, lambda: self._own_jacobian().T).T

    def _own_jacobian(self) -> FloatArray:
        model = self._model
        by_state, directly = model.level.output_slopes(At(self.c, self._whole, self.stiffness, self._F))
        free = model.level.free
        return np.asarray(by_state[:, free] @ self.slopes[free] + directly[:, model.places])

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        return np.asarray(direction) @ self.slopes.T @ self._model.data.fields[: len(self.c)]

    @cached_property
    def estimate(self) -> Estimate:
        """Estimate the errors of outputs and state by one step of Newton's method in the nested larger model.

        Under tools by its equilibrium. NaN where the larger model is not stable.

        Of an output that is the dual-weighted residual −zᵀR with the adjoint z in the larger model, Kᵀz = ∂ψ/∂u, which
        holds a basis of adjoints; the output is evaluated whole, so that curved ones are corrected too (R. Becker,
        R. Rannacher, Acta Numerica 10 (2001) 1–102).
        """
        if self._larger is None:
            return Estimate(np.full(len(self.outputs), np.nan), math.nan)
        larger, (c, change) = self._model.larger, self._larger
        errors = larger.outputs(c, self._whole) - self.outputs
        size = float(np.linalg.norm(c[larger.free])) or 1.0
        return Estimate(errors, float(np.linalg.norm(change)) / size)

    @cached_property
    def _larger(self) -> tuple[FloatArray, FloatArray] | None:
        """Coordinates in the larger model after a step of Newton's method, and the step; None where it is not stable.

        Under tools, where a step says little of what will touch, those of its equilibrium.
        """
        model, larger = self._model, self._model.larger
        if model.alone:
            return None
        modes = np.zeros(larger.modes)
        modes[: model.level.modes] = self.c[model.level.free]
        c = larger.coordinates(self._whole, modes)
        if model.touched:
            found = model.way(larger, self._whole, c, Work())
            return None if found is None else (found[0], (found[0] - c)[larger.free])
        R, K, _ = larger.stiffness(c, self._whole)
        K_free = K[larger.free, larger.free]
        if model.tested and not stable(K_free, larger.pressures):
            return None  # the body may be unstable here in a way that the few modes do not have
        change = step_by(K_free, R[larger.free], Work())
        if change is None:
            return None
        c[larger.free] += change
        return c, change

    @property
    def corrected_state(self) -> FloatArray:
        """Displacements (U,) of the nodes in the larger model where its step ends; NaN without one."""
        fields = self._model.data.fields
        return np.full(fields.shape[1], np.nan) if self._larger is None else self._larger[0] @ fields

    @cached_property
    def corrected_jacobian(self) -> FloatArray:
        """Derivatives (m, d) of the corrected outputs: of the larger model where its step ends; NaN without one."""
        model, larger = self._model, self._model.larger
        if self._larger is None:
            return np.full((len(self.outputs), len(self.parameters)), np.nan)
        c, free = self._larger[0], larger.free
        _, K, _ = larger.stiffness(c, self._whole)
        F = larger.by_parameters(c, self._whole, K)
        by_state, directly = larger.output_slopes(At(c, self._whole, K, F))
        return np.asarray((by_state[:, free] @ _slopes(larger, K, F)[free] + directly)[:, model.places])


def observed_by(specimen: SpecimenModel, models: tuple[ReducedModel, ...]) -> Joined:
    """Return reduced models of the load cases with parameters and outputs of a specimen; collective over its ranks."""
    found = []
    for one, body, model in zip(specimen.models, specimen.bodies, models, strict=True):
        assert body.rows is not None
        equations, fields = body.equations, body.space.scatter(model.data.fields[: model.level.count])
        seen = equations.total((body.rows.matrix(equations) @ fields.T).T).T
        found.append(replace(one, model=model.with_rows(seen, body.rows, body.outputs)))
    return Joined(tuple(found), specimen.outputs, specimen.labels)


def _slopes(level: ReducedEquations, K: FloatArray, F: FloatArray) -> FloatArray:
    """Return derivatives (N, d) of the coordinates of equilibria by all parameters, from those of the forces."""
    slopes = np.zeros(F.shape)
    for k, (number, _) in enumerate(level.data.lifts):
        if number >= 0:
            slopes[k, number] = 1.0
    slopes[level.free] = -np.linalg.solve(K[level.free, level.free], F[level.free])
    return slopes
