"""Groups of ranks that evaluate blocks of points side by side.

Rank 0 runs the method; the other ranks serve its requests. A group (the ranks that share one model) takes the next
block from a counter in rank 0's memory (an MPI window), so that no one waits for a slow neighbour. Which group computes
a block decides nothing: blocks are added in their order.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
from mpi4py import MPI

from forward.machine import StopError, reason_to_stop
from forward.model import FloatArray, ForwardModel, ModelError, SolveError
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.evaluate import BLOCKS, BlockSolver, Evaluations, Merger, Request

T = TypeVar("T")
Arrived = Callable[[Evaluations, bool], None]
CHEAP = 1e-3  # seconds below which a block is found sooner than its file is written and read again,
SELDOM = 0.1  # so that a file of such blocks is written only so often (s)
_RESULT = 1
SECONDS_FOR_OTHERS = 5.0  # in which ranks that fail alike come together
SECONDS_BETWEEN_COUNTS = 1.0  # of other groups' solves, while waiting for their blocks


def _unseen(done: int, failed: int) -> None:
    """Progress of what is no solve."""


class Ensemble:
    """A world of ranks, split into groups that share a model.

    Attributes
    ----------
    world
        All ranks (a duplicate of what was given).
    group
        This rank's group: the communicator of its model.
    groups
        Number of groups.
    """

    def __init__(self, world: Any, group: Any, groups: int, index: int) -> None:
        self.world = world
        self.group = group
        self.groups = groups
        self.index = index
        self._counted: Callable[[int, int], None] = lambda done, failed: None

    def count(self, done: int, failed: int) -> None:
        """Count solves of this group that are no points of a request: rank 0 hears of them, while a task runs."""
        if self.group.rank == 0:
            self._counted(done, failed)

    @classmethod
    def split(cls, world: Any, ranks_per_model: int = 1) -> Ensemble:
        """Split `world` into groups of neighbouring ranks; collective.

        Raises
        ------
        ValueError
            If the number of ranks is not a multiple of `ranks_per_model`.
        """
        if world.size % ranks_per_model:
            message = f"{world.size} ranks cannot be split into groups of ranks_per_model = {ranks_per_model}"
            raise ValueError(message)
        index = world.rank // ranks_per_model
        return cls(world.Dup(), world.Split(index, world.rank), world.size // ranks_per_model, index)

    def together(self, make: Callable[[], T]) -> T:
        """Return what all ranks make; what is raised on one of them is raised on all; collective.

        A rank that fails alone, while the others wait for it inside what they make, ends the job.
        """
        found, error = None, None
        try:
            found = make()
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
        return cast("T", found)

    def run(
        self,
        model: ForwardModel,
        task: Callable[[EnsembleEvaluate], T],
        *,
        others: Sequence[Callable[[], ForwardModel]] = (),
        checkpoint: Checkpoint | None = None,
        progress: Callable[[int, int], None] = lambda done, failed: None,
        blocks: int = BLOCKS,
        arrived: Arrived = lambda block, kept: None,
        counted: bool = True,
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
            Make this group's models number 1, 2, … (`Evaluate.on`), each when it is first asked for.
        checkpoint
            Where finished blocks are kept and found.
        progress
            On rank 0: told the numbers of points that were done and that failed since it was last told.
        blocks
            Most blocks that an evaluation is cut into.
        arrived
            On rank 0: told of each finished block of model number 0 as soon as it is there, in any order, and whether
            it was on disk.
        counted
            Whether a point of a request is a solve; if not, models count theirs, see `count`.
        node_volumes
            On rank 0: those of model number 0, see `Evaluate`.

        Returns
        -------
        object
            What the task returned, on rank 0; nothing on the other ranks.
        """
        with _counter(self.world) as counter, _counter(self.world) as solves, _counter(self.world) as failures:
            worker = _Worker(self, _Models(model, others), checkpoint, counter)
            tally = _Tally(solves, failures, progress if self.world.rank == 0 else None)

            def count(done: int, failed: int) -> None:
                tally(done, failed)
                worker.pulse()

            self._counted = count
            if self.world.rank > 0:
                with _abort_all(self.world):
                    while (order := self.world.bcast(None)) is not None:
                        worker.work(order)
                return None
            try:
                told = progress if counted else _unseen
                return task(EnsembleEvaluate(worker, 0, told, blocks, arrived, node_volumes))
            finally:
                self.world.bcast(None)


@dataclass(frozen=True)
class _Order:
    """A request on its way to all ranks: most blocks, those that are still to be computed, and where each is kept."""

    request: Request
    blocks: int
    pending: tuple[int, ...]
    keys: tuple[str, ...]


