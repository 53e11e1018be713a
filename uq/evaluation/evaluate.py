"""Evaluation of models at many points in this process, and a record of what was evaluated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from forward.model import FloatArray, ForwardModel, ModelError
from forward.pointwise import OfModel
from uq.evaluation.block import BlockSolver, merge
from uq.evaluation.request import OWN, Evaluate, Evaluations, Request

if TYPE_CHECKING:
    from uq.evaluation.kept import Kept

T = TypeVar("T")
BLOCKS = 16  # into which a request of one rank group is cut: an interruption costs at most one of them
LEAST = 4  # points in such a block, unless a request has fewer
LARGEST = 1e60  # size of outputs, and its inverse the smallest: fourth powers must not overflow or underflow
MANY = 8  # points among which at least one should have an output that is not small by chance


class OfEvaluate(Evaluate):
    """What an evaluation that stands around another one passes on from it."""

    _evaluate: Evaluate

    @property
    def parameters(self) -> tuple[str, ...]:
        return self._evaluate.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        return self._evaluate.outputs

    @property
    def differentiable(self) -> bool:
        return self._evaluate.differentiable

    @property
    def displacements(self) -> int:
        return self._evaluate.displacements

    @property
    def node_volumes(self) -> FloatArray | None:
        return self._evaluate.node_volumes


@dataclass(frozen=True)
class SerialEvaluate(OfModel):
    """Evaluation of a model in this process or rank group, block by block; collective over the group.

    Parameters
    ----------
    model
        The model.
    progress
        Told the numbers of points that finished and that failed since the last call.
    others
        Other models that a method may ask for, by name.
    node_volumes
        See `Evaluate`.
    kept
        Where finished blocks are kept and found; None if an interrupted run starts again. Its blocks have no fields.
    """

    model: ForwardModel
    progress: Callable[[int, int], None] = lambda done, failed: None
    others: Mapping[str, ForwardModel] = field(default_factory=dict)
    node_volumes: FloatArray | None = None
    kept: Kept | None = None

    def on(self, model: str) -> SerialEvaluate:
        """Return the evaluation of another of the models."""
        return self if model == OWN else replace(self, model=self.others[model])

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request; blocks on disk are read."""
        request = request.of(self.model, OWN)
        solver: list[BlockSolver] = []  # made for the first block that is not on disk
        found = []

        def solve(block: Request) -> Evaluations:
            if not solver:
                solver.append(BlockSolver(self.model, request))
            return solver[0](block.points, self.progress)

        most = None if self.kept is None else max(1, min(BLOCKS, len(request.points) // LEAST))
        for block in request.blocks(most):
            solved = partial(solve, block)
            one, new = (solved(), True) if self.kept is None else self.kept.found(_asked(block), solved)
            if not new:
                self.progress(len(one.points), len(one.failures))
            found.append(one)
        return merge(found, request.fields)


def _asked(block: Request) -> tuple[object, ...]:
    """What determines a block: of a start only its point, as its state has rounding errors if ranks share a model."""
    start = np.zeros(0) if block.start is None else block.start.reference.parameters
    return block.points, block.tangents, block.iterations, start, block.mesh_errors, block.saturations


class Recorder(OfEvaluate):
    """An evaluation that keeps what it returned, with the cost.

    Attributes
    ----------
    log
        Every evaluation, in order, of all models; shared by the evaluations of the other models, and may be given.
    models
        The name of the model of each evaluation.
    first
        The complete first evaluation of this model, with derivatives and fields: methods begin at the mean parameters.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        whole: Recorder | None = None,
        model: str = OWN,
        *,
        log: list[Evaluations] | None = None,
    ) -> None:
        self._evaluate = evaluate
        self._model = model
        self.first: Evaluations | None = None
        self.log: list[Evaluations] = whole.log if whole is not None else [] if log is None else log
        self.models: list[str] = [] if whole is None else whole.models

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request.

        Raises `ModelError` if outputs are so large or small that their fourth powers overflow or underflow.
        """
        evaluations = self._evaluate(request)
        sizes = np.abs(evaluations.outputs[evaluations.ok]).max(axis=0, initial=0.0)
        for name, size in zip(self.outputs, sizes.tolist(), strict=True):
            if size > LARGEST or (0 < size < 1 / LARGEST and len(evaluations.points) >= MANY):
                raise ModelError(
                    f"output {name} is of size {size:.3g}, expected 0 or {1 / LARGEST:g} to {LARGEST:g}, beyond which "
                    "moments overflow or vanish; use another unit, or its logarithm"
                )
        self.first = self.first or evaluations
        # Derivatives and fields are not kept: only methods need them.
        self.log.append(replace(evaluations, tangents=None, fields=evaluations.fields[:0], sketches=None))
        self.models.append(self._model)
        return evaluations

    def on(self, model: str) -> Recorder:
        """Return the evaluation of another of the models, with the same log."""
        return Recorder(self._evaluate.on(model), self, model)

    def add(self, log: Sequence[Evaluations], models: Sequence[str]) -> None:
        """Take what was returned before an interruption for what is not asked again."""
        self.log += log
        self.models += models
        if isinstance(self._evaluate, Recorder):
            self._evaluate.add(log, models)

    @property
    def solves(self) -> int:
        """Number of points so far."""
        return sum(len(evaluations.points) for evaluations in self.log)

    @property
    def seconds(self) -> float:
        """Processor time (s) of all points so far."""
        return float(sum(evaluations.seconds.sum() for evaluations in self.log))


@dataclass(frozen=True)
class Steps:
    """The steps of a method whose results are kept with what was evaluated on the way; without `kept`, none is.

    Parameters
    ----------
    kept, recorder
        Where they are kept and found, and what records their evaluations.
    name
        Of the part of the study whose steps these are.
    count
        Told how many solves, and how many of them failed, a step that was found had taken.
    """

    kept: Kept | None = None
    recorder: Recorder | None = None
    name: str = ""
    count: Callable[[int, int], None] = lambda done, failed: None

    def of(self, name: str) -> Steps:
        """Return the steps of a part of these."""
        return replace(self, name=f"{self.name}/{name}")

    def __call__(self, name: str, compute: Callable[[], T]) -> T:
        """Return what a step of a name has found, plain data, which is computed once; collective over the group."""
        if self.kept is None or self.recorder is None:
            return compute()
        log, models = self.recorder.log, self.recorder.models
        before = len(log)

        def made() -> tuple[T, list[Evaluations], list[str]]:
            return compute(), log[before:], models[before:]

        (found, more, names), new = self.kept.value(f"{self.name}/{name}", made)
        if not new:
            self.recorder.add(more, names)
            for one in more:
                self.count(len(one.points), len(one.failures))
        return found

    def rows(self, name: str) -> Callable[[FloatArray, Callable[[], T]], T]:
        """Return what keeps answers to questions that a step asks; collective over the group."""
        if self.kept is None:
            return lambda asked, answer: answer()
        return self.kept.rows(f"{self.name}/{name}")


ALL_AGAIN = Steps()
