"""What one rank group keeps of its evaluations and solves, so that a restart does not compute them again."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.combine import CombinedSolution, OfOne
from forward.model import (
    FloatArray,
    ForwardModel,
    Guess,
    InadmissibleError,
    Solution,
    SolveError,
    Stability,
    Work,
    gathered,
    scattered,
)
from uq.evaluation.checkpoint import read
from uq.evaluation.request import Evaluations, Failure

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint


@dataclass(frozen=True)
class _Block:
    """What determines a block."""

    label: str
    asked: object


@dataclass(frozen=True)
class Kept:
    """The blocks that one rank group keeps on disk.

    Parameters
    ----------
    checkpoint
        Where they are kept and found.
    group
        The communicator of the group.
    label
        What determines the model besides the study.

    Attributes
    ----------
    keys
        Names of the blocks so far.
    """

    checkpoint: Checkpoint
    group: Any
    label: str
    keys: list[str] = field(default_factory=list)

    def found(self, asked: object, compute: Callable[[], Evaluations]) -> tuple[Evaluations, bool]:
        """Return the block that was asked for, and whether it is new: what is on disk is not computed again.

        Collective over the group, as `compute` is.
        """
        key = self.checkpoint.key(_Block(self.label, asked))
        self.keys.append(key)
        first = self.group.rank == 0
        block: Evaluations | None = self.group.bcast(self.checkpoint.find(key, read) if first else None)
        if block is not None:
            return block, False
        block = compute()
        if first:
            self.checkpoint.save(key, block)
        return block, True

    def forget(self) -> None:
        """Remove the blocks, once their results are stored."""
        if self.group.rank == 0:
            self.checkpoint.drop(self.keys)
        self.keys.clear()


@dataclass(frozen=True)
class KeptModel(OfOne):
    """A model in one rank group whose solutions are kept, failures included.

    A solution on disk is solved for again only where it is asked for a derivative: from its state, which meets the
    tolerance already, so that the derivative is the same. Collective over the group.

    Parameters
    ----------
    model
        The model.
    kept
        Where its solutions are kept and found.
    log
        Every solve is added to it, without its point, which may have as many numbers as the mesh has nodes.
    """

    model: ForwardModel
    kept: Kept
    log: list[Evaluations] = field(default_factory=list)

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Return the solution at parameters (d,), the stored one if there is one; errors as for the model."""
        solutions: list[Solution] = []
        point = np.array(parameters)

        def solved() -> Evaluations:
            begin = time.process_time()
            try:
                solutions.append(self.model.solve(point, guess))
            except SolveError as error:
                return _recorded(self.model, point, error, time.process_time() - begin)
            return _recorded(self.model, point, solutions[0], time.process_time() - begin)

        block, _ = self.kept.found(point, solved)
        self.log.append(replace(block, points=np.zeros((1, 0)), fields=np.zeros((0, 0))))
        for failure in block.failures:
            refused = InadmissibleError if failure.inadmissible else SolveError
            work, stability = Work(*block.work[0].tolist()), Stability(block.stability[0])
            raise refused(failure.reason, failure.history, work, stability)
        if solutions:
            return solutions[0]
        state = scattered(self.model, block.fields)[0]
        return KeptSolution(block, state, lambda: self.model.solve(point, replace(guess or Guess(), state=state)))


class KeptSolution(CombinedSolution):
    """A solution whose values are stored; its model solves for it once anything else is asked.

    Parameters
    ----------
    block
        What is stored of it.
    state
        This rank's part (U_local,) of the state.
    solve
        Returns the solution of the model itself.
    """

    residual, converged, stability, work = 0.0, True, Stability.NOT_TESTED, Work()  # stored, not asked of `solutions`

    def __init__(self, block: Evaluations, state: FloatArray, solve: Callable[[], Solution]) -> None:
        self._solve = solve
        self.outputs, self.state = block.outputs[0], state
        self.residual, self.converged = float(block.residuals[0]), bool(block.converged[0])
        self.stability, self.work = Stability(block.stability[0]), Work(*block.work[0].tolist())

    @cached_property
    def solutions(self) -> tuple[Solution, ...]:
        """That of the model itself."""
        return (self._solve(),)


def _recorded(model: ForwardModel, point: FloatArray, found: Solution | SolveError, seconds: float) -> Evaluations:
    """A solve, with an answer or without one; its state is complete on the group's first rank."""
    failures: tuple[Failure, ...] = ()
    outputs, residual, converged, whole = np.full(len(model.outputs), np.nan), np.nan, False, None
    if isinstance(found, SolveError):
        failures = (Failure(0, (), found.reason, found.history, found.inadmissible),)
    else:
        outputs, residual, converged = np.array(found.outputs), found.residual, found.converged
        whole = gathered(model, np.asarray(found.state)[None])
    return Evaluations(
        point[None],
        outputs[None],
        None,
        failures,
        np.array([seconds]),
        found.work.as_array()[None],
        np.array([residual]),
        np.array([converged]),
        np.array([found.stability], dtype=np.int8),
        np.zeros((0, 0)) if whole is None else whole,
    )
