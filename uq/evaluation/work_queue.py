"""Numbered pieces of work that rank groups take as they become free; rank 0 receives the results.

A group takes the next piece from a counter in rank 0's memory (an MPI window), so that none waits for a slow one.
Rank 0 works too, and receives the results of others meanwhile.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from forward.machine import StopError, reason_to_stop
from forward.model import ModelError, SolveError

T = TypeVar("T")
# Told how many solves finished, and failed, since the last call; none and none: what follows has other costs.
Progress = Callable[[int, int], None]
_RESULT, _END = 1, 2  # tags: of results, and of a rank that ends the job
SHORTEST, SHARE, LONGEST = 1e-5, 1.1, 0.01  # pauses (s) while waiting: about a tenth of what one has waited
SECONDS_BETWEEN_COUNTS = 1.0  # of other groups' solves, while waiting for their results


class WorkQueue:
    """The turns of the rank groups of one world; making and using it is collective.

    Parameters
    ----------
    world, group, index
        All ranks, those of this rank's group, and the number of that group.
    progress
        On rank 0: told the counts of all groups.
    """

    def __init__(self, world: Any, group: Any, index: int, progress: Progress, counters: Sequence[Counter]) -> None:
        self._world, self._group, self._index = world, group, index
        self._progress = progress
        self._turn, *self._counters = counters
        self._told = [0, 0]  # solves of all groups, and those that failed, of which the progress knows
        self.drain: Callable[[], None] = lambda: None  # on rank 0: receive the results that have arrived

    @classmethod
    @contextmanager
    def of(cls, world: Any, group: Any, index: int, progress: Progress) -> Iterator[WorkQueue]:
        """Make the counters, and free them at the end; collective."""
        with Counter(world) as turn, Counter(world) as solves, Counter(world) as failures:
            yield cls(world, group, index, progress, (turn, solves, failures))

    def count(self, done: int, failed: int) -> None:
        """Count solves on the first rank of a group; rank 0 is told at its own next count."""
        if self._group.rank > 0:
            return
        now = [counter.add(count) + count for counter, count in zip(self._counters, (done, failed), strict=True)]
        if self._world.rank == 0:
            new, self._told = [a - b for a, b in zip(now, self._told, strict=True)], now
            self._progress(*new)
        self.drain()

    def lead(self, pending: Sequence[int], work: Callable[[int], T], receive: Callable[[int, T, bool], None]) -> None:
        """Rank 0: work on pieces until all are finished, here or elsewhere.

        Parameters
        ----------
        pending
            Numbers of the pieces.
        work
            Computes the result of a piece; collective over the group.
        receive
            Takes a number, its result, and whether another group computed it; in any order.
        """
        world, missing = self._world, set(pending)

        def accept(i: int, found: T, *, theirs: bool) -> None:
            missing.discard(i)
            receive(i, found, theirs)

        def drain() -> None:
            while world.iprobe(tag=_RESULT):
                accept(*world.recv(tag=_RESULT), theirs=True)

        self.drain = drain
        self._turn.reset()
        world.barrier()  # until turns start again: nobody takes one before
        for i, found in self._taken(pending, work):
            accept(i, found, theirs=False)
        heard = time.monotonic()
        while missing:
            # Waits as `recv` does, but keeps counting other groups' solves; what arrives while it counts is received.
            drain()
            time.sleep(0)
            if time.monotonic() > heard + SECONDS_BETWEEN_COUNTS:
                self.count(0, 0)
                heard = time.monotonic()
        world.barrier()  # until every rank has seen that no turn is left
        self.count(0, 0)

    def follow(self, pending: Sequence[int], work: Callable[[int], T]) -> None:
        """Other ranks: work on pieces until none is left, and send the results to rank 0.

        A piece taken before turns start again would be taken twice, and nobody would receive its second result.
        """
        sent: list[Any] = []
        self._world.barrier()
        for result in self._taken(pending, work):
            if self._group.rank == 0 and self._index > 0:
                sent.append(self._world.isend(result, dest=0, tag=_RESULT))
                sent = [request for request in sent if not request.test()[0]]
        for request in sent:
            request.wait()
        self._world.barrier()

    def _taken(self, pending: Sequence[int], work: Callable[[int], T]) -> Iterator[tuple[int, T]]:
        """Take pieces until none is left."""
        group = self._group
        while True:
            turn = self._turn.add(1) if group.rank == 0 else 0
            if group.size > 1:
                turn = group.bcast(turn)
            if turn >= len(pending):
                return
            yield pending[turn], work(pending[turn])


class Counter:
    """A number in rank 0's memory that any rank can read and increase atomically; begun and left by all at once."""

    def __init__(self, world: Any) -> None:
        self._world = world
        size = MPI.INT64_T.Get_size()
        try:
            self._window = MPI.Win.Allocate(size if world.rank == 0 else 0, size, comm=world)
        except MPI.Exception as error:
            message = (
                f"MPI has no memory that these nodes share a counter in ({error}): docs/clusters.md says what helps"
            )
            raise StopError(message) from None
        if world.rank == 0:
            self.reset()  # the memory is not initialised
        world.barrier()

    def reset(self) -> None:
        """Start from zero again (on rank 0, while no rank takes a number)."""
        zero = np.zeros(1, dtype=np.int64)
        self._window.Lock(0, MPI.LOCK_EXCLUSIVE)
        self._window.Put(zero, 0)
        self._window.Unlock(0)

    def add(self, count: int) -> int:
        """Increase the number by a count, and return the previous one."""
        value = np.empty(1, dtype=np.int64)
        self._window.Lock(0, MPI.LOCK_SHARED)
        self._window.Fetch_and_op(np.array([count], dtype=np.int64), value, 0, op=MPI.SUM)
        self._window.Unlock(0)
        return int(value[0])

    def __enter__(self) -> Counter:
        return self

    def __exit__(self, *_: object) -> None:
        self._window.Free()


