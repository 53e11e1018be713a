"""Evaluations, solves and derivatives of a model by one rank group, which stores what it has computed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from forward.model import (
    FloatArray,
    ForwardModel,
    Guess,
    InadmissibleError,
    MeshError,
    NodalSpace,
    OneByOne,
    Saturation,
    Solution,
    SolveError,
    Stability,
    Work,
    gathered,
    scattered,
)
from uq.evaluation.block import BlockSolver, merge
from uq.evaluation.checkpoint import HEAD, read
from uq.evaluation.evaluate import OfModel
from uq.evaluation.hdf5 import creation, image, in_memory, stored_array
from uq.evaluation.request import Evaluations, Failure, Request

if TYPE_CHECKING:
    from pathlib import Path

    from uq.evaluation.checkpoint import Checkpoint

T = TypeVar("T")
BLOCKS = 16  # into which a request is cut: an interruption costs at most one of them
LEAST = 4  # points in a block, unless a request has fewer


@dataclass(frozen=True)
class _Asked:
    """What determines a block: of a start only its point, as its state has rounding errors if ranks share a model."""

    label: str
    points: FloatArray
    tangents: bool
    iterations: int | None
    start: FloatArray


@dataclass(frozen=True)
class KeptEvaluate(OfModel):
    """Evaluation of a model in one rank group; blocks on disk are read. Collective over the group.

    Parameters
    ----------
    model
        The model of the group.
    group
        Its communicator.
    checkpoint
        Where finished blocks are kept and found.
    label
        What determines the model besides the study.
    progress
        Told the numbers of points that finished and that failed since the last call.
    log
        Every evaluation is added to it, without derivatives and fields.

    Attributes
    ----------
    keys
        Names of the blocks so far.
    """

    model: ForwardModel
    group: Any
    checkpoint: Checkpoint
    label: str
    progress: Callable[[int, int], None]
    log: list[Evaluations] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)

    def on(self, model: str) -> KeptEvaluate:
        """Return itself: there is one model."""
        return self

    @property
    def node_volumes(self) -> FloatArray | None:
        """None: no sums of fields."""
        return None

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request, without sums of fields."""
        solver: BlockSolver | None = None
        found = []
        for block in request.blocks(max(1, min(BLOCKS, len(request.points) // LEAST))):
            key = self.checkpoint.key(self._asked(block))
            self.keys.append(key)
            kept = self.group.bcast(self._read(key) if self.group.rank == 0 else None)
            if kept is None:
                solver = solver or BlockSolver(self.model, request)
                kept = solver(block.points, self.progress)
                if self.group.rank == 0:
                    self.checkpoint.save(key, kept)
            else:
                self.progress(len(kept.points), len(kept.failures))
            found.append(kept)
        whole = merge(found, request.fields)
        self.log.append(replace(whole, tangents=None, fields=whole.fields[:0]))
        return whole

    def _asked(self, block: Request) -> _Asked:
        start = np.asarray(getattr(block.start, "point", np.zeros(0)), dtype=float)
        return _Asked(self.label, block.points, block.tangents, block.iterations, start)

    def _read(self, key: str) -> Evaluations | None:
        return self.checkpoint.find(key, read)

    def forget(self) -> None:
        """Remove the blocks, once their results are stored."""
        if self.group.rank == 0:
            self.checkpoint.drop(self.keys)
        self.keys.clear()


@dataclass(frozen=True)
class _Solved:
    """What determines a solve."""

    label: str
    parameters: FloatArray


@dataclass(frozen=True)
class _Derived:
    """What determines derivatives at a solution."""

    solved: _Solved
    of: str
    along: FloatArray


@dataclass(frozen=True)
class _Rows:
    """Derivatives on disk."""

    values: FloatArray

    def image(self, note: str) -> bytes:
        """Return the bytes of an HDF5 file."""
        with in_memory(creation(HEAD)) as file:
            file["rows"] = self.values
            file.attrs["note"] = note
            return image(file)


@dataclass(frozen=True)
class KeptModel(OneByOne):
    """A model in one rank group whose solutions are stored, with the derivatives that were asked of them.

    What is on disk is not computed again, failures included; for what is not, the solver starts from the stored state,
    which meets the tolerance already, so that the solution is the same. Collective over the group.

    Parameters
    ----------
    model, group, checkpoint, label
        As in `KeptEvaluate`.
    log
        Every solve is added to it, without its point, which may have as many numbers as the mesh has nodes.

    Attributes
    ----------
    keys
        Names of the solves and derivatives so far.
    """

    model: ForwardModel
    group: Any
    checkpoint: Checkpoint
    label: str
    log: list[Evaluations] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.model.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @property
    def space(self) -> NodalSpace | None:
        """As for the model."""
        return self.model.space

    @property
    def differentiable(self) -> bool:
        """Whether solutions have derivatives."""
        return self.model.differentiable

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> KeptSolution:
        """Return the solution at parameters (d,), the stored one if there is one; errors as for the model."""
        solved = _Solved(self.label, np.array(parameters))
        key = self.checkpoint.key(solved)
        self.keys.append(key)
        block = self._read(key, read)
        if block is None:
            return self._solved(solved, key, guess)
        self._note(block)
        for failure in block.failures:
            refused = InadmissibleError if failure.inadmissible else SolveError
            work, stability = Work(*block.work[0].tolist()), Stability(block.stability[0])
            raise refused(failure.reason, failure.history, work, stability)
        state = scattered(self.model, block.fields)[0]
        return KeptSolution(
            self, solved, block, state, lambda: self.model.solve(parameters, replace(guess or Guess(), state=state))
        )

    def _solved(self, solved: _Solved, key: str, guess: Guess | None) -> KeptSolution:
        """Solve, and store what was found."""
        begin = time.process_time()
        try:
            solution = self.model.solve(solved.parameters, guess)
        except SolveError as error:
            self._keep(key, _failed(self.outputs, error, time.process_time() - begin))
            raise
        seconds = np.array([time.process_time() - begin])
        whole = gathered(self.model, np.asarray(solution.state)[None])
        work = solution.work.as_array()[None]
        residual, converged = np.array([solution.residual]), np.array([solution.converged])
        outputs = np.array(solution.outputs)[None]
        known = np.array([solution.stability], dtype=np.int8)
        state = np.zeros((0, 0)) if whole is None else whole
        block = Evaluations(
            solved.parameters[None], outputs, None, (), seconds, work, residual, converged, known, state
        )
        self._keep(key, block)
        return KeptSolution(self, solved, block, solution.state, lambda: solution)

    def derived(self, what: _Derived, find: Callable[[], FloatArray], *, states: bool = False) -> FloatArray:
        """Return derivatives, the stored ones if there are any; those of `states` (k, U_local) are distributed."""
        key = self.checkpoint.key(what)
        self.keys.append(key)
        kept = self._read(key, lambda path: stored_array(path, "rows"))
        if kept is not None:
            return scattered(self.model, kept) if states else kept
        rows = find()
        whole = gathered(self.model, rows) if states else rows
        if self.group.rank == 0 and whole is not None:
            self.checkpoint.save(key, _Rows(whole))
        return rows

    def _read(self, key: str, load: Callable[[Path], T]) -> T | None:
        found: T | None = self.group.bcast(self.checkpoint.find(key, load) if self.group.rank == 0 else None)
        return found

    def _keep(self, key: str, block: Evaluations) -> None:
        if self.group.rank == 0:
            self.checkpoint.save(key, block)
        self._note(block)

    def _note(self, block: Evaluations) -> None:
        self.log.append(replace(block, points=np.zeros((1, 0)), fields=np.zeros((0, 0))))

    def forget(self) -> None:
        """Remove states and derivatives, once their results are stored."""
        if self.group.rank == 0:
            self.checkpoint.drop(self.keys)
        self.keys.clear()


class KeptSolution:
    """A solution as it is stored; its model solves for it only where a derivative is asked that is not.

    Parameters
    ----------
    kept, solved, block
        The model, what determines the solution, and what is stored of it.
    state
        This rank's part (U_local,) of the state.
    solve
        Returns the solution of the model itself.
    """

    def __init__(
        self, kept: KeptModel, solved: _Solved, block: Evaluations, state: FloatArray, solve: Callable[[], Solution]
    ) -> None:
        self._kept, self._solved, self._solve = kept, solved, solve
        self.outputs, self.state = block.outputs[0], state
        self.residual, self.converged = float(block.residuals[0]), bool(block.converged[0])
        self.stability, self.work = Stability(block.stability[0]), Work(*block.work[0].tolist())

    @cached_property
    def _solution(self) -> Solution:
        return self._solve()

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along a `direction` (d,), or (k, m) for k of them."""
        what = _Derived(self._solved, "tangent", np.asarray(direction))
        return self._kept.derived(what, lambda: self._solution.tangent(direction))

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,), or (k, d) for k of them."""
        what = _Derived(self._solved, "adjoint", np.asarray(weights))
        return self._kept.derived(what, lambda: self._solution.adjoint(weights))

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the state (U_local,) along a `direction` (d,), or of k of them."""
        what = _Derived(self._solved, "state tangent", np.asarray(direction))
        rows = self._kept.derived(what, lambda: np.atleast_2d(self._solution.state_tangent(direction)), states=True)
        return rows if np.ndim(direction) == 2 else rows[0]

    def mesh_error(self) -> MeshError | None:
        """Estimate the error of the mesh."""
        return self._solution.mesh_error()

    def saturation(self, spare: float = math.inf) -> Saturation | None:
        """Calibrate estimates of the error of the mesh."""
        return self._solution.saturation(spare)


def _failed(outputs: Sequence[str], error: SolveError, seconds: float) -> Evaluations:
    """A solve without an answer."""
    failure = Failure(0, (), error.reason, error.history, isinstance(error, InadmissibleError))
    return Evaluations(
        np.zeros((1, 0)),
        np.full((1, len(outputs)), np.nan),
        None,
        (failure,),
        np.array([seconds]),
        error.work.as_array()[None],
        np.array([np.nan]),
        np.zeros(1, dtype=bool),
        np.array([error.stability], dtype=np.int8),
        np.zeros((0, 0)),
    )
