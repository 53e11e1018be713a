"""Models made of models, with the chain rule written once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, eye

from forward.affine import Affine, Sparse, along, picked, times
from forward.model import (
    FloatArray,
    ForwardModel,
    Guess,
    MeshError,
    NodalSpace,
    ReferenceSolution,
    Saturation,
    Solution,
    SolveError,
    Stability,
    Work,
)
from forward.pointwise import Known, OfModel, OneByOne


class OfOne(OfModel, OneByOne):
    """A model that is made of another `model`."""

    @property
    def space(self) -> NodalSpace | None:
        """Where the states live."""
        return self.model.space


@dataclass(frozen=True, eq=False)
class Rows(OfOne):
    """A model whose outputs are sums y = S o of the outputs o of another one.

    Parameters
    ----------
    model
        The other one.
    S
        Weights (n, m) in the sums.
    names
        Of the sums.
    """

    model: ForwardModel
    S: csr_matrix
    names: tuple[str, ...]

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the sums."""
        return self.names

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> CombinedSolution:
        """Solve as the other model does."""
        return CombinedSolution((self.model.solve(parameters, guess),), len(parameters), S=self.S)


def taking(model: ForwardModel, which: Sequence[int] | NDArray[np.int64], names: tuple[str, ...]) -> Mapped:
    """Return a model as one of other parameters, of which it takes some, by their places."""
    return Mapped(model, Sparse(picked(which, len(names)), np.zeros(len(which))), names)


def selected(model: ForwardModel, which: Sequence[int]) -> Rows:
    """Return the model of some outputs, by number; names are numbered where one is there several times."""
    names = [model.outputs[i] for i in which]
    numbered = tuple(
        f"{name}.{names[:k].count(name)}" if names.count(name) > 1 else name for k, name in enumerate(names)
    )
    return Rows(model, picked(which, len(model.outputs)), numbered)


def sums_of(model: ForwardModel) -> tuple[ForwardModel, csr_matrix]:
    """Return of which model's outputs (m,) those of a model (n,) are sums, and their weights (n, m): its own, or S."""
    return (model.model, model.S) if isinstance(model, Rows) else (model, eye(len(model.outputs), format="csr"))


