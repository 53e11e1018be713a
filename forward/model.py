"""The contract of a forward model.

A model maps parameters (d,) to a solution; the solution is immutable and carries its own linearisation, so that a
stale derivative cannot be written. Nothing here knows FEniCSx or MPI.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from forward.errors import Error

FloatArray = NDArray[np.float64]


@dataclass
class Work:
    """What a solution has cost so far, counted in the operations that matter, and what was looked at besides.

    Attributes
    ----------
    residuals, assemblies, factorisations, back_substitutions, load_steps
        Operations, those of audits among them.
    screens
        How often it was looked at whether a state may be one that is not joined to rest.
    calls
        How often that called for an audit.
    audits
        How often a path was followed to see it.
    audit_residuals, audit_factorisations, audit_back_substitutions
        Operations of these audits.
    others
        Stable equilibria that were found first and are not the answer, which audits found elsewhere.
    snaps
        Answers in which the path of loads from rest has jumped: the branch from rest ends before.
    """

    residuals: int = 0
    assemblies: int = 0
    factorisations: int = 0
    back_substitutions: int = 0
    load_steps: int = 0
    screens: int = 0
    calls: int = 0
    audits: int = 0
    audit_residuals: int = 0
    audit_factorisations: int = 0
    audit_back_substitutions: int = 0
    others: int = 0
    snaps: int = 0

    def as_array(self) -> NDArray[np.int64]:
        """Return the counts in the order of `WORK`."""
        return np.array([getattr(self, name) for name in WORK], dtype=np.int64)

    @classmethod
    def sum_of(cls, works: Iterable[Work]) -> Work:
        """Return the work of several solutions together."""
        return cls(*np.sum([work.as_array() for work in works], axis=0).tolist())


WORK = tuple(one.name for one in fields(Work))


class Stability(IntEnum):
    """How the stability of an equilibrium was tested, and the result."""

    NOT_TESTED = 0  # not requested, or the model has no equilibria, or the state is not one
    SCREENED = 1  # directions that are likely to show an instability show none
    COUNTED = 2  # the stiffness at the state has no negative eigenvalue, by a factor or Lanczos' process
    REFUSED = 3  # the stiffness has negative eigenvalues, and no stable equilibrium was found
    MISSED = 4  # as REFUSED, but the screen had shown none, or another equilibrium was found afterwards

    @classmethod
    def of_all(cls, known: Collection[Stability]) -> Stability:
        """Return that of several equilibria: of the one of which least is known; one that was missed counts more."""
        return max(known) if cls.MISSED in known else min(known)


class SolveError(Error):
    """The model has no answer at these parameters; the message says where the solver stopped and why.

    Parameters
    ----------
    reason
        One line for the user.
    history
        The iterations that led there, one line each.
    work
        What was spent on the attempt.
    stability
        Whether an equilibrium was found and refused.
    reached
        Outputs (m,) that are known all the same, as of the first steps of a path; NaN for the others.
    """

    inadmissible = False  # whether there is nothing to solve

    def __init__(
        self,
        reason: str,
        history: Sequence[str] = (),
        work: Work | None = None,
        stability: Stability = Stability.NOT_TESTED,
        reached: FloatArray | None = None,
    ) -> None:
        super().__init__(reason)
        self.reason, self.history, self.work = reason, tuple(history), work or Work()
        self.stability, self.reached = stability, reached

    def within(self, place: str) -> Self:
        """Return the same with the name of a part of the model in front."""
        return type(self)(f"{place}: {self.reason}", self.history, self.work, self.stability, self.reached)


class InadmissibleError(SolveError):
    """The material is inadmissible, or its energy undefined: there is nothing to solve, and the likelihood is zero."""

    inadmissible = True


class ModelError(Error, ValueError):
    """A model cannot be made or used at all, whatever its parameters; the message is one line for the user."""


class DerivativeError(Error):
    """A derivative was requested that the model or the output does not have."""


@dataclass(frozen=True, eq=False)
class ReferenceSolution:
    """An earlier solution whose linearisation can help to solve nearby.

    Attributes
    ----------
    parameters
        Parameter vector (d,) of the solution.
    state
        This rank's part (U_local,) of the state there.
    spread
        How far the parameters vary, if known: standard deviations (d,) of independent parameters, or a few random draws
        (k, d) of their differences from the mean.
    joined
        Whether the state is joined to rest: a path of loads leads to it without a jump. If not, nothing near it is
        known to be the answer either.
    """

    parameters: FloatArray
    state: FloatArray
    spread: FloatArray | None = None
    joined: bool = True

    def same(self, other: ReferenceSolution) -> bool:
        """Whether both are at the same place, for the same parameters."""
        pairs = zip(*([one.parameters, one.state, one.spread, one.joined] for one in (self, other)), strict=True)
        return self is other or all(a is b or np.array_equal(a, b) for a, b in pairs)


@dataclass(frozen=True, eq=False)
class Guess:
    """What is known about a solution before it is computed.

    A state and a reference may change the cost of the solution, but the answer only within the solver's tolerance.

    Attributes
    ----------
    state
        This rank's part (U_local,) of a prediction of the state, from which the solver starts.
    reference
        A solution nearby, whose linearisation helps.
    iterations
        Maximum number of iterations: the solution is then the state reached, and its `residual` says how far it is from
        equilibrium. If that state is not admissible, the model is solved after all. None: iterate to the tolerance.
    derivatives
        Whether all derivatives of the solution will be asked for: a model that goes on to another state meanwhile may
        find them before.
    audit
        Whether the path to the state is followed though no screen calls for it.
    """

    state: FloatArray | None = None
    reference: ReferenceSolution | None = None
    iterations: int | None = None
    derivatives: bool = False
    audit: bool = False


@dataclass(frozen=True, eq=False)
class Saturation:
    """What part of the error of a mesh an estimate sees, found once at one solution for others of the same model.

    Attributes
    ----------
    outputs
        What the estimated errors of the outputs (m,) have to be multiplied by; NaN where there is no estimate.
    state, energy
        The same of the state, and of the energy of the difference.
    measured
        Whether they were found for this model; typical values if not.
    shifts
        What is added to these errors (m,) then, where what is seen and what is true do not go together; at other
        solutions, in proportion to the outputs. None for zeros.
    doubts
        How far the calibrated errors (m,) may be wrong at the solution where this was found; None where not known.
    hidden
        What flat facets of a curved surface hide in the outputs (m,) there; None for nothing, NaN where not known.
    unstable
        Whether the equilibrium is stable on this mesh, and not on a finer one.
    """

    outputs: FloatArray
    state: float
    energy: float
    measured: bool = True
    shifts: FloatArray | None = None
    doubts: FloatArray | None = None
    hidden: FloatArray | None = None
    unstable: bool = False


@dataclass(frozen=True, eq=False)
class MeshError:
    """What error its mesh is estimated to make of a solution: the exact minus the discrete value, so with a sign.

    Estimates, and no bounds.

    Attributes
    ----------
    outputs
        Errors of the outputs (m,): added to these they correct them. NaN where there is no estimate, as of stresses at
        single points.
    state
        This rank's part (U_local,) of the error of the state at its own nodes.
    energy
        Half of the square of its energy norm (J).
    relative
        Its energy norm relative to the size of the state, as the root of `energy` over the energy that is stored; NaN
        where none is.
    work
        What the estimate has cost.
    seen
        Errors of the outputs (m,) before they were calibrated; None where they are not.
    stored
        Energy (J) that is stored; NaN where nobody asks.
    nonlinearity
        How far its linear step was from solving the equations: 0 if they are linear; from 1 on, or NaN, the estimate
        is worth nothing.
    """

    outputs: FloatArray
    state: FloatArray
    energy: float
    relative: float
    work: Work
    seen: FloatArray | None = None
    nonlinearity: float = 0.0
    stored: float = math.nan

    def calibrated(self, saturation: Saturation) -> MeshError:
        """Return the estimate of the whole error, with what elements of one degree more do not see.

        At the solution where the `saturation` was found: shifts are not in proportion to other outputs.
        """
        added = 0.0 if saturation.shifts is None else saturation.shifts
        return replace(
            self,
            outputs=saturation.outputs * self.outputs + added,
            seen=self.outputs,
            state=saturation.state * self.state,
            energy=saturation.energy * self.energy,
            relative=float(np.sqrt(saturation.energy)) * self.relative,
        )


class Solution(Protocol):
    """The answer of a model at one parameter vector, with its linearisation there.

    With d parameters, m outputs and a state of U unknowns (of which a rank of a distributed model holds its part).
    Directions and weights may be stacked as k rows, and then so are the results; this costs less than one at a
    time.
    """

    @property
    def outputs(self) -> FloatArray:
        """Values of the outputs (m,)."""

    @property
    def state(self) -> FloatArray:
        """This rank's part of the state (U_local,); empty where there is none.

        Displacements, interleaved by component, come first.
        """

    @property
    def residual(self) -> float:
        """Relative residual of the state, in the solver's measure; zero for a model that is not solved for."""

    @property
    def converged(self) -> bool:
        """Whether the residual meets the solver's tolerance (or is rounding); if not, the solver was stopped early."""

    @property
    def stability(self) -> Stability:
        """What is known so far about the stability of the equilibrium."""

    @property
    def work(self) -> Work:
        """What this solution has cost so far."""

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,) of the parameters; (k, m) for (k, d)."""

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) with respect to the parameters of the outputs weighted by `weights` (m,); (k, d)."""

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state (U_local,) along a `direction` (d,) of the parameters; (k, U_local)."""

    def mesh_error(self) -> MeshError | None:
        """Estimate the error that the mesh makes of outputs and state; None for a model without a mesh; collective.

        Raises
        ------
        SolveError
            If there is no estimate at this solution.
        """

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the error of the mesh, once for all solutions near this one; collective.

        None for a model without a mesh; typical values where this would take too much memory.

        Parameters
        ----------
        spare
            How many solves it may cost, by prediction, beside a fifth of what a study takes without its solves.

        Raises
        ------
        SolveError
            If there is no estimate at this solution.
        """


