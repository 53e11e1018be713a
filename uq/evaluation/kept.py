"""What one rank group keeps of its evaluations and solves, so that a restart does not compute them again."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import (
    FloatArray,
    ForwardModel,
    InadmissibleError,
    Solution,
    SolveError,
    Stability,
    Work,
    gathered,
    scattered,
)
from forward.pointwise import Known
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
class KeptSolves:
    """The solves of a model that one rank group keeps on disk, failures included (`forward.combine.Record`).

    Parameters
    ----------
    kept
        Where they are kept and found.
    log
        Every solve is added to it, without its point, which may have as many numbers as the mesh has nodes.
    """

    kept: Kept
    log: list[Evaluations] = field(default_factory=list)

    def __call__(self, model: ForwardModel, point: FloatArray, solve: Callable[[], Solution]) -> Solution | Known:
        """Return the solution at a point (d,), or its values if they are on disk; collective over the group.

        Raises
        ------
        SolveError
            As the model does, or did.
        """
        solutions: list[Solution] = []

        def solved() -> Evaluations:
            begin = time.process_time()
            try:
                solutions.append(solve())
            except SolveError as error:
                return _recorded(model, point, error, time.process_time() - begin)
            return _recorded(model, point, solutions[0], time.process_time() - begin)

        block, _ = self.kept.found(point, solved)
        self.log.append(replace(block, points=np.zeros((1, 0)), fields=np.zeros((0, 0))))
        work, stability = Work(*block.work[0].tolist()), Stability(block.stability[0])
        for failure in block.failures:
            refused = InadmissibleError if failure.inadmissible else SolveError
            raise refused(failure.reason, failure.history, work, stability)
        if solutions:
            return solutions[0]
        state, residual = scattered(model, block.fields)[0], float(block.residuals[0])
        return Known(block.outputs[0], state, residual, bool(block.converged[0]), stability, work)


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