@dataclass(frozen=True, eq=False)
class Mapped(OfOne):
    """A model of other parameters q, from which an affine map tells those of the one that it is made of.

    Parameters
    ----------
    model
        The one.
    by
        The map.
    names
        Of q.
    """

    model: ForwardModel
    by: Affine
    names: tuple[str, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of q."""
        return self.names

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> CombinedSolution:
        """Solve at q (d,)."""
        there = self.by.values(parameters[None])[0]
        return CombinedSolution((self.model.solve(there, mapped(guess, self.by)),), len(there), self.by)


def along_columns(
    model: ForwardModel, names: Sequence[str], columns: Mapping[str, FloatArray], behind: FloatArray
) -> Mapped:
    """Return a model of parameters of some names: its first ones, and others along columns (k,) of the k behind these.

    The values (k,) of those are `behind` where the others are zero.
    """
    own = model.parameters[: len(model.parameters) - len(behind)]
    by = np.zeros((len(model.parameters), len(names)))
    by[range(len(own)), [names.index(name) for name in own]] = 1.0
    for name, column in columns.items():
        by[len(own) :, names.index(name)] = column
    return Mapped(model, Sparse(csr_matrix(by), np.append(np.zeros(len(own)), behind)), tuple(names))


def mapped(guess: Guess | None, by: Affine) -> Guess | None:
    """Return a guess for parameters p of one for parameters q, by the map."""
    if guess is None or guess.reference is None:
        return guess
    near = guess.reference
    spread = None if near.spread is None else along(by, near.spread)
    there = ReferenceSolution(by.values(near.parameters[None])[0], near.state, spread, near.joined)
    return replace(guess, reference=there)


@dataclass(frozen=True, eq=False)
class Joined(OneByOne):
    """Several models of the same parameters as one: its outputs are those of the first, then of the second, and so on.

    Parameters
    ----------
    models
        The models.
    outputs
        Names of all outputs.
    labels
        What each is called where it has no answer; empty: nothing.
    order
        In which order their states, all of one length, stand side by side; empty: states of several meshes are none of
        one.
    space
        Where these live.
    """

    models: tuple[ForwardModel, ...]
    outputs: tuple[str, ...]
    labels: tuple[str, ...] = ()
    order: tuple[int, ...] = ()
    space: NodalSpace | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.models[0].parameters

    @property
    def differentiable(self) -> bool:
        """Whether solutions have tangents and adjoints."""
        return all(model.differentiable for model in self.models)

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> CombinedSolution:
        """Solve all at `parameters` (d,)."""
        return self.solve_each(parameters, self.guesses(guess))

    def guesses(self, guess: Guess | None) -> list[Guess]:
        """Split a guess into those of the models."""
        if guess is None or not self.order:
            return [Guess()] * len(self.models)
        near, count = guess.reference, len(self.order)
        states = [None] * count if guess.state is None else self.states(guess.state)
        there = [None] * count if near is None else [replace(near, state=one) for one in self.states(near.state)]
        known = replace(guess, audit=guess.audit and near is not None)  # nothing else is predicted
        return [replace(known, state=u, reference=one) for u, one in zip(states, there, strict=True)]

    def states(self, rows: FloatArray) -> list[FloatArray]:
        """Split states (…, U), or this rank's part of them, into those of the models."""
        parts = np.split(rows, len(self.order), axis=-1)
        return [parts[place] for place in np.argsort(self.order)]

    def solve_each(self, parameters: FloatArray, guesses: Sequence[Guess]) -> CombinedSolution:
        """Solve all at `parameters` (d,), each with its own guess."""
        found = []
        for k, (model, near) in enumerate(zip(self.models, guesses, strict=True)):
            try:
                found.append(model.solve(parameters, near))
            except SolveError as error:
                if not self.labels:
                    raise
                raise error.within(self.labels[k]) from error
        return CombinedSolution(tuple(found), len(parameters), order=self.order)


Record = Callable[[ForwardModel, FloatArray, Callable[[], Solution]], Solution | Known]
"""Returns the solution of a model at parameters (d,), by solving, or what was recorded of it."""


@dataclass(frozen=True, eq=False)
class Recorded(OfOne):
    """A model whose solutions are recorded.

    One of which the values are known is solved for only where more is asked of it: from its state, which meets the
    tolerance already, so that derivatives are the same.

    Parameters
    ----------
    model
        The model.
    record
        Where its solutions are found.
    """

    model: ForwardModel
    record: Record

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Return the solution at `parameters` (d,), solved for or recorded; errors as for the model."""
        point = np.array(parameters)
        found = self.record(self.model, point, lambda: self.model.solve(point, guess))
        if not isinstance(found, Known):
            return found
        return RecordedSolution(found, lambda: self.model.solve(point, replace(guess or Guess(), state=found.state)))


@dataclass(frozen=True, eq=False)
class CombinedSolution:
    """Sums y = S o of the outputs of one solution or of several, at parameters p = A q + b, as functions of q.

    Attributes
    ----------
    solutions
        The solutions.
    count
        Number D of the parameters p.
    by
        The map; None where q is p.
    S
        Weights (n, m) of all outputs in the sums; None where these are the outputs.
    order
        As of `Joined`.
    """

    solutions: tuple[Solution, ...]
    count: int
    by: Affine | None = None
    S: csr_matrix | None = None
    order: tuple[int, ...] = (0,)

    @cached_property
    def outputs(self) -> FloatArray:
        """Values of the outputs (n,)."""
        found = self._sums(np.concatenate([one.outputs for one in self.solutions]))
        found.flags.writeable = False
        return found

    @cached_property
    def state(self) -> FloatArray:
        """This rank's part of the states (U_local,)."""
        found = side_by_side([one.state for one in self.solutions], self.order)
        found.flags.writeable = False
        return found

    @property
    def residual(self) -> float:
        """The largest one."""
        return max(one.residual for one in self.solutions)

    @property
    def converged(self) -> bool:
        """Whether all meet the solver's tolerance."""
        return all(one.converged for one in self.solutions)

    @property
    def stability(self) -> Stability:
        """That of the one of which least is known; an instability that was missed counts more."""
        return Stability.of_all([one.stability for one in self.solutions])

    @property
    def work(self) -> Work:
        """What all have cost so far."""
        return Work.sum_of(one.work for one in self.solutions)

    def _sums(self, rows: FloatArray) -> FloatArray:
        return rows if self.S is None else times(self.S, rows)

    def _directions(self, direction: FloatArray) -> FloatArray:
        return direction if self.by is None else along(self.by, direction)

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (n,) along a `direction` (d,); (k, n) for (k, d)."""
        there = self._directions(direction)
        return self._sums(np.concatenate([one.tangent(there) for one in self.solutions], axis=-1))

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the states (U_local,) along a `direction` (d,), or (k, U_local) of k of them."""
        there = self._directions(direction)
        return side_by_side([one.state_tangent(there) for one in self.solutions], self.order)

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (n,); (k, d) for (k, n).

        Of several solutions, those whose outputs have no weight cost nothing.
        """
        own = weights if self.S is None else times(self.S.T, weights)
        found = self._gradients(own)
        return found if self.by is None else self.by.back(np.atleast_2d(found)).reshape(*np.shape(weights)[:-1], -1)

    def _gradients(self, weights: FloatArray) -> FloatArray:
        if len(self.solutions) == 1:
            return self.solutions[0].adjoint(weights)
        ends = np.cumsum([len(one.outputs) for one in self.solutions])[:-1]
        rows = np.atleast_2d(weights)
        gradients = np.zeros((len(rows), self.count))
        for one, own in zip(self.solutions, np.split(rows, ends, axis=-1), strict=True):
            counted = own.any(axis=1)
            if counted.any():
                gradients[counted] += one.adjoint(own[counted])
        return gradients.reshape(*np.shape(weights)[:-1], -1)

    def mesh_error(self) -> MeshError | None:
        """Estimate the errors that all meshes make; None where there are none."""
        found = self._errors()
        return found if found is None or self.S is None else replace(found, outputs=times(self.S, found.outputs))

    def _errors(self) -> MeshError | None:
        found = [(one, one.mesh_error()) for one in self.solutions]
        known = [error for _, error in found if error is not None]
        if not known:
            return None
        outputs = [np.zeros(len(one.outputs)) if error is None else error.outputs for one, error in found]
        return MeshError(
            np.concatenate(outputs),
            side_by_side([one.state for one in known], self.order),
            sum(one.energy for one in known),
            max(one.relative for one in known),
            Work.sum_of(one.work for one in known),
            nonlinearity=max((one.nonlinearity for one in known), key=lambda far: (not np.isfinite(far), far)),
            stored=sum(one.stored for one in known),
        )

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the errors of all meshes; None where there are none, and a factor of one without.

        The factor of a sum of several outputs is that by which its error grows where theirs grow by their own.
        """
        parts = self.saturations(spare)
        found = self._together(parts)
        if found is None or self.S is None:
            return found
        alone = np.diff(self.S.indptr) == 1
        factors = np.ones(len(alone))
        factors[alone] = found.outputs[self.S.indices[self.S.indptr[:-1][alone]]]
        if not alone.all():
            error = self._errors()
            assert error is not None  # of a model with a mesh
            before, after = times(self.S, error.outputs), times(self.S, found.outputs * error.outputs)
            some = ~alone & (before != 0)
            factors[some] = after[some] / before[some]
        shifts = None if found.shifts is None else times(self.S, found.shifts)
        doubts = None if found.doubts is None else times(abs(self.S), found.doubts)
        hidden = None if found.hidden is None else times(self.S, found.hidden)
        return replace(found, outputs=factors, shifts=shifts, doubts=doubts, hidden=hidden)

    def saturations(self, spare: float) -> list[Saturation | None]:
        """Calibrate each."""
        return [one.saturation(spare) for one in self.solutions]

    def _together(self, parts: Sequence[Saturation | None]) -> Saturation | None:
        if len(parts) == 1:
            return parts[0]
        known = [one for one in parts if one is not None]
        if not known:
            return None

        def all_of(values: Sequence[FloatArray | float | None], otherwise: float) -> FloatArray:
            pairs = zip(self.solutions, values, strict=True)
            return np.concatenate([np.broadcast_to(otherwise if v is None else v, len(s.outputs)) for s, v in pairs])

        return Saturation(
            all_of([None if one is None else one.outputs for one in parts], 1.0),
            float(np.mean([one.state for one in known])),
            float(np.mean([one.energy for one in known])),
            all(one.measured for one in known),
            all_of([0.0 if one is None else one.shifts for one in parts], 0.0),
            all_of([0.0 if one is None else one.doubts for one in parts], math.nan),
            all_of([None if one is None else one.hidden for one in parts], 0.0),
            any(one.unstable for one in known),
        )


class RecordedSolution(CombinedSolution):
    """A solution whose values are known; it is solved for once anything else is asked of it."""

    residual, converged, stability, work = 0.0, True, Stability.NOT_TESTED, Work()  # known, and not of `solutions`

    def __init__(self, known: Known, solve: Callable[[], Solution]) -> None:
        self.outputs, self.state, self.residual, self.converged, self.stability, self.work = known
        self._solve = solve

    @cached_property
    def solutions(self) -> tuple[Solution, ...]:
        """The one of the model itself."""
        return (self._solve(),)


def side_by_side(states: Sequence[FloatArray], order: Sequence[int]) -> FloatArray:
    """Return states (…, U_local) in an order as one; none (…, 0) without an order."""
    return np.concatenate([states[0][..., :0], *(states[k] for k in order)], axis=-1)