class _Models:
    """The models of this group, each made when it is first asked for; making one is collective over the group."""

    def __init__(self, first: ForwardModel, others: Sequence[Callable[[], ForwardModel]]) -> None:
        self._makers = others
        self._made = {0: first}

    def __getitem__(self, number: int) -> ForwardModel:
        if number not in self._made:
            self._made[number] = self._makers[number - 1]()
        return self._made[number]


@dataclass(frozen=True)
class EnsembleEvaluate:
    """The evaluation that a method sees on rank 0, of one of the models."""

    worker: _Worker
    number: int
    progress: Callable[[int, int], None]
    blocks: int = BLOCKS
    arrived: Arrived = lambda block, kept: None
    volumes: Callable[[], FloatArray | None] = lambda: None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.worker.models[self.number].parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.worker.models[self.number].outputs

    @property
    def differentiable(self) -> bool:
        """Whether solutions have derivatives."""
        return self.worker.models[self.number].differentiable

    @property
    def displacements(self) -> int:
        """Number of displacements at the head of a state."""
        return self.worker.models[self.number].displacements

    @property
    def node_volumes(self) -> FloatArray | None:
        """Share (n_nodes,) of the body that each node of model number 0 stands for, see `Evaluate`."""
        return self.volumes() if self.number == 0 else None

    def on(self, model: int) -> EnsembleEvaluate:
        """Return the evaluation of another of the models; all groups make it now."""
        self.worker.prepare(model)
        return replace(self, number=model)

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request on all groups; blocks that are on disk are read."""
        request = replace(request, model=self.number)
        blocks = request.blocks(self.blocks)
        checkpoint = self.worker.checkpoint
        keys = tuple(checkpoint.key(block) for block in blocks) if checkpoint else ()
        kept = {i: key for i, key in enumerate(keys) if checkpoint and checkpoint.has(key)}
        pending = tuple(i for i in range(len(blocks)) if i not in kept)
        merger, early = Merger(request.fields), dict[int, Evaluations]()

        def receive(index: int, block: Evaluations) -> None:
            if self.number == 0:
                self.arrived(block, False)
            early[index] = block
            add_in_order()

        def add_in_order() -> None:
            while (i := merger.count) in early or i in kept:
                block = early.pop(i, None)
                if block is None:
                    assert checkpoint is not None
                    block = checkpoint.load(kept[i])
                    self.progress(len(block.points), len(block.failures))
                    if self.number == 0:
                        self.arrived(block, True)
                merger.add(block)

        add_in_order()
        if pending:
            self.worker.dispatch(_Order(request, self.blocks, pending, keys), receive, self.progress)
        assert merger.count == len(blocks)
        return merger.result()


class _Worker:
    """What every rank does with an order."""

    def __init__(self, ensemble: Ensemble, models: _Models, checkpoint: Checkpoint | None, counter: _Counter) -> None:
        self._ensemble = ensemble
        self.models = models
        self.checkpoint = checkpoint
        self._counter = counter
        self._saved = -np.inf  # when a block was last written
        self.pulse: Callable[[], None] = lambda: None  # on rank 0: receive what is there

    def prepare(self, model: int) -> None:
        """Rank 0: have all groups make a model, this one too."""
        with _abort_all(self._ensemble.world):
            self._ensemble.world.bcast(model)
            self.models[model]

    def dispatch(
        self, order: _Order, receive: Callable[[int, Evaluations], None], progress: Callable[[int, int], None]
    ) -> None:
        """Rank 0: send an order to all ranks, work on it too, and receive the blocks of the others."""
        with _abort_all(self._ensemble.world):
            self._dispatch(order, receive, progress)

    def _dispatch(
        self, order: _Order, receive: Callable[[int, Evaluations], None], progress: Callable[[int, int], None]
    ) -> None:
        world = self._ensemble.world
        self._counter.reset()
        world.bcast(order)
        missing = set(order.pending)

        def accept(i: int, block: Evaluations) -> None:
            missing.discard(i)
            receive(i, block)

        def drain() -> None:
            while world.iprobe(tag=_RESULT):
                i, block = world.recv(tag=_RESULT)
                progress(len(block.points), len(block.failures))
                accept(i, block)

        def own_progress(done: int, failed: int) -> None:
            progress(done, failed)
            drain()

        self.pulse = drain
        for i, block in self._blocks(order, own_progress):
            accept(i, block)
        heard = time.monotonic()
        while missing:
            # Waiting as `recv` does, but other groups' solves go on being counted.
            while not world.iprobe(tag=_RESULT):
                time.sleep(0)
                if time.monotonic() > heard + SECONDS_BETWEEN_COUNTS:
                    self._ensemble.count(0, 0)
                    heard = time.monotonic()
            i, block = world.recv(tag=_RESULT)
            progress(len(block.points), len(block.failures))
            accept(i, block)
        # Only when everyone has seen that no turn is left may the counter start again for the next order.
        world.barrier()
        self._ensemble.count(0, 0)

    def work(self, order: _Order | int) -> None:
        """Compute blocks of an order until none is left, and send them to rank 0; or make a model, by its number."""
        world, sent = self._ensemble.world, []
        if isinstance(order, int):
            self.models[order]
            return
        for result in self._blocks(order, lambda done, failed: None):
            if self._ensemble.group.rank == 0 and self._ensemble.index > 0:
                sent.append(world.isend(result, dest=0, tag=_RESULT))
                sent = [request for request in sent if not request.test()[0]]
        for request in sent:
            request.wait()
        world.barrier()

    def _blocks(self, order: _Order, progress: Callable[[int, int], None]) -> Iterator[tuple[int, Evaluations]]:
        group = self._ensemble.group
        blocks = order.request.blocks(order.blocks)
        solver: BlockSolver | None = None
        while True:
            turn = self._counter.take() if group.rank == 0 else 0
            if group.size > 1:
                turn = group.bcast(turn)
            if turn >= len(order.pending):
                return
            solver = solver or BlockSolver(self.models[order.request.model], order.request)
            i = order.pending[turn]
            begin = time.monotonic()
            block = solver(blocks[i].points, progress)
            now = time.monotonic()
            worth = now - begin > CHEAP or now - self._saved > SELDOM
            if self.checkpoint is not None and group.rank == 0 and worth:
                self.checkpoint.save(order.keys[i], block)
                self._saved = now
            yield i, block


class _Counter:
    """A number in rank 0's memory that any rank can read and raise in one step."""

    def __init__(self, world: Any) -> None:
        self._world = world
        size = MPI.INT64_T.Get_size()
        self._window = MPI.Win.Allocate(size if world.rank == 0 else 0, size, comm=world)
        if world.rank == 0:
            self.reset()  # what the memory held before is anything
        world.barrier()

    def reset(self) -> None:
        """Start from zero again (rank 0, while no one takes)."""
        zero = np.zeros(1, dtype=np.int64)
        self._window.Lock(0, MPI.LOCK_EXCLUSIVE)
        self._window.Put(zero, 0)
        self._window.Unlock(0)

    def take(self) -> int:
        """Return the number and raise it by one."""
        return self.add(1)

    def add(self, count: int) -> int:
        """Raise the number by a count, and return what it was before."""
        value = np.empty(1, dtype=np.int64)
        self._window.Lock(0, MPI.LOCK_SHARED)
        self._window.Fetch_and_op(np.array([count], dtype=np.int64), value, 0, op=MPI.SUM)
        self._window.Unlock(0)
        return int(value[0])

    def free(self) -> None:
        """Give the window back; collective."""
        self._window.Free()


