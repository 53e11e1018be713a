"""Evaluations and solves of a model by one rank group, which stores what it has solved."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import (
    FloatArray,
    ForwardModel,
    Guess,
    InadmissibleError,
    NodalSpace,
    OneByOne,
    Solution,
    SolveError,
    gathered,
    scattered,
)
from uq.evaluation.evaluate import BlockSolver, Evaluations, Failure, OfModel, Request, merge

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint

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
        return self.checkpoint.load(key) if self.checkpoint.has(key) else None

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
class KeptModel(OneByOne):
    """A model in one rank group whose states are stored: the solver starts from a state on disk, and ends there.

    A stored state meets the tolerance already, so that the solution is the same. Collective over the group.

    Parameters
    ----------
    model, group, checkpoint, label
        As in `KeptEvaluate`.
    log
        Every solve is added to it, without its point, which may have as many numbers as the mesh has nodes.

    Attributes
    ----------
    keys
        Names of the solves so far.
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

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Return the solution at parameters (d,), from its state if that is stored; errors as for the model."""
        key = self.checkpoint.key(_Solved(self.label, np.asarray(parameters)))
        self.keys.append(key)
        kept = None
        if self.group.rank == 0 and self.checkpoint.has(key):
            kept = self.checkpoint.load(key)
        kept = self.group.bcast(kept)
        if kept is not None:
            self._note(kept)
            return self.model.solve(parameters, replace(guess or Guess(), state=scattered(self.model, kept.fields)[0]))
        begin = time.process_time()
        try:
            solution = self.model.solve(parameters, guess)
        except SolveError as error:
            self._note(_failed(self.outputs, error, time.process_time() - begin))
            raise
        seconds = np.array([time.process_time() - begin])
        whole = gathered(self.model, np.asarray(solution.state)[None])
        work = solution.work.as_array()[None]
        residual, converged = np.array([solution.residual]), np.array([solution.converged])
        outputs = np.asarray(solution.outputs)[None]
        known = np.array([solution.stability], dtype=np.int8)
        state = np.zeros((0, 0)) if whole is None else whole
        block = Evaluations(
            np.asarray(parameters)[None], outputs, None, (), seconds, work, residual, converged, known, state
        )
        if self.group.rank == 0:
            self.checkpoint.save(key, block)
        self._note(block)
        return solution

    def _note(self, block: Evaluations) -> None:
        self.log.append(replace(block, points=np.zeros((1, 0)), fields=np.zeros((0, 0))))

    def forget(self) -> None:
        """Remove the states, once their results are stored."""
        if self.group.rank == 0:
            self.checkpoint.drop(self.keys)
        self.keys.clear()


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
