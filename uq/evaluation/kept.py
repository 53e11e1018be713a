"""What one rank group keeps of its evaluations and solves, so that a restart does not compute them again."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

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
from uq.evaluation.checkpoint import Checkpoint, digest, reread
from uq.evaluation.request import Evaluations, Failure

T = TypeVar("T")
SECONDS_BETWEEN_STRETCHES = 10.0  # of answers that are written together


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

    def found(self, asked: object, compute: Callable[[], T]) -> tuple[T, bool]:
        """Return what was asked for, plain data, and whether it is new: what is on disk is not computed again.

        Collective over the group, as `compute` is.
        """
        block = self._find(asked)
        if block is not None:
            return block, False
        made = compute()
        self._save(asked, made)
        return made, True

    def value(self, name: str, compute: Callable[[], T]) -> tuple[T, bool]:
        """Return what a step of a name has found, as `found`; new or not, it is what can be read from disk."""
        return self.found(("step", name), lambda: reread(compute()))

    def rows(self, name: str) -> Rows:
        """Return the answers that were kept under a name; collective."""
        return Rows(self, name)

    def _find(self, asked: object) -> Any:
        self.keys.append(self.checkpoint.key((self.label, asked)))
        return self.group.bcast(self.checkpoint.find(self.keys[-1]) if self.group.rank == 0 else None)

    def _save(self, asked: object, block: object) -> None:
        if self.group.rank == 0:
            self.checkpoint.save(self.checkpoint.key((self.label, asked)), block)

    def forget(self) -> None:
        """Remove the blocks, once their results are stored."""
        if self.group.rank == 0:
            self.checkpoint.drop(self.keys)
        self.keys.clear()


class Rows:
    """Answers of a few numbers to questions that are asked in the same order by every run, kept in stretches."""

    def __init__(self, kept: Kept, name: str) -> None:
        self._kept, self._name, self._stretches = kept, name, 0
        self._known: list[tuple[bytes, Any]] = []
        while (known := kept._find(self._stretch)) is not None:
            self._known += known
            self._stretches += 1
        self._known.reverse()
        self._new: list[tuple[bytes, Any]] = []
        self._saved = time.monotonic()

    @property
    def _stretch(self) -> tuple[str, str]:
        return "step", f"{self._name}, stretch {self._stretches}"

    def __call__(self, asked: FloatArray, answer: Callable[[], T]) -> T:
        """Return the answer, plain data, to numbers that determine it."""
        question = digest(asked)  # many numbers, and few answers
        if self._known:
            before, found = self._known.pop()
            if before == question:
                return found  # type: ignore[no-any-return]
            self._known.clear()  # of a run that went on otherwise
        made = answer()
        self._new.append((question, made))
        if time.monotonic() - self._saved > SECONDS_BETWEEN_STRETCHES:
            self._kept._save(self._stretch, self._new)
            self._stretches += 1
            self._new, self._saved = [], time.monotonic()
        return made


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

        Raises `SolveError` as the model does, or did.
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