class _Tally:
    """Solves of all groups, in rank 0's memory; rank 0 tells its progress what the others have added."""

    def __init__(self, solves: _Counter, failures: _Counter, progress: Callable[[int, int], None] | None) -> None:
        self._counters = solves, failures
        self._progress = progress
        self._told = [0, 0]

    def __call__(self, done: int, failed: int) -> None:
        """Count solves of this group."""
        now = [counter.add(count) + count for counter, count in zip(self._counters, (done, failed), strict=True)]
        if self._progress is not None:
            new, self._told = [a - b for a, b in zip(now, self._told, strict=True)], now
            self._progress(*new)


@contextmanager
def _counter(world: Any) -> Iterator[_Counter]:
    counter = _Counter(world)
    try:
        yield counter
    finally:
        counter.free()


@contextmanager
def _abort_all(world: Any) -> Iterator[None]:
    """An exception that only one rank knows of would leave the others waiting for ever: print it and stop them all."""
    try:
        yield
    except BaseException as error:
        if world.size == 1:
            raise
        end_job(world, error)
        raise


def end_job(world: Any, error: BaseException) -> None:
    """End the job of all ranks with exit code 1 for an exception of this rank, in one line where it has a reason."""
    reason = str(error) if isinstance(error, ModelError | SolveError) else reason_to_stop(error)
    # Where all ranks fail alike, the first one to speak ends the others.
    time.sleep(min(0.1 * world.rank, 1.0))
    if reason is None:
        traceback.print_exception(error)
    else:
        sys.stderr.write(f"{'' if isinstance(error, KeyboardInterrupt) else 'failed: '}{reason}\n")
    sys.stderr.flush()
    world.Abort(1)