@contextmanager
def alone(world: Any) -> Iterator[None]:
    """Let one rank end its work; the others, which have none, sleep meanwhile; collective."""
    try:
        yield
    finally:
        gather_here(world)


def gather_here(world: Any) -> None:
    """Return once all ranks are here; who waits for long sleeps, where MPI would poll on a core; collective."""
    if world.size == 1:
        return
    here, pause = world.Ibarrier(), 0.0
    while not here.Test():
        time.sleep(pause)
        pause = min(SHARE * pause + SHORTEST, LONGEST)


@contextmanager
def abort_all(world: Any) -> Iterator[None]:
    """Print an exception that only one rank knows of, and stop all ranks: the others would wait forever."""
    try:
        yield
    except BaseException as error:
        if world.size == 1:
            raise
        end_job(world, error)
        raise


def end_job(world: Any, error: BaseException) -> None:
    """End the job of all ranks with exit code 1 for an exception of this rank, in one line if it has a reason.

    The others are told first, so that of ranks that fail in the same way one says so.
    """
    reason = str(error) if isinstance(error, ModelError | SolveError) else reason_to_stop(error)
    time.sleep(min(0.1 * world.rank, 1.0))
    if not is_ending():
        told = [MPI.COMM_WORLD.isend(None, rank, _END) for rank in range(MPI.COMM_WORLD.size)]
        if reason is None:
            traceback.print_exception(error)
        else:
            sys.stderr.write(f"{'' if isinstance(error, KeyboardInterrupt) else 'failed: '}{reason}\n")
        sys.stderr.flush()
        MPI.Request.Testall(told)
    world.Abort(1)


def is_ending() -> bool:
    """Whether a rank has said that it ends the job."""
    return bool(MPI.COMM_WORLD.iprobe(MPI.ANY_SOURCE, _END))