class NodalSpace(Protocol):
    """The nodes of a body, the cells between them, and states over them, distributed over a group's ranks.

    Nodes are in canonical order: sorted by x, then y, then z, whatever the number of ranks. A state (U,) in canonical
    order begins with the displacements of the nodes, interleaved by component.
    """

    @property
    def coordinates(self) -> FloatArray:
        """Coordinates (N, 3) of the nodes (m), on every rank."""

    @property
    def displacements(self) -> int:
        """Number of displacements with which a state (U,) begins; 0 if a state is not a displacement field.

        The rest of the state (pressures) is needed to predict states.
        """

    def cells(self) -> tuple[NDArray[np.int64], int]:
        """Return all cells (n_cells, k) as nodes in VTK's order, and VTK's number of their type; collective."""

    def regions(self) -> NDArray[np.int64] | None:
        """Return the number of the region of each cell, in the order of `cells`; None without regions; collective."""

    def gather(self, rows: FloatArray) -> FloatArray | None:
        """Collect (k, U_local) from the group as (k, U) on the group's first rank; None on the others."""

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Take this rank's part (k, U_local) of (k, U)."""

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d), by its name.

        Collective; empty except on the first rank. The nodes are those of the displacements, or of another degree: 1
        for the vertices.
        """

    @property
    def variance_kept(self) -> dict[str, float]:
        """Fraction of the variance of each random field that its modes make."""


class ForwardModel(Protocol):
    """A map from parameters to solutions, for one group of ranks."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the d parameters, in the order of the vectors."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the m outputs, in the order of the vectors."""

    @property
    def differentiable(self) -> bool:
        """Whether solutions have tangents and adjoints."""

    @property
    def space(self) -> NodalSpace | None:
        """Where the states of a body live; None for a model without states."""

    @property
    def together(self) -> int:
        """How many points, one after the other, `solve_many` solves at once where that is cheaper."""

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Solve at `parameters` (d,), with the help of a guess.

        Raises
        ------
        SolveError
            Where there is no answer.
        """

    def solve_many(
        self, points: FloatArray, guesses: Iterable[Guess | None] | None = None
    ) -> Iterator[Solution | SolveError]:
        """Solve at points (n, d), each with its guess; yield the solutions in this order, or why there is none.

        Whatever is needed from a solution is cheapest before the next one is requested.
        """


def displacements(model: ForwardModel) -> int:
    """Return the number of displacements with which a state of a model begins; 0 without states."""
    return 0 if model.space is None else model.space.displacements


def gathered(model: ForwardModel, rows: FloatArray) -> FloatArray | None:
    """Collect rows (k, U_local) of states of a model on the group's first rank; the (empty) rows without states."""
    return rows if model.space is None else model.space.gather(rows)


def scattered(model: ForwardModel, rows: FloatArray) -> FloatArray:
    """Take this rank's part (k, U_local) of states (k, U) of a model; the (empty) rows without states."""
    return rows if model.space is None else model.space.scatter(rows)
