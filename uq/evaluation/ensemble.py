"""Rank groups that evaluate blocks of points in parallel.

Rank 0 runs the method; the other ranks serve its requests. A group (the ranks that share one model) takes the next
block when it is free (`uq.evaluation.work_queue`). Results do not depend on which group computes a block: blocks are
added in order.
"""

from __future__ import annotations

import gc
import pickle
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from forward.machine import StopError
from forward.model import FloatArray, ForwardModel, SolveError
from forward.phases import phase
from forward.pointwise import OfModel
from uq.evaluation.block import BlockSolver, Merger
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.request import BLOCKS, OWN, Evaluations, Request
from uq.evaluation.work_queue import Progress, WorkQueue, abort_all, end_job, gather_here

T = TypeVar("T")
O = TypeVar("O")
R = TypeVar("R")
CHEAP = 1e-3  # seconds below which computing a block is faster than writing and reading its file;
SELDOM = 0.1  # files of such blocks are written at intervals of this length (s)
SECONDS_FOR_OTHERS = 5.0  # for ranks that fail in the same way to meet


class Ensemble:
    """A world of ranks, split into groups that share a model.

    Attributes
    ----------
    world
        All ranks (a duplicate of what was given).
    group
        This rank's group: the communicator of its model.
    rank_groups
        Number of groups.
    say
        Shows the user a line while something runs; set on the rank that has one.
    """

    def __init__(self, world: Any, group: Any, rank_groups: int, index: int) -> None:
        self.world = world
        self.group = group
        self.rank_groups = rank_groups
        self.index = index
        self.say: Callable[[str], None] = lambda line: None
        self._turns: WorkQueue | None = None

    def count(self, done: int, failed: int) -> None:
        """Count solves of this group that are not points of a request; rank 0 is told while something runs."""
        if self._turns is not None:
            self._turns.count(done, failed)

    @contextmanager
    def turns(self, progress: Progress) -> Iterator[WorkQueue]:
        """Let groups take turns, and count: `progress` on rank 0 is told the counts of all; collective."""
        with WorkQueue.of(self.world, self.group, self.index, progress) as found:
            self._turns = found
            try:
                yield found
            finally:
                self._turns = None

    @classmethod
    def split(cls, world: Any, ranks_per_model: int = 1) -> Ensemble:
        """Split `world` into groups of consecutive ranks; collective.

        Raises `ValueError` if the number of ranks is not a multiple of `ranks_per_model`.
        """
        if world.size % ranks_per_model:
            raise ValueError(f"{world.size} ranks cannot be split into groups of ranks_per_model = {ranks_per_model}")
        index = world.rank // ranks_per_model
        return cls(world.Dup(), world.Split(index, world.rank), world.size // ranks_per_model, index)

    def together(self, make: Callable[[], T]) -> T:
        """Return what `make` returns; what it raises on one rank is raised on all; collective.

        A rank that fails alone, while the others wait for it inside `make`, ends the job.
        """
        made, error = list[T](), None
        try:
            made.append(make())
        except (ValueError, SolveError, StopError) as refusal:  # mistakes of the study are ValueErrors
            error = refusal
        except BaseException as unexpected:
            if self.world.size > 1:
                end_job(self.world, unexpected)
            raise
        if self.world.size > 1:
            here, begin = self.world.Ibarrier(), time.monotonic()
            while error is not None and not here.Test():
                if time.monotonic() - begin > SECONDS_FOR_OTHERS:
                    end_job(self.world, error)
                time.sleep(0.01)
            here.Wait()
            error = next((one for one in self.world.allgather(error) if one is not None), None)
        if error is not None:
            raise error
        return made[0]

    def run(
        self,
        model: ForwardModel,
        task: Callable[[EnsembleEvaluate], T],
        *,
        others: Mapping[str, Callable[[], ForwardModel]] | None = None,
        passing: frozenset[str] = frozenset(),
        checkpoint: Checkpoint | None = None,
        progress: Progress = lambda done, failed: None,
        blocks: int = BLOCKS,
        node_volumes: Callable[[], FloatArray | None] = lambda: None,
    ) -> T | None:
        """Run `task` on rank 0 with an evaluation that all groups work on; collective.

        Parameters
        ----------
        model
            This group's model.
        task
            Called on rank 0 only, with the evaluation.
        others
            Make this group's other models by name (`Evaluate.on`), each when first needed.
        passing
            Names of models of which only the last one is kept, for memory.
        checkpoint
            Where finished blocks are kept and found.
        progress
            On rank 0: told the numbers of points that finished and that failed since the last call.
        blocks
            Largest number of blocks into which an evaluation is cut.
        node_volumes
            On rank 0: those of the first model, see `Evaluate`.

        Returns
        -------
        object
            What the task returned, on rank 0; None on the other ranks.

        Raises
        ------
        Exception
            What the task raises, on all ranks: the others would wait for rank 0 to write results.
        """
        with self.turns(progress) as turns:
            worker = _Worker(self, _Models(model, others or {}, passing), checkpoint, turns)
            return self._followed(
                lambda: task(EnsembleEvaluate(worker, OWN, progress, blocks, node_volumes)), worker.work
            )

    def led(self, task: Callable[[Callable[[O], R]], T], step: Callable[[O], R]) -> T | None:
        """Run `task` on rank 0 with a function that runs `step`, which is collective, on all ranks; collective.

        Returns
        -------
        object
            What the task returned, on rank 0; None on the other ranks.

        Raises
        ------
        Exception
            What the task raises, on all ranks.
        """

        def asked(of: O) -> R:
            self.told(of)
            with abort_all(self.world):
                return step(of)

        return self._followed(lambda: task(asked), step)

    def _followed(self, lead: Callable[[], T], follow: Callable[[Any], object]) -> T | None:
        """Run `lead` on rank 0, while the others follow all that it tells, to its end; collective."""
        if self.world.rank > 0:
            with abort_all(self.world):
                while (told := self.told())[1]:
                    follow(told[0])
            if told[0] is not None:
                raise told[0]
            return None
        ended = None
        try:
            return lead()
        except Exception as error:
            ended = _told_to_others(error)
            raise
        finally:
            self.told(ended, more=False)

    def told(self, order: object = None, *, more: bool = True) -> tuple[Any, bool]:
        """Return what rank 0 says, for which the others may wait long, and whether it says more; collective."""
        gather_here(self.world)
        told: tuple[Any, bool] = self.world.bcast((order, more))
        return told


def _told_to_others(error: Exception) -> Exception:
    """Return an exception as it can be sent to other ranks."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return StopError(str(error))
    return error


@dataclass(frozen=True)
class _Order:
    """A request sent to all ranks: largest number of blocks, those still to be computed, and their keys."""

    request: Request
    blocks: int
    pending: tuple[int, ...]
    keys: tuple[str, ...]


class _Models:
    """The models of this group, each made when first needed; making one is collective over the group.

    Of those that are passing only the last one is kept; one that is needed again is made again.
    """

    def __init__(
        self, first: ForwardModel, others: Mapping[str, Callable[[], ForwardModel]], passing: frozenset[str]
    ) -> None:
        self._makers, self._passing = others, passing
        self._made = {OWN: first}

    def __getitem__(self, name: str) -> ForwardModel:
        if name not in self._made:
            if name in self._passing:
                self._made = {other: model for other, model in self._made.items() if other not in self._passing}
                gc.collect()  # on all ranks of the group at once: freeing a factor is collective
            self._made[name] = self._makers[name]()
        return self._made[name]


@dataclass(frozen=True)
class EnsembleEvaluate(OfModel):
    """The evaluation that a method sees on rank 0, of one of the models."""

    worker: _Worker
    name: str
    progress: Progress
    blocks: int = BLOCKS
    volumes: Callable[[], FloatArray | None] = lambda: None

    @property
    def model(self) -> ForwardModel:
        """The model, in the group of rank 0."""
        return self.worker.models[self.name]

    @property
    def node_volumes(self) -> FloatArray | None:
        """Share (n_nodes,) of the body that each node of the first model represents, see `Evaluate`."""
        return self.volumes() if self.name == OWN else None

    def on(self, model: str) -> EnsembleEvaluate:
        """Return the evaluation of another model; all groups make it now."""
        self.worker.prepare(model)
        return replace(self, name=model)

    @property
    def spent(self) -> float:
        """Processor time (s) of evaluations of all models so far, on this rank."""
        return self.worker.spent

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request on all groups; blocks on disk are read."""
        begin = time.process_time()
        try:
            return self._evaluated(request)
        finally:
            self.worker.spent += time.process_time() - begin

    def _evaluated(self, request: Request) -> Evaluations:
        request = request.of(self.model, self.name)
        blocks = request.blocks(self.blocks)
        checkpoint = self.worker.checkpoint
        keys = tuple(checkpoint.key(block) for block in blocks) if checkpoint else ()
        kept = {i: key for i, key in enumerate(keys) if checkpoint and checkpoint.has(key)}
        merger, early = Merger(request.fields), dict[int, Evaluations]()

        def receive(index: int, block: Evaluations) -> None:
            early[index] = block
            add_in_order()

        def add_in_order() -> None:
            while (i := merger.count) in early or i in kept:
                if i in kept:
                    assert checkpoint is not None
                    block = checkpoint.read(kept.pop(i))
                    self.progress(len(block.points), len(block.failures))
                else:
                    block = early.pop(i)
                merger.add(block)

        pending = tuple(i for i in range(len(blocks)) if i not in kept)
        add_in_order()
        if pending:
            self.progress(0, 0)
            self.worker.dispatch(_Order(request, self.blocks, pending, keys), receive, self.progress)
        assert merger.count == len(blocks)
        return merger.result()


class _Worker:
    """The part of every rank in an order."""

    def __init__(self, ensemble: Ensemble, models: _Models, checkpoint: Checkpoint | None, turns: WorkQueue) -> None:
        self._ensemble = ensemble
        self.models = models
        self.checkpoint = checkpoint
        self._turns = turns
        self._saved = -np.inf  # when a block was last written
        self.spent = 0.0  # processor time (s) of evaluations

    def prepare(self, model: str) -> None:
        """Rank 0: have all groups make a model, this one too."""
        with abort_all(self._ensemble.world), phase(f"making {model}"):
            self._ensemble.told((model, None))
            self.models[model]

    def dispatch(self, order: _Order, receive: Callable[[int, Evaluations], None], progress: Progress) -> None:
        """Rank 0: send an order to all ranks, work on it too, and receive the blocks of the others."""

        def own_progress(done: int, failed: int) -> None:
            progress(done, failed)
            self._turns.drain()

        def accept(i: int, block: Evaluations, theirs: bool) -> None:
            if theirs:
                progress(len(block.points), len(block.failures))
            receive(i, block)

        with abort_all(self._ensemble.world), phase(f"solving {order.request.model}".rstrip()):
            self._ensemble.told((order.request.model, order))
            self._turns.lead(order.pending, self._solving(order, own_progress), accept)

    def work(self, told: tuple[str, _Order | None]) -> None:
        """Compute blocks of an order until none is left, and send them to rank 0; without one, make a model by name."""
        name, order = told
        if order is None:
            self.models[name]
        else:
            self._turns.follow(order.pending, self._solving(order, lambda done, failed: None))

    def _solving(self, order: _Order, progress: Progress) -> Callable[[int], Evaluations]:
        """Return the function that solves a block of an order, and keeps it."""
        blocks = order.request.blocks(order.blocks)
        solvers: list[BlockSolver] = []  # made for the first block that this group takes

        def solve(i: int) -> Evaluations:
            if not solvers:
                solvers.append(BlockSolver(self.models[order.request.model], order.request))
            begin = time.monotonic()
            block = solvers[0](blocks[i].points, progress)
            now = time.monotonic()
            worth = now - begin > CHEAP or now - self._saved > SELDOM
            if self.checkpoint is not None and self._ensemble.group.rank == 0 and worth:
                self.checkpoint.save(order.keys[i], block)
                self._saved = now
            return block

        return solve
